"""Asking motors, never while commands stream: who is there, registers, state.

Inspecting has no effect on the motors. Register replies and feedback come on the same id. They are
told apart by the one request that is outstanding: a reply repeats its motor's id, an operation and
the register's number.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.bus import GuardedLink, LinkError
from robot_sysid.damiao.protocol import frames
from robot_sysid.damiao.protocol.codec import Feedback, Scaling, decode_feedback
from robot_sysid.damiao.safety.realtime import undisturbed
from robot_sysid.errors import HardwareAbort

# A frame may be lost on a bus that another program has just left.
_TRIES = 3
# Answers that take longer are of no use to a control loop [s].
_LONGEST_CYCLE = 0.1


class RegisterReply(NamedTuple):
    """A register's value and the id it was answered on."""

    value: float
    reply_id: int


class RegisterClient:
    """Talks about registers over a link; an answer may take ``timeout`` [s]."""

    def __init__(self, link: GuardedLink, timeout: float = 0.02) -> None:
        self._link = link
        self._clock = link.clock
        self._timeout = timeout
        self.error_frames = 0

    def read(self, motor: frames.Address, register: int) -> RegisterReply | None:
        """Return a register's value, or None where the motor does not answer."""
        return next(iter(self.answers(frames.read_frame(motor, register), 1)), None)

    def write(
        self, motor: frames.Address, register: int, value: float, heard: bool = True
    ) -> None:
        """Write a register (lost at power-off), or raise HardwareAbort.

        A motor refuses a value by answering with the old one, so the answer is compared; unless it
        cannot be ``heard`` any more.
        """
        raw = frames.bytes_from_value(register, value)
        name = frames.NAMES[register]
        request = frames.write_frame(motor, register, raw)
        if not heard:
            return self._link.send(request)
        replies = self.answers(request, 1)
        if not replies:
            raise HardwareAbort(
                f"motor {motor.can_id} did not answer to writing {name}"
            )
        stored = replies[0].value
        if frames.bytes_from_value(register, stored) != raw:
            raise HardwareAbort(
                f"motor {motor.can_id} refused {name} = {value:g} and keeps {stored:g}"
            )

    def refresh(self, motor: frames.Address, master_id: int) -> frames.Frame | None:
        """Return a feedback frame without any effect on the motor, or None."""
        for _ in range(_TRIES):
            for frame in self._frames_after(frames.refresh_frame(motor)):
                if frame.id == master_id and frame.data[0] & 0xF == motor.can_id & 0xF:
                    return frame
        return None

    def state_of(self, motor: InspectedMotor) -> Feedback | None:
        """Ask a motor for its state, without any effect on it; None where it does not tell."""
        frame = self.refresh(motor.address, motor.reply_ids[0])
        return None if frame is None else motor.meaning(frame.data)

    def seconds_to_refresh(
        self, motors: Sequence[tuple[frames.Address, int]]
    ) -> float | None:
        """Return the time until all motors, asked at once, have answered [s], or None."""
        self._link.drain()
        start = self._clock.now()
        for motor, _ in motors:
            self._send(frames.refresh_frame(motor))
        missing = {(motor.bus, reply_id) for motor, reply_id in motors}
        while (
            missing
            and (frame := self._link.receive(start + _LONGEST_CYCLE)) is not None
        ):
            if not frame.echo and not frame.error:
                missing.discard((frame.bus, frame.id))
        return None if missing else self._clock.now() - start

    def answers(
        self, request: frames.Frame, limit: int | None = None
    ) -> list[RegisterReply]:
        """Return up to ``limit`` answers; more than one tells that motors share an id."""
        tries = (list(islice(self._replies(request), limit)) for _ in range(_TRIES))
        return next(filter(None, tries), [])

    def _replies(self, request: frames.Frame) -> Iterator[RegisterReply]:
        # Most firmware answers a write with 0x55, some with 0x33.
        codes = (
            (frames.READ, frames.WRITE)
            if request.data[2] == frames.WRITE
            else (frames.READ,)
        )
        heads = [request.data[:2] + bytes([code, request.data[3]]) for code in codes]
        for frame in self._frames_after(request):
            if frame.data[:4] in heads:
                value = frames.value_from_bytes(request.data[3], frame.data[4:8])
                yield RegisterReply(value, frame.id)

    def _frames_after(self, request: frames.Frame) -> Iterator[frames.Frame]:
        """Send a request and yield what motors say until the timeout."""
        self._link.drain()
        self._send(request)
        until = self._clock.now() + self._timeout
        while (frame := self._link.receive(until)) is not None:
            self.error_frames += frame.error
            sound = not frame.error and not frame.echo and len(frame.data) == 8
            if sound and frame.bus == request.bus:
                yield frame

    def _send(self, request: frames.Frame) -> None:
        """Send a request, again where a busy computer or adapter did not take it in time."""
        for _ in range(_TRIES - 1):
            with contextlib.suppress(LinkError):
                return self._link.send(request)
        self._link.send(request)


