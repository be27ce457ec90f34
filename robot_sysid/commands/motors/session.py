"""One run of a ``robot-sysid motors`` command: its options, questions to a person and tables."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from robot_sysid.commands import PROGRAM, Console
from robot_sysid.damiao.bus import GuardedLink, InspectedMotor, Inspection, inspect_bus
from robot_sysid.damiao.execution import RUN_OPTIONS, MotorRun, run
from robot_sysid.damiao.joints import DamiaoJoint, matching_types
from robot_sysid.damiao.player import PlayReport, StopRequest
from robot_sysid.damiao.preflight import require_playable
from robot_sysid.damiao.protocol import MODES, TIMEOUT_UNIT, Register, status_text
from robot_sysid.damiao.references import Activity
from robot_sysid.damiao.settings import Plan
from robot_sysid.errors import InputError
from robot_sysid.pipeline.next_steps import step_after, step_with_motion
from robot_sysid.records.file_access import plan_settings
from robot_sysid.records.messages import Level, NextStep, Remark, aligned_lines
from robot_sysid.records.option_fields import (
    OptionRecord,
    command_arguments,
    option,
    record_from,
)

USUAL_CHANNEL = "can0"
"""CAN interface in a printed command where the user has named none."""


def ask(prompt: str) -> str:
    """Return the line that a person types, without blanks around it and in small letters.

    InputError where standard input has ended.
    """
    with contextlib.suppress(EOFError):
        return input(prompt).strip().lower()
    raise InputError("not confirmed: standard input has ended")


_WARNING = (
    "The arm will move. Keep clear of it, keep the emergency stop at hand, and remember that it "
    "sinks when it is disabled. Type yes: "
)


def require_consent() -> None:
    """Ask a person whether the arm may move; InputError where nobody agrees, or can be asked."""
    if not sys.stdin.isatty():
        raise InputError(
            "nobody can confirm: standard input is no terminal; give --yes"
        )
    if ask(_WARNING) != "yes":
        raise InputError("not confirmed; nothing was moved")


@dataclass(frozen=True)
class PlayChoices(OptionRecord):
    """Whether a command that moves an arm asks a person."""

    yes: bool = option(False, "do not ask for confirmation", short="-y")


class Session(MotorRun):
    """One run of a motors command: a run on motors with a console.

    Args:
        values: value of each option that was given, by its key.
        console: prints what happens.

    Attributes:
        console: as given.
        verdict: last lines of the output, which the command sets.
        step: what to do next, the first of the verdict's steps; None where nothing is left to do.
    """

    def __init__(self, values: Mapping[str, Any], console: Console) -> None:
        super().__init__(values)
        self.console = console
        self.verdict: tuple[str, ...] = ()
        self.step: NextStep | None = None

    def conclude(self, verdict: str, *steps: NextStep) -> None:
        """Set the verdict: a line, and what to do next, one step after the other."""
        self.step = steps[0]
        self.verdict = (verdict, *chain.from_iterable(map(NextStep.lines, steps)))

    def command(self, name: str, **changes: Any) -> tuple[str, ...]:
        """Return the words of the motors command ``name`` with the options of this run.

        ``changes`` are values of options, by key, that are added or replaced; None leaves one out.
        """
        values = {**self.values, **changes}
        return (PROGRAM, "motors", name, *command_arguments(values, RUN_OPTIONS))


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
            is_right = joint.spec.name in types
            type_name = joint.motor_type if is_right else f"not {joint.motor_type}!"
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


def check_lines(checks: Sequence[Remark]) -> Iterator[str]:
    """Yield one line per finding."""
    for check in checks:
        mark = "STOP" if check.level is Level.REFUSES else "note"
        yield f"[{mark}] {check.text}"


def run_lines(report: PlayReport) -> Iterator[str]:
    """Yield a summary of a finished run: cycles, lateness, tracking errors, lost answers."""
    yield (
        f"played {report.cycles} cycles, {report.skipped} skipped; started late by "
        f"{1e3 * report.lateness_p50:.2f} ms (median), {1e3 * report.lateness_p99:.2f} ms (99 %)"
    )
    tracking = ", ".join(f"{error:.3f}" for error in report.worst_tracking)
    yield f"largest distance from the path per joint [rad]: {tracking}"
    if np.any(report.missed):
        yield f"unanswered commands per joint: {', '.join(map(str, report.missed))}"


def run_checked(
    session: Session,
    link: GuardedLink,
    plan: Plan,
    inspection: Inspection,
    is_real: bool,
    activity: Activity | None = None,
) -> None:
    """Check a plan on inspected motors, ask the user, run it, and print how it went.

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
    checks = session.checks(plan)
    checks += session.inspection_checks(plan, inspection, is_real)
    table = motor_table(inspection.motors.values(), plan.trajectory.joints)
    console.stage(*table, *check_lines(checks))
    require_playable(checks)
    if is_real and not record_from(PlayChoices, session.values).yes:
        require_consent()
        # The arm may have moved or been touched in the meantime.
        inspection = inspect_bus(link)
        require_playable(session.inspection_checks(plan, inspection))
    holding = session.holding(plan)
    report = run(
        link, plan, inspection, StopRequest(), console.stage, holding, activity
    )
    console.stage(*run_lines(report))


