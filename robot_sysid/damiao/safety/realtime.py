"""Processor time for a control loop, before the rest of this program and before other programs."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading
from collections.abc import Iterator

PRIORITY = 20
"""Real-time priority of the thread that keeps time: below the kernel's own threads (50)."""
# The other threads wait for the one that keeps time, but for no other program: whichever of them
# holds Python's lock when it is interrupted holds up the control loop too.
_PRIORITY_ASIDE = 10
# A busy thread gives way after this long [s]; Python's own default is more than a control cycle.
_SWITCH_INTERVAL = 2e-4


@contextlib.contextmanager
def undisturbed(live: bool = True) -> Iterator[bool]:
    """Keep garbage collection, other threads and other programs from pausing the block.

    A ``live`` block keeps to the computer's clock. It has to wait now and then: nothing else runs
    on its processor meanwhile. It is told whether it has real-time priority; where the system
    refuses that, or knows none, the rest still holds.
    """
    collects_garbage = gc.isenabled()
    switch_interval = sys.getswitchinterval()
    gc.collect()
    gc.disable()
    sys.setswitchinterval(_SWITCH_INTERVAL)
    try:
        with (
            _real_time_priority()
            if live
            else contextlib.nullcontext(False) as is_granted
        ):
            yield is_granted
    finally:
        sys.setswitchinterval(switch_interval)
        if collects_garbage:
            gc.enable()


@contextlib.contextmanager
def _real_time_priority() -> Iterator[bool]:
    """Give the threads of this program real-time priority, where it is allowed, and take it back.

    A policy that somebody has chosen already (by chrt) is left as it is.
    """
    policy = os.sched_getscheduler(0) if sys.platform == "linux" else None
    if policy is None or policy != os.SCHED_OTHER:
        yield policy is not None and policy in (os.SCHED_FIFO, os.SCHED_RR)
        return
    try:
        is_granted = _schedule(0, os.SCHED_FIFO, PRIORITY)
        for thread_id in _other_threads() if is_granted else ():
            _schedule(thread_id, os.SCHED_FIFO, _PRIORITY_ASIDE)
        yield is_granted
    finally:
        # Threads that were started meanwhile have inherited it.
        for thread_id in (0, *_other_threads()):
            _schedule(thread_id, os.SCHED_OTHER, 0)


def lacks_priority() -> bool:
    """Tell whether this system has real-time priority but has not given it to this thread."""
    if sys.platform != "linux":
        return False
    return os.sched_getscheduler(0) not in (os.SCHED_FIFO, os.SCHED_RR)


def _schedule(thread_id: int, policy: int, priority: int) -> bool:
    """Set how a thread is scheduled, 0 for the calling one; return whether it was allowed."""
    try:
        os.sched_setscheduler(thread_id, policy, os.sched_param(priority))
    except OSError:
        # No right to it, or the thread has ended.
        return False
    return True


def _other_threads() -> list[int]:
    """Return the system's numbers of the threads beside the calling one."""
    current = threading.get_native_id()
    ids = [thread.native_id for thread in threading.enumerate()]
    return [thread_id for thread_id in ids if thread_id not in (None, current)]
