"""How far the convex shapes of bodies reach, in any direction or beyond forbidden planes.

A body is a set of points, the corners of its geoms, and what is round about each of them: the balls
at both ends of a capsule, the rims of a cylinder, an ellipsoid about its middle. The farthest point
along a direction is then the farthest corner plus the farthest point of its round part. MuJoCo
tells distances between geoms, but not from planes that are no part of a model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import data_at_pose, subtree
from robot_sysid.model.bodies import count_moving_joints
from robot_sysid.model.chain import body_label
from robot_sysid.motion import HalfSpace
from robot_sysid.records import Array, RobotModel

_TYPES = mujoco.mjtGeom
_CORNERS = np.array(
    [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
)
_ENDS = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
_AXES = np.vstack((np.eye(3), -np.eye(3)))
_HULL_POINTS = 60
"""Corners beyond which a convex hull takes less time than it saves."""
_AT_ONCE = 256
"""Postures looked at in one product: as much memory as fits into a processor's cache."""


class Solid:
    """One body: its geoms that collide, else those that are seen, else its origin.

    Attributes:
        points: (P, 3) corners in the body's frame [m]; none of a body that is a plane.
        spread: (P, 3, 3) matrix that maps the unit ball to the ellipsoid about each corner [m].
        radius: (P,) largest half axis of this ellipsoid [m].
        center: (3,) centre of a ball that contains the body, in the body's frame [m].
        bound: radius of that ball [m].
    """

    def __init__(self, mj_model: Any, body: int) -> None:
        self.body = body
        geoms = np.flatnonzero(mj_model.geom_bodyid == body)
        solid = mj_model.geom_contype[geoms] | mj_model.geom_conaffinity[geoms]
        shape_geoms = geoms[solid != 0] if np.any(solid) else geoms
        origin = int(len(shape_geoms) == 0)
        points = [np.zeros((origin, 3))]
        spread = [np.zeros((origin, 3, 3))]
        for geom in shape_geoms:
            corners, axes = _shape(mj_model, int(geom))
            matrix = np.zeros(9)
            mujoco.mju_quat2Mat(matrix, mj_model.geom_quat[geom])
            turn = matrix.reshape(3, 3)
            points.append(mj_model.geom_pos[geom] + corners @ turn.T)
            spread.append(np.tile(turn * axes, (len(corners), 1, 1)))
        self.points = np.concatenate(points)
        self.spread = np.concatenate(spread)
        self.radius = np.max(np.linalg.norm(self.spread, axis=1), axis=1)
        on_hull = _on_the_hull(self.points, self.radius)
        self.points = self.points[on_hull]
        self.spread = self.spread[on_hull]
        self.radius = self.radius[on_hull]
        self._round = np.flatnonzero(self.radius)
        self._spreads = self.spread[self._round].transpose(1, 0, 2).reshape(3, -1)
        empty = len(self.points) == 0
        ends = (
            (np.zeros(3),)
            if empty
            else (np.min(self.points, 0), np.max(self.points, 0))
        )
        self.center = np.mean(ends, axis=0)
        reach = np.linalg.norm(self.points - self.center, axis=1) + self.radius
        self.bound = float(np.max(reach, initial=0.0))

    def farthest(self, directions: Array) -> Array:
        """Return the points (K, 3) farthest along unit directions (K, 3), in the body's frame."""
        heights = directions @ self.points.T
        round_ones = self._round
        if len(round_ones):
            turned = (directions @ self._spreads).reshape(len(directions), -1, 3)
            heights[:, round_ones] += np.sqrt(np.einsum("kpb,kpb->kp", turned, turned))
        best = np.argmax(heights, axis=1)
        if not len(round_ones):
            return np.asarray(self.points[best])
        spread = self.spread[best]
        around = np.einsum("ka,kab->kb", directions, spread)
        length = np.sqrt(np.einsum("kb,kb->k", around, around))[:, None]
        around /= np.where(length > 0.0, length, 1.0)
        return np.asarray(self.points[best] + np.einsum("kab,kb->ka", spread, around))


def solids_of(mj_model: Any, bodies: Sequence[int]) -> list[Solid]:
    """Return bodies with an extent of their own: MuJoCo's planes have none."""
    solids = (Solid(mj_model, int(body)) for body in bodies)
    return [solid for solid in solids if len(solid.points)]


