"""Samples are put on a uniform grid where they belong, and holes are known as holes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from robot_sysid.records import Measurement
from robot_sysid.signals import resampling
from robot_sysid.signals.resampling import bounded, is_even, part_of, resampled
from tests.support.swing import Swing, seconds


def test_an_even_log_is_taken_as_it_is():
    log = Swing().measured(5.0 + seconds(3.0, 200.0))
    uniform = resampled(log)
    np.testing.assert_array_equal(uniform.q, log.q)
    assert (uniform.start, uniform.notes, np.max(uniform.gap)) == (5.0, (), 0.0)
    assert abs(uniform.rate - 200.0) < 1e-9


def test_time_stamps_rounded_to_milliseconds_are_still_even():
    assert is_even(np.round(seconds(3.0, 333.0), 3))
    assert not is_even(seconds(3.0, 333.0) + 1e-3 * np.sin(np.arange(1000)))


@given(st.integers(0, 2**32), st.floats(0.05, 0.4))
def test_uneven_samples_are_put_where_they_belong(seed, jitter):
    rng = np.random.default_rng(seed)
    swing = Swing(seed)
    rate = 200.0
    even = seconds(4.0, rate)
    time = even + rng.uniform(-jitter, jitter, len(even)) / rate
    uniform = resampled(swing.measured(time))
    grid = uniform.start + np.arange(len(uniform.q)) / uniform.rate
    np.testing.assert_allclose(uniform.q, swing.q(grid), rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(uniform.tau, swing.tau(grid), rtol=0.0, atol=1e-6)


def test_each_joint_is_read_at_its_own_time():
    swing = Swing()
    rate = 250.0
    time = seconds(4.0, rate)
    own = time[:, None] + np.array([0.2e-3, 0.9e-3, 1.8e-3])
    q = np.column_stack([swing.q(own[:, j])[:, j] for j in range(3)])
    tau = np.column_stack([swing.tau(own[:, j])[:, j] for j in range(3)])
    uniform = resampled(Measurement(time, q, None, tau, joint_time=own))
    grid = uniform.start + np.arange(len(uniform.q)) / uniform.rate
    np.testing.assert_allclose(uniform.q, swing.q(grid), rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(uniform.tau, swing.tau(grid), rtol=0.0, atol=1e-6)
    assert "own time stamps" in uniform.notes[0]


@given(st.integers(0, 2**32), st.integers(1, 40))
# Here the grid's instant on the hole's first edge is rounded into the hole.
@example(5494522, 28)
def test_a_hole_is_one_from_the_first_missing_sample_on(seed, missing):
    """Its length stands at every instant that is bridged, and nowhere else."""
    rng = np.random.default_rng(seed)
    rate = 200.0
    even = seconds(4.0, rate)
    first = int(rng.integers(50, 700))
    keep = np.ones(len(even), dtype=bool)
    keep[first : first + missing] = False
    uniform = resampled(Swing().measured(even[keep]))
    expected = np.where(keep, 0.0, (missing + 1) / rate)
    np.testing.assert_allclose(uniform.gap, expected, rtol=0.0, atol=1e-9)


@given(st.integers(0, 2**32))
def test_samples_that_come_early_and_late_leave_no_hole(seed):
    """Up to 1.7 periods apart."""
    rng = np.random.default_rng(seed)
    rate = 200.0
    even = seconds(4.0, rate)
    time = even + rng.uniform(-0.35, 0.35, len(even)) / rate
    uniform = resampled(Swing().measured(time))
    assert np.max(np.diff(time)) > 1.5 / rate
    np.testing.assert_array_equal(uniform.gap, 0.0)


@given(st.integers(0, 2**32), st.integers(1, 3), st.sampled_from([0.0, 1e-4]))
def test_rows_lost_from_coarse_time_stamps_leave_a_hole(seed, missing, resolution):
    """1 kHz in milliseconds: even up to the last digit of the stamps all the same."""
    rng = np.random.default_rng(seed)
    swing = Swing(seed)
    even = seconds(4.0, 1000.0)
    fast = np.flatnonzero(np.linalg.norm(swing.q(even, 1), axis=1) > 0.5)
    first = int(rng.choice(fast[(fast > 50) & (fast < 3900)]))
    keep = np.ones(len(even), dtype=bool)
    keep[first : first + missing] = False
    log = swing.measured(even[keep], resolution)
    uniform = resampled(log)
    assert len(uniform.q) == len(even) and abs(uniform.rate - 1000.0) < 1e-6
    np.testing.assert_allclose(
        uniform.q, swing.q(even), rtol=0.0, atol=1e-7 + 2.0 * resolution
    )
    np.testing.assert_allclose(
        uniform.gap, np.where(keep, 0.0, 1e-3 * (missing + 1)), atol=1e-9
    )
    assert "resampled to a uniform 1000 Hz" in uniform.notes[0]


@given(st.integers(0, 2**32), st.floats(999.0, 999.99))
def test_a_clock_that_is_a_little_slow_loses_no_rows(seed, rate):
    swing = Swing(seed)
    even = seconds(4.0, rate)
    log = replace(swing.measured(even), time=np.floor(1e3 * even + 0.3) / 1e3)
    uniform = resampled(log)
    np.testing.assert_array_equal(uniform.q, log.q)
    assert uniform.notes == ()


def test_a_long_simulated_run_is_thinned_as_a_log_is(monkeypatch):
    log = Swing().measured(seconds(8.0, 500.0))
    chunks = [part_of(log, start, start + 700) for start in range(0, len(log), 700)]
    (whole,), said = bounded(chunks, len(log))
    np.testing.assert_array_equal(whole.q, log.q)
    assert said == ()
    monkeypatch.setattr(resampling, "MOST_KEPT", 1000)
    (thinned,), said = bounded(chunks, len(log))
    assert 700 < len(thinned) <= len(log) / 5.0 and said == ()
    np.testing.assert_allclose(thinned.q, Swing().q(thinned.time), atol=1e-3)
