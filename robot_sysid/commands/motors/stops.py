"""Zeros of motors from the two end stops of each joint.

A motor at m = d q + c, with direction d and offset c, is at d q_lower + c and d q_upper + c where
its joint is at its stops. Each of the two gives the offset; half their difference says how sure
their mean is. The difference is that of the measured span from the model's range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.records import Array

SPAN_TOLERANCE = 0.05
"""By how much a measured span may differ from the model's range [rad]: each of two stops gives way
by a degree, and models round their ranges to a degree. A zero is then uncertain by half of it."""
HELD_WITHIN = 0.01
"""By how much the position of a joint may change while it counts as held [rad]: half a degree."""
HELD_LOOKS = 4
"""In how many looks in a row it has to be held there: some tenth of a second. So neither a damaged
frame is a stop, nor an angle to which an arm swings that was let go of."""


class Extremes:
    """The smallest and the largest position at which each of m motors was held."""

    def __init__(self, n_motors: int) -> None:
        self._last = np.full((HELD_LOOKS, n_motors), np.nan)
        self.lowest = np.full(n_motors, np.inf)
        self.highest = np.full(n_motors, -np.inf)

    def follow(self, position: Array) -> None:
        """Take the positions (m,) of all motors at the next look [rad]."""
        self._last = np.vstack([self._last[1:], position])
        # NaN, where there were too few looks, is not held.
        is_held = np.ptp(self._last, axis=0) <= HELD_WITHIN
        mean = np.where(is_held, np.mean(self._last, axis=0), np.nan)
        self.lowest = np.fmin(self.lowest, mean)
        self.highest = np.fmax(self.highest, mean)

    @property
    def spans(self) -> Array:
        """Distance (m,) between the two [rad]; 0 where a motor was held nowhere."""
        return np.maximum(self.highest - self.lowest, 0.0)


@dataclass(frozen=True)
class StopZero:
    """Zero of a joint by its two stops.

    Attributes:
        lowest, highest: positions of the motor at the stops [rad].
        lower, upper: range of the joint in the model [rad].
        direction: 1, or -1 where the motor turns opposite to the joint.
    """

    lowest: float
    highest: float
    lower: float
    upper: float
    direction: int

    @property
    def was_reached(self) -> bool:
        """Whether the motor was held at two positions at all."""
        return self.highest > self.lowest

    @property
    def excess(self) -> float:
        """Measured span minus the model's range [rad]."""
        return (self.highest - self.lowest) - (self.upper - self.lower)

    @property
    def agrees(self) -> bool:
        """Whether span and range agree within ``SPAN_TOLERANCE``."""
        return self.was_reached and abs(self.excess) <= SPAN_TOLERANCE

    @property
    def offset(self) -> float:
        """Position of the motor where the joint is at zero, the mean of both stops' [rad]."""
        middle_of_motor = 0.5 * (self.lowest + self.highest)
        return middle_of_motor - self.direction * 0.5 * (self.lower + self.upper)

    @property
    def doubt(self) -> float:
        """How far the offset of either stop is from the mean [rad]."""
        return 0.5 * abs(self.excess)
