"""Forbidden half-spaces, and how far the bodies of an arm are from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_sysid.collision.obstacles import Box, Plane
from robot_sysid.collision.solids import Solids
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


class HalfSpaces:
    """How far some bodies are from the boundaries of half-spaces.

    Args:
        mj_model: compiled model.
        spaces: the half-spaces.

    Attributes:
        spaces: (K,) the half-spaces.
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

        Args:
            data: MuJoCo data, positions computed.
            near: shapes that surely have this much more height than they need are left out [m].
        """
        surely = self._solids.centers(data) @ self._normals.T - self._offsets
        surely -= self._solids.bound[:, None] + self.required
        for shape in np.flatnonzero(np.min(surely, axis=1) < near):
            lowest = self._solids.extremes(data, int(shape), -self._normals)
            yield int(shape), np.sum(lowest * self._normals, axis=1) - self._offsets, lowest
