"""What the arm must not touch, itself included, as everybody who plans a motion sees it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from robot_sysid.records import Array


@dataclass(frozen=True)
class Closest:
    """The tightest distance at one configuration.

    Attributes:
        slack: distance minus the distance that must be kept [m]; negative where it is not kept.
        distance: itself [m]; infinite where nothing is near.
        label: between what, for the reader.
    """

    slack: float
    distance: float
    label: str


@dataclass(frozen=True)
class Slack:
    """How much room N configurations have.

    Attributes:
        value: (N,) smallest slack [m], at most the obstacles' horizon.
        gradient: (N, n) with respect to the joint positions.
        budget: (N, P) smallest slack among the pairs of each row of ``Obstacles.rates`` [m];
            infinite where a row has no pair within the horizon.
    """

    value: Array
    gradient: Array
    budget: Array


class Obstacles(Protocol):
    """What the arm must not touch, itself included."""

    @property
    def horizon(self) -> float:
        """Largest slack that is told apart [m]; what is farther away counts as this far."""

    @property
    def rates(self) -> Array:
        """Approach bounds (P, n): pairs of row p approach at rates[p] @ abs(qd) [m/s] at most."""

    def slack(self, q: Array) -> Slack:
        """Return the slack at positions q (N, n)."""

    def closest(self, q: Array) -> Closest:
        """Return the tightest distance at one configuration q (n,)."""


class NoObstacles:
    """Empty space, for an arm whose model has no collision geometry.

    Args:
        joints: number of joints n.
    """

    horizon = 1.0

    def __init__(self, joints: int) -> None:
        self.rates = np.zeros((1, joints))

    def slack(self, q: Array) -> Slack:
        """Return the horizon everywhere."""
        full = np.full(len(q), self.horizon)
        return Slack(full, np.zeros_like(q), full[:, None])

    def closest(self, q: Array) -> Closest:
        """Return that nothing is near."""
        return Closest(self.horizon, np.inf, "")
