"""What the arm must not touch, itself included, as everybody who plans a motion sees it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array


@dataclass(frozen=True)
class HalfSpace:
    """Space some bodies must stay in: normal . x >= offset.

    The normal (3,) is a unit vector of the world, the clearance the distance to keep from the
    boundary [m].
    """

    normal: Array
    offset: float
    clearance: float
    bodies: tuple[int, ...]
    label: str


def plane_half_space(
    values: Sequence[float], clearance: float, bodies: Sequence[int] = ()
) -> HalfSpace:
    """Return the allowed side of a keep-out plane: points x with N . x >= OFFSET.

    It is told by four numbers NX NY NZ OFFSET (OFFSET in multiples of the normal); InputError where
    they are no plane.
    """
    if len(values) != 4:
        raise InputError("--keep-out takes four numbers: NX NY NZ OFFSET")
    length = math.sqrt(sum(v * v for v in values[:3]))
    if not (length > 0.0 and math.isfinite(length) and math.isfinite(values[3])):
        raise InputError(
            "--keep-out takes four numbers NX NY NZ OFFSET with a normal that is not zero; "
            "0 0 1 0 keeps the arm above the floor"
        )
    *normal, offset = (float(v) / length for v in values)
    label = f"the keep-out plane {np.round(normal, 3).tolist()} at {offset:g} m"
    return HalfSpace(np.array(normal), offset, clearance, tuple(bodies), label)


def box_half_spaces(sides: Sequence[float], bodies: Sequence[int] = ()) -> tuple[HalfSpace, ...]:
    """Return the finite sides of a workspace XMIN XMAX YMIN YMAX ZMIN ZMAX [m] in the world.

    Its walls may be touched. InputError where it is no box.
    """
    if len(sides) != 6:
        raise InputError("--workspace takes six numbers: XMIN XMAX YMIN YMAX ZMIN ZMAX")
    found = []
    for axis, low, high in zip(range(3), sides[0::2], sides[1::2]):
        if not low < high:
            raise InputError(
                f"--workspace is empty along {'xyz'[axis]}: {low:g} is not below {high:g}; "
                "the order is XMIN XMAX YMIN YMAX ZMIN ZMAX"
            )
        for sign, bound, side in ((1.0, low, "min"), (-1.0, high, "max")):
            if np.isfinite(bound):
                label = f"the workspace's {'xyz'[axis]}{side} = {bound:g} m"
                normal = sign * np.eye(3)[axis]
                found.append(HalfSpace(normal, sign * bound, 0.0, tuple(bodies), label))
    return tuple(found)


@dataclass(frozen=True)
class Closest:
    """The tightest distance at one configuration.

    Attributes:
        slack: distance minus the distance that must be kept [m]; negative where it is not kept.
        distance: [m]; infinite where nothing is near.
        label: between what.
        time: when, along a motion [s].
    """

    slack: float
    distance: float
    label: str
    time: float = 0.0


@dataclass(frozen=True)
class Slack:
    """How much room N configurations have.

    Attributes:
        value: (N,) smallest slack [m], at most the horizon.
        gradient: (N, n) with respect to the joint positions.
    """

    value: Array
    gradient: Array
