"""Somebody wants the run to end: a person at the keyboard, or the system."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator
from types import FrameType

from robot_sysid.interrupts import STOPPING

# One key press may arrive twice: from the terminal, and passed on by a program that started us.
_SAME_WISH = 0.2


class StopRequest:
    """Remembers whether somebody wants the run to end, and whether he insists.

    The first wish brings the arm to rest before it is disabled. Only a person who asks again is
    taken to mean "at once, even if the arm drops": hang-ups and terminations come in bursts when a
    terminal is closed or a computer shuts down.

    Attributes:
        count: wishes so far.
        insisted: whether the motors are to be disabled at once.
        reason: the first wish, in words.
    """

    def __init__(self) -> None:
        self.count = 0
        self.reason = ""
        self.insisted = False
        self._interrupted_at: float | None = None

    def __call__(self, reason: str, insist: bool = False) -> None:
        """Ask for a stop."""
        self.count += 1
        self.reason = self.reason or reason
        self.insisted |= insist

    @contextlib.contextmanager
    def on_signals(self) -> Iterator[None]:
        """Turn interrupt, terminate and hang-up signals into wishes inside the block."""
        # What nohup or a shell makes a process ignore stays ignored.
        heard = [number for number in STOPPING if signal.getsignal(number) is not signal.SIG_IGN]
        before = {number: signal.signal(number, self._handle) for number in heard}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self(f"stopped by {signal.Signals(number).name}", number == signal.SIGINT and self._again())

    def _again(self) -> bool:
        """Tell whether this key press is another one than the first."""
        first, now = self._interrupted_at, time.monotonic()
        self._interrupted_at = now if first is None else first
        return first is not None and now - first > _SAME_WISH
