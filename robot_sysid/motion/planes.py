"""Distances of bodies from planes that are no part of a model: walls, ground, boxes.

A body is all that is drawn of it or collides. Its distance from a plane is that of its point that
lies farthest against the plane's normal, by the support function of its shapes: of boxes and meshes
the extreme corner, of round ones

    c - (D^2 u / |D u| + h sign(u . z) z)

with the middle c, the direction u, the semi-axes D of an ellipsoid and half the length h of a line
along z that it is swept along. So spheres, capsules, ellipsoids and, with no third semi-axis,
cylinders are one formula (van den Bergen, "Collision Detection in Interactive 3D Environments",
2003, section 4.3.4). Distances are exact, negative ones too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import data_at_pose, subtree
from robot_sysid.model.stated import GROUND_TYPES
from robot_sysid.records import Array, RobotModel

# MuJoCo's types of geoms.
_TYPES = mujoco.mjtGeom
# Semi-axes of an ellipsoid, and half the length of the line that it is swept along, of each round
# shape with the three sizes that MuJoCo gives it.
_ROUND: dict[int, Callable[[float, float, float], tuple[list[float], float]]] = {
    int(_TYPES.mjGEOM_SPHERE): lambda x, y, z: ([x, x, x], 0.0),
    int(_TYPES.mjGEOM_CAPSULE): lambda x, y, z: ([x, x, x], y),
    int(_TYPES.mjGEOM_ELLIPSOID): lambda x, y, z: ([x, y, z], 0.0),
    int(_TYPES.mjGEOM_CYLINDER): lambda x, y, z: ([x, x, 0.0], y),
}
# Corners (8, 3) of a cube with half sides of one.
_CUBE = 2.0 * np.indices((2, 2, 2)).reshape(3, 8).T - 1.0
# Size of a core that gives a flat drawing the volume that the search for its hull needs [m]: a
# hundredth of what is ever said of a distance.
_CORE = 1e-5 * np.vstack((np.eye(3), -np.eye(3)))
# Keeps the direction of a support point where it is a line or a point [m].
_TINY = 1e-300


class NearPlanes(NamedTuple):
    """C bodies that are near planes.

    Attributes:
        posture: (C,) index of the posture.
        plane: (C,) index of the plane.
        body: (C,) MuJoCo id of the body.
        distance: (C,) of the body from the plane [m]; negative beyond it.
        point: (C, 3) the body's point with that distance, in the world [m].
    """

    posture: NDArray[np.int64]
    plane: NDArray[np.int64]
    body: NDArray[np.int64]
    distance: Array
    point: Array


_NOWHERE = NearPlanes(
    posture=np.zeros(0, dtype=np.int64),
    plane=np.zeros(0, dtype=np.int64),
    body=np.zeros(0, dtype=np.int64),
    distance=np.zeros(0),
    point=np.zeros((0, 3)),
)


class Planes:
    """Planes, and bodies whose distances from them are asked.

    Args:
        mj_model: the model.
        bodies: MuJoCo ids of these bodies; those that are planes alone are left out. A body without
            any geom is its origin.
        planes: of each its normal (3,), a unit vector in the world, and its offset from the world's
            origin along it [m]. Distances are positive on the normal's side.
        margin: distance up to which a body is near a plane [m].
        is_part: (ngeom,) which geoms count.

    Attributes:
        bodies: (B,) MuJoCo ids of the bodies with a shape.
        count: number of planes.
    """

    def __init__(
        self,
        mj_model: Any,
        bodies: Sequence[int] | NDArray[np.int64],
        planes: Sequence[tuple[Array, float]],
        margin: float = 0.0,
        is_part: NDArray[np.bool_] | bool = True,
    ) -> None:
        self._shapes: dict[int, _Shape] = {}
        for body in np.unique(bodies).tolist():
            geoms = np.flatnonzero((mj_model.geom_bodyid == body) & is_part)
            is_solid = ~np.isin(mj_model.geom_type[geoms], GROUND_TYPES)
            if np.any(is_solid) or not len(geoms):
                self._shapes[body] = _shape(mj_model, geoms[is_solid].tolist())
        self.bodies = np.array(list(self._shapes), dtype=np.int64)
        self.count = len(planes)
        self._normals = np.array([normal for normal, _ in planes])
        self._offsets = np.array([offset for _, offset in planes])
        self._margin = margin

    def near(self, data: Any) -> NearPlanes:
        """Return which bodies are near planes in the posture that the model's ``data`` has."""
        return self._near(data.xpos[None], data.xmat[None], is_often_asked=False)

    def near_in_postures(self, positions: Array, matrices: Array) -> NearPlanes:
        """Return which bodies are near planes in N postures.

        Args:
            positions: (N, nbody, 3) of all bodies' origins in the world [m].
            matrices: (N, nbody, 9) their rotation matrices.
        """
        return self._near(positions, matrices, is_often_asked=True)

    def depths(self, data: Any) -> Array:
        """Return how far each body reaches beyond each plane (planes, B) [m], at least 0."""
        near = self.near(data)
        depths = np.zeros((self.count, len(self.bodies)))
        at = near.plane, np.searchsorted(self.bodies, near.body)
        np.maximum.at(depths, at, -near.distance)
        return depths

    def _near(
        self, positions: Array, matrices: Array, is_often_asked: bool
    ) -> NearPlanes:
        """Return which bodies are near planes in N postures.

        Args:
            positions, matrices: as of ``near_in_postures``.
            is_often_asked: whether to look for hulls of shapes, which takes as long as to look for
                the extreme one of all corners a hundred times.
        """
        found = [_NOWHERE]
        for body, shape in self._shapes.items():
            origin = positions[:, body]
            axes = matrices[:, body].reshape(-1, 3, 3)
            # (N, planes): the height of the origin; (N, planes, 3): the normal in the body's axes.
            heights = origin @ self._normals.T - self._offsets
            directions = self._normals @ axes
            # Most bodies are so far that a ball about them is far too.
            nearest = heights + directions @ shape.middle - shape.radius
            posture, plane = np.nonzero(nearest < self._margin)
            if not len(posture):
                continue
            direction = directions[posture, plane]
            corners = shape.hull if is_often_asked else shape.corners
            lowest = shape.lowest_points(direction, corners)
            distance = heights[posture, plane] + np.sum(direction * lowest, axis=1)
            point = origin[posture] + np.einsum("kab,kb->ka", axes[posture], lowest)
            ids = np.full_like(posture, body)
            near = NearPlanes(posture, plane, ids, distance, point)
            is_near = distance < self._margin
            found.append(NearPlanes(*(values[is_near] for values in near)))
        return NearPlanes(*map(np.concatenate, zip(*found)))


