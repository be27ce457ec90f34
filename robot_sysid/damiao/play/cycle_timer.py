"""Absolute deadlines: a late cycle is skipped, never replayed, and lateness does not add up."""

from __future__ import annotations

from array import array

import numpy as np

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.errors import HardwareAbort


class CycleTimer:
    """Hands out cycle deadlines.

    Args:
        clock: the clock.
        period: length of a cycle [s].
        max_lateness: a cycle later than this stops the run [s].
    """

    def __init__(self, clock: Clock, period: float, max_lateness: float) -> None:
        self._clock, self.period, self.max_lateness = clock, period, max_lateness
        self._start = clock.now() + period
        self._index = 0
        self.skipped = 0
        self._lateness = array("f")

    @property
    def next_deadline(self) -> float:
        """When the next cycle is due [s]."""
        return self._start + self._index * self.period

    def wait(self, lenient: bool = False) -> float:
        """Sleep until the next cycle is due and return its deadline [s].

        Whole cycles that have already passed are skipped.

        Raises:
            HardwareAbort: too late, unless ``lenient``.
        """
        deadline = self.next_deadline
        self._clock.sleep_until(deadline)
        late = self._clock.now() - deadline
        self._lateness.append(late)
        skip = max(int(late / self.period), 0)
        self.skipped += skip
        self._index += skip + 1
        if late > self.max_lateness and not lenient:
            raise HardwareAbort(
                f"the computer was {1e3 * late:.1f} ms late for a control cycle, limit "
                f"{1e3 * self.max_lateness:g} ms; close other programs or lower --rate"
            )
        return deadline + skip * self.period

    def lateness(self, percentile: float) -> float:
        """Return a percentile of how late cycles started [s]."""
        return float(np.percentile(self._lateness, percentile)) if self._lateness else 0.0
