"""Real-time priority of a control loop."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading

import pytest

from robot_sysid.damiao.bus import undisturbed_processor

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's scheduling")


class Scheduler:
    """Stands for the system's scheduler; ``policies`` and ``priorities`` are by thread."""

    def __init__(self, monkeypatch, is_allowed=True, policy=0):
        self.is_allowed = is_allowed
        self.schedules = {}
        self.first_policy = policy
        monkeypatch.setattr(os, "sched_getscheduler", self.policy)
        monkeypatch.setattr(os, "sched_setscheduler", self.schedule)

    def policy(self, thread_id):
        return self.schedules.get(thread_id, (self.first_policy, 0))[0]

    def schedule(self, thread_id, policy, parameters):
        if not self.is_allowed:
            raise PermissionError(1, "Operation not permitted")
        self.schedules[thread_id] = policy, parameters.sched_priority


@contextlib.contextmanager
def waiting_thread():
    """A thread that waits for the end of the block; yields its number."""
    leave = threading.Event()
    thread = threading.Thread(target=leave.wait)
    thread.start()
    try:
        yield thread.native_id
    finally:
        leave.set()
        thread.join()


@LINUX
def test_the_loop_goes_before_the_other_threads_and_these_before_other_programs(
    monkeypatch,
):
    scheduler = Scheduler(monkeypatch)
    with waiting_thread() as other, undisturbed_processor():
        own_policy, own_priority = scheduler.schedules[threading.get_native_id()]
        policy, priority = scheduler.schedules[other]
        assert own_policy == policy == os.SCHED_FIFO
        # The kernel's own threads have a priority of 50.
        assert 0 < priority < own_priority < 50


@LINUX
@pytest.mark.parametrize("error", [None, ValueError, KeyboardInterrupt, SystemExit])
def test_priority_is_given_back_on_every_way_out(monkeypatch, error):
    scheduler = Scheduler(monkeypatch)
    expected = pytest.raises(error) if error else contextlib.nullcontext()
    with contextlib.ExitStack() as stack:
        earlier = stack.enter_context(waiting_thread())
        with expected, undisturbed_processor():
            # It inherits the loop's priority.
            later = stack.enter_context(waiting_thread())
            if error:
                raise error
        for thread_id in (threading.get_native_id(), earlier, later):
            assert scheduler.schedules[thread_id] == (os.SCHED_OTHER, 0)


@LINUX
def test_a_user_without_the_right_goes_on_without(monkeypatch):
    scheduler = Scheduler(monkeypatch, is_allowed=False)
    with undisturbed_processor():
        assert not gc.isenabled()
    assert gc.isenabled()
    assert scheduler.schedules == {}


@LINUX
def test_simulated_time_takes_no_priority(monkeypatch):
    """It never waits, and would keep a processor for itself."""
    scheduler = Scheduler(monkeypatch)
    with undisturbed_processor(live=False):
        assert not gc.isenabled()
    assert scheduler.schedules == {}
