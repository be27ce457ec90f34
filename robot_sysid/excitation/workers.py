"""Jobs on one shared object, in this process or in several.

Worker processes are started afresh ("spawn"), so nothing depends on what this process has loaded;
each receives the object once and keeps it. Results do not depend on how many workers there are.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, Callable

_THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

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
        self._serials = itertools.count()

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
        with _interrupts_ignored(), _one_thread_each():
            for _ in range(self._workers):
                here, there = context.Pipe()
                process = context.Process(target=_work, args=(there,), daemon=True)
                process.start()
                there.close()
                self._processes.append(process)
                self._ends.append(here)
        for end in self._ends:
            _send(end, self._shared)

    def run(self, jobs: Sequence[Job]) -> Iterator[Any]:
        """Yield each job's result as soon as it is there, in any order.

        Jobs of an earlier run that was not read to its end are finished and forgotten. Those of a
        worker that has died are done here, where an error in them is seen.
        """
        if not self._ends:
            yield from (job(self._shared) for job in jobs)
            return
        share = _Share(list(jobs), self._ends, self._serials)
        while share.open_jobs:
            ready: list[Any] = wait([end for end, serials in share.busy.items() if serials])
            for end in ready:
                yield from self._results(end, share)
        yield from (job(self._shared) for job in share.waiting)

    def _results(self, end: Connection, share: _Share) -> Iterator[Any]:
        """Yield what a worker's answer makes available."""
        answer = _receive(end)
        if answer is None:
            self._ends.remove(end)
            yield from (job(self._shared) for job in share.taken_from(end))
        elif share.is_due(end, answer[0]):
            yield answer[1]


class _Share:
    """Who does which jobs of one run.

    Args:
        waiting: jobs to do.
        ends: connections to the workers; each gets its first job.
        serials: numbers that no other run of the team uses.
    """

    def __init__(
        self, waiting: list[Job], ends: Sequence[Connection], serials: Iterator[int]
    ) -> None:
        self.waiting, self._serials = waiting, serials
        self.open_jobs: dict[int, Job] = {}
        self.busy: dict[Any, list[int]] = {end: [] for end in ends}
        for end in ends:
            self._hand_out(end)

    def is_due(self, end: Connection, serial: int) -> bool:
        """Take note of an answer and give that worker its next job; False if from another run."""
        if serial not in self.open_jobs:
            return False
        del self.open_jobs[serial]
        self.busy[end].remove(serial)
        self._hand_out(end)
        return True

    def taken_from(self, end: Connection) -> list[Job]:
        """Return the jobs a worker has left undone."""
        return [self.open_jobs.pop(serial) for serial in self.busy.pop(end)]

    def _hand_out(self, end: Connection) -> None:
        if not self.waiting:
            return
        serial, job = next(self._serials), self.waiting.pop(0)
        self.open_jobs[serial] = job
        self.busy[end].append(serial)
        _send(end, (serial, job))


def _send(end: Any, message: Any) -> None:
    """Send to the other side; one that has died is found out when its answer is awaited."""
    with contextlib.suppress(OSError):
        end.send(message)


def _receive(end: Any) -> Any:
    """Return an answer (serial, result), or None where the worker has died."""
    try:
        return end.recv()
    except (EOFError, OSError):
        return None


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Let processes started inside inherit that Ctrl-C is none of their business."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes started inside do their linear algebra in one thread.

    The matrices are small; threads that wait for each other would cost as much as they do.
    """
    before = {name: os.environ.get(name) for name in _THREAD_COUNTS}
    os.environ.update(dict.fromkeys(_THREAD_COUNTS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(end: Connection) -> None:
    """Serve jobs until the other side hangs up."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        shared = end.recv()
        while True:
            serial, job = end.recv()
            end.send((serial, job(shared)))
    except (EOFError, OSError):
        return