def tool_corners(robot: RobotModel) -> Array:
    """Return the corners (8, 3) of a box about the terminal link and all it carries, along the axes
    of the terminal body's frame, in that frame [m]; the frame's origin is in the box.
    """
    model = robot.mj_model
    data = data_at_pose(model, robot.reference_qpos)
    body = robot.body_id
    origin = data.xpos[body]
    axes = data.xmat[body].reshape(3, 3).T
    # Planes through the origin: how far the tool reaches beyond them is where the box ends.
    planes = [(normal, normal @ origin) for normal in (*axes, *-axes)]
    depths = Planes(model, subtree(model, body), planes).depths(data)
    extents = np.max(depths, axis=1, initial=0.0).reshape(2, 3)
    lower, upper = extents * [[-1.0], [1.0]]
    return 0.5 * (lower + upper + (upper - lower) * _CUBE)


@dataclass(frozen=True)
class _Round:
    """A round shape of a body, in the body's frame.

    Attributes:
        middle: (3,) [m].
        axes: (3, 3) its axes, one per column.
        semi_axes: (3,) of the ellipsoid [m].
        half_length: of the line along the third axis that it is swept along [m].
    """

    middle: Array
    axes: Array
    semi_axes: Array
    half_length: float

    @property
    def radius(self) -> float:
        """Radius of a ball about the middle that holds the shape [m]."""
        return float(np.max(self.semi_axes)) + self.half_length

    def lowest_points(self, directions: Array) -> Array:
        """Return the points (K, 3) that lie farthest against directions (K, 3)."""
        u = directions @ self.axes
        length = np.linalg.norm(self.semi_axes * u, axis=1, keepdims=True)
        reach = self.semi_axes**2 * u / np.maximum(length, _TINY)
        reach[:, 2] += self.half_length * np.sign(u[:, 2])
        return self.middle - reach @ self.axes.T


