"""The direction of gravity as two unknown angles: an arm whose base is not quite level.

Joint torques are linear in the gravity vector g. Turning g by small angles a1, a2 about two axes
e1, e2 perpendicular to it adds a1 tau(e1 x g) + a2 tau(e2 x g), tau(.) the torque of the resting
arm under that gravity. Estimated, applied and estimated again, this converges in a few rounds.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.errors import InputError
from robot_sysid.records import Array, RobotModel

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
        thetas: (n, 10) what is known so far of the links, see ``RobotModel.links``.
    """

    def __init__(self, robot: RobotModel, thetas: Array) -> None:
        here = gravity(robot)
        changes = [np.cross(axis, here) for axis in tilt_axes(here)]
        self._arms = [LinkDynamics(with_gravity(robot, change)) for change in changes]
        self._thetas = thetas

    def evaluate(self, q: Array) -> Array:
        """Return (N, n, 2) torque per radian of tilt at positions q (N, n) [N m/rad]."""
        still = np.zeros_like(q)
        torques = [arm.motion(q, still, still).torque(self._thetas) for arm in self._arms]
        return np.stack(torques, axis=-1)
