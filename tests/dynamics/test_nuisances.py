"""Columns of scale and encoder zeros against MuJoCo's own torque."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.dynamics.kinematics import ArmDynamics
from robot_sysid.dynamics.nuisances import NuisanceColumns
from robot_sysid.records import Motion
from tests.support import arms
from tests.support.arms import random_motion, robot_of


@pytest.mark.parametrize("name", ["seven", "slide in chain", "shared bodies", "tilted gravity"])
def test_a_zero_that_is_off_adds_its_column(name):
    robot = robot_of(arms.MODELS[name])
    q, qd, qdd = random_motion(np.random.default_rng(3), robot.n_joints, 20)
    thetas = np.array([link.theta for link in robot.links])
    columns = NuisanceColumns(robot, thetas).zero(Motion(np.arange(20.0), q, qd, qdd))
    dynamics, step = ArmDynamics(robot), 1e-4
    for joint in range(robot.n_joints):
        off = step * np.eye(robot.n_joints)[joint]
        change = dynamics.torque(q - off, qd, qdd) - dynamics.torque(q + off, qd, qdd)
        size = np.max(np.abs(columns)) + 1e-9
        expected = change / (2.0 * step)
        np.testing.assert_allclose(columns[:, :, joint], expected, rtol=0.0, atol=1e-6 * size)


def test_a_scale_stands_in_its_own_joints_equation_alone():
    robot = robot_of(arms.SEVEN)
    q, qd, qdd = random_motion(np.random.default_rng(4), robot.n_joints, 20)
    thetas = np.array([link.theta for link in robot.links])
    columns = NuisanceColumns(robot, thetas).scale(Motion(np.arange(20.0), q, qd, qdd))
    torque = ArmDynamics(robot).torque(q, qd, qdd)
    for joint, column in enumerate(np.moveaxis(columns, -1, 0)):
        expected = np.where(np.arange(robot.n_joints) == joint, torque, 0.0)
        allowed = 1e-10 * np.max(np.abs(torque))
        np.testing.assert_allclose(column, expected, rtol=0.0, atol=allowed)
