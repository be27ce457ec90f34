"""Sines for a whole arm: the draw that tells most of all links, within the limits."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.excitation.design.optimise import Design
from robot_sysid.excitation.design.search import draw_trajectories
from robot_sysid.excitation.design.whole_arm import design_for_arm, information
from robot_sysid.excitation.limit_check import keeps_limits
from robot_sysid.excitation.options import ExcitationOptions, LimitOptions
from robot_sysid.excitation.problem import build_problem
from robot_sysid.records.progress import Progress
from robot_sysid.trajectory import TrajectoryOptions
from tests.support import arms

ROBOT = arms.robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X)))
DRAWS = 5


def design_of(**limits):
    problem = build_problem(ROBOT, LimitOptions(**limits))
    options = ExcitationOptions(kind="optimal", draws=DRAWS, time_budget=1e6)
    return Design(problem, options, TrajectoryOptions(duration=4.0, sample_rate=100.0))


def test_the_best_draw_is_taken():
    design = design_of()
    plan = design_for_arm(design, np.random.default_rng(3), Progress())
    assert keeps_limits(design.problem, plan)
    seed = int(np.random.default_rng(3).integers(2**62))
    draws = draw_trajectories(design, seed, range(DRAWS))
    told = [information(design.problem, design.trajectory(d.x)) for d in draws]
    assert information(design.problem, plan) == pytest.approx(max(told), rel=1e-12)


def test_a_larger_motion_tells_more():
    design = design_of()
    plan = design_for_arm(design, np.random.default_rng(3), Progress())
    assert information(design.problem, plan.scaled(0.5)) < information(design.problem, plan)


def test_limits_that_nothing_keeps_are_said():
    with pytest.raises(InputError, match="keeps all limits"):
        design_for_arm(design_of(max_torque=(0.01,)), np.random.default_rng(0), Progress())