def _shape(mj_model: Any, geom: int) -> tuple[Array, Array]:
    """Return corners (P, 3) of a geom, and half axes (3,) of what is round about each [m]."""
    geom_type = int(mj_model.geom_type[geom])
    size = mj_model.geom_size[geom]
    axes = np.zeros(3)
    if geom_type == _TYPES.mjGEOM_PLANE:
        return np.zeros((0, 3)), axes
    if geom_type in (_TYPES.mjGEOM_MESH, _TYPES.mjGEOM_SDF):
        return _hull_vertices(mj_model, int(mj_model.geom_dataid[geom])), axes
    if geom_type == _TYPES.mjGEOM_BOX:
        return size * _CORNERS, axes
    axes[:] = size if geom_type == _TYPES.mjGEOM_ELLIPSOID else size[0]
    if geom_type == _TYPES.mjGEOM_CYLINDER:
        axes[2] = 0.0
    is_long = geom_type in (_TYPES.mjGEOM_CAPSULE, _TYPES.mjGEOM_CYLINDER)
    return size[1] * _ENDS if is_long else np.zeros((1, 3)), axes


def _hull_vertices(mj_model: Any, mesh: int) -> Array:
    """Return the vertices (P, 3) of a mesh; of its convex hull where MuJoCo has computed one."""
    first = int(mj_model.mesh_vertadr[mesh])
    count = int(mj_model.mesh_vertnum[mesh])
    vertices = np.array(mj_model.mesh_vert[first : first + count], dtype=float)
    graph = int(mj_model.mesh_graphadr[mesh])
    if graph < 0:
        return vertices
    # For each mesh: P, F, P addresses, P vertex numbers, ...
    hull = int(mj_model.mesh_graph[graph])
    return vertices[mj_model.mesh_graph[graph + 2 + hull : graph + 2 + 2 * hull]]


class HalfSpaces:
    """How far B bodies are from K boundaries with normals (K, 3), and which distance each has to
    keep (B, K) [m], minus infinite where a half-space does not bind it.
    """

    def __init__(self, mj_model: Any, spaces: Sequence[HalfSpace]) -> None:
        self.spaces = tuple(spaces)
        self.solids = solids_of(
            mj_model, sorted({body for s in spaces for body in s.bodies})
        )
        self.normals = np.array([space.normal for space in spaces]).reshape(-1, 3)
        self._bodies = np.array([solid.body for solid in self.solids], dtype=int)
        self._centers = np.array([solid.center for solid in self.solids]).reshape(-1, 3)
        self._bounds = np.array([[solid.bound] for solid in self.solids])
        self._offsets = np.array([space.offset for space in spaces])
        self.required = np.full((len(self.solids), len(spaces)), -np.inf)
        for row, solid in zip(self.required, self.solids):
            for k, space in enumerate(spaces):
                if solid.body in space.bodies:
                    row[k] = space.clearance

    def heights(
        self, positions: Array, rotations: Array, margin: float = np.inf
    ) -> Iterator[tuple[int, NDArray[np.intp], Array, Array]]:
        """Yield per body its index, the indices (M,) of postures, and its heights (M, K) above
        the boundaries there and its lowest points (M, K, 3) [m].

        Args:
            positions: (N, nbody, 3) of the bodies in N postures, MuJoCo's xpos [m].
            rotations: (N, nbody, 9) of the bodies, MuJoCo's xmat.
            margin: postures are left out that surely have more height than required by this [m].
        """
        positions = positions[:, self._bodies]
        rotations = rotations[:, self._bodies].reshape(*positions.shape, 3)
        middle = positions + (rotations @ self._centers[:, :, None])[..., 0]
        least_height = middle @ self.normals.T - self._offsets - self._bounds
        is_near = np.any(least_height - self.required < margin, axis=2)
        for k in np.flatnonzero(np.any(is_near, axis=0)).tolist():
            postures = np.flatnonzero(is_near[:, k])
            turn = rotations[postures, k]
            directions = (-self.normals @ turn).reshape(-1, 3)
            corner = self.solids[k].farthest(directions).reshape(len(postures), -1, 3)
            lowest = positions[postures, k, None] + corner @ turn.transpose(0, 2, 1)
            yield (
                k,
                postures,
                np.sum(lowest * self.normals, axis=2) - self._offsets,
                lowest,
            )