def play_step(session: Session, plan: Plan) -> NextStep:
    """Return the step that plays a plan's trajectory, slowly unless a speed was given.

    Options that were not given get the usual channel, a low speed and a recording beside the
    trajectory.
    """
    options = {
        "channel": USUAL_CHANNEL,
        "speed": 0.3,
        "record": plan.trajectory.path.with_name("slow.csv"),
        **session.values,
    }
    sentence = "Next, play it slowly"
    if "channel" not in session.values:
        sentence += f", on the arm at {USUAL_CHANNEL} (change --channel for another)"
    return NextStep(sentence, session.command("play", **options))


def step_after_play(session: Session, plan: Plan) -> NextStep:
    """Return the step after a trajectory was played on motors: play it again, or identify."""
    folder = plan.trajectory.path.parent
    planned = plan_settings(folder)
    purpose = planned.get("for_", "")
    record = plan.recording.record
    is_slow = record is None or plan.settings.speed < 1.0
    log = record or folder / "measured.csv"
    if is_slow and purpose != "payload":
        command = session.command("play", speed=None, record=folder / "measured.csv")
        sentence = "Next, play it at full speed and record it, to identify from"
        return NextStep(sentence, command)
    model = session.values.get("model")
    values = {**session.values, "path": model} if model else planned
    results = log.parent if planned else log.with_suffix("")
    values = {"path": "arm.xml", **values}
    return step_with_motion("motion recorded", purpose, values, results, log)


def steps_after_rehearsal(session: Session, plan: Plan) -> list[NextStep]:
    """Return the steps after a trajectory was played on a simulated arm.

    The arm is identified from a recording at full speed, and then real motors are checked. The
    torque of a simulated arm is computed, which has to be accepted where it has no friction.
    """
    steps = []
    record = plan.recording.record
    if record is not None and plan.settings.speed >= 1.0:
        values = {**session.values, "path": session.values["model"]}
        words = ["--accept", "computed"]
        if plan_settings(plan.trajectory.path.parent).get("for_") == "arm":
            words.append("--links")
        folder = record.with_suffix("")
        step = step_after("motion recorded", values, *words, log=record, folder=folder)
        sentence = (
            "Next, identify the simulated arm from it, to see what the motion tells"
        )
        steps.append(replace(step, sentence=sentence))
    unrecorded = {"speed": None, "record": None, "overwrite": None}
    options = {"channel": USUAL_CHANNEL, **session.values, **unrecorded}
    sentence = "Then" if steps else "Next"
    sentence += ", with the arm connected, check its motors"
    return [*steps, NextStep(sentence, session.command("check", **options))]
