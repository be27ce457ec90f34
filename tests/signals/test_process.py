"""Signals: one linear filter for both sides, exact derivatives, honest masks, delays put right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.logs.reader import read_measurements
from robot_sysid.records import Measurement
from robot_sysid.signals.cutoff import choose_cutoff
from robot_sysid.signals.differences import REACH, advanced, first_derivative, second_derivative
from robot_sysid.signals.low_pass import Thinner, design_low_pass
from robot_sysid.signals.process import (
    LARGEST_SLOW_SHARE,
    SignalOptions,
    delay_columns,
    process,
    with_delay,
)
from robot_sysid.signals.resampling import is_even, resampled
from tests.support.places import DATA

FREQUENCIES = np.array([0.13, 0.29, 0.43, 0.59])


class Swing:
    """Sums of sines with exact derivatives, three joints."""

    def __init__(self, seed: int = 0, frequencies: np.ndarray = FREQUENCIES) -> None:
        rng = np.random.default_rng(seed)
        self.omega = 2.0 * np.pi * frequencies
        self.amplitude = rng.uniform(0.1, 0.4, (len(frequencies), 3))
        self.phase = rng.uniform(0.0, 6.0, (len(frequencies), 3))

    def q(self, time: np.ndarray, order: int = 0) -> np.ndarray:
        """The derivative of this order (N, 3)."""
        angle = time[:, None, None] * self.omega[:, None] + self.phase + order * np.pi / 2.0
        return np.sum(self.amplitude * self.omega[:, None] ** order * np.sin(angle), axis=1)

    def measured(self, time: np.ndarray, resolution: float = 0.0) -> Measurement:
        """A log whose torque is 2 q + 3 qd + 0.5 qdd."""
        q = self.q(time)
        seen = np.round(q / resolution) * resolution if resolution else q
        return Measurement(time, seen, None, self.tau(time))

    def tau(self, time: np.ndarray) -> np.ndarray:
        """Torque at any time (N, 3)."""
        return 2.0 * self.q(time) + 3.0 * self.q(time, 1) + 0.5 * self.q(time, 2)


def seconds(duration: float, rate: float) -> np.ndarray:
    return np.arange(round(duration * rate) + 1) / rate


def root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


# ---- the low-pass


@settings(max_examples=100)
@given(st.floats(1.0, 60.0), st.lists(st.integers(1, 90), min_size=1, max_size=12), st.integers(0))
def test_chunks_of_any_size_give_the_same_thinned_samples(cutoff, sizes, seed):
    low_pass = design_low_pass(cutoff, 200.0)
    values = np.random.default_rng(seed).normal(size=(sum(sizes) + 500, 2, 3))
    stream = Thinner(low_pass)
    cuts = [0, *np.cumsum(sizes), len(values)]
    pieces = [stream.push(values[a:b]) for a, b in zip(cuts, cuts[1:])]
    np.testing.assert_array_equal(np.concatenate(pieces), low_pass.thinned(values))
    every = low_pass.filtered(values)[:: low_pass.step]
    np.testing.assert_allclose(low_pass.thinned(values), every, rtol=0.0, atol=1e-12)
    assert len(low_pass.centres(len(values))) == len(every)


@settings(max_examples=100)
@given(st.floats(1.0, 60.0), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_a_straight_line_passes_unchanged(cutoff, start, slope):
    low_pass = design_low_pass(cutoff, 200.0)
    line = start + slope * seconds(5.0, 200.0)
    inner = line[low_pass.half_width : len(line) - low_pass.half_width]
    np.testing.assert_allclose(low_pass.filtered(line), inner, rtol=0.0, atol=1e-11)


@settings(max_examples=100)
@given(st.integers(0, 2**32), st.floats(2.0, 60.0))
def test_an_equation_survives_the_filter(seed, cutoff):
    """Y theta = tau stays exact when rows and torque pass the same filter."""
    rng = np.random.default_rng(seed)
    rows, theta = rng.normal(size=(700, 4)), rng.normal(size=4)
    low_pass = design_low_pass(cutoff, 200.0)
    both = low_pass.thinned(rows) @ theta - low_pass.thinned(rows @ theta)
    assert np.max(np.abs(both)) < 1e-12


@settings(max_examples=100)
@given(st.floats(1.0, 60.0), st.floats(0.0, 1.0), st.floats(0.0, 6.0))
def test_pass_band_and_stop_band_keep_their_promise(cutoff, where, phase):
    rate = 200.0
    low_pass = design_low_pass(cutoff, rate)
    time = seconds(12.0, rate)
    half = low_pass.half_width
    slow = np.sin(2.0 * np.pi * 0.4 * cutoff * where * time + phase)
    assert np.max(np.abs(low_pass.filtered(slow) - slow[half : len(slow) - half])) < 1e-4
    stop = 1.6 * cutoff + where * max(0.0, 0.49 * rate - 1.6 * cutoff)
    assert np.max(np.abs(low_pass.filtered(np.sin(2.0 * np.pi * stop * time + phase)))) < 1e-4


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 61.0, np.nan])
def test_a_cutoff_outside_the_sample_rate_is_refused(cutoff):
    with pytest.raises(InputError, match="between 0 and 60 Hz"):
        design_low_pass(cutoff, 200.0)


# ---- derivatives and shifts


@settings(max_examples=100)
@given(st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9))
def test_derivatives_are_exact_for_polynomials_of_order_eight(coefficients):
    polynomial = np.polynomial.Polynomial(coefficients)
    time = seconds(2.0, 20.0) - 1.0
    inner = time[REACH:-REACH]
    for function, order in ((first_derivative, 1), (second_derivative, 2)):
        expected = polynomial.deriv(order)(inner)
        np.testing.assert_allclose(function(polynomial(time), 20.0), expected, atol=2e-9)


@settings(max_examples=100)
@given(st.floats(-40.0, 40.0), st.integers(0, 1000))
def test_a_shift_evaluates_the_signal_at_later_instants(samples, seed):
    swing, rate = Swing(seed, np.array([1.0, 7.0, 23.0])), 100.0
    time = seconds(6.0, rate)
    shifted, first = advanced(swing.q(time), samples)
    expected = swing.q(time[first : first + len(shifted)] + samples / rate)
    np.testing.assert_allclose(shifted, expected, rtol=0.0, atol=2e-5)


@settings(max_examples=100)
@given(st.integers(-50, 50), st.integers(0, 2**32))
def test_whole_samples_are_shifted_without_loss(samples, seed):
    noise = np.random.default_rng(seed).normal(size=300)
    shifted, first = advanced(noise, float(samples))
    start = first + samples
    np.testing.assert_allclose(shifted, noise[start : start + len(shifted)], atol=1e-14)


# ---- the uniform grid


def test_an_even_log_is_taken_as_it_is():
    log = Swing().measured(5.0 + seconds(3.0, 200.0))
    uniform = resampled(log)
    np.testing.assert_array_equal(uniform.q, log.q)
    assert (uniform.start, uniform.notes, np.max(uniform.gap)) == (5.0, (), 0.0)
    assert abs(uniform.rate - 200.0) < 1e-9


def test_time_stamps_rounded_to_milliseconds_are_still_even():
    assert is_even(np.round(seconds(3.0, 333.0), 3))
    assert not is_even(seconds(3.0, 333.0) + 1e-3 * np.sin(np.arange(1000)))


@settings(max_examples=100)
@given(st.integers(0, 2**32), st.floats(0.05, 0.4))
def test_uneven_samples_are_put_where_they_belong(seed, jitter):
    rng = np.random.default_rng(seed)
    swing, rate = Swing(seed), 200.0
    even = seconds(4.0, rate)
    time = even + rng.uniform(-jitter, jitter, len(even)) / rate
    uniform = resampled(swing.measured(time))
    grid = uniform.start + np.arange(len(uniform.q)) / uniform.rate
    np.testing.assert_allclose(uniform.q, swing.q(grid), rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(uniform.tau, swing.tau(grid), rtol=0.0, atol=1e-6)


def test_each_joint_is_read_at_its_own_time():
    swing, rate = Swing(), 250.0
    time = seconds(4.0, rate)
    own = time[:, None] + np.array([0.2e-3, 0.9e-3, 1.8e-3])
    q = np.column_stack([swing.q(own[:, j])[:, j] for j in range(3)])
    tau = np.column_stack([swing.tau(own[:, j])[:, j] for j in range(3)])
    uniform = resampled(Measurement(time, q, None, tau, joint_time=own))
    grid = uniform.start + np.arange(len(uniform.q)) / uniform.rate
    np.testing.assert_allclose(uniform.q, swing.q(grid), rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(uniform.tau, swing.tau(grid), rtol=0.0, atol=1e-6)
    assert "own time stamps" in uniform.notes[0]


# ---- the cut-off


@settings(max_examples=100)
@given(st.integers(0, 2**32), st.sampled_from([200.0, 1000.0]), st.floats(-4.5, -3.0))
def test_the_noise_of_the_encoder_is_read_off_the_data(seed, rate, magnitude):
    sigma = 10.0**magnitude
    rng = np.random.default_rng(seed)
    q = Swing(seed).q(seconds(10.0, rate))
    choice = choose_cutoff(q + sigma * rng.normal(size=q.shape), rate)
    np.testing.assert_allclose(choice.position_noise, sigma, rtol=0.12)
    assert 1.4 < choice.cutoff < 25.0


def test_quantisation_counts_as_its_own_noise():
    resolution, time = 1e-4, seconds(15.0, 1000.0)
    choice = choose_cutoff(Swing().measured(time, resolution).q, 1000.0)
    np.testing.assert_allclose(choice.position_noise, resolution / np.sqrt(12.0), rtol=0.12)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32), st.floats(0.1, 10.0), st.floats(1.5, 30.0))
def test_the_cutoff_ignores_the_unit_and_falls_with_the_noise(seed, scale, factor):
    rng = np.random.default_rng(seed)
    q = Swing(seed).q(seconds(8.0, 50.0))
    noise = 1e-4 * rng.normal(size=q.shape)
    first = choose_cutoff(q + noise, 50.0).cutoff
    assert choose_cutoff(scale * (q + noise), 50.0).cutoff == pytest.approx(first, rel=1e-9)
    assert choose_cutoff(q + factor * noise, 50.0).cutoff <= first * 1.13


def test_a_fast_small_motion_beside_a_slow_large_one_is_kept():
    time = seconds(15.0, 1000.0)
    noise = 1e-5 * np.random.default_rng(0).normal(size=time.shape)
    q = 0.5 * np.sin(0.2 * np.pi * time) + 0.01 * np.sin(10.0 * np.pi * time) + noise
    assert choose_cutoff(q[:, None], 1000.0).cutoff > 12.5


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([1e-5, 1e-4, 1e-3]))
def test_steps_of_a_coarse_encoder_are_not_taken_for_motion(seed, resolution):
    """A joint that creeps over few steps has a spectrum of its own, far above any motion."""
    q = Swing(seed).q(seconds(15.0, 1000.0)) * [1.0, 0.03, 0.01]
    cutoff = choose_cutoff(np.round(q / resolution) * resolution, 1000.0).cutoff
    # The fastest sine has 0.59 Hz, seen with a resolution of about a quarter of a hertz.
    assert cutoff < 15.0 * 1.1


def test_a_stretch_too_short_for_a_spectrum_is_refused():
    with pytest.raises(InputError, match="--cutoff HZ"):
        choose_cutoff(np.zeros((20, 2)), 200.0)


# ---- the whole way


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([200.0, 400.0]))
def test_motion_of_a_quantised_log_is_recovered(seed, rate):
    """Acceleration within 1 % of its root mean square from a 1e-4 rad encoder."""
    swing = Swing(seed)
    signals = process(swing.measured(seconds(12.0, rate), 1e-4), SignalOptions())
    for order, limit in ((0, 3e-4), (1, 2e-3), (2, 1e-2)):
        true = swing.q(signals.time, order)
        got = (signals.q, signals.qd, signals.qdd)[order]
        assert root_mean_square(got - true) < limit * root_mean_square(true)
    np.testing.assert_array_equal(signals.tau.shape, signals.q.shape)
    np.testing.assert_allclose(signals.tau, swing.tau(signals.time), rtol=0.0, atol=1e-12)


def test_rows_and_masks_have_the_same_length_and_times():
    signals = process(Swing().measured(seconds(10.0, 200.0)), SignalOptions(cutoff=8.0))
    stream = signals.thinner()
    rows = np.concatenate([stream.push(tau) for _, tau in signals.chunks(37)])
    assert len(rows) == len(signals.usable()) == len(signals.thinned_time())
    true = Swing().tau(signals.thinned_time())
    np.testing.assert_allclose(rows, true, rtol=0.0, atol=1e-3)


@settings(max_examples=100, deadline=None)
@given(st.floats(0.0, 2.0), st.integers(0, 1000))
def test_rows_that_mix_in_too_many_slow_samples_are_masked_and_only_those(deadband, seed):
    """A row is a sum over a window; what counts is the window's weight on slow samples."""
    log = Swing(seed).measured(seconds(6.0, 100.0))
    signals = process(log, SignalOptions(cutoff=8.0, velocity_deadband=deadband))
    weight = np.abs(signals.low_pass.kernel) / np.sum(np.abs(signals.low_pass.kernel))
    half = signals.low_pass.half_width
    slow = np.abs(signals.qd) < deadband
    for row, centre in enumerate(signals.low_pass.centres(len(signals))):
        share = weight @ slow[centre - half : centre + half + 1]
        np.testing.assert_allclose(signals.slow_share()[row], share, rtol=0.0, atol=1e-12)
        np.testing.assert_array_equal(signals.usable()[row], share <= LARGEST_SLOW_SHARE)


