"""What is shown of a motion: shares of limits, and a log beside its plan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.motion.options import LimitOptions
from robot_sysid.motion.problem import build_problem
from robot_sysid.preview.film import shown_log, shown_plan
from robot_sysid.records import JointLimits, Measurement
from tests.support import arms, measured_logs

LATE = 0.7


@pytest.fixture(scope="module")
def robot():
    return arms.robot_of(arms.THREE)


@pytest.fixture(scope="module")
def problem(robot):
    return build_problem(robot, LimitOptions(), "chain", 0.3, None)


@pytest.fixture(scope="module")
def plan(robot):
    return measured_logs.plan_of(robot, duration=6.0)


def log_of(plan, late=LATE, off=0.0):
    """The plan as it was recorded, with a while of rest before it."""
    time = np.arange(0.0, plan.duration + late, 0.01)
    q = plan.evaluate(np.clip(time - late, 0.0, plan.duration)).q + off
    return Measurement(time + 100.0, q, None, np.ones_like(q))


def test_shares_are_those_of_the_worst_joint(problem, plan):
    shown = shown_plan(problem, plan)
    motion = plan.evaluate(shown.time)
    largest = np.max(np.abs(motion.qd) / problem.limits.velocity, axis=1)
    np.testing.assert_allclose(shown.strips[1].values, 100.0 * largest)
    assert shown.ghost is None and len(shown.time) == 121
    assert np.all(np.isnan(shown.strips[2].values))  # the model has no torque limits


def test_a_log_is_laid_over_the_part_of_its_plan(problem, plan):
    shown = shown_plan(problem, plan, log_of(plan, off=np.array([0.0, 0.02, 0.0])))
    known = np.all(np.isfinite(shown.ghost), axis=1)
    assert np.mean(known) > 0.95
    off = np.abs(shown.ghost - shown.q)[known]
    assert np.max(off[:, 1]) == pytest.approx(0.02, abs=0.02)
    assert "0.70 s into the log" in shown.notes[0] and "joint1" in shown.notes[0]


def test_a_log_alone_has_the_limits_of_its_model(robot, plan):
    limits = robot.limits
    torque = JointLimits(limits.lower, limits.upper, limits.velocity, np.array([4.0, 2.0, 8.0]))
    shown = shown_log(replace(robot, limits=torque), log_of(plan))
    np.testing.assert_allclose(shown.strips[2].values, 50.0)
    assert shown.time[0] == 0.0 and shown.time[-1] == pytest.approx(plan.duration + LATE, abs=0.02)


def test_a_joint_without_limits_is_no_share(plan):
    robot = arms.robot_of(arms.UNLIMITED)
    assert np.all(np.isnan(shown_log(robot, log_of(plan)).strips[0].values))
