"""The maker's serial USB-CAN adapter (921600 baud) as a python-can bus, and a pretended adapter.

python-can finds the class (``interface="damiao"``) by its entry point; it is made on first use,
because python-can is an extra.

To the adapter, 30 bytes per CAN frame, numbers little endian: 55 AA, the length 1E, 03 for "send",
how often (4 bytes: 1), the pause between in four bytes (10), id type (0 for 11 bits), CAN id in
four bytes, frame type (0 for data), number of data bytes, two filters (0), eight bytes of data, and
a check byte that is not looked at (0).

From the adapter, 16 bytes: AA, kind (11 for a received frame), format, CAN id in four bytes little
endian, eight bytes of data, 55.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import select
import time
from collections import deque
from collections.abc import Callable
from functools import cache
from typing import Any

from robot_sysid.damiao.protocol.frames import Frame
from robot_sysid.errors import InputError

_HEAD = bytes([0x55, 0xAA, 30, 0x03, 1, 0, 0, 0, 10, 0, 0, 0, 0])
_RECEIVED = 16
_A_FRAME = b"\x11"
_PACKET = re.compile(rb"\xaa(.).(.{4})(.{8})\x55", re.DOTALL)
_DATA = 8


def packet(identifier: int, data: bytes) -> bytes:
    """Return the 30 bytes that send a frame of up to eight bytes, or raise ValueError."""
    if len(data) > _DATA or not 0 <= identifier <= 0x7FF:
        raise ValueError(
            "the adapter sends classic frames with 11-bit ids and up to 8 bytes"
        )
    body = identifier.to_bytes(4, "little") + bytes([0, len(data), 0, 0])
    return _HEAD + body + data.ljust(_DATA, b"\0") + b"\0"


class PacketReader:
    """Finds packets in what comes over the line, also after garbage or a packet's loss."""

    def __init__(self) -> None:
        self._incomplete = b""

    def take(self, piece: bytes) -> list[Frame]:
        """Return the frames that are complete now."""
        line = self._incomplete + piece
        frames = []
        end = max(len(line) - _RECEIVED + 1, 0)
        for match in _PACKET.finditer(line):
            end = max(end, match.end())
            if match[1] == _A_FRAME:
                frames.append(Frame(int.from_bytes(match[2], "little"), match[3]))
        self._incomplete = line[end:]
        return frames


BAUD = 921_600
# Longest wait for the line to take a packet: longer, and the motors' watchdogs are near [s].
_WRITE_TIMEOUT = 0.02
# How long a serial port waits for a byte before it is asked whether to go on [s].
_PATIENCE = 1e-3


def __getattr__(name: str) -> Any:
    if name == "DamiaoSerialBus":
        return _bus_class()
    raise AttributeError(name)


@cache
def _bus_class() -> Any:
    import can
    import serial

    class DamiaoSerialBus(can.BusABC):
        """Classic CAN over the adapter's serial line; the bit rate is set in the adapter."""

        def __init__(
            self,
            channel: str,
            baudrate: int = BAUD,
            write_timeout: float = _WRITE_TIMEOUT,
            **bus_options: Any,
        ) -> None:
            self._port = serial.Serial(
                channel, baudrate, timeout=0, write_timeout=write_timeout
            )
            self._reader = PacketReader()
            self._waiting = deque[Any]()
            self.channel_info = f"Damiao serial adapter at {channel}"
            super().__init__(channel=channel, **bus_options)

        def send(self, msg: Any, timeout: float | None = None) -> None:
            """Send a frame; the adapter does not say when it was on the bus."""
            self._port.write(packet(msg.arbitration_id, bytes(msg.data)))

        def _recv_internal(self, timeout: float | None) -> tuple[Any, bool]:
            until = None if timeout is None else time.monotonic() + timeout
            while not self._waiting:
                self._port.timeout = until and max(until - time.monotonic(), 0.0)
                # The rest of what has come already, or the first byte of what comes next.
                piece = self._port.read(max(self._port.in_waiting, 1))
                self._waiting.extend(self._reader.take(piece))
                if (
                    not self._waiting
                    and until is not None
                    and time.monotonic() >= until
                ):
                    return None, False
            frame = self._waiting.popleft()
            message = can.Message(
                timestamp=time.time(),
                arbitration_id=frame.id,
                is_extended_id=False,
                data=frame.data,
            )
            return message, False

        def shutdown(self) -> None:
            """Close the serial line."""
            super().shutdown()
            self._port.close()

    return DamiaoSerialBus


