"""One run of a ``robot-sysid motors`` command: its options, questions to a person and tables."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from robot_sysid.commands import PROGRAM, Console
from robot_sysid.damiao.bus import GuardedLink, InspectedMotor, Inspection, inspect_bus
from robot_sysid.damiao.checks.preflight import (
    LOOK_AT_BUS,
    NOTED_LOSS,
    require_playable,
)
from robot_sysid.damiao.execution import (
    COMPUTER,
    RUN_OPTIONS,
    Equipment,
    MotorRun,
    RunOptions,
    run,
)
from robot_sysid.damiao.joints import DamiaoJoint, matching_types
from robot_sysid.damiao.player import PlayReport, StopRequest
from robot_sysid.damiao.protocol import MODES, TIMEOUT_UNIT, Register, status_text
from robot_sysid.damiao.references import Activity
from robot_sysid.damiao.settings import Plan
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records.messages import Detail, Level, NextStep, Remark, aligned_lines
from robot_sysid.records.option_fields import OptionRecord, command_arguments, option

USUAL_CHANNEL = "can0"
"""CAN interface in a printed command where the user has named none."""


def ask(prompt: str) -> str:
    """Return the line that a person types, without blanks around it and in small letters.

    InputError where standard input has ended.
    """
    with contextlib.suppress(EOFError):
        return input(prompt).strip().lower()
    raise InputError("not confirmed: standard input has ended")


_USUAL_ARM = (
    "The simulated arm has links and rotors that differ from the model's as they usually do, and "
    "friction of which the model knows nothing; --plant-model FILE is exactly the arm of a file"
)
_WARNING = (
    "The arm will move. Keep clear of it, keep the emergency stop at hand, and remember that it "
    "sinks when it is disabled. Type yes: "
)


@dataclass(frozen=True)
class PlayChoices(OptionRecord):
    """Whether a command that moves an arm asks a person."""

    yes: bool = option(False, "do not ask for confirmation", short="-y")


class Session(MotorRun):
    """One run of a motors command: a run on motors with a console.

    Args:
        options: of the run.
        console: prints what happens.
        choices: whether a person is asked before the arm moves.
        equipment: clock and adapters.

    Attributes:
        console, choices: as given.
        verdict: last lines of the output, which the command sets.
        step: what to do next, the first of the verdict's steps; None where nothing is left to do.
    """

    def __init__(
        self,
        options: RunOptions,
        console: Console,
        choices: PlayChoices = PlayChoices(),
        equipment: Equipment = COMPUTER,
    ) -> None:
        super().__init__(options, equipment)
        self.console = console
        self.choices = choices
        self.verdict: tuple[str, ...] = ()
        self.step: NextStep | None = None

    @property
    def simulates_usual_arm(self) -> bool:
        """Whether a simulated arm is the usual one, and not that of another model."""
        return self.options.plant.plant_model is None

    def conclude(self, verdict: str, *steps: NextStep) -> None:
        """Set the verdict: a line, and what to do next, one step after the other."""
        self.step = steps[0]
        self.verdict = (verdict, *chain.from_iterable(map(NextStep.lines, steps)))

    def step_to(
        self, name: str, sentence: str, *words: str, **changes: Any
    ) -> NextStep:
        """Return the step to the motors command ``name`` with the options given to this run.

        Args:
            name: of the command.
            sentence: says what to do.
            words: further words of the command.
            changes: values of options, by key, that are added or replaced; None leaves one out.
        """
        arguments = command_arguments({**self.options.given, **changes}, RUN_OPTIONS)
        return NextStep(sentence, (PROGRAM, "motors", name, *arguments, *words))


_HEADINGS = "id reply mode PMAX VMAX TMAX type watchdog rad rad/s N·m degC state"


def motor_table(
    motors: Iterable[InspectedMotor], joints: Sequence[DamiaoJoint] = ()
) -> list[str]:
    """Return the lines of a table of inspected motors: headings, then one row per motor.

    ``joints`` are those of the trajectory, with whose motor types the motors are compared.
    """
    joint_by_id = {joint.can_id: joint for joint in joints}
    rows = [_HEADINGS.split()]
    for motor in motors:
        registers = motor.registers
        replies = "/".join(f"{i:#x}" for i in sorted(set(motor.reply_ids)))
        if len(motor.reply_ids) != 1:
            replies += f" (x{len(motor.reply_ids)})"
        types = matching_types(motor.limits)
        type_name = " or ".join(types) or "unknown"
        joint = joint_by_id.get(motor.can_id)
        if joint is not None:
            type_name = joint.motor_type
            if joint.spec.name not in types:
                type_name = f"not {type_name}!"
        state = [*"????", "does not tell"]
        if motor.feedback is not None:
            # Position, velocity and torque are between them.
            values = (value[0] for value in vars(motor.feedback).values())
            status, *signals, mos, rotor = values
            state = [f"{signal:.3f}" for signal in signals]
            state += [f"{mos}/{rotor}", status_text(status)]
        row = [
            str(motor.can_id),
            replies,
            MODES.get(int(registers.get(Register.CTRL_MODE, 0)), "?"),
            *(f"{limit or np.nan:g}" for limit in motor.limits),
            type_name,
            f"{1e3 * TIMEOUT_UNIT * registers.get(Register.TIMEOUT, 0.0):g} ms",
        ]
        rows.append(row + state)
    return aligned_lines(rows)


_STATUS_HEADING = "status"
_ERROR_FRAMES = "error frames on the bus: {}"


def inspected_health(inspection: Inspection) -> list[str]:
    """Return the lines of a table: how an inspection's motors answered when all were asked at once.

    It is empty where they were not asked, because the state of one of them is not known.
    """
    rows = [["bus health", "asked", "came", "after ms", "slowest ms", _STATUS_HEADING]]
    for motor in inspection.motors.values():
        if motor.feedback is None or not motor.answer_times:
            continue
        times = np.array(motor.answer_times)
        came = times[np.isfinite(times)]
        median, slowest = (
            (f"{1e3 * time:.2f}" for time in (np.median(came), np.max(came)))
            if came.size
            else ("?", "?")
        )
        counts = str(times.size), str(came.size)
        status = status_text(motor.feedback.status[0])
        rows.append([motor.name, *counts, median, slowest, status])
    errors = _ERROR_FRAMES.format(inspection.error_frames)
    return [*_table(rows), errors] if len(rows) > 1 else []


def run_health(report: PlayReport, joints: Sequence[DamiaoJoint]) -> list[str]:
    """Return lines that say how the motors of joints answered in a run.

    One line where every command was answered and nothing else was seen, else a table.
    """
    if report.is_flawless:
        return ["every command was answered"]
    headings = (
        *("bus health", "commands", "lost", "lost %", "late", "refused"),
        _STATUS_HEADING,
    )
    rows: list[Sequence[str]] = [headings]
    lost = 100.0 * report.n_lost / np.maximum(report.commands, 1)
    shares = [f"{share:.1f}" for share in lost]
    counts = report.commands, report.n_lost, shares, report.late, report.refused
    for joint, reports, *numbers in zip(joints, report.reports, *counts):
        status = ", ".join(
            f"{status_text(code)} ({n} times)" for code, n in sorted(reports.items())
        )
        rows.append([joint.label, *map(str, numbers), status or "-"])
    lines = [*_table(rows), _ERROR_FRAMES.format(report.error_frames)]
    if report.lost_share >= NOTED_LOSS:
        lines.append(
            f"{100.0 * report.lost_share:.1f} % of the commands were not answered; {LOOK_AT_BUS}"
        )
    return lines


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return aligned rows of which the first and the last column are texts, the others numbers."""
    return aligned_lines(rows, right_aligned=rows[0][1:-1])


