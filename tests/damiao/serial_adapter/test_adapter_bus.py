"""The adapter over a pseudo-terminal: the bytes that go and come."""

from __future__ import annotations

import os

import can
import pytest

from robot_sysid.damiao.bus.can_bus import BusAddress, open_bus
from robot_sysid.damiao.bus.clock import SystemClock
from robot_sysid.damiao.bus.link import LinkError
from robot_sysid.damiao.protocol.bus_load import BusTiming
from robot_sysid.damiao.protocol.frames import Address, Frame, disable_frame
from robot_sysid.damiao.serial_adapter import adapter_bus
from robot_sysid.errors import InputError

pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")


@pytest.fixture
def line():
    """(link, our end of its serial line)."""
    import tty

    near, far = os.openpty()
    tty.setraw(far)
    address = BusAddress("damiao", (os.ttyname(far),), ("write_timeout=5",))
    link = open_bus(address, BusTiming(), SystemClock())
    yield link, near
    link.close()
    for end in (near, far):
        os.close(end)


def test_thirty_bytes_go_out_per_frame(line):
    link, near = line
    link.send(disable_frame(Address(0, 3)))
    assert os.read(near, 100) == bytes.fromhex(
        "55aa1e03 01000000 0a000000 00 03000000 00 08 00 00 ffffffffffffff fd 00"
    )


def test_sixteen_bytes_come_in_per_frame(line):
    link, near = line
    clock = SystemClock()
    sent = bytes.fromhex("aa1108 13000000 138b217d3866231f 55")
    os.write(near, b"\x00\x55" + sent + sent[:7])
    frame = link.receive(clock.now() + 1.0)
    assert (frame.id, frame.data.hex(), frame.echo) == (0x13, "138b217d3866231f", False)
    assert abs(frame.time - clock.now()) < 0.5
    assert link.receive(clock.now() + 0.01) is None
    os.write(near, sent[7:])
    assert link.receive(clock.now() + 1.0).data == frame.data


def test_can_fd_is_refused_because_it_would_be_classic_frames():
    with pytest.raises(InputError, match="leave --fd off"):
        open_bus(BusAddress("damiao", ("/dev/null",)), BusTiming(fd=True), SystemClock())


def test_a_line_that_breaks_is_our_error(line):
    link, _ = line
    link.close()
    with pytest.raises(LinkError):
        link.send(Frame(1, bytes(8)))


def test_python_can_takes_it_for_a_bus():
    assert issubclass(adapter_bus.DamiaoSerialBus, can.BusABC)
    with pytest.raises(AttributeError):
        adapter_bus.no_such_name  # noqa: B018
