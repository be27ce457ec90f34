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


@pytest.fixture
def schedules(monkeypatch):
    """Policy and priority that the system's scheduler was told, by thread."""
    told = {}
    monkeypatch.setattr(os, "sched_getscheduler", lambda _: os.SCHED_OTHER)
    monkeypatch.setattr(
        os,
        "sched_setscheduler",
        lambda thread, policy, p: told.update({thread: (policy, p.sched_priority)}),
    )
    return told


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
@pytest.mark.parametrize("error", [None, ValueError, KeyboardInterrupt, SystemExit])
def test_priority_is_given_back_on_every_way_out(schedules, error):
    """The loop goes before the other threads, and these before other programs."""
    expected = pytest.raises(error) if error else contextlib.nullcontext()
    own = threading.get_native_id()
    with contextlib.ExitStack() as stack:
        earlier = stack.enter_context(waiting_thread())
        with expected, undisturbed_processor():
            assert not gc.isenabled()
            # It inherits the loop's priority.
            later = stack.enter_context(waiting_thread())
            assert schedules[own][0] == schedules[earlier][0] == os.SCHED_FIFO
            # The kernel's own threads have a priority of 50.
            assert 0 < schedules[earlier][1] < schedules[own][1] < 50
            if error:
                raise error
        assert gc.isenabled()
        for thread_id in (own, earlier, later):
            assert schedules[thread_id] == (os.SCHED_OTHER, 0)


@LINUX
def test_a_user_without_the_right_goes_on_without(schedules, monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with undisturbed_processor():
        assert not gc.isenabled()
    assert gc.isenabled()


@LINUX
def test_simulated_time_takes_no_priority(schedules):
    """It never waits, and would keep a processor for itself."""
    with undisturbed_processor(live=False):
        assert not gc.isenabled()
    assert schedules == {}