def test_a_row_beside_a_reversal_is_masked_though_its_own_instant_is_fast():
    time = seconds(10.0, 200.0)
    q = np.sin(2.0 * np.pi * 0.2 * time)[:, None]
    log = Measurement(time, q, None, q + 1.0)
    signals = process(log, SignalOptions(cutoff=8.0, velocity_deadband=0.05))
    fast = np.abs(signals.qd[signals.low_pass.centres(len(signals))]) >= 0.05
    assert not np.any(signals.usable() & ~fast)
    beside = fast & ~signals.usable()
    assert 0 < np.sum(beside) <= 4 * 4


def test_a_joint_at_rest_is_masked_and_named():
    log = Swing().measured(seconds(10.0, 200.0), 1e-4)
    still = np.array(log.q)
    still[:, 1] = 0.3
    signals = process(replace(log, q=still), SignalOptions(cutoff=8.0), ("a", "b", "c"))
    assert not np.any(signals.usable()[:, 1])
    assert np.mean(signals.usable()[:, 0]) > 0.9
    assert any("only 0 % of the rows of joint b" in note for note in signals.notes)


def test_rows_over_a_long_hole_are_masked_and_short_holes_are_bridged():
    swing, time = Swing(), seconds(12.0, 200.0)
    keep = np.ones(len(time), dtype=bool)
    keep[400:404] = False
    keep[1600:1660] = False
    log = swing.measured(time[keep])
    options = SignalOptions(cutoff=8.0, velocity_deadband=0.0)
    signals = process(log, options)
    dropped = signals.thinned_time()[~np.all(signals.usable(), axis=1)]
    hole = (time[1600], time[1660])
    reach = (2 * signals.low_pass.half_width + REACH) / 200.0
    assert hole[0] - reach - 0.1 < dropped.min() < hole[0] < hole[1] < dropped.max()
    assert dropped.max() < hole[1] + reach + 0.1
    kept = np.repeat(np.all(signals.usable(), axis=1), signals.low_pass.step)[: len(signals)]
    error = np.abs(signals.qdd - swing.q(signals.time, 2))[: len(kept)][kept]
    assert np.max(error) < 1e-2


