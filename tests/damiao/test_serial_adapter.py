"""The adapter's packets, byte by byte, and over a pseudo-terminal: the bytes that go and come."""

from __future__ import annotations

import contextlib
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.adapters import (
    BusAddress,
    PacketReader,
    open_bus,
    slcan_terminal,
)
from robot_sysid.damiao.bus import LinkError, SystemClock
from robot_sysid.damiao.protocol import Address, BusTiming, Frame, disable_frame
from robot_sysid.errors import InputError

FRAMES = st.lists(
    st.tuples(st.integers(0, 0x7FF), st.binary(min_size=8, max_size=8)).map(
        lambda f: Frame(*f)
    )
)


def answer(frame):
    """What the adapter says about a frame that it received."""
    return b"\xaa\x11\x08" + frame.id.to_bytes(4, "little") + frame.data + b"\x55"


@given(FRAMES, st.integers(1, 40))
def test_frames_come_through_in_whatever_pieces(frames, size):
    line = b"".join(map(answer, frames))
    reader = PacketReader()
    frames_read = []
    for start in range(0, len(line), size):
        frames_read += reader.take(line[start : start + size])
    assert frames_read == frames


def test_other_packets_and_broken_ones_are_passed_over():
    one = Frame(0x11, bytes(range(8)))
    status = b"\xaa\x01" + bytes(13) + b"\x55"
    torn = answer(one)[:9]
    # A torn packet swallows at most what looks like its own rest.
    frames_read = list(
        PacketReader().take(status + answer(one) + torn + answer(one) + answer(one))
    )
    assert frames_read.count(one) >= 2 and set(frames_read) == {one}


NEEDS_TERMINALS = pytest.mark.skipif(
    not hasattr(os, "openpty"), reason="needs pseudo-terminals"
)


@pytest.fixture
def line():
    """(link, our end of its serial line)."""
    import tty

    port, far = os.openpty()
    tty.setraw(far)
    address = BusAddress("damiao", (os.ttyname(far),), ("write_timeout=5",))
    link = open_bus(address, BusTiming(), SystemClock())
    yield link, port
    link.close()
    for end in (port, far):
        os.close(end)


@NEEDS_TERMINALS
def test_thirty_bytes_go_out_per_frame(line):
    """Typed from the maker's description."""
    link, port = line
    link.send(disable_frame(Address(0, 3)))
    assert os.read(port, 100) == bytes.fromhex(
        "55aa1e03 01000000 0a000000 00 03000000 00 08 00 00 ffffffffffffff fd 00"
    )


@NEEDS_TERMINALS
def test_sixteen_bytes_come_in_per_frame(line):
    link, port = line
    clock = SystemClock()
    sent = bytes.fromhex("aa1108 13000000 138b217d3866231f 55")
    os.write(port, b"\x00\x55" + sent + sent[:7])
    frame = link.receive(clock.now() + 1.0)
    assert (frame.id, frame.data.hex(), frame.echo) == (0x13, "138b217d3866231f", False)
    assert abs(frame.time - clock.now()) < 0.5
    assert link.receive(clock.now() + 0.01) is None
    os.write(port, sent[7:])
    assert link.receive(clock.now() + 1.0).data == frame.data


@NEEDS_TERMINALS
def test_a_silent_slcan_bus_keeps_no_other_one_waiting():
    """python-can waits a millisecond for the first byte: 100 frames would take 100 ms."""
    clock = SystemClock()
    ends = [slcan_terminal() for _ in range(2)]
    devices = tuple(device for _, device in ends)
    address = BusAddress("slcan", devices, ("sleep_after_open=0",))
    with contextlib.closing(open_bus(address, BusTiming(), clock)) as link:
        took = []
        for _ in range(3):
            ends[1][0].serialPortOrig.write((b"t0118" + b"AB" * 8 + b"\r") * 100)
            start = clock.now()
            frames = [link.receive(start + 1.0) for _ in range(100)]
            took.append(clock.now() - start)
            assert {(f.bus, f.id, f.data) for f in frames} == {(1, 0x11, b"\xab" * 8)}
    for bus, _ in ends:
        bus.shutdown()
    assert min(took) < 0.05


@NEEDS_TERMINALS
def test_can_fd_is_refused_because_it_would_be_classic_frames():
    with pytest.raises(InputError, match="leave --fd off"):
        open_bus(
            BusAddress("damiao", ("/dev/null",)), BusTiming(fd=True), SystemClock()
        )


@NEEDS_TERMINALS
def test_a_line_that_breaks_or_a_frame_that_is_none_is_our_error(line):
    link, _ = line
    for frame in (Frame(0x800, bytes(8)), Frame(1, bytes(9))):
        with pytest.raises(LinkError):
            link.send(frame)
    link.close()
    with pytest.raises(LinkError):
        link.send(Frame(1, bytes(8)))
