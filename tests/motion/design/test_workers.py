"""Jobs give the same results in this process and in others, and survive a worker's death."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from functools import partial
from pathlib import Path

import pytest

from robot_sysid.motion.design.workers import WorkerPool
from tests.support.places import ROOT


def add(shared, number):
    """A job."""
    return shared + number


def number(shared):
    """A job that tells which process does it."""
    time.sleep(0.05)
    return os.getpid()


def die_elsewhere(shared, number):
    """A job that kills any process but the one that started the pool."""
    if os.getpid() != shared:
        os._exit(3)
    return number


def fail(shared):
    """A job with an error."""
    raise ValueError(f"broken {shared}")


def thread_counts(shared):
    """A job that tells what its process was told about threads."""
    return os.environ.get("OMP_NUM_THREADS"), os.environ.get("MKL_NUM_THREADS")


def test_workers_use_one_thread_each_where_the_user_says_nothing(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with WorkerPool(0, 2) as pool:
        assert list(pool.run([thread_counts, thread_counts])) == [("7", "1")] * 2
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def test_one_worker_stays_in_this_process_and_keeps_the_order():
    with WorkerPool(os.getpid(), 1) as pool:
        assert list(pool.run([partial(add, number=k) for k in range(5)])) == [
            os.getpid() + k for k in range(5)
        ]


def test_several_workers_do_every_job_once():
    with WorkerPool(100, 2) as pool:
        for count in (7, 1, 0, 3):
            results = list(pool.run([partial(add, number=k) for k in range(count)]))
            assert sorted(results) == [100 + k for k in range(count)]


def test_a_run_that_is_not_read_to_its_end_does_not_disturb_the_next():
    with WorkerPool(0, 2) as pool:
        unread = pool.run([partial(add, number=k) for k in range(1000, 1010)])
        assert next(unread) >= 1000
        unread.close()
        assert sorted(pool.run([partial(add, number=k) for k in range(4)])) == [0, 1, 2, 3]


def test_jobs_of_workers_that_die_are_done_here():
    with WorkerPool(os.getpid(), 2) as pool:
        results = list(pool.run([partial(die_elsewhere, number=k) for k in range(5)]))
        assert sorted(results) == [0, 1, 2, 3, 4]


def test_an_interrupt_makes_the_pool_say_nothing(monkeypatch):
    """Ctrl-C while results are waited for: workers end, and no thread of the pool fails."""

    seen, result = [], Future.result

    def interrupted(future):
        if seen:
            raise KeyboardInterrupt
        seen.append(future)
        return result(future)

    failed = []
    monkeypatch.setattr(threading, "excepthook", failed.append)
    monkeypatch.setattr(Future, "result", interrupted)
    before = set(threading.enumerate())
    with pytest.raises(KeyboardInterrupt), WorkerPool(0, 2) as pool:
        list(pool.run([number] * 50))
    for thread in set(threading.enumerate()) - before:
        thread.join(20.0)
    assert failed == []


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_in_a_job_is_seen(workers, capfd):
    with WorkerPool("thing", workers) as pool, pytest.raises(ValueError, match="broken thing"):
        list(pool.run([fail]))


@pytest.mark.parametrize("error", [OSError(11, "again"), RuntimeError("no new thread")])
@pytest.mark.parametrize("place", ["ProcessPoolExecutor", "ProcessPoolExecutor.submit"])
def test_where_no_process_can_be_started_the_jobs_are_done_here(place, error, monkeypatch):
    """As under ``ulimit -u``: pipes and semaphores, or threads and processes, are refused."""

    def refuse(*_, **__):
        raise error

    monkeypatch.setattr(f"robot_sysid.motion.design.workers.{place}", refuse)
    with WorkerPool(os.getpid(), 2) as pool:
        for _ in range(2):
            results = list(pool.run([partial(add, number=k) for k in range(5)]))
            assert sorted(results) == [os.getpid() + k for k in range(5)]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes cannot be listed")
def test_workers_end_with_a_process_that_is_killed():
    """Whoever is killed cannot end his workers; they would wait for ever."""
    code = (
        "from tests.motion.design.test_workers import number\n"
        "from robot_sysid.motion.design.workers import WorkerPool\n"
        "with WorkerPool(0, 2) as pool:\n"
        "    print(*{*pool.run([number] * 8)}, flush=True)\n"
        "    input()\n"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdin=pipe, stdout=pipe) as run:
        workers = [Path("/proc", word.decode()) for word in run.stdout.readline().split()]
        assert workers and all(worker.is_dir() for worker in workers)
        run.kill()
    limit = time.monotonic() + 20.0
    while any(worker.is_dir() for worker in workers) and time.monotonic() < limit:
        time.sleep(0.02)
    assert not any(worker.is_dir() for worker in workers)
