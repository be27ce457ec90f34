"""Laws of the motion of all links: MuJoCo's inverse dynamics, by a formula of our own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from robot_sysid.dynamics.kinematics import ArmDynamics
from robot_sysid.dynamics.newton_euler import LinkDynamics
from tests.support import arms
from tests.support.arms import SEEDS, random_chain, random_motion, robot_of

SAMPLES = 4


def beyond_rigid_bodies(robot, motion):
    """Torque of armature, springs and tendons (N, n)."""
    return ArmDynamics(robot).beyond_rigid_bodies(*motion)


def assert_equals_mujoco(robot, motion):
    thetas = np.array([link.theta for link in robot.links])
    links = LinkDynamics(robot).motion(*motion)
    actual = ArmDynamics(robot).torque(*motion) - beyond_rigid_bodies(robot, motion)
    allowed = 1e-11 * np.max(np.abs(actual)) + 1e-13
    np.testing.assert_allclose(links.torque(thetas), actual, rtol=0.0, atol=allowed)
    columns = links.columns(range(robot.n_joints)) @ thetas.ravel()
    np.testing.assert_allclose(columns, actual, rtol=0.0, atol=allowed)


@given(random_chain(), SEEDS)
def test_links_and_columns_give_mujocos_torque_on_any_chain(xml, seed):
    robot = robot_of(xml)
    motion = random_motion(np.random.default_rng(seed), robot.n_joints, SAMPLES)
    assert_equals_mujoco(robot, motion)


@pytest.mark.parametrize("name", sorted(arms.MODELS))
def test_links_give_mujocos_torque_on_odd_arms(name):
    robot = robot_of(arms.MODELS[name])
    motion = random_motion(np.random.default_rng(0), robot.n_joints, SAMPLES)
    assert_equals_mujoco(robot, motion)
