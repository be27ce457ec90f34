"""Inspecting the motors on a bus without any effect on them: who is there, registers, state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.bus.register_client import RegisterClient
from robot_sysid.damiao.protocol import registers as reg
from robot_sysid.damiao.protocol.codec import Feedback, Scaling, decode_feedback
from robot_sysid.damiao.protocol.frames import Address

_ALL_IDS = range(1, 16)
_LISTEN = 0.05
_ASK_TIMEOUT = 0.03
# How often all motors are asked at once, to know how long that takes.
_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class InspectedMotor:
    """What one motor said.

    Attributes:
        address: bus and id it was asked under.
        reply_ids: ids on which answers came; several mean several motors.
        registers: register number to value; only those that were answered.
        feedback: its state (one joint), or None where it does not answer a refresh.
        channel: name of its bus where there are several, or "".
    """

    address: Address
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
        return int(self.registers.get(reg.MST_ID, self.reply_ids[0]))

    @property
    def limits(self) -> tuple[float, float, float] | None:
        """(PMAX, VMAX, TMAX) from its registers."""
        found = tuple(self.registers[number] for number in reg.SCALING if number in self.registers)
        return found if len(found) == 3 else None

    @property
    def position(self) -> float:
        """Where it is [rad]; NaN where it does not tell."""
        return float(self.feedback.position[0]) if self.feedback else np.nan


@dataclass(frozen=True)
class Inspection:
    """What the motors on a bus said.

    Attributes:
        motors: those that answered.
        unsolicited: frames seen before anything was asked; motors only speak when spoken to.
        error_frames: error frames seen while asking.
        round_trip: time in which all motors asked at once have answered, nearly always [s]; None
            where some did not answer.
    """

    motors: Mapping[Address, InspectedMotor]
    unsolicited: int
    error_frames: int
    round_trip: float | None = None


def inspect_bus(link: GuardedLink, clock: Clock) -> Inspection:
    """Ask every id on every bus for its registers and state; enables nothing."""
    unsolicited = _listen(link, clock)
    client = RegisterClient(link, clock, timeout=_ASK_TIMEOUT)
    motors = {}
    for address in (Address(bus, i) for bus in range(len(link.channels)) for i in _ALL_IDS):
        answers = client.read_all(address, reg.ESC_ID)
        if answers:
            reply_ids = tuple(answer.reply_id for answer in answers)
            channel = link.channels[address.bus] if len(link.channels) > 1 else ""
            motors[address] = _inspect_motor(client, address, reply_ids, channel)
    return Inspection(motors, unsolicited, client.error_frames, _round_trip(client, motors))


def _round_trip(client: RegisterClient, motors: Mapping[Address, InspectedMotor]) -> float | None:
    asked = [(address, motor.reply_ids[0]) for address, motor in motors.items()]
    if any(motor.feedback is None for motor in motors.values()):
        return None
    times = [client.seconds_to_refresh(asked) for _ in range(_ROUNDS)]
    answered = [time for time in times if time is not None]
    return float(np.percentile(answered, 90.0)) if len(answered) > _ROUNDS // 2 else None


def _listen(link: GuardedLink, clock: Clock) -> int:
    until, heard = clock.now() + _LISTEN, 0
    while (frame := link.receive(until)) is not None:
        heard += not frame.echo
    return heard


def _inspect_motor(
    client: RegisterClient, address: Address, reply_ids: tuple[int, ...], channel: str
) -> InspectedMotor:
    replies = {number: client.read(address, number) for number in reg.LOGGED}
    registers = {number: reply.value for number, reply in replies.items() if reply is not None}
    motor = InspectedMotor(address, reply_ids, registers, None, channel)
    return replace(motor, feedback=state_of(client, motor))


def state_of(client: RegisterClient, motor: InspectedMotor) -> Feedback | None:
    """Ask a motor for its state, without any effect on it; None where it does not tell."""
    frame = client.refresh(motor.address, motor.reply_ids[0])
    if frame is None or motor.limits is None or min(motor.limits) <= 0.0:
        return None
    raw = np.frombuffer(frame.data, dtype=np.uint8)[None]
    return decode_feedback(raw, Scaling.from_limits([motor.limits]))
