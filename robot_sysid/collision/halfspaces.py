"""Forbidden half-spaces, and the extreme points of geoms they are tested against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from robot_sysid.collision.obstacles import Box, Plane
from robot_sysid.records import Array


@dataclass(frozen=True)
class HalfSpace:
    """Space some bodies must stay in: normal . x >= offset.

    Attributes:
        normal: (3,) unit vector towards the allowed side, world frame.
        offset: of the boundary along the normal [m].
        clearance: distance to keep from the boundary [m].
        bodies: whose geoms are tested.
        label: what the reader calls it.
    """

    normal: Array
    offset: float
    clearance: float
    bodies: tuple[int, ...]
    label: str


def plane_half_space(plane: Plane, clearance: float, bodies: Sequence[int]) -> HalfSpace:
    """Return the allowed side of a keep-out plane."""
    label = f"the keep-out plane {np.round(plane.normal, 3).tolist()} at {plane.offset:g} m"
    return HalfSpace(np.array(plane.normal), plane.offset, clearance, tuple(bodies), label)


def box_half_spaces(box: Box, bodies: Sequence[int]) -> tuple[HalfSpace, ...]:
    """Return the finite sides of a workspace box; its walls may be touched."""
    found = []
    for axis in range(3):
        for sign, bound in ((1.0, box.lower[axis]), (-1.0, box.upper[axis])):
            if np.isfinite(bound):
                normal = sign * np.eye(3)[axis]
                side = "min" if sign > 0.0 else "max"
                label = f"the workspace's {'xyz'[axis]}{side} = {bound:g} m"
                found.append(HalfSpace(normal, sign * bound, 0.0, tuple(bodies), label))
    return tuple(found)


@dataclass(frozen=True)
class GeomShape:
    """A convex shape by its extreme points.

    Attributes:
        geom: geom id; -1 for the body's origin.
        body: the body it belongs to.
        kind: MuJoCo's geom type.
        size: (3,) MuJoCo's geom size [m].
        vertices: (P, 3) of a mesh, in the geom's frame [m].
    """

    geom: int
    body: int
    kind: int
    size: Array
    vertices: Array

    def extreme_point(self, direction: Array) -> Array:
        """Return the point (3,) farthest along a unit direction (3,), in the geom's frame."""
        if len(self.vertices):
            return self.vertices[np.argmax(self.vertices @ direction)]
        types = mujoco.mjtGeom
        if self.kind == int(types.mjGEOM_SPHERE):
            return self.size[0] * direction
        if self.kind == int(types.mjGEOM_ELLIPSOID):
            return self.size**2 * direction / np.linalg.norm(self.size * direction)
        if self.kind == int(types.mjGEOM_CAPSULE):
            return self.size[0] * direction + _end_cap(self.size[1], direction)
        if self.kind == int(types.mjGEOM_CYLINDER):
            flat = np.hypot(direction[0], direction[1])
            rim = np.array([direction[0], direction[1], 0.0]) / (flat if flat > 0.0 else 1.0)
            return self.size[0] * rim + _end_cap(self.size[1], direction)
        return self.size * np.sign(direction)


def _end_cap(half_length: float, direction: Array) -> Array:
    return np.array([0.0, 0.0, half_length * np.sign(direction[2])])


def geom_shapes(mj_model: Any, bodies: Sequence[int]) -> list[GeomShape]:
    """Return the shapes of some bodies: what collides, else visuals, else the origin.

    MuJoCo's planes have no extent of their own and are left out.
    """
    shapes = []
    for body in bodies:
        geoms = np.flatnonzero(mj_model.geom_bodyid == body)
        solid = mj_model.geom_contype[geoms] | mj_model.geom_conaffinity[geoms]
        chosen = geoms[solid != 0] if np.any(solid) else geoms
        shapes += [_shape(mj_model, int(geom), body) for geom in chosen] or [_point(body)]
    return [shape for shape in shapes if shape.kind != int(mujoco.mjtGeom.mjGEOM_PLANE)]


def _point(body: int) -> GeomShape:
    """Return a body's origin as a shape; geom -1 stands for the body itself."""
    sphere = int(mujoco.mjtGeom.mjGEOM_SPHERE)
    return GeomShape(-1, body, sphere, np.zeros(3), np.zeros((0, 3)))


def _shape(mj_model: Any, geom: int, body: int) -> GeomShape:
    kind = int(mj_model.geom_type[geom])
    vertices = np.zeros((0, 3))
    if kind in (int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_SDF)):
        vertices = _hull_vertices(mj_model, int(mj_model.geom_dataid[geom]))
    return GeomShape(geom, body, kind, mj_model.geom_size[geom].copy(), vertices)


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
