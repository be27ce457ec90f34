"""What a real arm does not tell of itself, as columns in the joints' equations.

An encoder whose zero is off, a base that is tilted by two angles: to first order each adds its
column, here, times an unknown whose size is known beforehand (``estimation.algebra.priors``).

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
# Below 1 + cosine of every turn but one upside down, for which all axes are as good.
_OPPOSITE = 1e-12


def gravity(robot: RobotModel) -> Array:
    """Return the model's gravity vector (3,) in the world frame [m/s^2]."""
    return np.array(robot.mj_model.opt.gravity, dtype=float)


def with_gravity(robot: RobotModel, vector: Array) -> RobotModel:
    """Return the arm under another gravity (3,) [m/s^2]."""
    mj_model = copy.copy(robot.mj_model)
    mj_model.opt.gravity[:] = vector
    return replace(robot, mj_model=mj_model)


def tilt_axes(level: Array, vector: Array | None = None) -> Array:
    """Return (2, 3) unit vectors perpendicular to gravity ``level`` (3,) and to each other.

    With another gravity ``vector`` (3,) they are carried along by the shortest turn to it, so that
    angles about the axes of a tilted arm add to those about the axes of the level one.
    """
    size = float(np.linalg.norm(level))
    if size == 0.0:
        raise InputError("--tilt auto needs gravity, but the model's gravity is zero")
    down = np.asarray(level) / size
    first = np.cross(down, np.eye(3)[int(np.argmin(np.abs(down)))])
    first /= np.linalg.norm(first)
    axes = np.array([first, np.cross(down, first)])
    if vector is None:
        return axes
    there = vector / np.linalg.norm(vector)
    turn = np.cross(down, there)
    once = np.cross(turn, axes)
    return np.asarray(
        axes + once + np.cross(turn, once) / max(1.0 + down @ there, _OPPOSITE)
    )


def turned(vector: Array, angles: Array, axes: Array | None = None) -> Array:
    """Return gravity (3,) turned by two angles (2,) [rad] about ``axes`` (2, 3) perpendicular to
    it; without them, about its own ``tilt_axes``.
    """
    turn = angles @ (tilt_axes(vector) if axes is None else axes)
    # Perpendicular to gravity, as Rodrigues' formula has it; numpy's sinc(x) is that of pi x.
    size = float(np.linalg.norm(turn))
    return np.cos(size) * vector + np.sinc(size / np.pi) * np.cross(turn, vector)


def tilt_angles(level: Array, vector: Array) -> Array:
    """Return the angles (2,) [rad] about ``tilt_axes(level)`` that turn ``level`` to a gravity."""
    turn = np.cross(level, vector)
    sine = float(np.linalg.norm(turn))
    if sine == 0.0:
        return np.array([np.pi * (level @ vector < 0.0), 0.0])
    angle = np.arctan2(sine, level @ vector)
    return np.asarray(angle / sine * (tilt_axes(level) @ turn))


def tilt_columns(
    robot: RobotModel, thetas: Array, q: Array, level: Array | None = None
) -> Array:
    """Return (N, n, 2) torque per radian of tilt around the arm's gravity [N m/rad], of links
    known as theta (n, 10), at positions q (N, n).

    Without the gravity ``level`` (3,) that tilts are told from, the arm's own is that.
    """
    here = gravity(robot)
    found = []
    axes = tilt_axes(here if level is None else level, here)
    down = np.cross(axes, here).T
    for some in np.array_split(q, len(q) // _MOST_TURNED + 1):
        twice = np.tile(some, (2, 1))
        still = np.zeros((2 * len(some), q.shape[1]))
        dynamics = LinkDynamics(robot, np.repeat(down, len(some), axis=1))
        found.append(np.split(dynamics.motion(twice, still, still).torque(thetas), 2))
    return np.moveaxis(np.concatenate(found, axis=1), 0, -1)


def zero_columns(robot: RobotModel, thetas: Array, motion: Motion) -> Array:
    """Return (K, n, n) torque per radian that a joint's reading is too large [N m/rad], of links
    known as theta (n, 10).
    """
    dynamics = LinkDynamics(robot)
    width = 12 * motion.q.shape[1] ** 2
    parts = in_parts(width, motion.q, motion.qd, motion.qdd)
    return np.concatenate(
        [-dynamics.motion(*each).slopes(thetas, each[1]) for each in parts]
    )
