"""Time for everything that runs against deadlines; injected, so that tests need no waiting."""

from __future__ import annotations

import heapq
import itertools
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """A clock that never runs backwards."""

    def now(self) -> float:
        """Return the time [s]; only differences mean anything."""

    def sleep_until(self, moment: float) -> None:
        """Return at ``moment`` [s], or at once if it has passed."""


class SystemClock:
    """The computer's monotonic clock."""

    def now(self) -> float:
        """Return the monotonic time [s]."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Sleep until ``moment`` [s]."""
        left = moment - time.monotonic()
        if left > 0.0:
            time.sleep(left)


class SimulatedClock:
    """A clock that moves only when someone sleeps; callbacks can be hung on moments."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start
        self._order = itertools.count()
        self._callbacks: list[tuple[float, int, Callable[[], None]]] = []

    def now(self) -> float:
        """Return the simulated time [s]."""
        return self._now

    def sleep_until(self, moment: float) -> None:
        """Move to ``moment`` [s], running the callbacks that fall due on the way."""
        while self._callbacks and self._callbacks[0][0] <= moment:
            due, _, callback = heapq.heappop(self._callbacks)
            self._now = max(self._now, due)
            callback()
        self._now = max(self._now, moment)

    def at(self, moment: float, callback: Callable[[], None]) -> None:
        """Call ``callback`` when the clock reaches ``moment`` [s]."""
        heapq.heappush(self._callbacks, (moment, next(self._order), callback))

    def stall(self, duration: float) -> None:
        """Let ``duration`` [s] pass without anybody having slept: a computer that was busy."""
        self._now += duration