def swept_space(robot: RobotModel, q: Array) -> tuple[Array, Array, str]:
    """Return the box (3,), (3,) [m] that all moving parts stay in, and which body gets lowest.

    At chain positions q (N, n), in axes of the world.
    """
    model = robot.mj_model
    data = data_at_pose(robot.mj_model, robot.reference_qpos)
    solids = solids_of(model, np.flatnonzero(count_moving_joints(robot)).tolist())
    bodies = [solid.body for solid in solids]
    reach = np.full((len(solids), 6), -np.inf)
    for chunk in np.array_split(q, 1 + len(q) // _AT_ONCE):
        frames = np.empty((len(chunk), len(bodies), 4, 3))
        for posture, frame in zip(chunk, frames):
            data.qpos[robot.qpos_index] = posture
            mujoco.mj_kinematics(model, data)
            frame[:, 0] = data.xpos[bodies]
            frame[:, 1:] = data.xmat[bodies].reshape(-1, 3, 3)
        for k, solid in enumerate(solids):
            directions = (_AXES @ frames[:, k, 1:]).reshape(-1, 3)
            height = np.sum(solid.farthest(directions) * directions, axis=1).reshape(
                -1, 6
            )
            highest = np.max(
                height + frames[:, k, 0] @ _AXES.T, axis=0, initial=-np.inf
            )
            reach[k] = np.maximum(reach[k], highest)
    lowest = int(np.argmax(reach[:, 5]))
    (*upper, x, y, z) = np.max(reach, axis=0)
    return -np.array([x, y, z]), np.array(upper), body_label(model, bodies[lowest])


def mounting_height(
    robot: RobotModel, start_pose: Array
) -> tuple[Array, float, list[int]] | None:
    """Return (up (3,), height of the ground along it [m], ids of the moving bodies above it).

    The height is the lowest of the origin of the body that carries the arm and of everything that
    is fixed to that body (its meshes where it has any, as collision geometry may be rough): the
    foot of a pedestal is on the ground. None without gravity, or where more of the arm than its
    first link is below that height: such an arm hangs, or stands at an edge.

    Args:
        robot: the arm.
        start_pose: (n,) joint positions in which the arm is looked at [rad or m].
    """
    model = robot.mj_model
    link_of_body = count_moving_joints(robot)
    down = np.array(model.opt.gravity, dtype=float)
    if not np.any(down):
        return None
    up = -down / np.linalg.norm(down)
    qpos = robot.reference_qpos.copy()
    qpos[robot.qpos_index] = start_pose
    data = data_at_pose(model, qpos)
    carrier = int(model.body_parentid[np.flatnonzero(link_of_body)[0]])
    fixed = np.flatnonzero(model.body_weldid == model.body_weldid[carrier])
    meshes = np.flatnonzero(
        np.isin(model.geom_bodyid, fixed) & (model.geom_type == _TYPES.mjGEOM_MESH)
    )

    def lowest(solid: Solid) -> float:
        turn = data.xmat[solid.body].reshape(3, 3)
        return float(
            up @ (data.xpos[solid.body] + turn @ solid.farthest(-up[None] @ turn)[0])
        )

    feet = [lowest(solid) for solid in solids_of(model, fixed.tolist())]
    if len(meshes):
        corners = [
            data.geom_xpos[geom]
            + _shape(model, geom)[0] @ data.geom_xmat[geom].reshape(3, 3).T
            for geom in meshes.tolist()
        ]
        feet = [float(np.min(np.concatenate(corners) @ up))]
    height = min(float(up @ data.xpos[carrier]), *feet, np.inf)
    heights = {
        s.body: lowest(s)
        for s in solids_of(model, np.flatnonzero(link_of_body).tolist())
    }
    low_bodies = [
        body for body, body_height in heights.items() if body_height <= height
    ]
    if any(link_of_body[body] > 1 for body in low_bodies):
        return None
    return up, height, [body for body in heights if body not in low_bodies]


def has_floor(robot: RobotModel) -> bool:
    """Return whether the model has a level plane, or ground of any form, that the arm can touch."""
    model = robot.mj_model
    fixed = model.body_weldid[model.geom_bodyid] == 0
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    ground = np.isin(
        model.geom_type, (int(_TYPES.mjGEOM_PLANE), int(_TYPES.mjGEOM_HFIELD))
    )
    return bool(np.any(fixed & solid & ground))


def outermost_points(robot: RobotModel) -> tuple[Array, Array]:
    """Return corners (P, 3) of the terminal link and all it carries, and the radius of a ball (P,).

    In the terminal body's frame [m]. All of the link is within the convex hull of these balls.
    """
    data = data_at_pose(robot.mj_model, robot.reference_qpos)
    body = robot.body_id
    solids = solids_of(robot.mj_model, subtree(robot.mj_model, body))
    axes = data.xmat[body].reshape(3, 3)
    points = [np.zeros((0, 3))]
    radius = [np.zeros(0)]
    for solid in solids:
        corners = (
            data.xpos[solid.body] + solid.points @ data.xmat[solid.body].reshape(3, 3).T
        )
        points.append((corners - data.xpos[body]) @ axes)
        radius.append(solid.radius)
    all_points = np.vstack(points)
    all_radius = np.concatenate(radius)
    on_hull = _on_the_hull(all_points, all_radius)
    return all_points[on_hull], all_radius[on_hull]


def _on_the_hull(points: Array, radius: Array) -> Any:
    """Return which points have a radius, or are no points inside the convex hull of the others."""
    sharp = np.flatnonzero(radius == 0.0)
    if len(sharp) <= _HULL_POINTS:
        return np.arange(len(points))
    from scipy.spatial import ConvexHull, QhullError

    try:
        outer = sharp[ConvexHull(points[sharp]).vertices]
    except QhullError:  # All in one plane.
        return np.arange(len(points))
    return np.sort(np.concatenate((outer, np.flatnonzero(radius > 0.0))))
