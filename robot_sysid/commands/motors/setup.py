"""``robot-sysid motors setup|monitor|map``: what is done to motors before anything is played.

Ids, mode, watchdog, bit rate, zero, and clearing an error: everything is asked for by name, for one
motor, while it is disabled; each step says what was there before and reads back what is there now.
Nothing of it ever happens in a run.

For mapping, the arm is limp. A person moves one joint after the other the way the model calls
positive; the motor that turned drives it. Then the arm is put into a pose that the model knows.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.commands.console import Console
from robot_sysid.commands.motors.asked import (
    Asked,
    answer,
    motor_table,
    said_yes,
    state_table,
)
from robot_sysid.damiao import protocol
from robot_sysid.damiao.bus import (
    GuardedLink,
    InspectedMotor,
    Inspection,
    RegisterClient,
    inspect_bus,
)
from robot_sysid.damiao.joints import BY_HAND, DamiaoJoint, id_problems, write_joint_map
from robot_sysid.damiao.protocol import refuse_motion
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.option_fields import (
    OptionRecord,
    given_options,
    option,
    parse_whole_number,
    record_from,
)

# A judgement: longer than a flash memory takes to be written [s].
_STORE_TIME = 0.05


def _within(low: float, high: float, words: str) -> Callable[[float], str | None]:
    return lambda value: None if low <= value <= high else f"must be from {words}"


_BIT_RATES = f"must be one of {', '.join(map(str, protocol.BIT_RATES))}"
_ID: dict[str, Any] = {
    "metavar": "ID",
    "parse": parse_whole_number,
    "check": _within(1, 15, "1 to 15"),
}


@dataclass(frozen=True)
class SetupOptions(OptionRecord):
    """What ``motors setup`` changes in one motor; nothing lists the motors."""

    scan: bool = option(
        False, "look for motors at every bit rate that the adapter can be set to"
    )
    motor: int | None = option(None, "CAN id of the motor to change", **_ID)
    new_id: int | None = option(None, "new CAN id", **_ID)
    new_master_id: int | None = option(
        None,
        "new id it answers on",
        **{**_ID, "check": _within(0, 0x7FE, "0 to 0x7fe")},
    )
    mit: bool = option(False, "set the control mode to MIT")
    watchdog: float | None = option(
        None, "set its watchdog, 0 for none", "S [s]", check=_within(0, 5, "0 to 5 s")
    )
    motor_bitrate: int | None = option(
        None,
        "set its bit rate; it listens at the new one from then on",
        "RATE [bit/s]",
        parse=parse_whole_number,
        check=lambda rate: None if rate in protocol.BIT_RATES else _BIT_RATES,
    )
    set_zero: bool = option(False, "make where it stands its zero; asks twice")
    clear_error: bool = option(False, "clear its error, once you know its cause")
    store: bool = option(False, "keep the changes when the power goes off")


class MotorSetup:
    """Changes one motor; raises HardwareAbort where it is enabled, or does not tell.

    The link has to let pass what a run never sends.
    """

    def __init__(self, link: GuardedLink, motor: InspectedMotor) -> None:
        self._link = link
        self._client = RegisterClient(link)
        self._motor = motor
        self._address = motor.address
        self._master = motor.master_id
        self._require_off()

    def apply(self, asked: SetupOptions) -> Iterator[str]:
        """Make the changes, in an order in which the motor stays reachable; yield what was done.

        InputError where a person does not confirm, and HardwareAbort where the motor refuses, does
        not answer any more, or is enabled.
        """
        if asked.clear_error:
            yield self._cleared()
        if asked.mit:
            yield self._written(protocol.CTRL_MODE, protocol.MIT_MODE)
        if asked.watchdog is not None:
            yield self._written(
                protocol.TIMEOUT, float(round(asked.watchdog / protocol.TIMEOUT_UNIT))
            )
        if asked.set_zero:
            yield self._zeroed()
        if asked.new_master_id is not None:
            yield self._written(protocol.MST_ID, asked.new_master_id)
            self._master = asked.new_master_id
        if asked.new_id is not None:
            yield self._written(protocol.ESC_ID, asked.new_id)
            self._address = protocol.Address(self._address.bus, asked.new_id)
        if asked.store and asked.motor_bitrate is None:
            self._send_off(protocol.store_frame(self._address))
            yield f"{self._motor.name} keeps its values when the power goes off"
        if asked.motor_bitrate is not None:
            yield self._written(
                protocol.CAN_BR, protocol.BIT_RATES[asked.motor_bitrate], verify=False
            )
            if asked.store:
                yield "not stored: open the bus at the new bit rate and give --store again"

    def _written(self, register: int, value: float, verify: bool = True) -> str:
        self._require_off()
        before = self._client.read(self._address, register)
        self._client.write(self._address, register, value, verify)
        old = (
            "unknown"
            if before is None
            else protocol.register_text(register, before.value)
        )
        return f"{self._motor.name}: {old} is now {protocol.register_text(register, value)}"

    def _cleared(self) -> str:
        name = self._motor.name
        before = self._feedback()[0] >> 4
        if not protocol.is_fault(before):
            return f"{name} has no error to clear ({protocol.status_text(before)})"
        self._link.send(protocol.clear_error_frame(self._address))
        after = self._feedback()[0] >> 4
        if protocol.is_fault(after):
            raise HardwareAbort(f"{name} still reports {protocol.status_text(after)}")
        return f"{name}: {protocol.status_text(before)} is cleared"

    def _zeroed(self) -> str:
        name = self._motor.name
        before = self._position()
        for question in (
            f"{name} stands at {before:.4f} rad; make that its zero?",
            "every joint map, recording and trajectory made with the old zero is wrong then; sure?",
        ):
            if not said_yes(question):
                raise InputError("not confirmed; the zero is as it was")
        self._send_off(protocol.set_zero_frame(self._address))
        return f"{name}: {before:.4f} rad is now {self._position():.4f} rad; the motor keeps it"

    def _send_off(self, frame: protocol.Frame) -> None:
        """Send what a motor that is off writes to its flash memory."""
        self._require_off()
        self._link.send(frame)
        self._link.clock.sleep_until(self._link.clock.now() + _STORE_TIME)

    def _require_off(self) -> None:
        if self._feedback()[0] >> 4 == protocol.ENABLED:
            raise HardwareAbort(
                f"{self._motor.name} is enabled; end the program that uses it, nothing was changed"
            )

    def _position(self) -> float:
        told = self._motor.decode_feedback(self._feedback())
        if told is None:
            raise HardwareAbort(
                f"{self._motor.name} does not tell its PMAX, so nobody knows what angle it means; "
                "the zero is as it was"
            )
        return float(told.position[0])

    def _feedback(self) -> bytes:
        frame = self._client.refresh(self._address, self._master)
        if frame is None:
            raise HardwareAbort(
                f"{self._motor.name} does not tell its state; nothing more is done"
            )
        return frame.data


Positions = Mapping[protocol.Address, float]
# Half of the 20 degrees that are asked for [rad]; the motor that was meant turns three times as far
# as any that a limp arm drags along. Judgements.
_MOVED = 0.15
_CLEARLY = 3.0
_TRIES = 3
_ENTER = "; then press Enter: "
# A turn of 17 degrees [rad] that moves the tip by less than this [m] is not seen at the tip.
_PROBE = 0.3
_SEEN = 0.02
_WAYS = ("-x", "+x"), ("-y", "+y"), ("-z (down)", "+z (up)")


def positive_ways(
    robot: RobotModel, q: Array | None = None, signs: Array | float = 1.0
) -> list[str]:
    """Return, per joint, what the model does when it moves the positive way, in words.

    That is from q (n,) [rad], or else from its own pose; with ``signs`` (n,) the way they say.
    """
    # Imported here so that setting up and monitoring do not wait for MuJoCo.
    from robot_sysid.simulation.forward_dynamics import ArmStepper

    place = robot.reference if q is None else q
    words = []
    begin = ArmStepper(robot, place)
    probe = _PROBE * np.diag(np.zeros(robot.n_joints) + signs)
    for j in range(robot.n_joints):
        shift = ArmStepper(robot, place + probe[j]).tip() - begin.tip()
        seen = np.max(np.abs(shift)) > _SEEN
        vector = shift if seen else np.sign(probe[j, j]) * begin.axis(j)
        k = int(np.argmax(np.abs(vector)))
        start = (
            "the end of the arm moves towards"
            if seen
            else "it turns counter-clockwise seen from"
        )
        words.append(f"{start} {_WAYS[k][int(vector[k] > 0.0)]}")
    return words


def map_by_hand(link: GuardedLink, robot: RobotModel) -> list[DamiaoJoint]:
    """Return the joint map that a person shows; all motors are limp.

    InputError for fewer motors than joints; HardwareAbort where one is not off for sure or does not
    answer any more, or where a movement could not be told from others three times.
    """
    client = RegisterClient(link)
    by_address = inspect_bus(link).motors
    if len(by_address) < robot.n_joints:
        raise InputError(
            f"{len(by_address)} motors answer but the model's chain has {robot.n_joints} joints"
        )
    for motor in by_address.values():
        if motor.feedback is None or motor.feedback.status[0] == protocol.ENABLED:
            raise HardwareAbort(
                f"{motor.name} is enabled or does not tell; the arm has to be limp"
            )

    def positions() -> Positions:
        states = [client.state_of(motor) for motor in by_address.values()]
        told = [float(state.position[0]) for state in states if state]
        if len(told) < len(states):
            raise HardwareAbort("a motor does not answer any more; nothing was written")
        return dict(zip(by_address, told))

    found: dict[protocol.Address, tuple[str, int]] = {}
    for name, way in zip(robot.joint_names, positive_ways(robot)):
        address, direction = _moved_one(
            name, way, set(by_address) - set(found), positions
        )
        found[address] = name, direction
    listed = ", ".join(
        f"{n} {q:.3f}" for n, q in zip(robot.joint_names, robot.reference)
    )
    answer(
        f"put the arm into the model's own pose ({listed} rad or m) and hold it there{_ENTER}"
    )
    here = positions()
    rows = []
    for (address, (name, direction)), q in zip(found.items(), robot.reference):
        motor = by_address[address]
        offset = round(here[address] - direction * float(q), 4)
        place = address.can_id, motor.master_id, name, 0, motor.channel
        rows.append(DamiaoJoint("", *place, direction, offset, verified=BY_HAND))
    return rows


def _moved_one(
    name: str, way: str, left: set[protocol.Address], positions: Callable[[], Positions]
) -> tuple[protocol.Address, int]:
    again = ""
    for _ in range(_TRIES):
        before = positions()
        answer(
            f"{again}move joint {name} alone, by 20 degrees or more, so that {way}{_ENTER}"
        )
        after = positions()
        turns = {each: after[each] - before[each] for each in left}
        moved, *others = sorted(left, key=lambda each: -abs(turns[each]))
        most = abs(turns[moved])
        if most > _MOVED and (not others or most > _CLEARLY * abs(turns[others[0]])):
            return moved, 1 if turns[moved] > 0.0 else -1
        again = (
            "several motors turned; "
            if most > _MOVED
            else "no motor turned far enough; "
        )
    raise HardwareAbort(
        f"it cannot be told which motor drives {name}; nothing was written"
    )


@dataclass(frozen=True)
class LifetimeOptions(OptionRecord):
    """When that ends which would go on until Ctrl-C."""

    lifetime: float | None = option(
        None, "end after this time", "S [s] > 0", flag="--for", default_text="Ctrl-C"
    )


@dataclass(frozen=True)
class MonitorOptions(LifetimeOptions):
    """How ``motors monitor`` watches."""

    interval: float = option(0.2, "time between two looks", "S [s] > 0", flag="--every")


@dataclass(frozen=True)
class MapOptions(OptionRecord):
    """What ``motors map`` writes."""

    output: Path = option(Path("joint_map.csv"), "where to write the map", "FILE")


def setup(asked: Asked) -> int:
    """Find motors, and change one of them."""
    options = record_from(SetupOptions, asked.values)
    changes = any(
        given.key not in ("scan", "motor") for given in given_options(options)
    )
    if changes and options.motor is None:
        raise InputError("--motor says which motor to change, for instance --motor 1")
    if options.scan:
        return _scan(asked)
    with asked.open_guarded(refuse_motion) as link:
        inspection = inspect_bus(link)
        asked.console.stage(*motor_table(inspection))
        if changes:
            for line in MotorSetup(link, _only(inspection, options)).apply(options):
                asked.console.stage(line)
        changed = f"motor {options.motor} is changed" if changes else ""
        return _found(asked, len(inspection.motors), changed)


SILENT = "no motor answers: check power, wiring and bit rate"


def _found(asked: Asked, motors: int, changed: str = "") -> int:
    """Say how many motors there are and what to do next; return the exit code."""
    asked.verdict = (f"Not usable: {SILENT}",)
    if motors:
        asked.conclude(
            f"Done: {changed or f'{motors} motors answer'}", asked.command("check")
        )
    return 0 if motors else 1


def _scan(asked: Asked) -> int:
    if asked.address.interface in ("socketcan", "damiao", "virtual"):
        raise InputError(
            f"the bit rate of {asked.address.interface} is set outside of this program (ip link, "
            "or the adapter's own tool); set one after the other there and run setup without --scan"
        )
    heard = 0
    refused = []
    rates = [rate for rate in protocol.BIT_RATES if rate <= 1_000_000]
    for rate in sorted(rates, reverse=True):
        try:
            with asked.open_guarded(
                refuse_motion, replace(asked.timing, bitrate=float(rate))
            ) as link:
                inspection = inspect_bus(link)
        except InputError as error:
            refused.append(error)
            asked.console.stage(f"{rate} bit/s: not tried, {error}")
            continue
        found = len(inspection.motors)
        heard += found
        asked.console.stage(f"{rate} bit/s: {found} motors")
        asked.console.stage(*(motor_table(inspection) if found else []))
    if len(refused) == len(rates):
        raise refused[0]
    return _found(asked, heard)


def _only(inspection: Inspection, options: SetupOptions) -> InspectedMotor:
    """Return the motor to change, or raise where it is not one, or would clash with others."""
    meant = [m for m in inspection.motors.values() if m.can_id == options.motor]
    if len(meant) > 1:
        raise HardwareAbort(
            f"{' and '.join(m.channel for m in meant)} each have a motor {options.motor}; give "
            "only the --channel of the one that you mean"
        )
    if len(meant) != 1 or len(meant[0].reply_ids) != 1:
        raise HardwareAbort(
            f"{len(meant)} motors answer to CAN id {options.motor}, or several share it: leave one "
            "motor on the bus"
        )
    (motor,) = meant
    bus = meant[0].address.bus
    others = [
        m for m in inspection.motors.values() if m is not motor and m.address.bus == bus
    ]
    if options.motor_bitrate is not None and others:
        raise InputError("a bit rate can only be changed with one motor on the bus")
    now = bus, motor.can_id, motor.master_id
    new_master = now[2] if options.new_master_id is None else options.new_master_id
    new = bus, options.new_id or now[1], new_master
    for there in ((bus, other.can_id, other.master_id) for other in others):
        # What clashes already may be put right one motor after the other.
        before = set(id_problems([now, there]))
        for problem in (
            each for each in id_problems([new, there]) if each not in before
        ):
            raise InputError(f"nothing was changed: {problem}")
    return motor


def monitor(asked: Asked) -> int:
    """Show the motors' states again and again; enables nothing."""
    options = record_from(MonitorOptions, asked.values)
    console = asked.console
    with asked.open_guarded(refuse_motion) as link:
        motors = list(inspect_bus(link).motors.values())
        if not motors:
            return _found(asked, 0)
        with contextlib.suppress(KeyboardInterrupt):
            _watch(link, motors, options, console)
    return 0


def _watch(
    link: GuardedLink,
    motors: Sequence[InspectedMotor],
    options: MonitorOptions,
    console: Console,
) -> None:
    client = RegisterClient(link)
    clock = link.clock
    ends = clock.now() + (options.lifetime or float("inf"))
    while True:
        lines = list(state_table([(motor, client.state_of(motor)) for motor in motors]))
        console.stage(*lines)
        if clock.now() + options.interval > ends:
            return
        clock.sleep_until(clock.now() + options.interval)
        console.back(len(lines))


def map_joints(asked: Asked) -> int:
    """Write the joint map that a person shows by moving the limp arm."""
    options = record_from(MapOptions, asked.values)
    robot = asked.robot
    if options.output.exists():
        raise InputError(f"{options.output} exists; choose another --output")
    with asked.open_guarded(refuse_motion) as link:
        rows = map_by_hand(link, robot)
    write_joint_map(options.output, rows)
    play = asked.command("play", trajectory="TRAJECTORY", joint_map=options.output)
    asked.conclude(f"Done: written to {options.output}", play)
    return 0
