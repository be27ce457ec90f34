"""Sweeps: every joint that has room, alone, at several speeds both ways, within the limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.excitation.limit_check import check_limits
from robot_sysid.excitation.options import LimitOptions
from robot_sysid.excitation.problem import build_problem
from robot_sysid.excitation.static.sweeps import FASTEST, SPEEDS, design_sweeps, sweep_lines
from robot_sysid.excitation.trajectory_files import at_speed, load_trajectory, save_trajectory
from tests.support import arms

ROBOT = arms.robot_of(arms.serial_arm((arms.Z, arms.Y)))


@pytest.fixture(scope="module")
def problem():
    return build_problem(ROBOT, LimitOptions())


@pytest.fixture(scope="module")
def plan(problem):
    return design_sweeps(problem)


@pytest.mark.slow
def test_all_limits_are_kept_and_the_ends_are_at_rest(problem, plan):
    assert check_limits(problem, plan).failure is None
    ends = plan.evaluate(np.array([0.0, plan.duration]))
    np.testing.assert_allclose(ends.q, np.tile(problem.rest, (2, 1)), atol=1e-12)
    np.testing.assert_allclose(ends.qd, 0.0, atol=1e-12)


def test_one_joint_moves_at_a_time_both_ways_at_every_speed(plan):
    speeds = plan.speeds
    assert np.all(np.count_nonzero(speeds, axis=1) == 1)
    for own in speeds.T:
        held = np.round(own[own != 0.0], 9)
        both = set(held[held > 0.0]) & set(-held[held < 0.0])
        assert len(both) >= SPEEDS and max(both) == pytest.approx(FASTEST)


def test_a_joint_without_room_is_left_out_and_said(problem):
    upper = np.where([True, False], problem.rest + 0.005, problem.limits.upper)
    lower = np.where([True, False], problem.rest - 0.005, problem.limits.lower)
    tight = replace(problem, limits=replace(problem.limits, lower=lower, upper=upper))
    plan = design_sweeps(tight)
    assert not np.any(plan.speeds[:, 0])
    assert "No room to sweep joint0" in " ".join(sweep_lines(ROBOT, tight, plan))
    none = np.full(2, 0.005)
    shut = replace(tight.limits, lower=problem.rest - none, upper=problem.rest + none)
    with pytest.raises(InputError, match="no joint has room"):
        design_sweeps(replace(tight, limits=shut))


def test_a_saved_plan_is_the_same_at_half_speed_too(problem, plan, tmp_path):
    path = tmp_path / "plan.json"
    slow = at_speed(plan, 0.5)
    save_trajectory(path, slow, ROBOT.joint_names)
    again = load_trajectory(path).plan
    time = np.linspace(0.0, slow.duration, 50)
    np.testing.assert_array_equal(again.evaluate(time).q, slow.evaluate(time).q)
    assert "joint1 0.5" in sweep_lines(ROBOT, problem, again)[0]
