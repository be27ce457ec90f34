"""Reading and writing motor registers, one request at a time and never while commands stream.

Register replies and feedback come on the same id. They are told apart by the request that is
outstanding: a reply repeats its motor's id, an operation and the register's number.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.protocol import registers as reg
from robot_sysid.damiao.protocol.frames import (
    READ,
    WRITE,
    Address,
    Frame,
    read_frame,
    refresh_frame,
    write_frame,
)
from robot_sysid.errors import HardwareAbort

# How often a question is asked.
_TRIES = 3
# Answers that take longer are of no use to a control loop [s].
_LONGEST_CYCLE = 0.1


class RegisterReply(NamedTuple):
    """A register's value and the id it was answered on."""

    value: float
    reply_id: int


class RegisterClient:
    """Talks about registers over a link; an answer may take ``timeout`` [s]."""

    def __init__(self, link: GuardedLink, clock: Clock, timeout: float = 0.02) -> None:
        self._link, self._clock, self._timeout = link, clock, timeout
        self.error_frames = 0

    def read(self, motor: Address, register: int) -> RegisterReply | None:
        """Return a register's value, or None where the motor does not answer."""
        for _ in range(_TRIES):
            reply = next(self._replies(read_frame(motor, register)), None)
            if reply is not None:
                return reply
        return None

    def read_all(self, motor: Address, register: int) -> list[RegisterReply]:
        """Return every answer to one request: more than one means that motors share an id."""
        for _ in range(_TRIES):
            replies = list(self._replies(read_frame(motor, register)))
            if replies:
                return replies
        return []

    def write(self, motor: Address, register: int, value: float) -> None:
        """Write a register (lost at power-off), or raise HardwareAbort.

        A motor refuses a value by answering with the old one, so the answer is compared.
        """
        raw = reg.bytes_from_value(register, value)
        name = reg.REGISTERS[register].name
        for _ in range(_TRIES):
            reply = next(self._replies(write_frame(motor, register, raw)), None)
            if reply is not None and reg.bytes_from_value(register, reply.value) == raw:
                return
            if reply is not None:
                raise HardwareAbort(
                    f"motor {motor.can_id} refused {name} = {value:g} and keeps {reply.value:g}"
                )
        raise HardwareAbort(f"motor {motor.can_id} did not answer to writing {name}")

    def tell(self, motor: Address, register: int, value: float) -> None:
        """Write a register after which the motor cannot be heard any more."""
        self._link.send(write_frame(motor, register, reg.bytes_from_value(register, value)))

    def refresh(self, motor: Address, master_id: int) -> Frame | None:
        """Return a feedback frame without any effect on the motor, or None."""
        for _ in range(_TRIES):
            for frame in self._frames_after(refresh_frame(motor)):
                if frame.id == master_id and frame.data[0] & 0xF == motor.can_id & 0xF:
                    return frame
        return None

    def seconds_to_refresh(self, motors: Sequence[tuple[Address, int]]) -> float | None:
        """Ask motors one right after the other for their state, as a control cycle does.

        Args:
            motors: where they are, with the ids they answer on.

        Returns:
            Time until the last answer [s]; None where one did not come.
        """
        self._link.drain()
        start = self._clock.now()
        for motor, _ in motors:
            self._link.send(refresh_frame(motor))
        missing = {(motor.bus, reply_id) for motor, reply_id in motors}
        while missing and (frame := self._link.receive(start + _LONGEST_CYCLE)) is not None:
            if not frame.echo and not frame.error:
                missing.discard((frame.bus, frame.id))
        return None if missing else self._clock.now() - start

    def _replies(self, request: Frame) -> Iterator[RegisterReply]:
        for frame in self._frames_after(request):
            if _answers(frame, request):
                value = reg.value_from_bytes(request.data[3], frame.data[4:8])
                yield RegisterReply(value, frame.id)

    def _frames_after(self, request: Frame) -> Iterator[Frame]:
        """Send a request and yield what motors say until the timeout."""
        self._link.drain()
        self._link.send(request)
        until = self._clock.now() + self._timeout
        while (frame := self._link.receive(until)) is not None:
            self.error_frames += frame.error
            sound = not frame.error and not frame.echo and len(frame.data) == 8
            if sound and frame.bus == request.bus:
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
    client: RegisterClient,
    before: Mapping[Address, float],
    seconds: float,
    is_off: Callable[[Address], bool],
) -> Iterator[None]:
    """Write the watchdog register of each motor, and its old value when the block ends.

    A motor that may still be running keeps the new value: without a watchdog it would go on for
    ever. Nothing is stored to flash: after a power cycle the motors have their own values again.

    Args:
        client: talks to the motors.
        before: value of the register now, by motor.
        seconds: watchdog time [s].
        is_off: tells, at the end, whether a motor is surely disabled.
    """
    try:
        for address in before:
            client.write(address, reg.TIMEOUT, float(round(seconds / reg.TIMEOUT_UNIT)))
        yield
    finally:
        for address in filter(is_off, before):
            # A motor that does not answer any more keeps the safer value until power-off.
            with contextlib.suppress(HardwareAbort):
                client.write(address, reg.TIMEOUT, before[address])
