"""Reading and writing motor registers, one request at a time and never while commands stream.

Register replies and feedback come on the same id. They are told apart by the request that is
outstanding: a reply repeats its motor's id, an operation and the register's number.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.protocol.frames import (
    READ,
    WRITE,
    Frame,
    read_frame,
    refresh_frame,
    write_frame,
)
from robot_sysid.damiao.protocol.registers import (
    REGISTERS,
    TIMEOUT,
    TIMEOUT_UNIT,
    bytes_from_value,
    value_from_bytes,
)
from robot_sysid.errors import HardwareAbort

# How often a question is asked.
_TRIES = 3


class RegisterReply(NamedTuple):
    """A register's value and the id it was answered on."""

    value: float
    reply_id: int


class RegisterClient:
    """Talks about registers over a link; an answer may take ``timeout`` [s]."""

    def __init__(self, link: GuardedLink, clock: Clock, timeout: float = 0.02) -> None:
        self._link, self._clock, self._timeout = link, clock, timeout
        self.error_frames = 0

    def read(self, can_id: int, register: int) -> RegisterReply | None:
        """Return a register's value, or None where the motor does not answer."""
        for _ in range(_TRIES):
            reply = next(self._replies(read_frame(can_id, register)), None)
            if reply is not None:
                return reply
        return None

    def read_all(self, can_id: int, register: int) -> list[RegisterReply]:
        """Return every answer to one request: more than one means that motors share an id."""
        return list(self._replies(read_frame(can_id, register)))

    def write(self, can_id: int, register: int, value: float) -> None:
        """Write a register (lost at power-off), or raise HardwareAbort.

        A motor refuses a value by answering with the old one, so the answer is compared.
        """
        raw = bytes_from_value(register, value)
        name = REGISTERS[register].name
        for _ in range(_TRIES):
            reply = next(self._replies(write_frame(can_id, register, raw)), None)
            if reply is not None and bytes_from_value(register, reply.value) == raw:
                return
            if reply is not None:
                raise HardwareAbort(
                    f"motor {can_id} refused {name} = {value:g} and keeps {reply.value:g}"
                )
        raise HardwareAbort(f"motor {can_id} did not answer to writing {name}")

    def refresh(self, can_id: int, master_id: int) -> Frame | None:
        """Return a feedback frame without any effect on the motor, or None."""
        for _ in range(_TRIES):
            for frame in self._frames_after(refresh_frame(can_id)):
                if frame.id == master_id and frame.data[0] & 0xF == can_id & 0xF:
                    return frame
        return None

    def _replies(self, request: Frame) -> Iterator[RegisterReply]:
        for frame in self._frames_after(request):
            if _answers(frame, request):
                value = value_from_bytes(request.data[3], frame.data[4:8])
                yield RegisterReply(value, frame.id)

    def _frames_after(self, request: Frame) -> Iterator[Frame]:
        """Send a request and yield what motors say until the timeout."""
        self._link.drain()
        self._link.send(request)
        until = self._clock.now() + self._timeout
        while (frame := self._link.receive(until)) is not None:
            self.error_frames += frame.error
            if not frame.error and not frame.echo and len(frame.data) == 8:
                yield frame


def _answers(frame: Frame, request: Frame) -> bool:
    # Most firmware answers a write with 0x55, some with 0x33.
    operations = (READ, WRITE) if request.data[2] == WRITE else (READ,)
    return (
        frame.data[:2] == request.data[:2]
        and frame.data[2] in operations
        and frame.data[3] == request.data[3]
    )


@contextlib.contextmanager
def watchdogs_set_to(
    client: RegisterClient, before: Mapping[int, float], seconds: float
) -> Iterator[None]:
    """Write the watchdog register of each motor, and its old value when the block ends.

    Nothing is stored to flash: after a power cycle the motors have their own values again.

    Args:
        client: talks to the motors.
        before: CAN id to the value of the register now.
        seconds: watchdog time [s].
    """
    try:
        for can_id in before:
            client.write(can_id, TIMEOUT, float(round(seconds / TIMEOUT_UNIT)))
        yield
    finally:
        for can_id, value in before.items():
            # A motor that does not answer any more keeps the safer value until power-off.
            with contextlib.suppress(HardwareAbort):
                client.write(can_id, TIMEOUT, value)
