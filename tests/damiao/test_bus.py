"""Real-time priority of a control loop, and what an inspection of a bus finds."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading

import numpy as np
import pytest

from rigs.motors.damiao_rig import MotorBus
from robot_sysid.damiao.bus import inspect_bus, undisturbed_processor
from robot_sysid.damiao.protocol import REFRESH

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


def test_an_inspection_says_how_the_motors_answered():
    """Of the answers to twenty requests to all motors at once, some are lost."""
    bus = MotorBus()
    sound = inspect_bus(bus.link)
    times = np.array([motor.answer_times for motor in sound.motors.values()])
    assert times.shape == (2, 20) and sound.error_frames == 0
    # Both are asked, then answer one after the other.
    assert np.all(np.diff(times, axis=0) > 1e-4)
    assert np.max(times) == sound.round_trip < 1e-3
    second = bus.motors[1]
    handle = second.handle
    counts = []

    def lose_some(frame, time):
        """Lose the answers to three of the twenty requests."""
        answer = handle(frame, time)
        is_round = frame.data[2] == REFRESH and frame.data[0] == second.can_id
        counts.extend([time] * is_round)
        # The state is asked for once before.
        is_lost = is_round and len(counts) in (3, 6, 9)
        return None if is_lost else answer

    second.handle = lose_some
    bus.bus.error_frames = 4
    worse = inspect_bus(bus.link)
    lost = np.flatnonzero(np.isnan(worse.motors[2].answer_times))
    assert lost.tolist() == [1, 4, 7]
    assert np.all(np.isfinite(worse.motors[1].answer_times))
    # More than a tenth.
    assert np.isnan(worse.round_trip) and worse.error_frames == 0
