"""The adapter's packets, byte by byte."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.serial_adapter.packets import PacketReader, Received, packet

FRAMES = st.lists(st.builds(Received, st.integers(0, 0x7FF), st.binary(min_size=8, max_size=8)))


def answer(frame):
    """What the adapter says about a frame that it received."""
    return b"\xaa\x11\x08" + frame.id.to_bytes(4, "little") + frame.data + b"\x55"


def test_a_packet_is_as_the_maker_writes_it():
    """Typed from the maker's description: enabling motor 0x123."""
    assert packet(0x123, bytes.fromhex("ffffffffffffff fc")) == bytes.fromhex(
        "55aa1e03 01000000 0a000000 00 23010000 00 08 00 00 ffffffffffffff fc 00"
    )


@given(FRAMES, st.integers(1, 40))
def test_frames_come_through_in_whatever_pieces(frames, size):
    line, reader, found = b"".join(map(answer, frames)), PacketReader(), []
    for start in range(0, len(line), size):
        found += reader.take(line[start : start + size])
    assert found == frames


@given(st.binary(max_size=40).filter(lambda b: b"\xaa" not in b), FRAMES)
def test_garbage_before_frames_is_passed_over(garbage, frames):
    assert list(PacketReader().take(garbage + b"".join(map(answer, frames)))) == frames


def test_other_packets_and_broken_ones_are_passed_over():
    one = Received(0x11, bytes(range(8)))
    status = b"\xaa\x01" + bytes(13) + b"\x55"
    torn = answer(one)[:9]
    # A torn packet swallows at most what looks like its own rest.
    found = list(PacketReader().take(status + answer(one) + torn + answer(one) + answer(one)))
    assert found.count(one) >= 2 and set(found) == {one}


@pytest.mark.parametrize(("identifier", "size"), [(0x800, 8), (-1, 8), (1, 9)])
def test_what_the_adapter_cannot_send_is_refused(identifier, size):
    with pytest.raises(ValueError, match="11-bit ids"):
        packet(identifier, bytes(size))
