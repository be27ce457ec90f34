"""Samples are put on a uniform grid, gaps are marked, long logs are split."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms.small_arms import SEEDS
from rigs.logs.swing import Swing, seconds
from robot_sysid.records import Recording
from robot_sysid.signals import resampling
from robot_sysid.signals.resampling import (
    is_even,
    piece_notes,
    resample_uniformly,
    sampling_period,
    split_at_gaps,
)

assert_close = partial(assert_allclose, rtol=0.0)
"""Compare arrays within the absolute tolerance ``atol`` alone."""


def uneven_times(seed, jitter):
    """Return 801 instants at 200 Hz, each off by at most ``jitter`` periods."""
    even = seconds(4.0, 200.0)
    return even + default_rng(seed).uniform(-jitter, jitter, len(even)) / 200.0


def assert_equals_swing(uniform, swing):
    """Check resampled positions and torques against the exact ones on the grid."""
    assert_close(np.diff(uniform.time), sampling_period(uniform.time), atol=1e-12)
    assert_close(uniform.q, swing.q(uniform.time), atol=1e-7)
    assert_close(uniform.tau, swing.tau(uniform.time), atol=1e-6)


def test_an_even_log_is_unchanged():
    log = Swing().measurement(5.0 + seconds(3.0, 200.0))
    uniform = resample_uniformly(log)
    assert_array_equal(uniform.q, log.q)
    assert (uniform.time[0], uniform.notes, np.max(uniform.hole)) == (5.0, (), 0.0)
    assert abs(1.0 / sampling_period(uniform.time) - 200.0) < 1e-9


def test_time_stamps_rounded_to_milliseconds_are_still_even():
    assert is_even(np.round(seconds(3.0, 333.0), 3))
    assert not is_even(seconds(3.0, 333.0) + 1e-3 * np.sin(np.arange(1000)))


@given(SEEDS, st.floats(0.05, 0.35))
def test_uneven_samples_are_interpolated_and_leave_no_hole(seed, jitter):
    """Up to 1.7 periods apart: a step of 1.75 periods is a hole (``GAP_STEPS``)."""
    swing = Swing(seed)
    uniform = resample_uniformly(swing.measurement(uneven_times(seed, jitter)))
    assert_equals_swing(uniform, swing)
    assert_array_equal(uniform.hole, 0.0)


def test_joint_time_stamps_are_used_for_each_joint():
    swing = Swing()
    rate = 250.0
    time = seconds(4.0, rate)
    joint_time = time[:, None] + np.array([0.2e-3, 0.9e-3, 1.8e-3])
    q, tau = np.empty((2, *joint_time.shape))
    for j, stamps in enumerate(joint_time.T):
        q[:, j] = swing.q(stamps)[:, j]
        tau[:, j] = swing.tau(stamps)[:, j]
    uniform = resample_uniformly(Recording(time, q, None, tau, joint_time=joint_time))
    assert_equals_swing(uniform, swing)
    assert "resampled" in uniform.notes[0]


@given(SEEDS, st.integers(1, 40))
# Here the grid's instant on the hole's first edge is rounded into the hole.
@example(5494522, 28)
def test_the_length_of_a_hole_is_marked_at_its_samples(seed, missing):
    """The gap is zero at every other instant."""
    rng = default_rng(seed)
    rate = 200.0
    even = seconds(4.0, rate)
    first = int(rng.integers(50, 700))
    keep = np.ones(len(even), dtype=bool)
    keep[first : first + missing] = False
    uniform = resample_uniformly(Swing().measurement(even[keep]))
    expected = np.where(keep, 0.0, (missing + 1) / rate)
    assert_close(uniform.hole, expected, atol=1e-9)


@given(SEEDS, st.floats(999.0, 999.99))
def test_a_clock_that_is_a_little_slow_loses_no_rows(seed, rate):
    swing = Swing(seed)
    even = seconds(4.0, rate)
    log = replace(swing.measurement(even), time=np.floor(1e3 * even + 0.3) / 1e3)
    uniform = resample_uniformly(log)
    assert_array_equal(uniform.q, log.q)
    assert uniform.notes == ()


@given(
    st.lists(
        st.tuples(st.floats(0.1, 12.0), st.floats(0.6, 5.0)), min_size=1, max_size=5
    )
)
def test_a_log_is_split_at_gaps(lengths_and_gaps):
    start = 0.0
    times = []
    for length, gap in lengths_and_gaps:
        times.append(start + np.arange(0.0, length, 0.01))
        start = float(times[-1][-1]) + gap
    recording = Swing().measurement(np.concatenate(times))
    pieces = split_at_gaps(recording)
    long = [time for time in times if time[-1] - time[0] >= resampling.SHORTEST_PIECE]
    if not long:
        assert len(pieces) == 1 and pieces[0] is recording
        return
    assert [len(piece) for piece in pieces] == [len(time) for time in long]
    for piece, time in zip(pieces, long):
        assert_array_equal(piece.time, time)
    assert bool(piece_notes(recording, pieces)) == (len(times) > 1)


def test_a_log_of_hours_keeps_the_minutes_that_move():
    time = np.arange(0.0, 7200.0, 0.1)
    moves = (time > 3000.0) & (time < 3600.0)
    q = np.where(moves, np.sin(time), 1e-4 * np.sin(time))[:, None]
    pieces = split_at_gaps(Recording(time, q, None, q))
    assert 500.0 < sum(np.ptp(piece.time) for piece in pieces) < 800.0
    assert all(2900.0 < piece.time[0] < 3700.0 for piece in pieces)
    always = split_at_gaps(Swing().measurement(time))
    assert sum(np.ptp(piece.time) for piece in always) == pytest.approx(600.0, rel=0.1)
    assert always[0].time[0] == 0.0 and always[-1].time[-1] == time[-1]
    still = split_at_gaps(Recording(time, 0.0 * q, None, q))
    assert [piece.time[0] for piece in still] == [piece.time[0] for piece in always]