class _LineReader:
    """Reads an slcan adapter's lines for python-can, whose own loop asks for each byte.

    It waits no longer than it is asked to: python-can's waits a millisecond for the first byte also
    where only what has come is wanted, a quarter of a control cycle. ``fetch`` returns all bytes
    that have come, and waits for the first one as long as it is told [s].
    """

    def __init__(self, fetch: Callable[[float], bytes]) -> None:
        self._fetch = fetch
        self._come = b""

    def __call__(self, timeout: float | None) -> str | None:
        """Return the next line with its end, or None after ``timeout`` [s]."""
        until = math.inf if timeout is None else time.monotonic() + timeout
        while (end := _LINE_END.search(self._come)) is None:
            left = min(max(until - time.monotonic(), 0.0), _LONGEST_LOOK)
            piece = self._fetch(left)
            self._come += piece
            if not piece and left == 0.0:
                return None
        line = self._come[: end.end()]
        self._come = self._come[end.end() :]
        # python-can gives up at a byte that is no text.
        return line.decode("ascii", "ignore")


# A wait without end is made of looks as long as this [s].
_LONGEST_LOOK = 1.0
# slcan ends a line with a carriage return, or with a bell where it refuses a command.
_LINE_END = re.compile(rb"[\r\a]")


def read_in_pieces(bus: Any, alone: bool, write_timeout: float) -> None:
    """Let python-can's slcan read what has come at once; wait for it only on a bus that is alone.

    Where there are several, a wait for one that is silent keeps the others waiting.
    """
    port = bus.serialPortOrig
    port.timeout = _PATIENCE if alone else 0.0
    port.write_timeout = write_timeout
    # Setting a port's time-out configures it anew, so it stays what it is.
    bus._read = _LineReader(lambda left: port.read(port.in_waiting or int(left > 0.0)))


class _NearEnd:
    """Our end of a pseudo-terminal."""

    write_timeout: float | None = None

    def __init__(self) -> None:
        import tty

        # The far end stays open here too, so that a client may come and go.
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        self.device = os.ttyname(self._far)

    def fetch(self, patience: float) -> bytes:
        """Return the bytes that have come, after waiting for the first one [s]."""
        ready = select.select([self._near], [], [], patience)[0]
        return os.read(self._near, 4096) if ready else b""

    def write(self, data: bytes) -> None:
        """Write; what nobody reads is dropped, as on a bus."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._near, data)

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        """Close the terminal."""
        os.close(self._near)
        os.close(self._far)


def slcan_terminal() -> tuple[Any, str]:
    """Return a python-can bus behind a pseudo-terminal, and the device at which to open it.

    Whoever opens the device with python-can's slcan interface talks to this process; nothing leaves
    the computer. InputError where there are no pseudo-terminals.
    """
    if not hasattr(os, "openpty"):
        raise InputError("pseudo-terminals need a Unix system")
    from can.interfaces.slcan import slcanBus

    class Terminal(slcanBus):
        """Frames are the same text both ways; what sets an adapter up is passed over."""

        def _recv_internal(self, timeout: float | None) -> tuple[Any, bool]:
            # What a client that was killed left of its last line is no frame either.
            with contextlib.suppress(ValueError, IndexError):
                return super()._recv_internal(timeout)
            return None, False

    bus: Any = Terminal("loop://", sleep_after_open=0)
    line = _NearEnd()
    bus.serialPortOrig = line
    bus._read = _LineReader(line.fetch)
    return bus, line.device
