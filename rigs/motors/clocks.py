"""A simulated clock on which things happen by themselves, and signals that are heard."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import signal

from robot_sysid.damiao.bus import SimulatedClock
from robot_sysid.errors import STOP_SIGNALS, SUSPENSION


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


@contextlib.contextmanager
def heard_signals():
    """Signals that are not ignored, also where nohup or a shell's ``&`` started the tests."""
    before = {
        number: signal.signal(number, signal.default_int_handler)
        for number in (*STOP_SIGNALS, *SUSPENSION)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