@contextlib.contextmanager
def watchdogs_set_to(
    client: RegisterClient,
    motors: Sequence[InspectedMotor],
    seconds: float,
    is_off: Callable[[frames.Address], bool],
) -> Iterator[None]:
    """Write the watchdog register of each motor, and its old value when the block ends.

    A motor that may still be running keeps the new value: without a watchdog it would go on for
    ever. Nothing is stored to flash: after a power cycle the motors have their own values again.
    ``is_off`` tells, at the end, whether a motor is surely disabled.
    """
    old_values = {motor.address: motor.registers[frames.TIMEOUT] for motor in motors}
    try:
        for address in old_values:
            client.write(
                address, frames.TIMEOUT, float(round(seconds / frames.TIMEOUT_UNIT))
            )
        yield
    finally:
        for address in filter(is_off, old_values):
            # A motor that does not answer any more keeps the safer value until power-off.
            with contextlib.suppress(BaseException):
                client.write(address, frames.TIMEOUT, old_values[address])


_ALL_IDS = range(1, 16)
# A program that streams at 40 Hz or more is heard in this time; a slow adapter answers in half of
# the other (16 ms, see docs/damiao.md) [s].
_LISTEN = 0.05
_ASK_TIMEOUT = 0.03
# How often all motors are asked at once, to know how long nine of ten times take.
_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class InspectedMotor:
    """What one motor said; several ids on which answers came mean several motors.

    Only registers that were answered are there; feedback is None where it does not answer a
    refresh, and the channel is named where there are several.
    """

    address: frames.Address
    reply_ids: tuple[int, ...]
    registers: Mapping[int, float]
    feedback: Feedback | None
    channel: str = ""

    @property
    def can_id(self) -> int:
        """Id it was asked under."""
        return self.address.can_id

    @property
    def name(self) -> str:
        """How messages call it."""
        return f"motor {self.can_id}" + (f" on {self.channel}" if self.channel else "")

    @property
    def master_id(self) -> int:
        """The reply id its register names."""
        return int(self.registers.get(frames.MST_ID, self.reply_ids[0]))

    @property
    def limits(self) -> tuple[float, float, float]:
        """(PMAX, VMAX, TMAX) from its registers; 0 where it does not tell."""
        position, velocity, torque = (
            self.registers.get(k, 0.0) for k in frames.SCALING
        )
        return position, velocity, torque

    def meaning(self, feedback: bytes) -> Feedback | None:
        """What a frame of its feedback says; None where its scaling is not known."""
        if min(self.limits) <= 0.0:
            return None
        raw = np.frombuffer(feedback, dtype=np.uint8)[None]
        return decode_feedback(raw, Scaling([self.limits]))

    @property
    def position(self) -> float:
        """Where it is [rad]; NaN where it does not tell."""
        return float(self.feedback.position[0]) if self.feedback else np.nan


@dataclass(frozen=True)
class Inspection:
    """What the motors on a bus said; ``unsolicited`` frames came before anything was asked.

    Asked at once, all have answered within ``round_trip`` [s], nearly always; None if some did not.
    """

    motors: Mapping[frames.Address, InspectedMotor]
    unsolicited: int
    error_frames: int
    round_trip: float | None = None


def inspect_bus(link: GuardedLink) -> Inspection:
    """Ask every id on every bus for its registers and state; enables nothing."""
    until = link.clock.now() + _LISTEN
    unsolicited = 0
    while (frame := link.receive(until)) is not None:
        unsolicited += not frame.echo
    client = RegisterClient(link, timeout=_ASK_TIMEOUT)
    motors = {}
    for address in (
        frames.Address(bus, i) for bus in range(len(link.channels)) for i in _ALL_IDS
    ):
        answers = client.answers(frames.read_frame(address, frames.ESC_ID))
        if not answers:
            continue
        replies = {number: client.read(address, number) for number in frames.LOGGED}
        registers = {
            number: reply.value
            for number, reply in replies.items()
            if reply is not None
        }
        reply_ids = tuple(answer.reply_id for answer in answers)
        channel = link.channels[address.bus] if len(link.channels) > 1 else ""
        motor = InspectedMotor(address, reply_ids, registers, None, channel)
        motors[address] = replace(motor, feedback=client.state_of(motor))
    round_trip = None
    if all(motor.feedback for motor in motors.values()):
        addresses = [(motor.address, motor.reply_ids[0]) for motor in motors.values()]
        # As in the run that it is for.
        with undisturbed(link.clock.live):
            times = [client.seconds_to_refresh(addresses) for _ in range(_ROUNDS)]
        answered = [time for time in times if time is not None]
        if len(answered) > _ROUNDS // 2:
            round_trip = float(np.percentile(answered, 90.0))
    return Inspection(motors, unsolicited, client.error_frames, round_trip)
