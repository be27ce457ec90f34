"""Fewer rows of a log that is longer than any identification needs.

Two hours at 1 kHz say no more about an arm than the same hours at 60 Hz, and take sixteen times the
memory. Times, positions and torques pass one zero-phase low-pass and are decimated, so that what is
left is a log recorded at a lower rate behind a proper filter.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from robot_sysid.records import Array
from robot_sysid.signals.low_pass import Decimator, design_low_pass
from robot_sysid.signals.pieces import longest_step
from robot_sysid.signals.resampling import usual_period

MOST_ROWS = 300_000
"""Rows beyond which a log is thinned."""
LEAST_RATE = 60.0
"""Rows per second that thinning leaves at least [Hz]."""
# Of the rate that is left; flat below 0.4 times this, and what folds back stays above that.
_CUTOFF = 0.45


class Thinning:
    """Passes rows on, every one or every so many of them.

    Args:
        every: how many rows become one.
        period: usual step of time [s].
    """

    def __init__(self, every: int, period: float) -> None:
        self.every = every
        self._longest = longest_step(period)
        self._last = np.nan
        if every > 1:
            rate = 1.0 / period
            self._low_pass = replace(design_low_pass(_CUTOFF * rate / every, rate), step=every)
            self._decimator = Decimator(self._low_pass)

    @classmethod
    def of(cls, time: Array, expected: float) -> Thinning:
        """Return what suits a log.

        Args:
            time: (N,) its first time stamps [s].
            expected: about how many rows it has.
        """
        period = usual_period(time)
        slowest = max(1, math.floor(1.0 / (period * LEAST_RATE))) if period > 0.0 else 1
        return cls(min(math.ceil(expected / MOST_ROWS), slowest), period)

    def push(self, rows: Array) -> Array:
        """Take the next rows (N, 2 + C), line and time first, and return those that are kept."""
        if self.every == 1 or not len(rows):
            return rows
        step = np.diff(rows[:, 1], prepend=self._last)
        self._last = rows[-1, 1]
        parts = []
        for part in np.split(rows, np.flatnonzero(step > self._longest)):
            parts.append(self._decimator.push(part))
            if part is not rows and part[-1:, 1] != self._last:
                # The filter does not reach over a gap.
                self._decimator = Decimator(self._low_pass)
        return np.concatenate(parts)
