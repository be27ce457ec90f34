"""The slcan text protocol of serial CAN adapters: frames as lines.

``tIIILDD..`` is a classic frame (id, length, data), ``d`` a CAN-FD frame, ``b`` one with bit-rate
switch; O, L, C, S, Y, s set the adapter up. Lines end with a carriage return.
"""

from __future__ import annotations

from robot_sysid.damiao.frames import Frame

END = b"\r"
_CLASSIC, _FD = ("t",), ("d", "b")


def frame_from_line(line: str) -> Frame | None:
    """Return the frame that a line stands for, or None where it is a set-up command or broken."""
    kind = line[:1]
    if kind not in _CLASSIC + _FD:
        return None
    try:
        length = int(line[4], 16)
        data = bytes.fromhex(line[5 : 5 + 2 * length])
        identifier = int(line[1:4], 16)
    except (ValueError, IndexError):
        return None
    if length > 8 or len(data) != length:
        return None
    return Frame(identifier, data, fd=kind in _FD)


def line_from_frame(frame: Frame) -> str:
    """Return the line for a frame of up to eight bytes."""
    kind = "b" if frame.fd else "t"
    return f"{kind}{frame.id:03X}{len(frame.data):X}{frame.data.hex().upper()}"
