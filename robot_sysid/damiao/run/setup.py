"""Changing what a motor holds, and finding out by hand which motor drives which joint.

Ids, mode, watchdog, bit rate, zero, and clearing an error: everything is asked for by name, for one
motor, while it is disabled; each step says what was there before and reads back what is there now.
Nothing of it ever happens in a run.

For mapping, the arm is limp. A person moves one joint after the other the way the model calls
positive; the motor that turned drives it. Then the arm is put into a pose that the model knows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_sysid.damiao.bus.inspection import InspectedMotor, RegisterClient, inspect_bus, state_of
from robot_sysid.damiao.bus.link import GuardedLink
from robot_sysid.damiao.protocol import frames
from robot_sysid.damiao.protocol import registers as reg
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.options import OptionRecord, given_options, option, whole_number

_STORE_TIME = 0.05


def _within(low: float, high: float, words: str) -> Callable[[float], str | None]:
    return lambda value: None if low <= value <= high else f"must be from {words}"


def _bit_rate(value: int) -> str | None:
    listed = ", ".join(map(str, reg.BIT_RATES))
    return None if value in reg.BIT_RATES else f"must be one of {listed}"


_ID: dict[str, Any] = {"metavar": "ID", "parse": whole_number, "check": _within(1, 15, "1 to 15")}


@dataclass(frozen=True)
class SetupOptions(OptionRecord):
    """What ``motors setup`` changes in one motor; nothing lists the motors."""

    scan: bool = option(False, "look for motors at every bit rate that the adapter can be set to")
    motor: int | None = option(None, "CAN id of the motor to change", **_ID)
    new_id: int | None = option(None, "new CAN id", **_ID)
    new_master_id: int | None = option(
        None, "new id it answers on", **{**_ID, "check": _within(0, 0x7FE, "0 to 0x7fe")}
    )
    mit: bool = option(False, "set the control mode to MIT")
    watchdog: float | None = option(
        None, "set its watchdog, 0 for none", "S [s]", check=_within(0, 5, "0 to 5 s")
    )
    motor_bitrate: int | None = option(
        None,
        "set its bit rate; it listens at the new one from then on",
        "RATE [bit/s]",
        parse=whole_number,
        check=_bit_rate,
    )
    set_zero: bool = option(False, "make where it stands its zero; asks twice")
    clear_error: bool = option(False, "clear its error, once you know its cause")
    store: bool = option(False, "keep the changes when the power goes off")

    @property
    def changes(self) -> bool:
        """Whether anything is to be changed."""
        return any(given.key not in ("scan", "motor") for given in given_options(self))


class MotorSetup:
    """Changes one motor; raises HardwareAbort where it is enabled, or does not tell.

    The link has to let pass what a run never sends.
    """

    def __init__(self, link: GuardedLink, motor: InspectedMotor) -> None:
        self._link, self._clock, self._motor = link, link.clock, motor
        self._client, self._address = RegisterClient(link), motor.address
        self._master = motor.master_id
        self._require_off()

    def apply(self, asked: SetupOptions, sure: Callable[[str], bool]) -> Iterator[str]:
        """Make the changes, in an order in which the motor stays reachable; yield what was done.

        ``sure`` asks a person whether he means it; InputError where he does not, and HardwareAbort
        where the motor refuses, does not answer any more, or is enabled.
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
            self._address = frames.Address(self._address.bus, asked.new_id)
        if asked.store and asked.motor_bitrate is None:
            yield self._stored()
        if asked.motor_bitrate is not None:
            yield self._written(reg.CAN_BR, reg.BIT_RATES[asked.motor_bitrate], heard=False)
            if asked.store:
                yield "not stored: open the bus at the new bit rate and give --store again"

    def _written(self, register: int, value: float, heard: bool = True) -> str:
        self._require_off()
        before = self._client.read(self._address, register)
        self._client.write(self._address, register, value, heard)
        old = "unknown" if before is None else reg.text_of(register, before.value)
        return f"{self._motor.name}: {old} is now {reg.text_of(register, value)}"

    def _cleared(self) -> str:
        before = self._status()
        if not reg.is_fault(before):
            return f"{self._motor.name} has no error to clear ({reg.describe(before)})"
        self._link.send(frames.clear_error_frame(self._address))
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
        self._link.send(frames.set_zero_frame(self._address))
        self._clock.sleep_until(self._clock.now() + _STORE_TIME)
        after = self._position()
        return f"{self._motor.name}: {before:.4f} rad is now {after:.4f} rad; the motor keeps it"

    def _stored(self) -> str:
        self._require_off()
        self._link.send(frames.store_frame(self._address))
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
        told = self._motor.meaning(self._feedback())
        if told is None:
            raise HardwareAbort(
                f"{self._motor.name} does not tell its PMAX, so nobody knows what angle it means; "
                "the zero is as it was"
            )
        return float(told.position[0])

    def _feedback(self) -> bytes:
        frame = self._client.refresh(self._address, self._master)
        if frame is None:
            raise HardwareAbort(f"{self._motor.name} does not tell its state; nothing more is done")
        return frame.data


