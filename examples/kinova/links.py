"""The example arm's look: its meshes, drawn along the published joint frames.

These are simple shapes of our own, not Kinova's CAD. A link is a tube that flows into half a
knuckle; the next link brings the other half. Meshes are in the frame of their link, in metres.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from shapes import box, drum, lathe, loft, ring, rotate, shift

Array = NDArray[np.float64]

LARGE = 0.046
SMALL = 0.035
GAP = 0.0012
EDGE = 0.006

# Rotations that take a part drawn along +z to where the link has it.
TO_MINUS_Z = np.diag([1.0, -1.0, -1.0])
TO_MINUS_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
END_FOR_END = np.diag([-1.0, 1.0, -1.0])


def link_meshes() -> dict[str, Array]:
    """Return the meshes (T, 3, 3) by file name without ending."""
    return {
        "base": _base(),
        "link0": _straight_link(0.12838, 0.005375, LARGE),
        "link1": _crossing_link(0.21038, -0.006375, LARGE, LARGE),
        "link2": _straight_link(0.21038, 0.006375, LARGE),
        "link3": _crossing_link(0.20843, -0.006375, LARGE, SMALL),
        "link4": _straight_link(0.10593, 0.00017505, SMALL),
        "link5": _crossing_link(0.10593, -0.00017505, SMALL, SMALL),
        "bracelet": _bracelet(),
        "camera": _camera(),
        "probe": _probe(),
        "gripper": _gripper(),
        "fingers": _fingers(),
        "workpiece": box((0.0, 0.0, 0.2065), (0.025, 0.015, 0.013)),
    }


def knuckle_height(radius: float) -> float:
    """Return how far half a knuckle reaches from the plane that splits it [m]."""
    return GAP + 1.08 * radius


def _straight_link(reach: float, split: float, radius: float) -> Array:
    """Return a link that runs along -z; its half knuckle lies below y = ``split``."""
    return rotate(_limb((radius, radius), reach, (0.0, -split), side=1.0), TO_MINUS_Z)


def _crossing_link(reach: float, offset: float, radius: float, end: float) -> Array:
    """Return a link that starts with half a knuckle about z and runs along -y.

    Args:
        reach: distance to the next joint [m].
        offset: z of the tube's middle line [m].
        radius, end: tube radius at the knuckle and at the next joint [m].
    """
    limb = _limb((end, radius), reach, (offset, 0.0), side=-1.0)
    return rotate(shift(rotate(limb, END_FOR_END), (0.0, 0.0, reach)), TO_MINUS_Y)


def _limb(
    radii: tuple[float, float], reach: float, y: tuple[float, float], side: float
) -> Array:
    """Return a tube along +z that ends in half a knuckle about an axis parallel to y.

    Args:
        radii: tube radius at its foot and at the knuckle [m].
        reach: height of the knuckle's axis [m].
        y: of the tube's middle line, and of the plane that splits the knuckle [m].
        side: +1 or -1, side of that plane on which this half lies.
    """
    foot, radius = radii
    middle, split = y
    top = knuckle_height(radius)
    half = ring(
        (0.0, split + side * 0.5 * (GAP + top), 0.0), radius, 0.5 * (top - GAP), 5.0
    )
    tube = _rounded_foot(foot, middle)
    neck = ring((0.0, middle, reach - 1.75 * radius), radius, radius)
    tube += _blend(tube[-1], neck, 9)[1:]
    tube += _blend(neck, half + (0.0, 0.0, reach - 0.75 * radius), 9)[1:]
    tube.append(half + (0.0, 0.0, reach))
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, side], [0.0, -side, 0.0]])
    head = shift(rotate(drum(radius, GAP, top, EDGE), upright), (0.0, split, reach))
    return np.concatenate((loft(tube), head))


def _rounded_foot(radius: float, y: float) -> list[Array]:
    """Return the rings of a foot with a rounded edge at the height y [m]."""
    rings = []
    for angle in np.linspace(0.0, 0.5 * np.pi, 4):
        size = radius - EDGE * (1.0 - np.sin(angle))
        rings.append(ring((0.0, y, GAP + EDGE * (1.0 - np.cos(angle))), size, size))
    return rings


def _blend(start: Array, end: Array, steps: int) -> list[Array]:
    """Return rings from ``start`` to ``end``, both included, with a smooth start and finish."""
    share = np.linspace(0.0, 1.0, steps)[:, None, None]
    shape = share**2 * (3.0 - 2.0 * share)
    rings = (1.0 - shape) * start + shape * end
    rings[..., 2] = ((1.0 - share) * start + share * end)[..., 2]
    return list(rings)


def _base() -> Array:
    """Return the mesh of the base."""
    foot = [(0.075, 0.0), (0.078, 0.002), (0.078, 0.010), (0.075, 0.013)]
    column = [(0.058, 0.015), (0.052, 0.03), (0.048, 0.06), (LARGE, 0.10)]
    return lathe([*foot, *column, (LARGE, 0.149), (0.044, 0.153), (0.040, 0.1552)])


def _bracelet() -> Array:
    """Return the mesh of the last link without camera and tool."""
    body = [(0.031, GAP), (0.034, 0.003), (0.0365, 0.010), (0.0375, 0.022)]
    return lathe(
        [*body, (0.0375, 0.054), (0.036, 0.058), (0.033, 0.0605), (0.0315, 0.0615)]
    )


def _camera() -> Array:
    """Return the mesh of the camera."""
    slices = ((0.014, 0.030, 0.012), (0.017, 0.038, 0.016), (0.026, 0.044, 0.020))
    slices += ((0.052, 0.045, 0.021), (0.058, 0.043, 0.019), (0.0605, 0.040, 0.016))
    return loft([ring((0.0, 0.052, z), a, b, 5.0) for z, a, b in slices])


def _probe() -> Array:
    """Return the mesh of the probe."""
    adapter = [(0.0315, 0.0619), (0.0315, 0.072), (0.024, 0.076)]
    handle = [
        (0.021, 0.085),
        (0.0225, 0.11),
        (0.0225, 0.17),
        (0.019, 0.195),
        (0.010, 0.215),
    ]
    return lathe(
        [
            *adapter,
            *handle,
            (0.005, 0.235),
            (0.005, 0.292),
            (0.003, 0.298),
            (0.001, 0.3),
        ]
    )


def _gripper() -> Array:
    """Return the mesh of the gripper's body."""
    slices = ((0.0619, 0.0375, 0.0375, 2.0), (0.078, 0.0375, 0.0375, 2.0))
    slices += ((0.083, 0.038, 0.034, 2.6), (0.105, 0.052, 0.030, 3.5))
    slices += ((0.140, 0.062, 0.028, 4.5), (0.150, 0.060, 0.026, 4.5))
    return loft([ring((0.0, 0.0, z), a, b, k) for z, a, b, k in slices])


def _fingers() -> Array:
    """Return the meshes of two fingers: a leaning link, and a pad that closes on the workpiece."""
    meshes = []
    for side in (-1.0, 1.0):
        heights = ((0.140, 0.052), (0.165, 0.060), (0.185, 0.052), (0.192, 0.044))
        link = [ring((side * x, 0.0, z), 0.008, 0.012, 5.0) for z, x in heights]
        meshes += [
            loft(link),
            box((side * 0.0335, 0.0, 0.2035), (0.008, 0.0125, 0.022)),
        ]
    return np.concatenate(meshes)
