"""A link on which one feedback frame is damaged, as text on a serial line, or others talk.

An adapter that speaks slcan sends a frame as a line of text: ``t``, the id in three hexadecimal
digits, the number of bytes in one, the bytes in two each. No check sum protects it.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np

from rigs.links import RememberingLink
from robot_sysid.damiao import protocol

_SPANS = {
    "arbitration id": (1, 4),
    "status": (5, 6),
    "id nibble": (6, 7),
    "position": (7, 11),
    "velocity": (11, 14),
    "torque": (14, 17),
}
"""Which characters of a feedback frame's line carry a field."""


def slcan_line(frame):
    """Return the line of text of a classic frame, without its end."""
    return f"t{frame.id:03X}{len(frame.data):X}{frame.data.hex().upper()}"


def frame_of_line(line, frame):
    """Return a frame with the id and the data of a line; ValueError where it is none."""
    length = int(line[4], 16)
    text = line[5 : 5 + 2 * length]
    if line[0] != "t" or len(text) != 2 * length:
        raise ValueError("not a frame")
    return frame._replace(id=int(line[1:4], 16), data=bytes.fromhex(text))


def _with_code(line, name, code):
    begin, end = _SPANS[name]
    return f"{line[:begin]}{code:0{end - begin}X}{line[end:]}"


def _code(line, name):
    begin, end = _SPANS[name]
    return int(line[begin:end], 16)


@dataclass(frozen=True)
class Damage:
    """What happens to a line that carries a joint's feedback.

    ``field`` is one of the frame's, or "text"; ``size`` is an angle [rad] for the position, a bit
    for velocity and torque, the number of a flipped bit of the whole line for "text", and else the
    code that stands there instead.
    """

    field: str
    size: float
    joint: int

    def __str__(self):
        unit = {"position": " rad", "velocity": " (bit)", "torque": " (bit)"}.get(
            self.field, ""
        )
        size = "" if self.field == "text" else f" {self.size:g}{unit}"
        return f"{self.field}{size}"

    def apply(self, line, position_limit):
        """Return the damaged line of a motor whose PMAX is ``position_limit`` [rad]."""
        if self.field == "text":
            return _with_flipped_bit(line, int(self.size))
        if self.field == "position":
            return _with_moved_position(line, self.size, position_limit)
        if self.field in ("velocity", "torque"):
            code = _code(line, self.field) ^ (1 << int(self.size))
            return _with_code(line, self.field, code)
        return _with_code(line, self.field, int(self.size))


def _with_flipped_bit(line, bit):
    index = bit // 8 % len(line)
    character = chr(ord(line[index]) ^ (1 << bit % 7))
    return line[:index] + character + line[index + 1 :]


def _with_moved_position(line, angle, position_limit):
    step = 2.0 * position_limit / 0xFFFF
    code = _code(line, "position")
    moved = code + round(angle / step)
    if not 0 <= moved <= 0xFFFF:
        moved = code - round(angle / step)
    return _with_code(line, "position", moved)


class FaultyLink(RememberingLink):
    """Passes frames on; damages an answer when asked to, and lets another master talk.

    Attributes:
        damage: what happens to the next answer of its joint; None once it has happened.
    """

    def __init__(self, link, clock, joints):
        super().__init__(link, clock)
        self._joints = joints
        self._foreign = []
        self._foreign_is_seen = True
        self.damage = None

    @property
    def disabled_at(self):
        """When the first disable frame was sent [s]; None before."""
        disable = protocol.special_frame(protocol.DISABLE, 0).data
        return next((frame.time for frame in self.sent if frame.data == disable), None)

    def send_foreign(self, frame, is_seen):
        """Let another master send a frame, which this computer's adapter sees or does not."""
        self._foreign.append((frame.id, frame.data))
        self._foreign_is_seen = is_seen
        self._link.send(frame)

    def receive(self, until):
        while True:
            frame = super().receive(until)
            if frame is None:
                return None
            if frame.echo and (frame.id, frame.data) in self._foreign:
                self._foreign.remove((frame.id, frame.data))
                if not self._foreign_is_seen:
                    continue
                return frame._replace(echo=False)
            if not self._is_to_be_damaged(frame):
                return frame
            # As ``BusLink`` does, pass over a line that is no frame.
            with contextlib.suppress(ValueError):
                return self._damaged(frame)

    def _is_to_be_damaged(self, frame):
        if self.damage is None or frame.echo or len(frame.data) != 8:
            return False
        joint = self._joints[self.damage.joint]
        # Answers to questions about registers repeat the id in their first two bytes.
        is_feedback = frame.data[0] & 0xF == joint.can_id & 0xF and frame.data[0] >> 4
        return frame.id == joint.master_id and bool(is_feedback)

    def _damaged(self, frame):
        damage = self.damage
        self.damage = None
        limit = self._joints[damage.joint].spec.limits[0]
        return frame_of_line(damage.apply(slcan_line(frame), limit), frame)

    def command_paths(self):
        """Return the times (N,) of a joint's commands and their positions (N,), for each joint."""
        paths = []
        for joint in self._joints:
            frames = [frame for frame in self.sent if frame.id == joint.can_id]
            rows = []
            for frame in frames:
                if not protocol.is_special(frame.data):
                    share = int.from_bytes(frame.data[:2], "big") / 0xFFFF
                    rows.append(
                        (frame.time, (2.0 * share - 1.0) * joint.spec.limits[0])
                    )
            paths.append(np.array(rows).reshape(-1, 2).T)
        return paths
