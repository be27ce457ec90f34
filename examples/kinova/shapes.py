"""Closed triangle meshes from two ideas, lathe and loft, and the binary STL file.

Legend. A ring is (S, 3): one closed outline of S points, counter-clockwise about the direction in
which the rings follow each other. A mesh is (T, 3, 3): T triangles, three corners each, counter-
clockwise seen from outside. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SEGMENTS = 40
# Vertices are rounded to a micrometre, so that the files do not depend on the last bit of cos().
GRID = 1e-6

_STL_TRIANGLE = np.dtype(
    [("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
)


def ring(
    centre: Sequence[float],
    half_width: float,
    half_depth: float,
    squareness: float = 2.0,
) -> Array:
    """Return a superellipse |x/a|^k + |y/b|^k = 1 parallel to the xy plane.

    Args:
        centre: (3,) middle of the ring [m].
        half_width, half_depth: a along x and b along y [m].
        squareness: k; 2 is an ellipse, larger is closer to a rectangle.
    """
    angle = 2.0 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    cosine = np.cos(angle)
    sine = np.sin(angle)
    x = half_width * np.sign(cosine) * np.abs(cosine) ** (2.0 / squareness)
    y = half_depth * np.sign(sine) * np.abs(sine) ** (2.0 / squareness)
    return np.column_stack((x, y, np.zeros(SEGMENTS))) + np.asarray(centre, dtype=float)


def loft(rings: Sequence[Array]) -> Array:
    """Return the closed skin over rings (each (S, 3)) that follow each other, with flat ends."""
    walls = [_wall(lower, upper) for lower, upper in zip(rings[:-1], rings[1:])]
    return np.concatenate([_cap(rings[0][::-1]), *walls, _cap(rings[-1])])


def lathe(profile: Sequence[tuple[float, float]]) -> Array:
    """Return the solid of revolution about z of a profile.

    Args:
        profile: (radius, z) pairs with growing z [m].
    """
    return loft([ring((0.0, 0.0, z), radius, radius) for radius, z in profile])


def drum(radius: float, bottom: float, top: float, edge: float) -> Array:
    """Return a cylinder about z with both edges rounded by a quarter circle of radius ``edge``."""
    turn = np.linspace(0.0, 0.5 * np.pi, 5)
    lower = [
        (radius - edge + edge * np.sin(a), bottom + edge - edge * np.cos(a))
        for a in turn
    ]
    upper = [
        (radius - edge + edge * np.cos(a), top - edge + edge * np.sin(a)) for a in turn
    ]
    return lathe(lower + upper)


def box(centre: Sequence[float], half_sizes: Sequence[float]) -> Array:
    """Return a box with softened vertical edges.

    Args:
        centre: (3,) its middle [m].
        half_sizes: (3,) half lengths along x, y, z [m].
    """
    x, y, z = centre
    a, b, c = half_sizes
    return loft(
        [ring((x, y, z + side * c), a, b, squareness=12.0) for side in (-1.0, 1.0)]
    )


def rotate(mesh: Array, rotation: Array) -> Array:
    """Return the mesh with every corner p replaced by ``rotation`` p, rotation being (3, 3)."""
    return mesh @ np.asarray(rotation, dtype=float).T


def shift(mesh: Array, offset: Sequence[float]) -> Array:
    """Return the mesh shifted by ``offset`` (3,) [m]."""
    return mesh + np.asarray(offset, dtype=float)


def volume(mesh: Array) -> float:
    """Return the enclosed volume [m^3]: sum of a . (b x c) / 6; negative when inside out."""
    a, b, c = np.moveaxis(mesh, 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def write_stl(path: Path, mesh: Array) -> None:
    """Write a mesh as binary STL; the same mesh gives the same bytes."""
    corners = np.round(mesh / GRID) * GRID
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    solid = lengths > 0.0
    records = np.zeros(int(np.sum(solid)), dtype=_STL_TRIANGLE)
    records["normal"] = normals[solid] / lengths[solid, None]
    records["corners"] = corners[solid]
    header = b"robot-sysid Kinova example, metres".ljust(80)
    path.write_bytes(header + np.uint32(len(records)).tobytes() + records.tobytes())


def read_stl(path: Path) -> Array:
    """Return the triangles (T, 3, 3) of a binary STL file."""
    records = np.frombuffer(path.read_bytes()[84:], dtype=_STL_TRIANGLE)
    return records["corners"].astype(np.float64)


def _wall(lower: Array, upper: Array) -> Array:
    """Return the triangles between two rings (n, 3) of corners."""
    next_lower = np.roll(lower, -1, axis=0)
    next_upper = np.roll(upper, -1, axis=0)
    first = np.stack((lower, next_lower, next_upper), axis=1)
    second = np.stack((lower, next_upper, upper), axis=1)
    return np.concatenate((first, second))


def _cap(outline: Array) -> Array:
    """Return the triangles that close a ring (n, 3) of corners."""
    middle = np.broadcast_to(outline.mean(axis=0), outline.shape)
    return np.stack((middle, outline, np.roll(outline, -1, axis=0)), axis=1)