@dataclass(frozen=True)
class _Shape:
    """Shape of a body in its own frame.

    Attributes:
        corners: (V, 3) all corners of its boxes and meshes [m]; its origin where it has no geom.
        rounds: its round shapes.
    """

    corners: Array
    rounds: tuple[_Round, ...]

    @cached_property
    def middle(self) -> Array:
        """Middle (3,) of a ball that holds the shape [m]."""
        points = np.vstack((self.corners, *(each.middle for each in self.rounds)))
        return 0.5 * (np.min(points, axis=0) + np.max(points, axis=0))

    @cached_property
    def radius(self) -> float:
        """Radius of that ball [m]."""
        far = np.linalg.norm(self.corners - self.middle, axis=1)
        of_rounds = [
            float(np.linalg.norm(each.middle - self.middle)) + each.radius
            for each in self.rounds
        ]
        return max(float(np.max(far, initial=0.0)), *of_rounds, 0.0)

    @cached_property
    def hull(self) -> Array:
        """The corners (H, 3) of the convex hull of all corners [m]."""
        from scipy.spatial import ConvexHull

        if len(self.corners) <= len(_CUBE):
            return self.corners
        points = np.vstack((self.corners, np.mean(self.corners, axis=0) + _CORE))
        return points[np.sort(ConvexHull(points).vertices)]

    def lowest_points(self, directions: Array, corners: Array) -> Array:
        """Return the points (K, 3) of the shape that lie farthest against directions (K, 3).

        ``corners`` are all of its corners, or those of their hull.
        """
        candidates = [each.lowest_points(directions) for each in self.rounds]
        if len(corners):
            lowest = np.argmin(directions @ corners.T, axis=1)
            candidates.append(corners[lowest])
        points = np.stack(candidates)
        heights = np.sum(points * directions, axis=2)
        return points[np.argmin(heights, axis=0), np.arange(len(directions))]


def _shape(mj_model: Any, geoms: Sequence[int]) -> _Shape:
    """Return the shape of a body by geoms, given by their ids; its origin where there are none."""
    corners = [np.zeros((0 if geoms else 1, 3))]
    rounds = []
    for geom in geoms:
        middle = mj_model.geom_pos[geom]
        size = mj_model.geom_size[geom]
        geom_type = int(mj_model.geom_type[geom])
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, mj_model.geom_quat[geom])
        axes = matrix.reshape(3, 3)
        if geom_type in _ROUND:
            semi_axes, half_length = _ROUND[geom_type](*size.tolist())
            rounds.append(_Round(middle, axes, np.array(semi_axes), half_length))
            continue
        points = size * _CUBE
        if geom_type != _TYPES.mjGEOM_BOX:
            mesh = mj_model.geom_dataid[geom]
            first = mj_model.mesh_vertadr[mesh]
            count = mj_model.mesh_vertnum[mesh]
            points = mj_model.mesh_vert[first : first + count].astype(float)
        corners.append(middle + points @ axes.T)
    return _Shape(np.concatenate(corners), tuple(rounds))
