"""Jobs give the same results in this process and in others, and survive a worker's death."""

from __future__ import annotations

import os
from functools import partial

import pytest

from robot_sysid.excitation.workers import Team


def add(shared, number):
    """A job."""
    return shared + number


def die_elsewhere(shared, number):
    """A job that kills any process but the one that started the team."""
    if os.getpid() != shared:
        os._exit(3)
    return number


def fail(shared):
    """A job with an error."""
    raise ValueError(f"broken {shared}")


def thread_count(shared):
    """A job that tells what its process was told about threads."""
    return os.environ.get("OMP_NUM_THREADS")


def test_workers_use_one_thread_each_and_leave_ours_alone(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with Team(0, 2) as team:
        assert list(team.run([thread_count, thread_count])) == ["1", "1"]
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def test_one_worker_stays_in_this_process_and_keeps_the_order():
    with Team(os.getpid(), 1) as team:
        assert list(team.run([partial(add, number=k) for k in range(5)])) == [
            os.getpid() + k for k in range(5)
        ]


def test_several_workers_do_every_job_once():
    with Team(100, 2) as team:
        for count in (7, 1, 0, 3):
            results = list(team.run([partial(add, number=k) for k in range(count)]))
            assert sorted(results) == [100 + k for k in range(count)]


def test_a_run_that_is_not_read_to_its_end_does_not_disturb_the_next():
    with Team(0, 2) as team:
        unread = team.run([partial(add, number=k) for k in range(1000, 1010)])
        assert next(unread) >= 1000
        unread.close()
        assert sorted(team.run([partial(add, number=k) for k in range(4)])) == [0, 1, 2, 3]


def test_jobs_of_workers_that_die_are_done_here():
    with Team(os.getpid(), 2) as team:
        results = list(team.run([partial(die_elsewhere, number=k) for k in range(5)]))
        assert sorted(results) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_in_a_job_is_seen(workers, capfd):
    with Team("thing", workers) as team, pytest.raises(ValueError, match="broken thing"):
        list(team.run([fail]))
