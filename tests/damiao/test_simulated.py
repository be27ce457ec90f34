"""Serving a simulated arm, in simulated time, and behind a pseudo-terminal."""

from __future__ import annotations

import os

import can
import pytest
from hypothesis import given

from robot_sysid.damiao.bus import BusLink, GuardedLink, SimulatedClock, SystemClock
from robot_sysid.damiao.inspection import inspect_bus
from robot_sysid.damiao.protocol.frames import (
    Address,
    Frame,
    disable_frame,
    enable_frame,
    refresh_frame,
)
from robot_sysid.damiao.simulated import SlcanTerminal, frame_from_line, line_from_frame, serve
from tests.support.can_frames import FRAMES
from tests.support.damiao_rig import two_motor_arm
from tests.support.links import served_in_background


class FarEnd:
    """The arm's end of a bus: frames that come at given times, and what was answered."""

    def __init__(self, clock, *arrivals):
        self._clock, self._arrivals = clock, list(arrivals)
        self.answers = []

    def receive(self, until):
        if self._arrivals and self._arrivals[0][0] <= until:
            moment, frame = self._arrivals.pop(0)
            self._clock.sleep_until(moment)
            return frame
        self._clock.sleep_until(until)
        return None

    def send(self, frame):
        self.answers.append((self._clock.now(), frame.id))


def served(clock, far, arm, seconds):
    return serve(arm, far, clock, lambda: clock.now() < seconds)


def test_each_frame_is_answered_when_it_comes():
    clock, arm = SimulatedClock(), two_motor_arm()
    far = FarEnd(
        clock,
        (0.1, refresh_frame(Address(0, 1))),
        (0.2, refresh_frame(Address(0, 2))),
        (0.3, refresh_frame(Address(0, 3))),
    )
    assert served(clock, far, arm, 1.0) == 0.0
    assert far.answers == [(0.1, 17), (0.2, 18)]
    assert arm.time == pytest.approx(1.0, abs=2e-3)


def test_an_echo_is_no_question():
    clock, arm = SimulatedClock(), two_motor_arm()
    far = FarEnd(clock, (0.1, enable_frame(Address(0, 1))._replace(echo=True)))
    served(clock, far, arm, 1.0)
    assert far.answers == [] and not arm.motors[0].driving


def test_watchdogs_expire_while_nobody_talks():
    clock, arm = SimulatedClock(), two_motor_arm(watchdog=0.1)
    far = FarEnd(clock, (0.1, enable_frame(Address(0, 1))), (0.3, disable_frame(Address(0, 2))))
    served(clock, far, arm, 0.15)
    assert arm.motors[0].driving
    served(clock, far, arm, 0.3)
    assert not arm.motors[0].driving


def test_a_computer_that_falls_behind_leaves_time_out_instead_of_catching_up():
    clock, arm = SimulatedClock(), two_motor_arm()
    far = FarEnd(clock, (0.1, enable_frame(Address(0, 1))), (0.11, Frame(99, bytes(8))))
    ordinary, steps = far.receive, []
    arm.mechanism.step, step = lambda *law: steps.append(0) or step(*law), arm.mechanism.step

    def paused(until):
        if 0.5 < clock.now() < 0.6:
            clock.sleep_until(5.0)
        return ordinary(until)

    far.receive = paused
    assert served(clock, far, arm, 6.0) == pytest.approx(5.0 - 0.5, abs=5e-3)
    assert arm.time == pytest.approx(6.0, abs=2e-3)
    # Physics ran from enabling to the pause and after it, in steps of a millisecond.
    assert len(steps) == pytest.approx(1000 * (0.4 + 1.0), abs=10)


NEEDS_TERMINALS = pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")
# Far longer than any pause of a busy machine.
PATIENCE = 60.0


@given(FRAMES)
def test_frames_survive_the_serial_text(frame):
    assert frame_from_line(line_from_frame(frame)) == frame


@pytest.mark.parametrize(
    "line",
    ["", "O", "S8", "C", "t", "t12", "t0013", "t001zz", "t0019" + 18 * "0", "x", "T000000010"],
)
def test_lines_that_are_no_frames_give_none(line):
    assert frame_from_line(line) is None


@pytest.fixture
def adapter():
    """(our end, python-can's end) of a serial adapter."""
    pytest.importorskip("serial")
    clock = SystemClock()
    far = SlcanTerminal(clock)
    bus = can.Bus(interface="slcan", channel=far.device, bitrate=1000000, sleep_after_open=0)
    near = BusLink([bus], clock)
    yield far, near
    near.close()
    far.close()


@NEEDS_TERMINALS
def test_frames_pass_through_the_adapter_both_ways(adapter):
    far, near = adapter
    clock = SystemClock()
    for number in range(1, 20):
        near.send(Frame(number, bytes([number])))
        asked = far.receive(clock.now() + PATIENCE)
        assert (asked.id, asked.data) == (number, bytes([number]))
        far.send(Frame(0x100 + number, bytes(8)))
        answer = near.receive(clock.now() + PATIENCE)
        assert (answer.id, answer.data) == (0x100 + number, bytes(8))


@NEEDS_TERMINALS
def test_an_adapter_that_nobody_reads_drops_frames_instead_of_waiting(adapter):
    far, _ = adapter
    for _ in range(2000):
        far.send(Frame(1, bytes(8)))


@pytest.mark.realtime
@NEEDS_TERMINALS
def test_an_arm_behind_a_serial_adapter_answers_pythons_slcan(adapter):
    (far, near), clock = adapter, SystemClock()
    with served_in_background(two_motor_arm(), far, clock, close=False):
        found = inspect_bus(GuardedLink(near, clock))
    assert [address.can_id for address in sorted(found.motors)] == [1, 2]
    assert found.motors[Address(0, 2)].feedback.temperature_rotor[0] == 29
