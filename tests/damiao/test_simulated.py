"""Serving a simulated arm, in simulated time, and behind a pseudo-terminal."""

from __future__ import annotations

import os

import can
import pytest

from rigs.realtime_arm import NEEDS_TERMINALS, slcan_terminal
from robot_sysid.damiao.adapters import BusLink
from robot_sysid.damiao.bus import SystemClock
from robot_sysid.damiao.protocol import CanFrame

# Far longer than any pause of a busy machine.
PATIENCE = 60.0


@pytest.fixture
def adapter():
    """(our end, python-can's end) of a serial adapter, and the device between them."""
    pytest.importorskip("serial")
    clock = SystemClock()
    terminal, device = slcan_terminal()
    far = BusLink(terminal, clock)
    bus = can.Bus(
        interface="slcan", channel=device, bitrate=1000000, sleep_after_open=0
    )
    near_link = BusLink(bus, clock)
    yield far, near_link, device
    near_link.close()
    far.close()


@NEEDS_TERMINALS
def test_frames_pass_through_the_adapter_both_ways_whatever_else_is_on_the_line(
    adapter,
):
    """A client that was killed leaves half a line."""
    far, near_link, device = adapter
    clock = SystemClock()
    for number in range(1, 10):
        near_link.send(CanFrame(number, bytes([number])))
        received = far.receive(clock.now() + PATIENCE)
        assert (received.id, received.data) == (number, bytes([number]))
        far.send(CanFrame(0x100 + number, bytes(8)))
        answer = near_link.receive(clock.now() + PATIENCE)
        assert (answer.id, answer.data) == (0x100 + number, bytes(8))
        # Half a frame, then the line that opens an adapter; what is none of either.
        line = os.open(device, os.O_WRONLY | os.O_NOCTTY)
        os.write(line, (b"t00C\r", b"t0018C\r", b"\xff\xfe\r", b"\r")[number % 4])
        os.close(line)
