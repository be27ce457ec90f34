"""Changing what a motor holds: ids, mode, watchdog, bit rate, zero, and clearing an error.

Everything here is asked for by name, for one motor, while it is disabled; each step says what was
there before and reads back what is there now. Nothing of it ever happens in a run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from robot_sysid.damiao.bus.clock import Clock
from robot_sysid.damiao.bus.inspection import InspectedMotor
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.bus.register_client import RegisterClient
from robot_sysid.damiao.protocol import registers as reg
from robot_sysid.damiao.protocol.codec import Scaling, decode_feedback
from robot_sysid.damiao.protocol.frames import (
    Address,
    clear_error_frame,
    set_zero_frame,
    store_frame,
)
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records.options import OptionRecord, option

_STORE_TIME = 0.05
_LARGEST_ID = 15


def _id(value: int) -> str | None:
    return None if 1 <= value <= _LARGEST_ID else f"must be from 1 to {_LARGEST_ID}"


def _master(value: int) -> str | None:
    return None if 0 <= value <= 0x7FE else "must be from 0 to 0x7fe"


def _watchdog(value: float) -> str | None:
    return None if 0.0 <= value <= 5.0 else "must be from 0 to 5 s"


def _bit_rate(value: int) -> str | None:
    return (
        None if value in reg.BIT_RATES else f"must be one of {', '.join(map(str, reg.BIT_RATES))}"
    )


def _whole(text: str) -> int:
    return int(text, 0)


@dataclass(frozen=True)
class SetupOptions(OptionRecord):
    """What ``motors setup`` changes in one motor; nothing lists the motors."""

    motor: int | None = option(
        None, "CAN id of the motor to change", metavar="ID", parse=_whole, check=_id
    )
    new_id: int | None = option(None, "new CAN id", metavar="ID", parse=_whole, check=_id)
    new_master_id: int | None = option(
        None, "new id it answers on", metavar="ID", parse=_whole, check=_master
    )
    mit: bool = option(False, "set the control mode to MIT")
    watchdog: float | None = option(
        None, "set its watchdog, 0 for none", unit="s", metavar="S", check=_watchdog
    )
    motor_bitrate: int | None = option(
        None,
        "set its bit rate; it listens at the new one from then on",
        unit="bit/s",
        metavar="RATE",
        parse=_whole,
        check=_bit_rate,
    )
    set_zero: bool = option(False, "make where it stands its zero; asks twice")
    clear_error: bool = option(False, "clear its error, once you know its cause")
    store: bool = option(False, "keep the changes when the power goes off")

    @property
    def changes(self) -> bool:
        """Whether anything is to be changed."""
        values = (self.new_id, self.new_master_id, self.watchdog, self.motor_bitrate)
        asked = self.mit, self.set_zero, self.clear_error, self.store
        return any(value is not None for value in values) or any(asked)


class MotorSetup:
    """Changes one motor.

    Args:
        link: the bus; has to let pass what a run never sends.
        clock: for waiting.
        motor: what it said when it was asked.

    Raises:
        HardwareAbort: the motor is enabled, or does not tell.
    """

    def __init__(self, link: GuardedLink, clock: Clock, motor: InspectedMotor) -> None:
        self._link, self._clock, self._motor = link, clock, motor
        self._client, self._address = RegisterClient(link, clock), motor.address
        self._master = motor.master_id
        self._require_off()

    def apply(self, asked: SetupOptions, sure: Callable[[str], bool]) -> Iterator[str]:
        """Make the changes, in an order in which the motor stays reachable; yield what was done.

        Args:
            asked: the changes.
            sure: asks a person whether he means it.

        Raises:
            HardwareAbort: the motor refused, does not answer any more, or is enabled.
            InputError: the person did not mean it.
        """
        if asked.clear_error:
            yield self._cleared()
        if asked.mit:
            yield self._written(reg.CTRL_MODE, reg.MIT_MODE)
        if asked.watchdog is not None:
            yield self._written(reg.TIMEOUT, float(round(asked.watchdog / reg.TIMEOUT_UNIT)))
        if asked.set_zero:
            yield self._zeroed(sure)
        if asked.new_master_id is not None:
            yield self._written(reg.MST_ID, asked.new_master_id)
            self._master = asked.new_master_id
        if asked.new_id is not None:
            yield self._written(reg.ESC_ID, asked.new_id)
            self._address = Address(self._address.bus, asked.new_id)
        if asked.store and asked.motor_bitrate is None:
            yield self._stored()
        if asked.motor_bitrate is not None:
            yield from self._at_another_bit_rate(asked)

    def _at_another_bit_rate(self, asked: SetupOptions) -> Iterator[str]:
        yield self._written(reg.CAN_BR, reg.BIT_RATES[asked.motor_bitrate or 0], read_back=False)
        if asked.store:
            yield "not stored: open the bus at the new bit rate and give --store again"

    def _written(self, register: int, value: float, read_back: bool = True) -> str:
        self._require_off()
        before = self._client.read(self._address, register)
        if read_back:
            self._client.write(self._address, register, value)
        else:
            self._client.tell(self._address, register, value)
        old = "unknown" if before is None else reg.text_of(register, before.value)
        return f"{self._motor.name}: {old} is now {reg.text_of(register, value)}"

    def _cleared(self) -> str:
        before = self._status()
        if not reg.is_fault(before):
            return f"{self._motor.name} has no error to clear ({reg.describe(before)})"
        self._link.send(clear_error_frame(self._address))
        after = self._status()
        if reg.is_fault(after):
            raise HardwareAbort(f"{self._motor.name} still reports {reg.describe(after)}")
        return f"{self._motor.name}: {reg.describe(before)} is cleared"

    def _zeroed(self, sure: Callable[[str], bool]) -> str:
        before = self._position()
        for question in (
            f"{self._motor.name} stands at {before:.4f} rad; make that its zero?",
            "every joint map, recording and trajectory made with the old zero is wrong then; sure?",
        ):
            if not sure(question):
                raise InputError("not confirmed; the zero is as it was")
        self._require_off()
        self._link.send(set_zero_frame(self._address))
        self._clock.sleep_until(self._clock.now() + _STORE_TIME)
        after = self._position()
        return f"{self._motor.name}: {before:.4f} rad is now {after:.4f} rad; the motor keeps it"

    def _stored(self) -> str:
        self._require_off()
        self._link.send(store_frame(self._address))
        self._clock.sleep_until(self._clock.now() + _STORE_TIME)
        return f"{self._motor.name} keeps its values when the power goes off"

    def _require_off(self) -> None:
        status = self._status()
        if status != reg.DISABLED and not reg.is_fault(status):
            raise HardwareAbort(
                f"{self._motor.name} is enabled; end the program that uses it, nothing was changed"
            )

    def _status(self) -> int:
        return self._feedback()[0] >> 4

    def _position(self) -> float:
        limits = self._motor.limits
        if limits is None or min(limits) <= 0.0:
            raise HardwareAbort(
                f"{self._motor.name} does not tell its PMAX, so nobody knows what angle it means; "
                "the zero is as it was"
            )
        raw = np.frombuffer(self._feedback(), dtype=np.uint8)[None]
        return float(decode_feedback(raw, Scaling.from_limits([limits])).position[0])

    def _feedback(self) -> bytes:
        frame = self._client.refresh(self._address, self._master)
        if frame is None:
            raise HardwareAbort(f"{self._motor.name} does not tell its state; nothing more is done")
        return frame.data
