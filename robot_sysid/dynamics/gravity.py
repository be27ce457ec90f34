"""The direction of gravity as two unknown angles: an arm whose base is not quite level.

Joint torques are linear in the gravity vector g. Turning g by small angles a1, a2 about two axes
e1, e2 perpendicular to it adds a1 tau(e1 x g) + a2 tau(e2 x g), tau(.) the torque of the resting
arm under that gravity. Estimated, applied and estimated again, this converges in a few rounds.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.kinematics import ChainKinematics
from robot_sysid.errors import InputError
from robot_sysid.records import Array, RobotModel
from robot_sysid.regressor import joint_torque

TILT_NAMES = ("tilt_1", "tilt_2")


def gravity(robot: RobotModel) -> Array:
    """Return the model's gravity vector (3,) in the world frame [m/s^2]."""
    return np.array(robot.mj_model.opt.gravity, dtype=float)


def with_gravity(robot: RobotModel, vector: Array) -> RobotModel:
    """Return the arm under another gravity (3,) [m/s^2]."""
    mj_model = copy.copy(robot.mj_model)
    mj_model.opt.gravity[:] = vector
    return replace(robot, mj_model=mj_model)


def tilt_axes(vector: Array) -> Array:
    """Return (2, 3) unit vectors perpendicular to gravity and to each other.

    Raises:
        InputError: there is no gravity.
    """
    size = float(np.linalg.norm(vector))
    if size == 0.0:
        raise InputError("--tilt auto needs gravity, but the model's gravity is zero")
    down = np.asarray(vector) / size
    first = np.cross(down, np.eye(3)[int(np.argmin(np.abs(down)))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(down, first)])


def turned(vector: Array, angles: Array) -> Array:
    """Return gravity (3,) turned by two angles (2,) [rad] about ``tilt_axes``."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(angles @ tilt_axes(vector)).apply(vector))


class TiltColumns:
    """Columns of the two tilt angles in the joints' equations.

    Args:
        robot: the arm, with the gravity around which to linearise.
        theta: (10,) current estimate of the terminal link.
    """

    def __init__(self, robot: RobotModel, theta: Array) -> None:
        self._theta = theta
        here = gravity(robot)
        changes = [np.cross(axis, here) for axis in tilt_axes(here)]
        arms = [with_gravity(robot, vector) for vector in (np.zeros(3), *changes)]
        self._kinematics = [ChainKinematics(arm) for arm in arms]

    def evaluate(self, q: Array) -> Array:
        """Return (N, n, 2) torque per radian of tilt at positions q (N, n) [N m/rad]."""
        still = np.zeros_like(q)
        motions = (kinematics.evaluate(q, still, still) for kinematics in self._kinematics)
        weightless, *tilted = (joint_torque(motion, self._theta) for motion in motions)
        return np.stack([torque - weightless for torque in tilted], axis=-1)
