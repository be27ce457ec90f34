"""A simulated clock on which things happen by themselves."""

from __future__ import annotations

import heapq
import itertools

from robot_sysid.damiao.bus import SimulatedClock


class ScriptedClock(SimulatedClock):
    """A simulated clock that runs callbacks at given moments and can lose time."""

    def __init__(self):
        super().__init__()
        self._order = itertools.count()
        self._callbacks = []

    def sleep_until(self, moment):
        """Move to a moment [s], running the callbacks that fall due on the way."""
        while self._callbacks and self._callbacks[0][0] <= moment:
            due, _, callback = heapq.heappop(self._callbacks)
            super().sleep_until(due)
            callback()
        super().sleep_until(moment)

    def at(self, moment, callback):
        """Call ``callback`` when the clock reaches a moment [s]."""
        heapq.heappush(self._callbacks, (moment, next(self._order), callback))

    def stall(self, duration):
        """Let time [s] pass without anybody having slept: a computer that was busy."""
        super().sleep_until(self.now() + duration)
