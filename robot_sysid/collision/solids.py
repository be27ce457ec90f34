"""The convex shapes of some bodies, and how far they reach in any direction.

Every geom is a set of points, the corners it has, and what is round about each of them: the balls
at both ends of a capsule, the rims of a cylinder, an ellipsoid about its middle. The farthest point
along a direction is then the farthest corner plus the farthest point of its round part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from robot_sysid.records import Array

_TYPES = mujoco.mjtGeom
_SPHERE, _CAPSULE = int(_TYPES.mjGEOM_SPHERE), int(_TYPES.mjGEOM_CAPSULE)
_CYLINDER, _ELLIPSOID = int(_TYPES.mjGEOM_CYLINDER), int(_TYPES.mjGEOM_ELLIPSOID)
_BOX, _PLANE = int(_TYPES.mjGEOM_BOX), int(_TYPES.mjGEOM_PLANE)
_MESHES = (int(_TYPES.mjGEOM_MESH), int(_TYPES.mjGEOM_SDF))
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_ENDS = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Shape:
    """A convex shape.

    Attributes:
        geom: geom id; -1 for a body's origin.
        body: the body it belongs to.
        kind: MuJoCo's geom type.
        size: (3,) MuJoCo's geom size [m].
        corners: (P, 3) in the geom's frame [m].
    """

    geom: int
    body: int
    kind: int
    size: Array
    corners: Array

    @property
    def radius(self) -> float:
        """Radius of a ball that holds what is round about each corner [m]."""
        if self.kind == _ELLIPSOID:
            return float(np.max(self.size))
        return float(self.size[0]) if self.kind in (_SPHERE, _CAPSULE, _CYLINDER) else 0.0

    def extremes(self, directions: Array) -> Array:
        """Return the points (K, 3) farthest along unit directions (K, 3), in the geom's frame."""
        corner = self.corners[np.argmax(self.corners @ directions.T, axis=0)]
        if self.kind in (_SPHERE, _CAPSULE):
            return corner + self.size[0] * directions
        if self.kind == _CYLINDER:
            flat = directions * np.array([1.0, 1.0, 0.0])
            wide = np.linalg.norm(flat, axis=1, keepdims=True)
            return corner + self.size[0] * flat / np.where(wide > 0.0, wide, 1.0)
        if self.kind == _ELLIPSOID:
            length = np.linalg.norm(self.size * directions, axis=1, keepdims=True)
            return corner + self.size**2 * directions / np.where(length > 0.0, length, 1.0)
        return corner


class Solids:
    """The shapes of some bodies: what collides of each, else what is seen, else its origin.

    MuJoCo's planes have no extent of their own and are left out.

    Args:
        mj_model: compiled model.
        bodies: body ids.

    Attributes:
        shapes: the G shapes.
        body: (G,) the body each belongs to.
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
        """Return the points (K, 3) of a shape farthest along unit directions (K, 3) [m].

        Args:
            data: MuJoCo data, positions computed.
            shape: its number.
            directions: in the world frame, as the points are.
        """
        one = self.shapes[shape]
        if one.geom < 0:
            return np.broadcast_to(data.xpos[one.body], directions.shape)
        rotation = data.geom_xmat[one.geom].reshape(3, 3)
        return data.geom_xpos[one.geom] + one.extremes(directions @ rotation) @ rotation.T


def _geoms(mj_model: Any, body: int) -> list[int]:
    """Return the geoms that stand for a body; -1 for its origin."""
    geoms = np.flatnonzero(mj_model.geom_bodyid == body)
    solid = mj_model.geom_contype[geoms] | mj_model.geom_conaffinity[geoms]
    chosen = geoms[solid != 0] if np.any(solid) else geoms
    if len(chosen) == 0:
        return [-1]
    return [int(geom) for geom in chosen if mj_model.geom_type[geom] != _PLANE]


def _shape(mj_model: Any, geom: int, body: int) -> Shape:
    if geom < 0:
        return Shape(geom, body, _SPHERE, np.zeros(3), np.zeros((1, 3)))
    kind, size = int(mj_model.geom_type[geom]), mj_model.geom_size[geom].copy()
    corners = np.zeros((1, 3))
    if kind in _MESHES:
        corners = _hull_vertices(mj_model, int(mj_model.geom_dataid[geom]))
    elif kind in (_CAPSULE, _CYLINDER):
        corners = size[1] * _ENDS
    elif kind == _BOX:
        corners = size * _CORNERS
    return Shape(geom, body, kind, size, corners)


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
