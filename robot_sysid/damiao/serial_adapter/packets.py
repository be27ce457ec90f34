"""The packets of the maker's serial USB-CAN adapter (921600 baud).

To the adapter, 30 bytes per CAN frame:

======  =========================================================
0, 1    55 AA
2       1E, the length
3       03, send
4-7     how often, little endian: 1
8-11    pause between repetitions, little endian: 10
12      id type, 0 for 11 bits
13-16   CAN id, little endian
17      frame type, 0 for data
18      number of data bytes, 8
19, 20  no filters: 0
21-28   data
29      check byte, not looked at: 0
======  =========================================================

From the adapter, 16 bytes: AA, kind (11 for a received frame), format, CAN id in four bytes little
endian, eight bytes of data, 55.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

SENT, RECEIVED = 30, 16
_HEAD = bytes([0x55, 0xAA, SENT, 0x03, 1, 0, 0, 0, 10, 0, 0, 0, 0])
_BEGIN, _END, _A_FRAME = 0xAA, 0x55, 0x11
_DATA = 8


class Received(NamedTuple):
    """A CAN frame from the adapter."""

    id: int
    data: bytes


def packet(identifier: int, data: bytes) -> bytes:
    """Return the 30 bytes that send a frame of up to eight bytes, or raise ValueError."""
    if len(data) > _DATA or not 0 <= identifier <= 0x7FF:
        raise ValueError("the adapter sends classic frames with 11-bit ids and up to 8 bytes")
    body = identifier.to_bytes(4, "little") + bytes([0, len(data), 0, 0])
    return _HEAD + body + data.ljust(_DATA, b"\0") + b"\0"


class PacketReader:
    """Finds packets in what comes over the line, also after garbage or a packet's loss."""

    def __init__(self) -> None:
        self._rest = b""

    def take(self, piece: bytes) -> Iterator[Received]:
        """Yield the frames that are complete now."""
        self._rest += piece
        while len(self._rest) >= RECEIVED:
            begin = self._rest.find(_BEGIN)
            if begin < 0:
                self._rest = b""
                return
            whole = self._rest[begin : begin + RECEIVED]
            if len(whole) < RECEIVED:
                self._rest = whole
                return
            sound = whole[-1] == _END
            self._rest = self._rest[begin + (RECEIVED if sound else 1) :]
            if sound and whole[1] == _A_FRAME:
                yield Received(int.from_bytes(whole[3:7], "little"), whole[7:15])
