"""A motion from pose to pose with a rest at each, smooth and with exact derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, checked_array

PEAK_SPEED, PEAK_ACCELERATION = 2.1875, 7.5132
"""Largest first and second derivative of a smooth step from 0 to 1 in unit time."""


@dataclass(frozen=True)
class PoseTrajectory:
    """A motion along straight lines in joint space, with a smooth step for each.

    Attributes:
        points: (P, n) positions, the first and the last where the arm rests [rad].
        moves: (P - 1,) how long the way from each point to the next takes [s].
        dwells: (P,) how long the arm rests at each point [s].
    """

    points: Array
    moves: Array
    dwells: Array

    def __post_init__(self) -> None:
        count = len(self.points)
        object.__setattr__(self, "points", checked_array(self.points, (count, None), "points"))
        object.__setattr__(self, "moves", checked_array(self.moves, (count - 1,), "moves"))
        object.__setattr__(self, "dwells", checked_array(self.dwells, (count,), "dwells"))
        if count < 2 or np.any(self.moves <= 0.0) or np.any(self.dwells < 0.0):
            raise InputError("moves between poses take time, and rests are not negative")

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return int(self.points.shape[1])

    @property
    def duration(self) -> float:
        """Length [s]."""
        return float(np.sum(self.moves) + np.sum(self.dwells))

    @property
    def arrivals(self) -> Array:
        """When each point is reached (P,) [s]."""
        return np.concatenate(([0.0], np.cumsum(self.dwells[:-1] + self.moves)))

    def evaluate(self, time: Array) -> Motion:
        """Return the motion at times (N,) [s]; exact derivatives."""
        time = np.asarray(time, dtype=float)
        at = np.clip(np.searchsorted(self.arrivals, time, side="right") - 1, 0, len(self.moves) - 1)
        step, length = np.diff(self.points, axis=0)[at], self.moves[at]
        x = np.clip((time - self.arrivals[at] - self.dwells[at]) / length, 0.0, 1.0)
        w, dw, ddw = smooth_step(x)
        return Motion(
            time,
            self.points[at] + w[:, None] * step,
            (dw / length)[:, None] * step,
            (ddw / length**2)[:, None] * step,
        )


def straight_way(begin: Array, end: Array) -> PoseTrajectory:
    """Return the motion from one pose (n,) to another in a straight line, at about 1 rad/s."""
    seconds = max(1.0, float(np.max(np.abs(end - begin))))
    return PoseTrajectory(np.stack((begin, end)), np.array([seconds]), np.zeros(2))


def smooth_step(x: Array) -> tuple[Array, Array, Array]:
    """Return w, w' and w'' (N,) of 35 x^4 - 84 x^5 + 70 x^6 - 20 x^7, which rises from 0 to 1."""
    w = x**4 * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x)))
    return w, 140.0 * (x * (1.0 - x)) ** 3, 420.0 * (x * (1.0 - x)) ** 2 * (1.0 - 2.0 * x)
