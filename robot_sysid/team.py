"""Jobs on one shared object, in this process or in several.

Worker processes are started afresh ("spawn"), so nothing depends on what this process has loaded;
each receives the object once and keeps it. Results do not depend on how many workers there are.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, Callable

Job = Callable[[Any], Any]
"""A function of the shared object; ``functools.partial`` of a module's function, to be sent."""


class Team:
    """Does jobs; use it as a context manager so that its processes end with it.

    Args:
        shared: what every job gets as its argument.
        workers: number of processes; 1 uses the present one.
    """

    def __init__(self, shared: Any, workers: int) -> None:
        self._shared, self._workers = shared, workers
        self._processes: list[Any] = []
        self._ends: list[Connection] = []

    def __enter__(self) -> Team:
        if self._workers > 1:
            self._start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for end in self._ends:
            end.close()
        for process in self._processes:
            process.terminate()
            process.join()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        for _ in range(self._workers):
            here, there = context.Pipe()
            process = context.Process(target=_work, args=(there,), daemon=True)
            process.start()
            there.close()
            self._processes.append(process)
            self._ends.append(here)
        for end in list(self._ends):
            self._send(end, self._shared)

    def run(self, jobs: Sequence[Job]) -> Iterator[Any]:
        """Yield each job's result as soon as it is there, in any order."""
        if not self._ends:
            yield from (job(self._shared) for job in jobs)
            return
        waiting, busy = list(jobs), {}
        for end in self._ends:
            self._hand_out(end, waiting, busy)
        while busy:
            for end in wait(list(busy)):
                job = busy.pop(end)
                result, answered = self._receive(end)
                if answered:
                    self._hand_out(end, waiting, busy)
                    yield result
                else:
                    waiting.append(job)
            if waiting and not busy:
                yield from (job(self._shared) for job in waiting)
                return

    def _hand_out(self, end: Any, waiting: list[Job], busy: dict[Any, Job]) -> None:
        if waiting and end in self._ends:
            job = waiting.pop(0)
            self._send(end, job)
            busy[end] = job

    def _send(self, end: Any, message: Any) -> None:
        """Send to a worker; one that has died is found out when its answer is awaited."""
        with contextlib.suppress(OSError):
            end.send(message)

    def _receive(self, end: Any) -> tuple[Any, bool]:
        """Return (result, True), or (None, False) where the worker has died."""
        try:
            return end.recv(), True
        except (EOFError, OSError):
            self._ends.remove(end)
            return None, False


def _work(end: Connection) -> None:
    """Serve jobs until the other side hangs up; Ctrl-C is the other side's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        shared = end.recv()
        while True:
            end.send(end.recv()(shared))
    except (EOFError, OSError):
        return
