"""The convex shapes of bodies: how far they reach, in any direction or beyond forbidden planes.

Every geom is a set of points, the corners it has, and what is round about each of them: the balls
at both ends of a capsule, the rims of a cylinder, an ellipsoid about its middle. The farthest point
along a direction is then the farthest corner plus the farthest point of its round part.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics.kinematics import subtree
from robot_sysid.model.chain import body_label
from robot_sysid.model.contacts import parts_of
from robot_sysid.motion.options import HalfSpace
from robot_sysid.records import Array, RobotModel

_TYPES = mujoco.mjtGeom
_SPHERE, _CAPSULE = int(_TYPES.mjGEOM_SPHERE), int(_TYPES.mjGEOM_CAPSULE)
_CYLINDER, _ELLIPSOID = int(_TYPES.mjGEOM_CYLINDER), int(_TYPES.mjGEOM_ELLIPSOID)
_BOX, _PLANE = int(_TYPES.mjGEOM_BOX), int(_TYPES.mjGEOM_PLANE)
_MESHES = (int(_TYPES.mjGEOM_MESH), int(_TYPES.mjGEOM_SDF))
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_ENDS = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
_AXES = np.vstack((np.eye(3), -np.eye(3)))
_MANY = 60
"""Corners of a tool beyond which it pays to drop those inside their convex hull."""


@dataclass(frozen=True)
class Shape:
    """A geom, or a body's origin (geom -1): an ellipsoid about each of its corners.

    In the geom's frame the ``corners`` are (P, 3) and ``axes`` (3,) is half the size of what is
    round about each, along the frame's axes [m].
    """

    geom: int
    body: int
    corners: Array
    axes: Array

    @property
    def radius(self) -> float:
        """Radius of a ball that holds what is round about each corner [m]."""
        return float(np.max(self.axes))

    def extremes(self, directions: Array) -> Array:
        """Return the points (K, 3) farthest along unit directions (K, 3), in the geom's frame."""
        corner = self.corners[np.argmax(self.corners @ directions.T, axis=0)]
        length = np.linalg.norm(self.axes * directions, axis=1, keepdims=True)
        return corner + self.axes**2 * directions / np.where(length > 0.0, length, 1.0)


class Solids:
    """The shapes of some bodies: what collides of each, else what is seen, else its origin.

    MuJoCo's planes have no extent of their own and are left out.

    Attributes:
        body: (G,) the body each of the G shapes belongs to.
        bound: (G,) radius of a ball about each shape's frame that holds all of it [m].
    """

    def __init__(self, mj_model: Any, bodies: Sequence[int]) -> None:
        self.shapes = [
            _shape(mj_model, geom, body) for body in bodies for geom in _geoms(mj_model, body)
        ]
        self.body = np.array([shape.body for shape in self.shapes], dtype=int)
        self.bound = np.array(
            [np.max(np.linalg.norm(s.corners, axis=1)) + s.radius for s in self.shapes]
        )
        self._geom = np.array([shape.geom for shape in self.shapes], dtype=int)
        self._is_geom = self._geom >= 0

    def centers(self, data: Any) -> Array:
        """Return where the frame of each shape is (G, 3) [m]."""
        found = data.xpos[self.body]
        found[self._is_geom] = data.geom_xpos[self._geom[self._is_geom]]
        return np.asarray(found)

    def extremes(self, data: Any, shape: int, directions: Array) -> Array:
        """Return the points (K, 3) of a shape farthest along unit directions (K, 3) [m], world."""
        place, turn = self.frame(data, shape)
        return place + self.shapes[shape].extremes(directions @ turn) @ turn.T

    def frame(self, data: Any, shape: int) -> tuple[Array, Array]:
        """Return position (3,) [m] and rotation (3, 3) of a shape's frame in the world."""
        one = self.shapes[shape]
        places, turns, k = data.geom_xpos, data.geom_xmat, one.geom
        if one.geom < 0:
            places, turns, k = data.xpos, data.xmat, one.body
        return places[k], turns[k].reshape(3, 3)


