"""From a robot to an excitation problem: limits, rest, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.collision.clearance import Clearance
from robot_sysid.collision.halfspaces import Box, Plane
from robot_sysid.collision.obstacles import NoObstacles
from robot_sysid.errors import InputError
from robot_sysid.excitation.problem import build_problem
from robot_sysid.records import JointLimits
from robot_sysid.simulator import inverse_torque
from tests.support import arms
from tests.support.arms import robot_of
from tests.support.excitation_arms import TUBES, TUBES_AND_POST, options, robot


def limits(lower=-2.0, upper=2.0, velocity=1.0, torque=np.inf, joints=3):
    return JointLimits(*(np.full(joints, float(v)) for v in (lower, upper, velocity, torque)))


def built(xml, **changes):
    return build_problem(robot(xml), options(**changes))


def test_limits_are_those_of_the_model_less_margins():
    some = build_problem(replace(robot_of(arms.THREE), limits=limits(torque=100.0)), options())
    assert np.allclose(some.limits.lower, -2.0 + 0.02 * 4.0)
    assert np.allclose(some.limits.upper, 2.0 - 0.02 * 4.0)
    assert np.allclose(some.limits.velocity, 1.0)
    assert np.allclose(some.limits.torque, 95.0)
    assert np.allclose(some.limits.acceleration, 2.0 * np.pi * 4 / 6.0)


def test_asked_limits_tighten_those_of_the_model():
    chosen = options(max_acceleration=3.0, max_torque=(50.0, 60.0, 200.0))
    some = build_problem(replace(robot_of(arms.THREE), limits=limits(torque=100.0)), chosen)
    assert np.allclose(some.limits.acceleration, 3.0)
    assert np.allclose(some.limits.torque, [47.5, 57.0, 95.0])


@pytest.mark.parametrize("changes", [{"lower": -np.inf, "upper": np.inf}, {"upper": np.inf}])
def test_a_joint_without_a_limit_gets_an_assumed_range(changes):
    some = build_problem(replace(robot_of(arms.THREE), limits=limits(**changes)), options())
    assert np.all(np.isfinite(some.limits.upper)) and np.all(some.limits.upper > some.rest)
    assert np.all(np.isfinite(some.limits.lower)) and np.all(some.limits.lower < some.rest)


def test_a_reference_beyond_a_limit_is_moved_to_it_and_noted():
    some = build_problem(replace(robot_of(arms.THREE), limits=limits(lower=0.5)), options())
    assert np.allclose(some.rest, 0.5 + 0.02 * 1.5)
    assert any("joint1 at 0.530 instead of 0.000" in note for note in some.notes)


def test_a_motor_too_weak_to_hold_the_arm_is_noted_and_not_obeyed():
    weak = limits()
    weak = JointLimits(weak.lower, weak.upper, weak.velocity, np.array([50.0, 0.1, 50.0]))
    leaning = replace(robot_of(arms.THREE), limits=weak, reference_qpos=np.array([0.0, 0.7, 0.2]))
    some = build_problem(leaning, options())
    assert np.isinf(some.limits.torque[1]) and np.isfinite(some.limits.torque[0])
    assert any("at joint joint1, more than its torque limit" in note for note in some.notes)


def test_the_torque_is_the_simulators():
    some, arm = built(arms.SEVEN), robot(arms.SEVEN)
    from robot_sysid.records import Motion

    rng = np.random.default_rng(0)
    motion = Motion(np.arange(5.0), *rng.normal(size=(3, 5, 7)))
    assert np.array_equal(some.torque(motion), inverse_torque(arm)(motion))


def test_terminal_torques_use_one_row():
    some = built(arms.SEVEN, torques="terminal", noise_torque=tuple(range(1, 8)))
    assert some.rows == (6,)
    assert some.sigma.tolist() == [7.0]
    assert built(arms.SEVEN).rows == tuple(range(7))


def test_a_model_without_collision_geometry_says_so():
    some = built(arms.THREE)
    assert isinstance(some.obstacles, NoObstacles)
    assert any("no collision geometry" in note for note in some.notes)
    assert isinstance(built(TUBES).obstacles, Clearance)


def test_half_spaces_work_without_collision_geometry():
    some = built(arms.THREE, keep_out=(Plane((0.0, 0.0, 1.0), 0.1),))
    assert isinstance(some.obstacles, Clearance)


def test_a_workspace_the_link_leaves_already_at_rest_is_refused():
    box = Box((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0))
    with pytest.raises(InputError, match=r"body link3 is 230 mm beyond the workspace's zmax = 1 m"):
        built(TUBES, workspace=box)


def test_a_keep_out_plane_the_arm_crosses_at_rest_is_refused():
    with pytest.raises(InputError, match=r"no trajectory is feasible: at rest, body link0 is"):
        built(TUBES_AND_POST, keep_out=(Plane((0.0, 0.0, 1.0), 0.4),))


def test_the_workspace_binds_the_terminal_link_alone():
    low = Box((-2.0, -2.0, 0.9), (2.0, 2.0, 2.0))
    some = built(TUBES, workspace=low)
    folded = np.array([0.0, 0.0, 0.0, 2.2])
    assert some.obstacles.closest(folded).slack < 0.0
    assert "link3 and the workspace's zmin" in some.obstacles.closest(folded).label


def test_one_noise_per_joint_or_one_for_all():
    with pytest.raises(InputError, match="--noise-torque takes one number, or one for each of the"):
        built(arms.THREE, noise_torque=(0.1, 0.2))
