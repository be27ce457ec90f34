"""Adapters behind python-can with a simulated arm, and the maker's serial adapter byte by byte."""

from __future__ import annotations

import contextlib
import errno
import subprocess
import sys
import time

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigs.motors.realtime_arm import NEEDS_TERMINALS, NearEnd, slcan_terminal
from robot_sysid.damiao.adapters import (
    INTERFACES,
    SERIAL_ADAPTER,
    BusAddress,
    BusLink,
    SerialAdapter,
    open_bus,
)
from robot_sysid.damiao.bus import GuardedLink, LinkError, SimulatedClock, SystemClock
from robot_sysid.damiao.protocol import DISABLE, BusTiming, CanFrame, special_frame
from robot_sysid.errors import InputError

WALL = 1.7e9


class WaitingBus:
    """What BusLink receives of a python-can bus in simulated time: what waits, or is raised."""

    def __init__(self, clock):
        self._clock = clock
        self.waiting = []

    def message(self, identifier=1, data=b"", age=0.0, **fields):
        stamp = WALL + self._clock.now() - age
        fields = {"is_extended_id": False, **fields}
        return can.Message(
            timestamp=stamp, arbitration_id=identifier, data=data, **fields
        )

    def recv(self, timeout):
        if not self.waiting:
            self._clock.sleep_until(self._clock.now() + timeout)
            return None
        message = self.waiting.pop(0)
        if isinstance(message, Exception):
            raise message
        return message


@pytest.fixture
def clock(monkeypatch):
    """A simulated clock that the wall clock follows."""
    simulated = SimulatedClock()
    monkeypatch.setattr(time, "time", lambda: WALL + simulated.now())
    return simulated


@pytest.mark.parametrize(
    ("age", "taken_back"),
    [(0.0, 0.0), (0.3, 0.3), (0.999, 0.999), (-0.1, 0.0), (1.5, 0.0)],
)
def test_stamps_are_in_our_clock_unless_they_are_of_another_one(clock, age, taken_back):
    bus = WaitingBus(clock)
    clock.sleep_until(5.0)
    bus.waiting = [bus.message(age=age)]
    # The wall clock counts in quarters of a microsecond.
    assert BusLink(bus, clock).receive(6.0).time == pytest.approx(
        5.0 - taken_back, abs=1e-6
    )


def test_other_and_garbled_frames_are_passed_over_and_echoes_marked(clock):
    bus = WaitingBus(clock)
    bus.waiting = [
        bus.message(7, is_extended_id=True),
        bus.message(1, is_rx=False),
        bus.message(2, is_error_frame=True),
        *2 * [ValueError("invalid literal")],
        bus.message(3),
    ]
    link = BusLink(bus, clock)
    frames = [link.receive(1.0) for _ in range(2)]
    assert [(f.id, f.echo) for f in frames] == [(1, True), (3, False)]
    assert link.error_frames == GuardedLink(link, clock).error_frames == 1
    assert link.receive(1.0) is None and clock.now() == 1.0


class Broken:
    """A driver that raises an error the first times that it is asked for something."""

    def __init__(self, error, times):
        self.error = error
        self.times = times

    def send(self, *_, timeout=None):
        self.times -= 1
        if self.times >= 0:
            raise self.error

    recv = shutdown = send


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("7", errno.ENOBUFS),
        RuntimeError(7),
        SystemExit(7),
        KeyboardInterrupt(7),
    ],
)
def test_whatever_a_driver_raises_is_our_error(clock, error):
    """A frame is tried again within the cycle; nothing that closing raises goes on."""
    link = BusLink(Broken(error, 1e9), clock)
    link.close()
    if isinstance(error, KeyboardInterrupt):
        return
    BusLink(Broken(error, 1), clock).send(CanFrame(1, bytes(8)))
    assert 0.0 < clock.now() < 1e-3
    message = "7.*the motors' power, the wiring and the termination"
    with pytest.raises(LinkError, match=message):
        link.send(CanFrame(1, b""))
    assert clock.now() < 4e-3
    with pytest.raises(LinkError, match="7"):
        link.receive(0.1)


# Older releases of python-can trip over a bus they have only half built.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("interface", "channel", "message"),
    [
        ("udp_multicast", "239.0.0.1", "--interface 'udp_multicast': choose one of"),
        ("socketcan", "no-such-bus", "cannot open socketcan channel no-such-bus"),
    ],
)
def test_a_bus_that_cannot_be_opened_is_said(interface, channel, message):
    with pytest.raises(InputError, match=message):
        open_bus(BusAddress(interface, channel), BusTiming(), SystemClock())