@settings(max_examples=100, deadline=None)
@given(st.floats(-0.01, 0.01), st.integers(0, 1000))
def test_an_injected_delay_is_estimated_and_put_right(delay, seed):
    """To 0.1 ms (five times the Cramer-Rao bound), with 0.4 % torque noise and a 1e-4 rad encoder.

    Stiffness and inertia are fitted at the same time.
    """
    swing, rng = Swing(seed), np.random.default_rng(seed)
    time = seconds(12.0, 200.0)
    late = 2.0 * swing.q(time - delay) + 0.5 * swing.q(time - delay, 2)
    late = late + 0.004 * root_mean_square(late) * rng.normal(size=late.shape)
    log = replace(swing.measured(time, 1e-4), tau=late)
    signals = process(log, SignalOptions(cutoff=6.0))
    found = 0.0
    for _ in range(3):
        found += _remaining_delay(with_delay(signals, found))
    assert abs(found - delay) < 1e-4


def _remaining_delay(signals) -> float:
    """Fit tau = a q + b qdd + delay (-d tau/dt) on the filtered equations."""
    columns = [signals.q, signals.qdd, delay_columns(signals)]
    rows = signals.low_pass.thinned(np.stack(columns, axis=-1))
    tau = signals.low_pass.thinned(signals.tau)
    solution = np.linalg.lstsq(rows.reshape(-1, 3), tau.reshape(-1), rcond=None)[0]
    return float(solution[2])


