"""Where the moving parts of an arm get to, and which points of its tool are outermost."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from robot_sysid.collision.solids import Solids
from robot_sysid.dynamics.kinematics import subtree
from robot_sysid.model.chain import body_label
from robot_sysid.model.contacts import parts_of
from robot_sysid.records import Array, RobotModel

_AXES = np.vstack((np.eye(3), -np.eye(3)))
_MANY = 60
"""Corners of a tool beyond which it pays to drop those inside their convex hull."""


@dataclass(frozen=True)
class SweptSpace:
    """The box that all moving parts stay in along a motion, axes of the world.

    Attributes:
        lower, upper: (3,) opposite corners [m].
        lowest: name of the body that gets lowest.
    """

    lower: Array
    upper: Array
    lowest: str


def swept_space(robot: RobotModel, positions: Iterable[Array]) -> SweptSpace:
    """Return where the moving parts get to.

    Args:
        robot: the arm.
        positions: chain positions (N, n) along the motion, in parts.
    """
    model = robot.mj_model
    solids = Solids(model, np.flatnonzero(parts_of(robot)).tolist())
    data, reach, body = _resting(robot), np.full(6, -np.inf), int(solids.body[0])
    for q in (q for part in positions for q in part):
        data.qpos[robot.qpos_index] = q
        mujoco.mj_kinematics(model, data)
        # A ball about each shape tells which shapes may reach farther than any has so far.
        possible = solids.centers(data) @ _AXES.T + solids.bound[:, None] > reach
        for shape in np.flatnonzero(np.any(possible, axis=1)):
            here = np.sum(solids.extremes(data, int(shape), _AXES) * _AXES, axis=1)
            body = int(solids.body[shape]) if here[5] > reach[5] else body
            reach = np.maximum(reach, here)
    return SweptSpace(-reach[3:], reach[:3], body_label(model, body))


def has_floor(robot: RobotModel) -> bool:
    """Tell whether the model has a level plane, or ground of any form, that the arm can touch."""
    model = robot.mj_model
    fixed = model.body_weldid[model.geom_bodyid] == 0
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    ground = np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD))
    return bool(np.any(fixed & solid & ground))


def outermost_points(robot: RobotModel) -> tuple[Array, Array]:
    """Return corners (P, 3) of the terminal link and all it carries, and the radius of a ball (P,).

    In the terminal body's frame [m]. All of the link is within the convex hull of these balls.
    """
    data, body = _resting(robot), robot.body_id
    mujoco.mj_kinematics(robot.mj_model, data)
    solids = Solids(robot.mj_model, subtree(robot.mj_model, body))
    axes = data.xmat[body].reshape(3, 3)
    points, radius = [np.zeros((0, 3))], [np.zeros(0)]
    for shape in solids.shapes:
        corners = data.xpos[[shape.body]]
        if shape.geom >= 0:
            turned = shape.corners @ data.geom_xmat[shape.geom].reshape(3, 3).T
            corners = data.geom_xpos[shape.geom] + turned
        points.append((corners - data.xpos[body]) @ axes)
        radius.append(np.full(len(corners), shape.radius))
    return _on_the_hull(np.vstack(points), np.concatenate(radius))


def _resting(robot: RobotModel) -> Any:
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.reference_qpos
    return data


def _on_the_hull(points: Array, radius: Array) -> tuple[Array, Array]:
    """Leave out points without radius that are inside the convex hull of the others."""
    sharp = np.flatnonzero(radius == 0.0)
    if len(sharp) <= _MANY:
        return points, radius
    from scipy.spatial import ConvexHull, QhullError

    try:
        outer = sharp[ConvexHull(points[sharp]).vertices]
    except QhullError:  # All in one plane.
        return points, radius
    kept = np.sort(np.concatenate((outer, np.flatnonzero(radius > 0.0))))
    return points[kept], radius[kept]