def test_no_interface_reaches_a_network():
    assert not {"udp_multicast", "socketcand", "remote"} & set(INTERFACES)
    assert set(INTERFACES) - {SERIAL_ADAPTER} <= set(can.VALID_INTERFACES)


def test_everything_but_the_bus_works_without_python_can():
    """With python-can out of reach, all modules import, and opening a bus says what to install."""
    script = """
import pkgutil, sys
sys.modules["can"] = None
import robot_sysid.damiao
for module in pkgutil.walk_packages(robot_sysid.damiao.__path__, "robot_sysid.damiao."):
    __import__(module.name)
from robot_sysid.cli import main
sys.exit(main(["motors", "setup", "--channel", "can0"]))
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True
    )
    assert done.returncode == 2
    error, command = done.stderr.splitlines()
    assert error.endswith("needs python-can; install with:")
    assert command.startswith("  pip install -e ") and command.endswith('[can]"')


PACKET_FRAMES = st.lists(
    st.tuples(st.integers(0, 0x7FF), st.binary(min_size=8, max_size=8)).map(
        lambda f: CanFrame(*f)
    )
)


def answer(frame):
    """What the adapter says about a frame that it received."""
    return b"\xaa\x11\x08" + frame.id.to_bytes(4, "little") + frame.data + b"\x55"


class Port:
    """A serial port whose line comes in pieces of one size."""

    in_waiting = 0

    def __init__(self, line, size):
        self._pieces = [line[k : k + size] for k in range(0, len(line), size)]

    def read(self, size):
        return self._pieces.pop(0) if self._pieces else b""


def frames_in(line, size):
    """The frames that the maker's adapter finds in a line."""
    adapter = SerialAdapter(Port(line, size))
    messages = [adapter.recv(1e-3) for _ in range(len(line) // 16 + 1)]
    return [CanFrame(m.arbitration_id, bytes(m.data)) for m in messages if m]


@settings(deadline=None)
@given(PACKET_FRAMES, st.integers(1, 40))
def test_frames_come_through_in_whatever_pieces(frames, size):
    assert frames_in(b"".join(map(answer, frames)), size) == frames


def test_other_packets_and_broken_ones_are_passed_over():
    one = CanFrame(0x11, bytes(range(8)))
    status = b"\xaa\x01" + bytes(13) + b"\x55"
    torn = answer(one)[:9]
    # A torn packet swallows at most what looks like its own rest.
    frames_read = frames_in(status + answer(one) + torn + answer(one) + answer(one), 7)
    assert frames_read.count(one) >= 2 and set(frames_read) == {one}


@pytest.fixture
def line():
    """(link, the far end of its serial line)."""
    far = NearEnd()
    address = BusAddress("damiao", far.device, ("baudrate=115200",))
    link = open_bus(address, BusTiming(), SystemClock())
    yield link, far
    link.close()
    far.close()


@NEEDS_TERMINALS
def test_thirty_bytes_go_out_per_frame_and_sixteen_come_in(line):
    """Typed from the maker's description."""
    link, far = line
    link.send(special_frame(DISABLE, 3))
    assert far.read(1) == bytes.fromhex(
        "55aa1e03 01000000 0a000000 00 03000000 00 08 00 00 ffffffffffffff fd 00"
    )
    sent = bytes.fromhex("aa1108 13000000 138b217d3866231f 55")
    far.write(b"\x00\x55" + sent + sent[:7])
    clock = SystemClock()
    frame = link.receive(clock.now() + 1.0)
    assert (frame.id, frame.data, frame.echo) == (0x13, sent[7:15], False)
    assert abs(frame.time - clock.now()) < 0.5
    assert link.receive(clock.now() + 0.01) is None


@NEEDS_TERMINALS
def test_an_slcan_bus_is_read_in_pieces():
    """python-can asks for every byte, and waits a millisecond where none has come."""
    clock = SystemClock()
    far, device = slcan_terminal()
    address = BusAddress("slcan", device, ("sleep_after_open=0",))
    with contextlib.closing(open_bus(address, BusTiming(), clock)) as link:
        took = []
        for _ in range(3):
            far.serialPortOrig.write((b"t0118" + b"AB" * 8 + b"\r") * 100)
            start = clock.now()
            frames = [link.receive(start + 1.0) for _ in range(100)]
            assert link.receive(clock.now()) is None
            took.append(clock.now() - start)
            assert {(f.id, f.data) for f in frames} == {(0x11, b"\xab" * 8)}
    far.shutdown()
    assert min(took) < 0.01
