"""``robot-sysid motors setup|monitor|map``: what is done to motors before anything is played."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from robot_sysid.commands.motors.asked import Asked
from robot_sysid.damiao.bus.inspection import (
    InspectedMotor,
    Inspection,
    RegisterClient,
    inspect_bus,
    state_of,
)
from robot_sysid.damiao.protocol.frames import refuse_motion
from robot_sysid.damiao.protocol.joints import write_joint_map
from robot_sysid.damiao.protocol.registers import BIT_RATES
from robot_sysid.damiao.report_lines import motor_table, state_table
from robot_sysid.damiao.run.setup import MotorSetup, SetupOptions, map_by_hand
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records.options import OptionRecord, option, record_from

# Where the bit rate is not ours to choose.
_FIXED_RATE = ("socketcan", "damiao", "virtual")
_CLASSIC_TOP = 1_000_000


def lifetime_option() -> Any:
    """Return the option that ends what would go on until Ctrl-C."""
    return option(None, "end after this time", "S [s] > 0", flag="--for", usual="Ctrl-C")


@dataclass(frozen=True)
class MonitorOptions(OptionRecord):
    """How ``motors monitor`` watches."""

    lifetime: float | None = lifetime_option()
    interval: float = option(0.2, "time between two looks", "S [s] > 0", flag="--every")


@dataclass(frozen=True)
class MapOptions(OptionRecord):
    """What ``motors map`` writes."""

    output: Path = option(Path("joint_map.csv"), "where to write the map", "FILE")


def setup(asked: Asked) -> int:
    """Find motors, and change one of them."""
    options = record_from(SetupOptions, asked.values)
    if options.changes and options.motor is None:
        raise InputError("--motor says which motor to change, for instance --motor 1")
    if options.scan:
        return _scan(asked)
    with asked.bus(refuse_motion) as link:
        inspection = inspect_bus(link)
        asked.console.lines(motor_table(inspection))
        if options.changes:
            for line in MotorSetup(link, _only(inspection, options)).apply(options, _sure):
                asked.console.stage(line)
        return 0 if inspection.motors else 1


def _scan(asked: Asked) -> int:
    if asked.address.interface in _FIXED_RATE:
        raise InputError(
            f"the bit rate of {asked.address.interface} is set outside of this program (ip link, "
            "or the adapter's own tool); set one after the other there and run setup without --scan"
        )
    heard = 0
    for rate in sorted((rate for rate in BIT_RATES if rate <= _CLASSIC_TOP), reverse=True):
        with asked.bus(refuse_motion, replace(asked.timing, bitrate=float(rate))) as link:
            inspection = inspect_bus(link)
        found = len(inspection.motors)
        heard += found
        asked.console.stage(f"{rate} bit/s: {found} motors")
        asked.console.lines(motor_table(inspection) if found else [])
    return 0 if heard else 1


def _only(inspection: Inspection, options: SetupOptions) -> InspectedMotor:
    meant = [m for m in inspection.motors.values() if m.can_id == options.motor]
    if len(meant) != 1 or len(meant[0].reply_ids) != 1:
        raise HardwareAbort(
            f"{len(meant)} motors answer to CAN id {options.motor}, or several share it: leave one "
            "motor on the bus"
        )
    others = [m.can_id for m in inspection.motors.values() if m is not meant[0]]
    if options.new_id in others:
        raise InputError(f"CAN id {options.new_id} is taken by another motor on the bus")
    if options.motor_bitrate is not None and others:
        raise InputError("a bit rate can only be changed with one motor on the bus")
    return meant[0]


def _sure(question: str) -> bool:
    if not sys.stdin.isatty():
        raise InputError("nobody can confirm: standard input is no terminal")
    return _answer(f"{question} Type yes: ").strip().lower() == "yes"


def _answer(prompt: str) -> str:
    with contextlib.suppress(EOFError):
        return input(prompt)
    raise InputError("standard input has ended")


def monitor(asked: Asked) -> int:
    """Show the motors' states again and again; enables nothing."""
    options, console = record_from(MonitorOptions, asked.values), asked.console
    with asked.bus(refuse_motion) as link:
        motors = list(inspect_bus(link).motors.values())
        if not motors:
            console.stage("no motor answers: check power, wiring and bit rate")
            return 1
        with contextlib.suppress(KeyboardInterrupt):
            _watch(RegisterClient(link), motors, options, asked)
    return 0


def _watch(
    client: RegisterClient, motors: Sequence[InspectedMotor], options: MonitorOptions, asked: Asked
) -> None:
    clock, console = asked.clock, asked.console
    ends = clock.now() + (options.lifetime or float("inf"))
    while True:
        lines = list(state_table([(motor, state_of(client, motor)) for motor in motors]))
        console.lines(lines)
        if clock.now() + options.interval > ends:
            return
        clock.sleep_until(clock.now() + options.interval)
        console.back(len(lines))


def map_joints(asked: Asked) -> int:
    """Write the joint map that a person shows by moving the limp arm."""
    options, robot = record_from(MapOptions, asked.values), asked.robot
    if options.output.exists():
        raise InputError(f"{options.output} exists; choose another --output")

    def ask(words: str) -> None:
        _answer(f"{words}; then press Enter: ")

    with asked.bus(refuse_motion) as link:
        rows = map_by_hand(link, robot, ask)
    write_joint_map(options.output, rows)
    asked.console.stage(f"written to {options.output}; give it to play with --joint-map")
    return 0
