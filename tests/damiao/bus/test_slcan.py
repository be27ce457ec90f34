"""The pseudo-terminal that acts as a serial CAN adapter."""

from __future__ import annotations

import os

import can
import pytest
from hypothesis import given

from robot_sysid.damiao.bus.can_bus import BusLink
from robot_sysid.damiao.bus.clock import SystemClock
from robot_sysid.damiao.bus.inspection import inspect_bus
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.bus.slcan import SlcanTerminal, frame_from_line, line_from_frame
from robot_sysid.damiao.protocol.frames import Address, Frame
from tests.support.can_frames import FRAMES
from tests.support.damiao_rig import two_motor_arm
from tests.support.links import served_in_background

NEEDS_TERMINALS = pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")
# Far longer than any pause of a busy machine.
PATIENCE = 60.0


@given(FRAMES)
def test_frames_survive_the_serial_text(frame):
    assert frame_from_line(line_from_frame(frame)) == frame


@pytest.mark.parametrize(
    "line", ["", "O", "S8", "C", "t", "t12", "t0013", "t001zz", "t0019" + 18 * "0", "x"]
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
    near = BusLink(bus, clock)
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
        found = inspect_bus(GuardedLink(near, clock.now), clock)
    assert [address.can_id for address in sorted(found.motors)] == [1, 2]
    assert found.motors[Address(0, 2)].feedback.temperature_rotor[0] == 29
