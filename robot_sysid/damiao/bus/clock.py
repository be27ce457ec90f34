"""Time for everything that runs against deadlines; injected, so that tests need no waiting."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """A clock that never runs backwards.

    Attributes:
        live: whether time passes by itself, also while this program waits for something.
    """

    live: bool

    def now(self) -> float:
        """Return the time [s]; only differences mean anything."""

    def sleep_until(self, moment: float) -> None:
        """Return at ``moment`` [s], or at once if it has passed."""


class SystemClock:
    """The computer's monotonic clock."""

    live = True

    def now(self) -> float:
        """Return the monotonic time [s]."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Sleep until ``moment`` [s]."""
        left = moment - time.monotonic()
        if left > 0.0:
            time.sleep(left)


class SimulatedClock:
    """A clock that moves only when someone sleeps."""

    live = False

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Return the simulated time [s]."""
        return self._now

    def sleep_until(self, moment: float) -> None:
        """Move to ``moment`` [s], unless it has passed."""
        self._now = max(self._now, moment)
