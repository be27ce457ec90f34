"""Jobs on one shared object, in this process or in a pool of workers, and the time for them.

Worker processes are started afresh ("spawn"), so nothing depends on what this process has loaded;
each receives the object once and keeps it. Results do not depend on how many workers there are.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Callable

from robot_sysid.interrupts import held_back

_THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

Job = Callable[[Any], Any]
"""A function of the shared object; ``functools.partial`` of a module's function, to be sent."""

clock = time.monotonic
"""Gives the time [s], of the machine, so that a deadline can be told to other processes too."""


def is_over(deadline: float) -> bool:
    """Tell whether a deadline on the ``clock`` [s] has passed."""
    return clock() > deadline


# What the jobs of this process work on, where this process is a worker.
_received: Any = None


class WorkerPool:
    """Does jobs on ``shared``; a context manager, so that its processes end with it.

    With one worker it uses the present process. Others do their linear algebra in one thread: the
    matrices are small, and threads that wait for each other would cost as much as they do. Whoever
    has set one of the variables for that keeps his value.
    """

    def __init__(self, shared: Any, workers: int) -> None:
        self._shared, self._others = shared, multiprocessing.active_children()
        self._pool: ProcessPoolExecutor | None = None
        self._unset = [name for name in _THREAD_COUNTS if name not in os.environ]
        # Without room for another process, for its pipes or its semaphores there is no pool.
        with contextlib.suppress(OSError, RuntimeError, ImportError):
            if workers > 1:
                context = multiprocessing.get_context("spawn")
                self._pool = ProcessPoolExecutor(workers, context, _receive, (shared,))

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(self, *failure: object) -> None:
        if self._pool is None:
            return
        ours = [p for p in multiprocessing.active_children() if p not in self._others]
        self._pool.shutdown(wait=False, cancel_futures=True)
        # A job that nobody waits for any more would keep this program from ending.
        for process in ours:
            process.terminate()
        self._pool = None

    def run(self, jobs: Sequence[Job]) -> Iterator[Any]:
        """Yield the results of the jobs, in their order.

        What workers that died, or could not be started, leave undone is done here, where an error
        in a job is seen.
        """
        done, futures = 0, list[Future[Any]]()
        try:
            if self._pool is not None:
                futures = self._submitted(self._pool, jobs)
            for future in futures:
                yield future.result()
                done += 1
        except (BrokenProcessPool, OSError, RuntimeError):
            self.__exit__()
        except GeneratorExit:
            # Not where all ends: the pool's thread fails with a traceback at a cancelled job whose
            # worker is ended.
            for future in futures if self._pool is not None else ():
                future.cancel()
            raise
        yield from (job(self._shared) for job in jobs[done:])

    def _submitted(self, pool: ProcessPoolExecutor, jobs: Sequence[Job]) -> list[Future[Any]]:
        """Return the futures of jobs; the first ones start processes, as far as the system lets."""
        os.environ.update(dict.fromkeys(self._unset, "1"))
        try:
            with held_back((signal.SIGINT,)):
                return [pool.submit(_do, job) for job in jobs]
        finally:
            for name in self._unset:
                os.environ.pop(name, None)


def _receive(shared: Any) -> None:
    """Make this process a worker on an object, which ends with the one that started it."""
    global _received
    _received = shared
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    # Workers hold both ends of their queue: one whose parent was killed would wait for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _do(job: Job) -> Any:
    return job(_received)