def test_a_delay_longer_than_the_log_is_refused():
    signals = process(Swing().measured(seconds(10.0, 200.0)), SignalOptions(cutoff=8.0))
    with pytest.raises(InputError, match="leaves nothing"):
        with_delay(signals, 9.5)


def test_a_log_too_short_for_its_cutoff_says_how_long_it_must_be():
    with pytest.raises(InputError, match=r"2 s are too short for a cut-off of 3 Hz, which needs"):
        process(Swing().measured(seconds(2.0, 200.0)), SignalOptions(cutoff=3.0))


@pytest.mark.parametrize(
    "options", [{"cutoff": 0.0}, {"cutoff": np.nan}, {"sample_rate": -1.0},
                {"velocity_deadband": -0.1}, {"velocity_deadband": np.inf}],
)  # fmt: skip
def test_options_out_of_range_are_refused(options):
    with pytest.raises(InputError, match="must"):
        SignalOptions(**options)


@pytest.mark.parametrize(
    ("name", "n_joints", "lowest", "highest"),
    [("tx40/tx40_500Hz.csv", 6, 10.0, 60.0), ("kuka_lwr4/lwr4_hw1_200Hz.csv", 7, 3.0, 12.0)],
)
def test_the_cutoff_of_real_logs_is_sensible(name, n_joints, lowest, highest):
    """Published identifications of these arms used 60 and 8 Hz."""
    if not (DATA / name).exists():
        pytest.skip("the logs of real arms are not here")
    log = read_measurements(DATA / name, [f"joint_{k}" for k in range(n_joints)])
    signals = process(log.load(), SignalOptions(), log.joint_names)
    assert lowest < signals.cutoff < highest
    assert np.all(np.isfinite(signals.qdd))
