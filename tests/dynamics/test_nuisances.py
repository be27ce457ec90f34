"""Columns of scale and encoder zeros against MuJoCo's own torque."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.kinematics import ArmDynamics
from robot_sysid.dynamics.nuisances import (
    gravity,
    tilt_axes,
    tilt_columns,
    turned,
    with_gravity,
    zero_columns,
)
from robot_sysid.errors import InputError
from robot_sysid.records import Motion
from tests.support import arms
from tests.support.arms import SEEDS, random_motion, robot_of


@pytest.mark.parametrize("name", ["seven", "slide in chain", "shared bodies", "tilted gravity"])
def test_a_zero_that_is_off_adds_its_column(name):
    robot = robot_of(arms.MODELS[name])
    q, qd, qdd = random_motion(np.random.default_rng(3), robot.n_joints, 20)
    thetas = np.array([link.theta for link in robot.links])
    columns = zero_columns(robot, thetas, Motion(np.arange(20.0), q, qd, qdd))
    dynamics, step = ArmDynamics(robot), 1e-4
    for joint in range(robot.n_joints):
        off = step * np.eye(robot.n_joints)[joint]
        change = dynamics.torque(q - off, qd, qdd) - dynamics.torque(q + off, qd, qdd)
        size = np.max(np.abs(columns)) + 1e-9
        expected = change / (2.0 * step)
        np.testing.assert_allclose(columns[:, :, joint], expected, rtol=0.0, atol=1e-6 * size)


angle = st.floats(-0.3, 0.3)


@given(SEEDS, angle, angle)
def test_turning_keeps_the_strength_and_turns_by_the_angle(seed, first, second):
    down = 9.81 * np.random.default_rng(seed).normal(size=3)
    after = turned(down, np.array([first, second]))
    np.testing.assert_allclose(np.linalg.norm(after), np.linalg.norm(down), rtol=1e-12)
    # Both axes are perpendicular to gravity, so the whole turn shows.
    sine = np.linalg.norm(np.cross(down, after)) / (down @ down)
    np.testing.assert_allclose(sine, np.sin(np.hypot(first, second)), rtol=0.0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["shared bodies", "springs", "tendon spring"])
@given(seed=SEEDS)
def test_columns_are_the_derivative_of_mujocos_torque(name, seed):
    """By central differences of the whole arm's inverse dynamics at rest.

    Springs pull at rest too, but they do not know where down is.
    """
    rng = np.random.default_rng(seed)
    robot = with_gravity(arms.robot_of(arms.MODELS[name]), 9.81 * rng.normal(size=3))
    q = rng.uniform(-1.0, 1.0, (4, robot.n_joints))
    columns = tilt_columns(robot, np.array([link.theta for link in robot.links]), q)
    step, still, down = 1e-4, np.zeros_like(q), gravity(robot)
    for k, axis in enumerate(np.eye(2)):
        plus, minus = (
            ArmDynamics(with_gravity(robot, turned(down, s * step * axis))).torque(q, still, still)
            for s in (1.0, -1.0)
        )
        expected = (plus - minus) / (2.0 * step)
        # The third derivative of a sine leaves step^2 / 6.
        size = np.max(np.abs(expected)) + 1e-3
        np.testing.assert_allclose(columns[:, :, k], expected, rtol=0.0, atol=1e-7 * size)


def test_without_gravity_there_is_no_tilt():
    with pytest.raises(InputError, match="--tilt auto needs gravity"):
        tilt_axes(np.zeros(3))
