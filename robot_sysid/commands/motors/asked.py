"""One command line of ``robot-sysid motors``: what it asks for, what it says, and who says yes."""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from robot_sysid.commands.arguments import PROGRAM
from robot_sysid.commands.console import Console
from robot_sysid.commands.streams import print_line
from robot_sysid.damiao import protocol
from robot_sysid.damiao.adapters import BusAddress
from robot_sysid.damiao.bus import InspectedMotor, Inspection
from robot_sysid.damiao.execution import MotorRun
from robot_sysid.damiao.joints import DamiaoJoint, limits_agree, matching_types
from robot_sysid.damiao.player import PlayReport
from robot_sysid.damiao.preflight import OK, Check
from robot_sysid.damiao.protocol import Feedback
from robot_sysid.damiao.recorder import Aside
from robot_sysid.damiao.settings import (
    Permissions,
    PlaySettings,
    RecordingOptions,
    SecondArm,
)
from robot_sysid.damiao.trajectory import LIMITS
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.model import ModelOptions
from robot_sysid.motion.plan_options import LimitOptions
from robot_sysid.records.messages import Detail
from robot_sysid.records.option_fields import command_arguments
from robot_sysid.results.verdict import two_lines


def answer(prompt: str) -> str:
    """Return what a person types."""
    with contextlib.suppress(EOFError):
        return input(prompt)
    raise InputError("not confirmed: standard input has ended")


def said_yes(question: str, hint: str = "") -> bool:
    """Ask a person, who has to sit at a terminal."""
    if not sys.stdin.isatty():
        raise InputError(f"nobody can confirm: standard input is no terminal{hint}")
    return answer(f"{question} Type yes: ").strip().lower() == "yes"


# What printing a line may take [s].
_PATIENCE = 1.0


def _hanging(words: str, last: bool) -> None:
    """Say what hangs, and end the program: its main thread cannot any more."""
    # A terminal that takes nothing must not keep it from ending.
    aside = Aside(threaded=True)
    aside(
        partial(
            print_line,
            f"robot-sysid: {'error' if last else 'note'}: {words}",
            sys.stderr,
        )
    )
    aside.finish(_PATIENCE)
    if last:
        os._exit(HardwareAbort.exit_code)


_WHERE = BusAddress, protocol.BusTiming
_HOW = ModelOptions, SecondArm, PlaySettings, Permissions, RecordingOptions


class Asked(MotorRun):
    """One command line of ``motors``, as records."""

    def __init__(self, values: Mapping[str, Any], console: Console) -> None:
        super().__init__(values, _hanging)
        self.console = console
        self.verdict: tuple[str, ...] = ()

    def conclude(self, use: str, following: Sequence[str], why: str = "") -> None:
        """Note what came of it, and the words of the next command: that is said at the end."""
        self.verdict = two_lines(use, shlex.join(following) + why)

    def command(self, name: str, *leave_out: str, **more: Any) -> list[str]:
        """Return the words of a command of motors, with all that was given for this one.

        Keys in ``leave_out`` are not given again, but some are ``more``.
        """
        values = {
            key: value for key, value in self.values.items() if key not in leave_out
        } | more
        words = [PROGRAM, "motors", name]
        files = ("model", "joint_map")
        words += [str(values[key]) for key in ("trajectory",) if values.get(key)]
        words += command_arguments(values, *_WHERE)
        for key in (key for key in files if values.get(key)):
            words += [f"--{key.replace('_', '-')}", str(values[key])]
        limits = {key: values[key] for key in LIMITS if key in values}
        return [
            *words,
            *command_arguments(values, *_HOW),
            *command_arguments(limits, LimitOptions),
        ]

    def play_words(self) -> list[str]:
        """Return the words of the command that plays what was checked, slowly at first."""
        usual = {"channel": ("CHANNEL",), "speed": 0.3, "record": "slow.csv"}
        return self.command(
            "play", **{k: v for k, v in usual.items() if k not in self.values}
        )


