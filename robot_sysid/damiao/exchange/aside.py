"""Printing and recording beside a run: never in its way, and never a reason to let an arm drop.

A terminal that is gone, held (Ctrl-S) or full, a reader that went away, a disk that is full or does
not answer: a control loop that printed by itself would fail or wait with it, and the motors'
watchdogs would let the arm go. So what is to be said and written is handed over here.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

Action = Callable[[], object]
_PATIENCE = 2.0


class Aside:
    """Does things one after the other; what goes wrong is kept instead of raised.

    After a failure nothing more is done.

    Args:
        threaded: do them in a thread of its own; without, at once (for simulated time, where
            nobody waits).

    Attributes:
        failure: what went wrong, or None.
    """

    def __init__(self, threaded: bool) -> None:
        self.failure: BaseException | None = None
        self._waiting: queue.SimpleQueue[Action | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._work, daemon=True)
            self._thread.start()

    def __call__(self, action: Action) -> None:
        """Have something done."""
        if self._thread is None:
            self._do(action)
        else:
            self._waiting.put(action)

    def if_idle(self, action: Action) -> None:
        """Have something done that is not worth waiting for, such as moving a progress bar."""
        if self._waiting.empty():
            self(action)

    def finish(self, patience: float = _PATIENCE) -> None:
        """Wait until all is done, or until ``patience`` [s] is at an end."""
        if self._thread is None:
            return
        self._waiting.put(None)
        self._thread.join(patience)
        if self._thread.is_alive() and self.failure is None:
            self.failure = TimeoutError("it takes nothing any more")

    def _work(self) -> None:
        while (action := self._waiting.get()) is not None:
            self._do(action)

    def _do(self, action: Action) -> None:
        if self.failure is not None:
            return
        try:
            action()
        except BaseException as error:
            self.failure = error