def _geoms(mj_model: Any, body: int) -> list[int]:
    """Return the geoms that stand for a body; -1 for its origin."""
    geoms = np.flatnonzero(mj_model.geom_bodyid == body)
    solid = mj_model.geom_contype[geoms] | mj_model.geom_conaffinity[geoms]
    chosen = geoms[solid != 0] if np.any(solid) else geoms
    if len(chosen) == 0:
        return [-1]
    return [int(geom) for geom in chosen if mj_model.geom_type[geom] != _PLANE]


def _shape(mj_model: Any, geom: int, body: int) -> Shape:
    corners, axes = np.zeros((1, 3)), np.zeros(3)
    if geom < 0:
        return Shape(geom, body, corners, axes)
    kind, size = int(mj_model.geom_type[geom]), mj_model.geom_size[geom].copy()
    if kind in _MESHES:
        corners = _hull_vertices(mj_model, int(mj_model.geom_dataid[geom]))
    elif kind in (_CAPSULE, _CYLINDER):
        corners = size[1] * _ENDS
    elif kind == _BOX:
        corners = size * _CORNERS
    if kind == _ELLIPSOID:
        axes = size
    elif kind in (_SPHERE, _CAPSULE, _CYLINDER):
        axes[: 2 if kind == _CYLINDER else 3] = size[0]
    return Shape(geom, body, corners, axes)


def _hull_vertices(mj_model: Any, mesh: int) -> Array:
    """Return the vertices (P, 3) of a mesh; of its convex hull where MuJoCo has computed one.

    ``mesh_graph`` holds [P, F, P addresses, P vertex numbers, ...] for each mesh.
    """
    first, count = int(mj_model.mesh_vertadr[mesh]), int(mj_model.mesh_vertnum[mesh])
    vertices = np.array(mj_model.mesh_vert[first : first + count], dtype=float)
    graph = int(mj_model.mesh_graphadr[mesh])
    if graph < 0:
        return vertices
    hull = int(mj_model.mesh_graph[graph])
    return vertices[mj_model.mesh_graph[graph + 2 + hull : graph + 2 + 2 * hull]]


class HalfSpaces:
    """How far some bodies are from the boundaries of half-spaces.

    Attributes:
        required: (G, K) distance that each shape has to keep from each boundary [m]; minus infinite
            where a half-space does not bind its body.
        body: (G,) the body of each shape.
    """

    def __init__(self, mj_model: Any, spaces: Sequence[HalfSpace]) -> None:
        self.spaces = tuple(spaces)
        bodies = sorted({body for space in spaces for body in space.bodies})
        self._solids = Solids(mj_model, bodies)
        self.body = self._solids.body
        self._normals = np.array([space.normal for space in spaces]).reshape(-1, 3)
        self._offsets = np.array([space.offset for space in spaces])
        binding = np.array([np.isin(self.body, space.bodies) for space in spaces]).T
        clearance = np.array([space.clearance for space in spaces])
        self.required = np.where(binding.reshape(-1, len(spaces)), clearance, -np.inf)

    def heights(self, data: Any, near: float = np.inf) -> Iterator[tuple[int, Array, Array]]:
        """Yield (shape, heights (K,), lowest points (K, 3)) of the shapes above the boundaries.

        Shapes that surely have so much more height than they need are left out: ``near`` [m].
        """
        surely = self._solids.centers(data) @ self._normals.T - self._offsets
        surely -= self._solids.bound[:, None] + self.required
        for shape in np.flatnonzero(np.min(surely, axis=1) < near):
            lowest = self._solids.extremes(data, int(shape), -self._normals)
            yield int(shape), np.sum(lowest * self._normals, axis=1) - self._offsets, lowest


@dataclass(frozen=True)
class SweptSpace:
    """The box [m] that all moving parts stay in, axes of the world; which body gets lowest."""

    lower: Array
    upper: Array
    lowest: str


def swept_space(robot: RobotModel, positions: Iterable[Array]) -> SweptSpace:
    """Return where the moving parts get to at chain positions (N, n) along a motion, in parts."""
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
    ground = np.isin(model.geom_type, (_PLANE, int(_TYPES.mjGEOM_HFIELD)))
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
    for k, shape in enumerate(solids.shapes):
        place, turn = solids.frame(data, k)
        points.append((place + shape.corners @ turn.T - data.xpos[body]) @ axes)
        radius.append(np.full(len(shape.corners), shape.radius))
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
