"""What a real arm does not tell of itself, as columns in the joints' equations.

An encoder whose zero is off, a base that is tilted by two angles: to first order each adds its
column, here, times an unknown whose size is known beforehand (``estimation.algebra.nuisances``).

Zero of a joint: -d tau / d q_joint [N m/rad]. Tilt: joint torques are linear in gravity g. Turning
it by small angles a1, a2 about two axes e1, e2 perpendicular to it adds a1 tau(e1 x g) +
a2 tau(e2 x g), tau(.) the torque of the resting arm under that gravity. Estimated, applied and
estimated again, this converges in a few rounds.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.newton_euler import LinkDynamics, in_parts
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, RobotModel

TILT_NAMES = ("tilt_1", "tilt_2")
_MOST_TURNED = 1000
"""Rows turned at once."""


def gravity(robot: RobotModel) -> Array:
    """Return the model's gravity vector (3,) in the world frame [m/s^2]."""
    return np.array(robot.mj_model.opt.gravity, dtype=float)


def with_gravity(robot: RobotModel, vector: Array) -> RobotModel:
    """Return the arm under another gravity (3,) [m/s^2]."""
    mj_model = copy.copy(robot.mj_model)
    mj_model.opt.gravity[:] = vector
    return replace(robot, mj_model=mj_model)


def tilt_axes(vector: Array) -> Array:
    """Return (2, 3) unit vectors perpendicular to gravity and to each other."""
    size = float(np.linalg.norm(vector))
    if size == 0.0:
        raise InputError("--tilt auto needs gravity, but the model's gravity is zero")
    down = np.asarray(vector) / size
    first = np.cross(down, np.eye(3)[int(np.argmin(np.abs(down)))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(down, first)])


def turned(vector: Array, angles: Array) -> Array:
    """Return gravity (3,) turned by two angles (2,) [rad] about ``tilt_axes``."""
    turn = angles @ tilt_axes(vector)
    # Perpendicular to gravity, as Rodrigues' formula has it; numpy's sinc(x) is that of pi x.
    size = float(np.linalg.norm(turn))
    return np.cos(size) * vector + np.sinc(size / np.pi) * np.cross(turn, vector)


def tilt_columns(robot: RobotModel, thetas: Array, q: Array) -> Array:
    """Return (N, n, 2) torque per radian of tilt around the arm's gravity [N m/rad], of links
    known as theta (n, 10), at positions q (N, n).
    """
    here, found = gravity(robot), []
    down = np.cross(tilt_axes(here), here).T
    for some in np.array_split(q, len(q) // _MOST_TURNED + 1):
        twice, still = np.tile(some, (2, 1)), np.zeros((2 * len(some), q.shape[1]))
        dynamics = LinkDynamics(robot, np.repeat(down, len(some), axis=1))
        found.append(np.split(dynamics.motion(twice, still, still).torque(thetas), 2))
    return np.moveaxis(np.concatenate(found, axis=1), 0, -1)


def zero_columns(robot: RobotModel, thetas: Array, motion: Motion) -> Array:
    """Return (K, n, n) torque per radian that a joint's reading is too large [N m/rad], of links
    known as theta (n, 10).
    """
    dynamics, width = LinkDynamics(robot), 12 * motion.q.shape[1] ** 2
    parts = in_parts(width, motion.q, motion.qd, motion.qdd)
    return np.concatenate([-dynamics.motion(*each).slopes(thetas, each[1]) for each in parts])
