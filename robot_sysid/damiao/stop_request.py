"""A wish to stop, from Ctrl-C, from the system, or from another part of the program."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType


class StopRequest:
    """Remembers whether somebody wants the run to end, and how often they asked.

    The first wish brings the arm to rest before it is disabled; a second one disables it at once.
    """

    def __init__(self) -> None:
        self.count = 0
        self.reason = ""

    def __call__(self, reason: str) -> None:
        """Ask for a stop."""
        self.count += 1
        self.reason = self.reason or reason

    @contextlib.contextmanager
    def on_signals(self) -> Iterator[None]:
        """Turn interrupt, terminate and hang-up signals into wishes inside the block."""
        names = [n for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]
        before = {n: signal.signal(getattr(signal, n), self._handle) for n in names}
        try:
            yield
        finally:
            for name, handler in before.items():
                signal.signal(getattr(signal, name), handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self(f"stopped by {signal.Signals(number).name}")