_HEADINGS: tuple[str, ...] = (
    "id",
    "reply",
    "mode",
    "PMAX",
    "VMAX",
    "TMAX",
    "type",
    "watchdog",
    "gear",
    "degC",
    "state",
)
_MARKS = {"ok": "ok  ", "note": "note", "stop": "STOP"}


def motor_table(
    inspection: Inspection, joints: Sequence[DamiaoJoint] = ()
) -> Iterator[str]:
    """Yield a table of the motors found; ``joints`` names the types to compare with."""
    types = {joint.address: joint for joint in joints}
    found = sorted(inspection.motors.items())
    yield from _columns(
        [_HEADINGS, *(_row(motor, types.get(place)) for place, motor in found)]
    )


def state_table(
    states: Iterable[tuple[InspectedMotor, Feedback | None]],
) -> Iterator[str]:
    """Yield a table of what motors measure."""
    rows: list[tuple[str, ...]] = [
        ("motor", "position", "velocity", "torque", "degC", "state")
    ]
    for motor, state in states:
        if state is None:
            rows.append((motor.name, "?", "?", "?", "?", "does not tell"))
            continue
        measured = state.position[0], state.velocity[0], state.torque[0]
        heat = f"{state.temperature_mos[0]}/{state.temperature_rotor[0]}"
        numbers = (f"{value:8.3f}" for value in measured)
        rows.append(
            (motor.name, *numbers, heat, protocol.status_text(int(state.status[0])))
        )
    yield from _columns(rows)


def _columns(rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(*rows)]
    for row in rows:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip()


def check_lines(checks: Sequence[Check]) -> Iterator[str]:
    """Yield one line per check; those that are in order are details, and counted."""
    for check in checks:
        line = f"[{_MARKS[check.severity]}] {check.text}"
        yield Detail(line) if check.severity == OK else line
    yield f"[ok  ] {sum(check.severity == OK for check in checks)} points (--verbose lists them)"


def run_lines(report: PlayReport) -> Iterator[str]:
    """Yield what is worth knowing about a finished run."""
    yield (
        f"played {report.cycles} cycles, {report.skipped} skipped; started late by "
        f"{1e3 * report.lateness_p50:.2f} ms (median), {1e3 * report.lateness_p99:.2f} ms (99 %)"
    )
    tracking = ", ".join(f"{error:.3f}" for error in report.worst_tracking)
    yield f"largest distance from the path per joint [rad]: {tracking}"
    if np.any(report.missed):
        missed = ", ".join(str(count) for count in report.missed)
        yield f"unanswered commands per joint: {missed}"


def _row(motor: InspectedMotor, joint: DamiaoJoint | None) -> tuple[str, ...]:
    registers = motor.registers
    limits = motor.limits
    mode = int(registers.get(protocol.CTRL_MODE, 0))
    replies = "/".join(f"{i:#x}" for i in sorted(set(motor.reply_ids)))
    feedback = motor.feedback
    return (
        f"{motor.can_id}{' ' + motor.channel if motor.channel else ''}",
        replies
        if len(motor.reply_ids) == 1
        else f"{replies} (x{len(motor.reply_ids)})",
        protocol.MODES.get(mode, "?"),
        *(f"{value or np.nan:g}" for value in limits),
        _type_name(limits, joint),
        f"{1e3 * registers.get(protocol.TIMEOUT, 0.0) * protocol.TIMEOUT_UNIT:g} ms",
        f"{registers.get(protocol.GR, np.nan):g}",
        f"{feedback.temperature_mos[0]}/{feedback.temperature_rotor[0]}"
        if feedback
        else "?",
        protocol.status_text(int(feedback.status[0])) if feedback else "does not tell",
    )


def _type_name(limits: tuple[float, float, float], joint: DamiaoJoint | None) -> str:
    if joint is None:
        return " or ".join(matching_types(limits)) or "unknown"
    agrees = limits_agree(joint.spec.limits, limits)
    return joint.motor_type if agrees else f"not {joint.motor_type}!"
