"""What the arm must not touch, itself included, as everybody who plans a motion sees it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in world coordinates [m]; infinite where a side is open."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.lower) != 3 or len(self.upper) != 3:
            raise InputError("--workspace takes six numbers: XMIN XMAX YMIN YMAX ZMIN ZMAX")
        for axis, low, high in zip("xyz", self.lower, self.upper):
            if not low < high:
                raise InputError(
                    f"--workspace is empty along {axis}: {low:g} is not below {high:g}; "
                    "the order is XMIN XMAX YMIN YMAX ZMIN ZMAX"
                )


@dataclass(frozen=True)
class Plane:
    """A plane no part of the arm may cross: points x with normal . x >= offset [m] are allowed.

    The normal is made a unit vector.
    """

    normal: tuple[float, float, float]
    offset: float

    def __post_init__(self) -> None:
        length = math.sqrt(sum(v * v for v in self.normal)) if len(self.normal) == 3 else 0.0
        if not (length > 0.0 and math.isfinite(length) and math.isfinite(self.offset)):
            raise InputError(
                "--keep-out takes four numbers NX NY NZ OFFSET with a normal that is not zero; "
                "0 0 1 0 keeps the arm above the floor"
            )
        unit = tuple(float(v) / length for v in self.normal)
        object.__setattr__(self, "normal", unit)
        object.__setattr__(self, "offset", float(self.offset) / length)


def plane_from(values: tuple[float, ...]) -> Plane:
    """Return the plane of four numbers NX NY NZ OFFSET (OFFSET in multiples of the normal)."""
    if len(values) != 4:
        raise InputError("--keep-out takes four numbers: NX NY NZ OFFSET")
    return Plane((values[0], values[1], values[2]), values[3])


@dataclass(frozen=True)
class Closest:
    """The tightest distance at one configuration.

    Attributes:
        slack: distance minus the distance that must be kept [m]; negative where it is not kept.
        distance: [m]; infinite where nothing is near.
        label: between what.
    """

    slack: float
    distance: float
    label: str


@dataclass(frozen=True)
class Slack:
    """How much room N configurations have.

    Attributes:
        value: (N,) smallest slack [m], at most the horizon.
        gradient: (N, n) with respect to the joint positions.
        budget: (N, P) smallest slack among the pairs of each row of ``Clearance.rates`` [m];
            infinite where a row has no pair within the horizon.
    """

    value: Array
    gradient: Array
    budget: Array


@dataclass(frozen=True)
class RestPairs:
    """Pairs of bodies that need words, each with its distance where the motion starts.

    Attributes:
        ignored: neighbours inside each other, which are not looked at.
        deep: others inside each other: collisions.
        touching: others that touch; they never get deeper.
        near: apart, but so near that they keep half that distance instead of the clearance.
    """

    ignored: tuple[str, ...] = ()
    deep: tuple[str, ...] = ()
    touching: tuple[str, ...] = ()
    near: tuple[str, ...] = ()


class NoObstacles:
    """Empty space, for an arm whose model has no collision geometry; see ``Clearance``."""

    horizon = 1.0
    at_rest = RestPairs()
    neighbours = Closest(horizon, math.inf, "")

    def __init__(self, joints: int) -> None:
        self.rates = np.zeros((1, joints))

    def slack(self, q: Array) -> Slack:
        """Return the horizon everywhere."""
        full = np.full(len(q), self.horizon)
        return Slack(full, np.zeros_like(q), full[:, None])

    def slack_at(self, q: Array) -> tuple[float, Array]:
        """Return the horizon."""
        return self.horizon, np.full(1, self.horizon)

    @property
    def distances(self) -> NoObstacles:
        """Itself."""
        return self

    def closest(self, q: Array) -> Closest:
        """Return that nothing is near."""
        return Closest(self.horizon, np.inf, "")
