"""Laws of trajectories: exact derivatives, limits kept at all times, rest at both ends."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms import small_arms
from rigs.arms.small_arms import SEEDS, robot_of
from robot_sysid.records import Limits
from robot_sysid.trajectory import (
    SLOW_RATE,
    SLOW_SHARE,
    STANDING_TIME,
    StoppingTrajectory,
    generate_excitation_trajectory,
    sample_count,
    sample_times,
)

THREE = robot_of(small_arms.THREE)
DURATIONS = st.one_of(st.floats(0.02, 3.0), st.floats(3.0, 60.0))


def excitation(robot, seed, duration=15.0):
    """Return an excitation trajectory for a seed."""
    return generate_excitation_trajectory(robot, default_rng(seed), duration)


def dense(plan, points=4001):
    """Return the motion of a plan at ``points`` even instants."""
    return plan.evaluate(np.linspace(0.0, plan.duration, points))


@st.composite
def limited_arms(draw):
    """Draw an arm with any limits that Limits accepts and any rest position."""

    def three(low, high):
        """Draw one number per joint between two bounds (3,)."""
        numbers = st.lists(st.floats(low, high), min_size=3, max_size=3)
        return np.array(draw(numbers))

    middle = three(-6.0, 6.0)
    width = three(1e-3, 12.0)
    # Most joints have a range.
    sides = st.sampled_from([False, False, True])
    is_open = np.array(draw(st.lists(sides, min_size=3, max_size=3)))
    lower = np.where(is_open, -np.inf, middle - 0.5 * width)
    upper = np.where(is_open, np.inf, middle + 0.5 * width)
    limits = Limits(lower, upper, three(0.01, 20.0))
    reference = three(-8.0, 8.0)
    return replace(THREE, limits=limits, reference_qpos=reference)


@given(limited_arms(), SEEDS, DURATIONS)
def test_position_and_velocity_limits_hold_at_all_times(robot, seed, duration):
    plan = excitation(robot, seed, duration)
    motion = dense(plan)
    assert np.all(motion.q > robot.limits.lower)
    assert np.all(motion.q < robot.limits.upper)
    assert np.all(np.abs(motion.qd) <= robot.limits.velocity)


@given(limited_arms(), SEEDS, DURATIONS)
def test_every_joint_uses_its_range_or_its_speed(robot, seed, duration):
    """Either the reach or the speed is what holds a joint back, not the tool's timidity."""
    plan = excitation(robot, seed, duration)
    speed = np.max(np.abs(dense(plan).qd), axis=0) / robot.limits.velocity
    span = robot.limits.upper - robot.limits.lower
    span[np.isinf(span)] = 2.0 * np.pi
    share = 2.0 * np.sum(np.abs(plan.amplitude), axis=1) / span
    full = np.isclose(share, [0.1, 0.1, 0.7], rtol=1e-12)
    assert np.all(full | (speed > 0.95))


@given(SEEDS)
def test_frequencies_are_in_the_band_and_distinct(seed):
    plan = excitation(robot_of(small_arms.SEVEN), seed)
    used = plan.amplitude != 0.0
    assert np.all(np.isin(np.sum(used, axis=1), (3, 4, 5)))
    frequency = np.sort(plan.frequency_hz[used])
    assert frequency[0] > 0.1 and frequency[-1] < 0.6
    assert np.min(np.diff(frequency)) > 1e-3


@given(st.floats(0.01, 100.0), st.floats(1.0, 1000.0), st.integers(1, 500))
def test_sample_times_do_not_depend_on_the_chunk(duration, rate, chunk):
    times = np.concatenate(list(sample_times(duration, rate, chunk)))
    assert len(times) == sample_count(duration, rate)
    assert_array_equal(times, np.concatenate(list(sample_times(duration, rate))))
    assert times[0] == 0.0
    assert duration - 1.0 / rate < times[-1] <= duration
    assert np.all(np.diff(times) > 0.0)


@given(SEEDS, st.floats(2.0, 40.0), st.floats(0.05, 5.0))
def test_stops_change_the_timing_of_a_path_and_nothing_else(
    seed, duration, stopping_time
):
    """Its positions are those of the path at instants that it passes from begin to end, never
    faster than the path."""
    path = excitation(THREE, seed, duration)
    plan = StoppingTrajectory(path, stopping_time)
    ends = plan.evaluate(np.array([0.0, plan.duration]))
    assert_allclose(ends.q, path.evaluate(np.array([0.0, duration])).q, atol=1e-9)
    assert_allclose((ends.qd, ends.qdd), 0.0, atol=1e-7)

    time = np.linspace(0.01, plan.duration - 0.01, 200)
    ahead, behind, middle = (plan.evaluate(time + step) for step in (1e-5, -1e-5, 0.0))
    assert_allclose((ahead.q - behind.q) / 2e-5, middle.qd, atol=1e-5)
    error = 1e-4 * (1.0 + np.max(np.abs(middle.qdd)) / stopping_time**2)
    assert_allclose((ahead.qd - behind.qd) / 2e-5, middle.qdd, atol=error)
    assert np.all(np.max(np.abs(middle.qd), axis=0) <= 1.01 * fastest(path))


def fastest(path):
    """Return the highest speed of each joint (n,)."""
    return np.max(np.abs(dense(path).qd), axis=0)


def test_a_motion_stands_between_moves_and_ends_slowly():
    path = excitation(THREE, 1, 20.0)
    plan = StoppingTrajectory(path)
    motion = dense(plan, 8001)
    stands = np.all(np.abs(motion.qd) < 1e-9, axis=1)
    step = motion.time[1]
    # 17 moves of a second; the stop takes a part of the time in which it stands. Each begin and end
    # is known to a sample or two.
    standing = 17 * (STANDING_TIME - plan.stopping_time)
    assert abs(step * np.sum(stands) - standing) < 2 * 17 * 2 * step
    is_late = motion.time > plan.duration - 0.9 * SLOW_SHARE * 20.0 / SLOW_RATE
    share = np.max(np.abs(motion.qd[is_late])) / np.max(fastest(path))
    assert share <= SLOW_RATE