Positions = Mapping[frames.Address, float]
_MOVED, _CLEARLY = 0.15, 3.0
_TRIES = 3
_PROBE, _SEEN = 0.3, 0.02
_AXES = ("x", "y", "z")
_WAYS = {"+z": " (up)", "-z": " (down)"}


def positive_ways(robot: RobotModel) -> list[str]:
    """Return, per joint, what the model does when it moves the positive way, in words."""
    # Imported here so that setting up and monitoring do not wait for MuJoCo.
    from robot_sysid.simulation.forward_dynamics import ArmStepper

    begin, words = ArmStepper(robot), []
    for j in range(robot.n_joints):
        q = robot.reference + _PROBE * (np.arange(robot.n_joints) == j)
        shift = ArmStepper(robot, q).tip() - begin.tip()
        if np.max(np.abs(shift)) > _SEEN:
            words.append(f"the end of the arm moves towards {_way(shift)}")
        else:
            words.append(f"it turns counter-clockwise seen from {_way(begin.axis(j))}")
    return words


def _way(vector: Array) -> str:
    k = int(np.argmax(np.abs(vector)))
    way = f"{'+' if vector[k] > 0.0 else '-'}{_AXES[k]}"
    return way + _WAYS.get(way, "")


def map_by_hand(
    link: GuardedLink, robot: RobotModel, ask: Callable[[str], None]
) -> list[DamiaoJoint]:
    """Return the joint map that a person shows; all motors are limp.

    ``ask`` says what to do and returns when it is done. InputError for fewer motors than joints;
    HardwareAbort where one is not off for sure or does not answer any more, or where a movement
    could not be told from others three times.
    """
    client, by_address = RegisterClient(link), inspect_bus(link).motors
    _require_limp(by_address.values(), robot.n_joints)

    def positions() -> Positions:
        states = [state_of(client, motor) for motor in by_address.values()]
        told = [float(state.position[0]) for state in states if state]
        if len(told) < len(states):
            raise HardwareAbort("a motor does not answer any more; nothing was written")
        return dict(zip(by_address, told))

    found: list[tuple[str, frames.Address, int]] = []
    for name, way in zip(robot.joint_names, positive_ways(robot)):
        left = set(by_address) - {address for _, address, _ in found}
        found.append((name, *_moved_one(name, way, left, positions, ask)))
    listed = ", ".join(f"{n} {q:.3f}" for n, q in zip(robot.joint_names, robot.reference))
    ask(f"put the arm into the model's own pose ({listed} rad or m) and hold it there")
    here = positions()
    rows = []
    for (name, address, direction), q in zip(found, robot.reference):
        motor = by_address[address]
        offset = round(here[address] - direction * float(q), 4)
        place = address.can_id, motor.master_id, name, 0, motor.channel
        rows.append(DamiaoJoint("", *place, direction, offset))
    return rows


def _moved_one(
    name: str,
    way: str,
    left: set[frames.Address],
    positions: Callable[[], Positions],
    ask: Callable[[str], None],
) -> tuple[frames.Address, int]:
    again = ""
    for _ in range(_TRIES):
        before = positions()
        ask(f"{again}move joint {name} alone, by 20 degrees or more, so that {way}")
        after = positions()
        turned = sorted(left, key=lambda each: -abs(after[each] - before[each]))
        way_back = [after[each] - before[each] for each in turned]
        if turned and abs(way_back[0]) > _MOVED:
            if len(turned) == 1 or abs(way_back[0]) > _CLEARLY * abs(way_back[1]):
                return turned[0], 1 if way_back[0] > 0.0 else -1
            again = "several motors turned; "
        else:
            again = "no motor turned far enough; "
    raise HardwareAbort(f"it cannot be told which motor drives {name}; nothing was written")


def _require_limp(motors: Collection[InspectedMotor], n: int) -> None:
    if len(motors) < n:
        raise InputError(f"{len(motors)} motors answer but the model's chain has {n} joints")
    for motor in motors:
        if motor.feedback is None or motor.feedback.status[0] == reg.ENABLED:
            raise HardwareAbort(f"{motor.name} is enabled or does not tell; the arm has to be limp")
