"""A pseudo-terminal that acts as a serial CAN adapter, for a simulated arm to sit behind.

Whoever opens its device (python-can's slcan interface, for instance) talks to this process; nothing
leaves the computer. Needs a Unix system.

The slcan protocol is lines of text that end with a carriage return: ``tIIILDD..`` is a classic
frame (id, length, data), ``d`` a CAN-FD frame, ``b`` one with bit-rate switch; O, L, C, S, Y, s set
the adapter up.
"""

from __future__ import annotations

import os
import select

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.link import LinkError
from robot_sysid.damiao.protocol.frames import Frame
from robot_sysid.errors import InputError


class SlcanTerminal:
    """The adapter's end of the line, as a link.

    Attributes:
        device: path of the terminal to give to ``--channel``.
    """

    def __init__(self, clock: Clock) -> None:
        try:
            import tty
        except ImportError:
            raise InputError("pseudo-terminals need a Unix system") from None
        self._clock = clock
        # The far end stays open here too, so that a client may come and go.
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)
        self.device = os.ttyname(self._far)
        self._text = b""
        self._frames: list[Frame] = []

    def receive(self, until: float) -> Frame | None:
        """Return the next frame, or None at ``until`` [s]."""
        while not self._frames:
            left = max(until - self._clock.now(), 0.0)
            readable, _, _ = select.select([self._near], [], [], left)
            if not readable:
                return None
            self._take(os.read(self._near, 4096))
        return self._frames.pop(0)

    def send(self, frame: Frame) -> None:
        """Write a frame; one that nobody reads is dropped, as on a bus."""
        self._write(line_from_frame(frame).encode() + END)

    def close(self) -> None:
        """Close the terminal."""
        os.close(self._near)
        os.close(self._far)

    def _take(self, data: bytes) -> None:
        *lines, self._text = (self._text + data).split(END)
        for line in lines:
            frame = frame_from_line(line.decode("ascii", errors="replace"))
            if frame is None:
                self._write(END)
            else:
                self._frames.append(frame._replace(time=self._clock.now()))

    def _write(self, data: bytes) -> None:
        try:
            os.write(self._near, data)
        except BlockingIOError:
            return  # a full buffer: nobody has the terminal open
        except OSError as error:
            raise LinkError(f"the pseudo-terminal is closed: {error.strerror}") from error


END = b"\r"


def frame_from_line(line: str) -> Frame | None:
    """Return the frame that a line stands for, or None where it is a set-up command or broken."""
    kind = line[:1]
    if kind not in ("t", "d", "b"):
        return None
    try:
        length = int(line[4], 16)
        data = bytes.fromhex(line[5 : 5 + 2 * length])
        identifier = int(line[1:4], 16)
    except (ValueError, IndexError):
        return None
    if length > 8 or len(data) != length:
        return None
    return Frame(identifier, data, fd=kind != "t")


def line_from_frame(frame: Frame) -> str:
    """Return the line for a frame of up to eight bytes."""
    kind = "b" if frame.fd else "t"
    return f"{kind}{frame.id:03X}{len(frame.data):X}{frame.data.hex().upper()}"