def conclude_on_reports(
    session: Session, report: PlayReport, joints: Sequence[DamiaoJoint]
) -> int:
    """Return the exit code of a run that went to its end: 1 where a motor reported a fault.

    A motor may go on driving meanwhile. Then the verdict says which status was reported how often.
    """
    faults = [
        f"{joint.label} reported {status_text(code)} in {n} answers"
        for joint, reports in zip(joints, report.confirmed_reports)
        for code, n in reports.items()
    ]
    if not faults:
        return 0
    session.step = None
    session.verdict = (
        f"Not usable: {'; '.join(faults)}; played to the end, and all motors are disabled",
        "Find the cause, then switch the motor's power off and on",
    )
    return 1


def findings(
    session: Session, plan: Plan, inspection: Inspection | None, is_real: bool = True
) -> list[Remark]:
    """Return all remarks on a plan, and print them, below a table of the inspected motors.

    Without an inspection only the plan is judged. ``is_real`` is whether its motors are real ones.
    """
    remarks = session.checks(plan)
    if inspection is not None:
        remarks += session.inspection_checks(plan, inspection, is_real)
        motors = inspection.motors.values()
        lines = motor_table(motors, plan.trajectory.joints)
        lines += inspected_health(inspection)
        # Simulated motors are as the files say.
        session.console.stage(*(lines if is_real else map(Detail, lines)))
    for remark in remarks:
        mark = "STOP" if remark.level is Level.REFUSES else "note"
        session.console.stage(f"[{mark}] {remark.text}")
    return remarks


def check_and_run(
    session: Session,
    link: GuardedLink,
    plan: Plan,
    inspection: Inspection,
    is_real: bool,
    activity: Activity | None = None,
) -> PlayReport:
    """Check a plan on inspected motors, ask the user, run it, print how it went and return that.

    When the user has confirmed, the motors are inspected and checked once more.

    Args:
        session: run of the command.
        link: link of the motors' bus.
        plan: the plan.
        inspection: answers of the motors.
        is_real: whether the motors are real ones.
        activity: what the arm does; None plays the trajectory.

    Raises:
        HardwareAbort: a check forbids the run, or the run was stopped.
        InputError: the user does not confirm, or the recording cannot be written.
    """
    console = session.console
    if not is_real and session.simulates_usual_arm:
        console.stage(_USUAL_ARM)
    require_playable(findings(session, plan, inspection, is_real))
    if is_real and not session.choices.yes:
        if not sys.stdin.isatty():
            raise InputError(
                "nobody can confirm: standard input is no terminal; give --yes"
            )
        if ask(_WARNING) != "yes":
            raise InputError("not confirmed; nothing was moved")
        # The arm may have moved or been touched in the meantime.
        inspection = inspect_bus(link)
        require_playable(session.inspection_checks(plan, inspection))
    holding = session.holding(plan)
    joints = plan.trajectory.joints
    stop = StopRequest(outputs=(sys.stdout, sys.stderr))
    try:
        report = run(link, plan, inspection, stop, console.stage, holding, activity)
    except HardwareAbort as stopped:
        # No error of printing may hide what happened to the motors.
        with contextlib.suppress(Exception):
            if stopped.report is not None:
                console.stage(*run_health(stopped.report, joints))
        raise
    tracking = ", ".join(f"{error:.3f}" for error in report.worst_tracking)
    timing = (
        f"played {report.cycles} cycles, {report.skipped} skipped; started late by "
        f"{1e3 * report.lateness_p50:.2f} ms (median), {1e3 * report.lateness_p99:.2f} ms (99 %)"
    )
    console.stage(
        timing if report.skipped else Detail(timing),
        f"largest distance from the path per joint [rad]: {tracking}",
        *run_health(report, joints),
    )
    return report
