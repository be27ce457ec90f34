"""Somebody's wish that a run should end."""

from __future__ import annotations

import signal
import time
from contextlib import AbstractContextManager
from typing import Any

from robot_sysid.errors import handle_stop_signals

# One key press may arrive twice: from the terminal, and passed on by a program that started us.
# Longer than a busy computer takes to pass it on, shorter than pressing a key twice on purpose [s].
_SAME_WISH = 0.2


class StopRequest:
    """Remembers whether somebody wants the run to end, and whether he insists.

    The first wish brings the arm to rest before it is disabled. Only a person who asks again is
    taken to mean "at once, even if the arm drops": hang-ups and terminations come in bursts when a
    terminal is closed or a computer shuts down. ``reason`` is the first wish in words.
    """

    def __init__(self) -> None:
        self.count = 0
        self.reason = ""
        self.insisted = False
        self._interrupted_at = float("inf")

    def __call__(self, reason: str, insist: bool = False) -> None:
        """Ask for a stop."""
        self.count += 1
        self.reason = self.reason or reason
        self.insisted |= insist

    def on_signals(self) -> AbstractContextManager[None]:
        """Return a block in which signals that ask a program to end are wishes."""
        return handle_stop_signals(self._handle)

    def _handle(self, number: int, frame: Any) -> None:
        again = False
        if number == signal.SIGINT:
            now = time.monotonic()
            self._interrupted_at = min(self._interrupted_at, now)
            again = now - self._interrupted_at > _SAME_WISH
        self(f"stopped by {signal.Signals(number).name}", again)
