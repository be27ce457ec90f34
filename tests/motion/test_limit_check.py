"""The continuous check finds violations between samples, and reports no others."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.optimize import brentq

from rigs.arms import small_arms
from rigs.arms.excitation_arms import TUBES_AND_POST, make_problem
from rigs.arms.small_arms import SEEDS
from robot_sysid.motion.clearance import HORIZON, Closest
from robot_sysid.motion.limit_check import (
    LONGEST_STOPPING,
    check_limits,
    first_contact,
    keeps_limits,
    with_stops,
)
from robot_sysid.motion.trajectories import LineTrajectory
from robot_sysid.records import Motion
from robot_sysid.trajectory import STOPPING_TIME, SineTrajectory


def series(rest, coefficients, duration=0.4, fade=0.15):
    """Return an offset and sinusoids of one and two periods under a window."""
    frequency = np.tile([0.0, 1.0, 2.0], (len(rest), 1)) / duration
    phase = np.full(frequency.shape, 0.5 * np.pi)
    return SineTrajectory(rest, coefficients, frequency, phase, duration, fade)


def plan_of(problem, seed, size):
    """Return a series with random coefficients of standard deviation ``size``."""
    shape = (problem.n_joints, 3)
    return series(problem.rest, size * default_rng(seed).normal(size=shape))


THREE = make_problem(small_arms.THREE)


@given(SEEDS, st.floats(0.02, 0.6))
def test_peaks_equal_those_of_dense_samples(seed, size):
    plan = plan_of(THREE, seed, size)
    check = check_limits(THREE, plan)
    motion = plan.evaluate(np.arange(401) / 1000.0)
    limits = THREE.limits
    offset = motion.q - limits.center
    signals = (offset, motion.qd, motion.qdd, THREE.torque(motion))
    largest = np.max(np.abs(signals), axis=1)
    peaks = np.reshape([use.value for use in check.uses[:12]], (4, 3))
    assert_allclose(np.abs(peaks), largest, atol=1e-9)
    is_within = (motion.q >= limits.lower) & (motion.q <= limits.upper)
    is_within &= np.abs(motion.qd) <= limits.velocity
    is_within &= np.abs(motion.qdd) <= limits.acceleration
    assert (not check.excesses) == np.all(is_within) == keeps_limits(THREE, plan)


def test_a_torque_that_is_nan_breaks_its_limit():
    lost = replace(THREE, arm_torque=lambda motion: np.full_like(motion.q, np.nan))
    plan = plan_of(THREE, 0, 1e-3)
    assert keeps_limits(THREE, plan) and not keeps_limits(lost, plan)
    assert "torque limit of joint" in check_limits(lost, plan).excesses[0].name


@pytest.mark.slow
@given(SEEDS, st.floats(0.02, 0.2))
def test_clearance_equals_that_of_dense_samples(seed, size):
    problem = make_problem(TUBES_AND_POST)
    plan = plan_of(problem, seed, size)
    often = plan.evaluate(np.arange(161) / 400.0)
    # The search's slack ends nearer than the check looks.
    least = min(HORIZON, np.min(problem.obstacles.slacks(often.q)))
    fastest = np.max(problem.obstacles.rates @ np.max(np.abs(often.qd), axis=0))
    check = check_limits(problem, plan)
    assert check.closest.slack <= least + 1e-3 + 1e-6
    # Between two of these samples nothing moves farther than this.
    assert check.closest.slack >= least - 0.0025 * fastest
    assert (first_contact(problem, plan) is not None) == (check.closest.slack < 0.0)


class ThinWall:
    """Forbids a band of 2 mrad in the first joint's position."""

    rates = np.array([[1.0, 0.0, 0.0]])

    def slacks(self, q):
        return np.minimum(np.abs(q[:, :1] - 0.2) - 1e-3, 0.1)

    def closest_pair(self, q):
        (value,) = self.slacks(q[None])[0]
        return Closest(value, value, "arm and wall")


def test_a_wall_between_two_samples_is_detected():
    problem = replace(THREE, obstacles=ThinWall())
    coefficients = np.zeros((3, 3))
    coefficients[0, 0] = 0.4
    plan = series(problem.rest, coefficients, 4.0, 1.0)
    sampled = plan.evaluate(np.arange(80) / 20.0 + 0.02)
    assert np.min(problem.obstacles.slacks(sampled.q)) > 0.0
    check = check_limits(problem, plan)
    assert check.excesses[0].name == "clearance of arm and wall"
    contact = first_contact(problem, plan)
    assert contact.time == pytest.approx(check.closest.time, abs=3.0)


class Stopping:
    """The first joint moves at 2.1 rad/s and stops from one instant to the next."""

    duration = 0.2

    def __init__(self, end):
        self.end = end

    def evaluate(self, time):
        """Motion at times (N,), the speed before an instant rather than after it."""
        q, moving = np.zeros((2, len(time), 3))
        q[:, 0] = np.minimum(self.end, 2.1 * time)
        moving[:, 0] = 2.1 * (2.1 * time < self.end)
        return Motion(time, q, moving, np.zeros_like(q))


@pytest.mark.parametrize(("end", "touches"), [(0.1988, False), (0.19945, True)])
def test_a_motion_that_stops_inside_a_wall_is_detected(end, touches):
    """Between two samples the speed is that at the start of the step."""
    problem = replace(THREE, obstacles=ThinWall())
    assert (first_contact(problem, Stopping(end)) is not None) == touches


@pytest.mark.parametrize(
    ("shortfall", "holds"), [(2e-9, True), (1e-7, True), (5e-6, False)]
)
def test_a_clearance_may_fall_short_by_rounding_alone(shortfall, holds):
    """The end pose falls short of its clearance by ``shortfall`` metres."""
    problem = make_problem(TUBES_AND_POST)
    towards = np.array([0.0, 1.2, 0.0, 0.0])

    def surplus(share):
        """Return the slack beyond the shortfall at a share of the way [m]."""
        return (
            problem.obstacles.closest_pair(problem.rest + share * towards).slack
            + shortfall
        )

    end = brentq(surplus, 0.0, 1.0, xtol=1e-12)
    plan = LineTrajectory(problem.rest, problem.rest + end * towards)
    check = check_limits(problem, plan)
    assert any("clearance" in excess.name for excess in check.excesses) != holds


def slow_plan():
    """Return a slow path and its greatest accelerations (n,), with a fifth more."""
    plan = plan_of(THREE, 0, 0.05)
    plan = replace(plan, duration=8.0, fade=2.0, frequency_hz=plan.frequency_hz / 20.0)
    qdd = plan.evaluate(np.linspace(0.0, 8.0, 4001)).qdd
    return plan, 1.2 * np.max(np.abs(qdd), axis=0)


def test_stops_take_as_long_as_the_limits_ask():
    """A path that keeps its limits keeps them with stops, which take longer where need be."""
    plan, top = slow_plan()
    strong = replace(THREE, limits=replace(THREE.limits, acceleration=np.full(3, 1e3)))
    assert with_stops(strong, plan).stopping_time == STOPPING_TIME

    weak = replace(THREE, limits=replace(THREE.limits, acceleration=top))
    assert keeps_limits(weak, plan)
    softer = with_stops(weak, plan)
    assert STOPPING_TIME < softer.stopping_time < LONGEST_STOPPING
    assert not check_limits(weak, softer).excesses


def test_a_path_that_breaks_its_limits_breaks_them_with_any_stops():
    plan, top = slow_plan()
    broken = replace(THREE, limits=replace(THREE.limits, acceleration=0.1 * top))
    assert check_limits(broken, with_stops(broken, plan)).excesses
