"""The chosen cut-off: noise is estimated from the spectrum, encoder steps are not motion."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs.logs.swing import FREQUENCIES, Swing, filtered, seconds
from robot_sysid.records import Recording
from robot_sysid.signals.cutoff import choose_cutoff


def cutoff_of(q, rate):
    """Return the chosen cut-off [Hz] of positions q (N, n) at a sample rate [Hz]."""
    return choose_cutoff(q, rate).cutoff


@pytest.mark.parametrize(
    ("seed", "rate", "sigma"), [(0, 200.0, 1e-3), (1, 500.0, 3e-5)]
)
def test_the_expected_error_is_that_of_the_acceleration(seed, rate, sigma):
    swing = Swing(seed)
    log = swing.measurement(seconds(20.0, rate))
    noise = sigma * default_rng(seed).normal(size=log.q.shape)
    signals = filtered(replace(log, q=log.q + noise))
    true = swing.q(signals.time, 2)
    error = np.linalg.norm(signals.qdd - true) / np.linalg.norm(true)
    assert_allclose(signals.acceleration_error, error, rtol=0.15)
    assert 1.4 < signals.cutoff < 15.0


def test_a_fast_small_motion_beside_a_slow_large_one_is_kept():
    time = seconds(15.0, 1000.0)
    noise = 1e-5 * default_rng(0).normal(size=time.shape)
    q = 0.5 * np.sin(0.2 * np.pi * time) + 0.01 * np.sin(10.0 * np.pi * time) + noise
    assert cutoff_of(q[:, None], 1000.0) > 12.5


SCALES = [(1.0, 0.03, 0.01), (0.1, 0.03, 0.01), (0.3, 0.1, 0.003), (0.03, 0.03, 0.03)]
# The fastest sine has 0.59 Hz, seen with a resolution of about a quarter of a hertz; the chosen
# cut-off is 0.6 of the highest one.
HIGHEST = 0.6 * 15.0 * 1.1


def encoder_reading(q, resolution):
    """Return positions rounded to the resolution of an encoder."""
    return np.round(q / resolution) * resolution


@pytest.mark.parametrize(
    ("seed", "resolution", "scale"),
    [
        (14107, 1e-3, SCALES[0]),
        (130, 1e-3, SCALES[0]),
        (1, 1e-5, SCALES[1]),
        (2, 1e-4, SCALES[3]),
    ],
)
def test_steps_of_a_coarse_encoder_are_not_taken_for_motion(seed, resolution, scale):
    """A joint that creeps over few steps has a spectrum of its own, far above any motion."""
    q = Swing(seed).q(seconds(15.0, 1000.0)) * scale
    assert cutoff_of(encoder_reading(q, resolution), 1000.0) < HIGHEST


@pytest.mark.parametrize(
    ("seed", "scale", "jitter"), [(0, SCALES[0], 0.4), (1, SCALES[2], 0.1)]
)
def test_interpolated_steps_are_not_taken_for_motion(seed, scale, jitter):
    """Splines through uneven samples smooth the steps of a coarse encoder."""
    even = seconds(15.0, 500.0)
    rate = 500.0
    time = even + jitter * default_rng(seed).uniform(-1.0, 1.0, len(even)) / rate
    log = Swing(seed).measurement(time)
    signals = filtered(replace(log, q=encoder_reading(log.q * scale, 1e-3)))
    assert "uneven time stamps" in signals.notes[0]
    assert signals.cutoff < HIGHEST


def test_stale_readings_with_their_own_time_stamps_are_no_steps():
    """Without time stamps per joint, a stale reading looks like a joint at rest."""
    seed = 0
    rng = default_rng(seed)
    time = seconds(15.0, 500.0)
    drawn = np.where(rng.random((len(time), 3)) < 0.4, time[:, None], 0.0)
    stamps = np.maximum.accumulate(drawn)
    slow = Swing(seed)
    fast = Swing(seed + 1, 8.0 * FREQUENCIES)
    q = np.empty_like(stamps)
    for j, joint_stamps in enumerate(stamps.T):
        positions = slow.q(joint_stamps) + 1e-3 * fast.q(joint_stamps)
        q[:, j] = positions[:, j]
    log = Recording(time, q, None, q + 1.0, joint_time=stamps)
    # The fastest motion that can be told from the stale readings has 0.59 Hz.
    assert 6.0 < filtered(log).cutoff < HIGHEST
    assert filtered(replace(log, joint_time=None)).cutoff < 5.0


def test_positions_repeated_over_rows_keep_their_cutoff():
    """A controller's log at 1 kHz of positions that arrive at 125 Hz."""
    held = 8
    time = np.arange(15000) / 1000.0
    q = np.column_stack([np.sin(2.0 * np.pi * f * time) for f in (0.2, 0.5, 0.9)])
    rows = q[held * (np.arange(len(q)) // held)]
    slow = choose_cutoff(rows, 1000.0)
    assert slow.expected_error < 1e-2
    assert 0.5 * cutoff_of(q, 1000.0) < slow.cutoff < 1.5 * cutoff_of(q, 1000.0)
