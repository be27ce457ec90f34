"""Designed poses: within the limits, informative, and saved with every bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.excitation.limit_check import check_limits
from robot_sysid.excitation.options import LimitOptions
from robot_sysid.excitation.problem import build_problem
from robot_sysid.excitation.static.options import PoseOptions
from robot_sysid.excitation.static.pose_design import APPROACH, GENTLE, design_poses, pose_lines
from robot_sysid.excitation.trajectory_files import load_trajectory, save_trajectory
from tests.support import arms

ROBOT = arms.robot_of(arms.serial_arm((arms.Z, arms.Y, arms.Y, arms.X)))
OPTIONS = PoseOptions("payload", True, poses=6, dwell=1.0)


@pytest.fixture(scope="module")
def problem():
    return build_problem(ROBOT, LimitOptions())


@pytest.fixture(scope="module")
def plan(problem):
    return design_poses(ROBOT, problem, OPTIONS, np.random.default_rng(0))


@pytest.mark.slow
def test_all_limits_are_kept_and_the_motion_is_gentle(problem, plan):
    check = check_limits(problem, plan)
    assert check.failure is None
    assert np.max(check.velocity) <= GENTLE


def test_each_pose_is_approached_from_both_sides(plan):
    rests = np.flatnonzero(plan.dwells > 0.0)
    assert len(rests) == 12
    for first, second in rests.reshape(-1, 2):
        np.testing.assert_array_equal(plan.points[first], plan.points[second])
        np.testing.assert_allclose(plan.points[first] - plan.points[first - 1], APPROACH)
        np.testing.assert_allclose(plan.points[second] - plan.points[second - 1], -APPROACH)


def test_the_promise_tells_the_mass(problem, plan):
    told = " ".join(pose_lines(ROBOT, problem, plan))
    assert "6 poses" in told and "mass to 0.0" in told


def test_a_saved_plan_is_the_same(plan, tmp_path):
    path = tmp_path / "plan.json"
    save_trajectory(path, plan, ROBOT.joint_names)
    again = load_trajectory(path).plan
    for name in ("points", "moves", "dwells"):
        np.testing.assert_array_equal(getattr(again, name), getattr(plan, name))


def test_where_nothing_can_be_reached_it_is_said(problem):
    lame = replace(problem.limits, torque=np.full(4, 1e-3))
    with pytest.raises(InputError, match="poses within the limits"):
        design_poses(ROBOT, replace(problem, limits=lame), OPTIONS, np.random.default_rng(0))


def test_a_few_poses_are_too_few():
    with pytest.raises(InputError, match="--poses must be at least 5"):
        PoseOptions("payload", True, poses=2)
