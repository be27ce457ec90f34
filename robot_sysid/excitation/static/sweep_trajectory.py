"""A motion along straight lines in joint space, most of each at constant speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, checked_array

PEAK_ACCELERATION = 1.875
"""Largest derivative of the rise of speed from 0 to 1 in unit time."""


@dataclass(frozen=True)
class SweepTrajectory:
    """Lines from point to point; speed rises smoothly, stays the same, and falls.

    Attributes:
        points: (P, n) where the motion turns round; it rests at the first and the last [rad].
        moves: (P - 1,) how long the way from each point to the next takes [s].
        ramps: (P - 1,) how long speed takes to rise, and to fall; at most half the way [s].
    """

    points: Array
    moves: Array
    ramps: Array

    def __post_init__(self) -> None:
        count = len(self.points)
        object.__setattr__(self, "points", checked_array(self.points, (count, None), "points"))
        for name in ("moves", "ramps"):
            value = checked_array(getattr(self, name), (count - 1,), name)
            object.__setattr__(self, name, value)
        if count < 2 or np.any(self.ramps <= 0.0) or np.any(2.0 * self.ramps > self.moves):
            raise InputError("a sweep takes time, and its ramps fit into it twice")

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return int(self.points.shape[1])

    @property
    def duration(self) -> float:
        """Length [s]."""
        return float(np.sum(self.moves))

    @property
    def speeds(self) -> Array:
        """Constant part of each line's velocity (P - 1, n) [rad/s]."""
        return np.asarray(np.diff(self.points, axis=0) / (self.moves - self.ramps)[:, None])

    def evaluate(self, time: Array) -> Motion:
        """Return the motion at times (N,) [s]; exact derivatives."""
        time = np.asarray(time, dtype=float)
        start = np.concatenate(([0.0], np.cumsum(self.moves)[:-1]))
        at = np.clip(np.searchsorted(start, time, side="right") - 1, 0, len(start) - 1)
        ramp, left = self.ramps[at], np.clip(time - start[at], 0.0, self.moves[at])
        right = self.moves[at] - left
        rise, rising, bend = _rise(np.minimum(left / ramp, 1.0))
        fall, falling, brake = _rise(np.minimum(right / ramp, 1.0))
        early, late = left < ramp, right < ramp
        # The way at unit speed: ramps count half.
        way = np.where(early, ramp * rise, left - 0.5 * ramp)
        way = np.where(late, self.moves[at] - ramp - ramp * fall, way)
        speed = np.where(early, rising, np.where(late, falling, 1.0))
        change = np.where(early, bend / ramp, np.where(late, -brake / ramp, 0.0))
        velocity = self.speeds[at]
        return Motion(
            time,
            self.points[at] + way[:, None] * velocity,
            speed[:, None] * velocity,
            change[:, None] * velocity,
        )


def _rise(x: Array) -> tuple[Array, Array, Array]:
    """Return integral, value and slope (N,) of 10 x^3 - 15 x^4 + 6 x^5, which rises from 0 to 1."""
    integral = x**4 * (2.5 + x * (x - 3.0))
    return integral, x**3 * (10.0 + x * (6.0 * x - 15.0)), 30.0 * (x * (1.0 - x)) ** 2
