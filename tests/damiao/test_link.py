"""The guard that every frame goes through, and time."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.bus import SimulatedClock, SystemClock
from robot_sysid.damiao.protocol.frames import Frame
from robot_sysid.errors import SysidError
from tests.support.clocks import ScriptedClock
from tests.support.motor_bench import Bench


def test_a_refused_frame_does_not_reach_the_bus():
    bench = Bench()
    with pytest.raises(SysidError):
        bench.link.send(Frame(1, b"\xff" * 7 + b"\xfe"))
    assert bench.bus.sent == []


@given(st.lists(st.floats(-10.0, 10.0), max_size=20))
def test_a_simulated_clock_is_at_the_latest_moment_that_anybody_slept_until(moments):
    clock = SimulatedClock()
    for moment in moments:
        clock.sleep_until(moment)
    assert clock.now() == max([0.0, *moments])


def test_callbacks_run_when_the_scripted_clock_passes_them():
    clock, seen = ScriptedClock(), []
    for moment in (0.3, 0.1, 0.2):
        clock.at(moment, lambda: seen.append(round(clock.now(), 6)))
    clock.sleep_until(0.25)
    assert seen == [0.1, 0.2] and clock.now() == 0.25


def test_a_scripted_clock_can_lose_time():
    clock = ScriptedClock()
    clock.sleep_until(1.0)
    clock.stall(0.5)
    assert clock.now() == 1.5


def test_the_system_clock_sleeps_until_the_moment():
    clock = SystemClock()
    start = clock.now()
    clock.sleep_until(start + 0.01)
    assert clock.now() - start >= 0.01
    clock.sleep_until(start)
