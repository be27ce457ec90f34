"""One run of a ``robot-sysid motors`` command: its options, questions to a person and tables."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_sysid.commands import PROGRAM, Console
from robot_sysid.damiao import protocol
from robot_sysid.damiao.bus import GuardedLink, InspectedMotor, Inspection, inspect_bus
from robot_sysid.damiao.execution import RUN_OPTIONS, MotorRun, run
from robot_sysid.damiao.joints import DamiaoJoint, limits_agree, matching_types
from robot_sysid.damiao.player import PlayReport, StopRequest
from robot_sysid.damiao.preflight import require_playable
from robot_sysid.damiao.references import Activity
from robot_sysid.damiao.settings import Plan
from robot_sysid.errors import InputError
from robot_sysid.pipeline.next_steps import step_with_motion
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
    """Return the line that a person types; InputError where standard input has ended."""
    with contextlib.suppress(EOFError):
        return input(prompt)
    raise InputError("not confirmed: standard input has ended")


_WARNING = (
    "The arm will move. Keep clear of it, keep the emergency stop at hand, and remember that it "
    "sinks when it is disabled. Type yes: "
)


def confirm() -> bool:
    """Return whether a person agrees that the arm moves.

    InputError where standard input is no terminal.
    """
    if not sys.stdin.isatty():
        raise InputError(
            "nobody can confirm: standard input is no terminal; give --yes"
        )
    return ask(_WARNING).strip().lower() == "yes"


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
        step: what to do next, as the verdict states it; None where nothing is left to do.
    """

    def __init__(self, values: Mapping[str, Any], console: Console) -> None:
        super().__init__(values)
        self.console = console
        self.verdict: tuple[str, ...] = ()
        self.step: NextStep | None = None

    def conclude(self, verdict: str, step: NextStep) -> None:
        """Set the verdict: a line, and what to do next."""
        self.step = step
        self.verdict = (verdict, *step.lines())

    def command(self, name: str, **changes: Any) -> tuple[str, ...]:
        """Return the words of the motors command ``name`` with the options of this run.

        ``changes`` are values of options, by key, that are added or replaced; None leaves one out.
        """
        values = {**self.values, **changes}
        return (PROGRAM, "motors", name, *command_arguments(values, RUN_OPTIONS))


_HEADINGS = (
    "id",
    "reply",
    "mode",
    "PMAX",
    "VMAX",
    "TMAX",
    "type",
    "watchdog",
    "rad",
    "rad/s",
    "N·m",
    "degC",
    "state",
)


def motor_table(
    motors: Iterable[InspectedMotor], joints: Sequence[DamiaoJoint] = ()
) -> list[str]:
    """Return the lines of a table of inspected motors: headings, then one row per motor.

    ``joints`` are those of the trajectory, with whose motor types the motors are compared.
    """
    joint_by_id = {joint.can_id: joint for joint in joints}
    rows: list[tuple[str, ...]] = [_HEADINGS]
    for motor in motors:
        registers = motor.registers
        mode = int(registers.get(protocol.Register.CTRL_MODE, 0))
        replies = "/".join(f"{i:#x}" for i in sorted(set(motor.reply_ids)))
        if len(motor.reply_ids) != 1:
            replies += f" (x{len(motor.reply_ids)})"
        watchdog = (
            1e3 * protocol.TIMEOUT_UNIT * registers.get(protocol.Register.TIMEOUT, 0.0)
        )
        measured, heat, status = ["?"] * 3, "?", "does not tell"
        state = motor.feedback
        if state is not None:
            signals = state.position, state.velocity, state.torque
            measured = [f"{values[0]:.3f}" for values in signals]
            heat = f"{state.temperature_mos[0]}/{state.temperature_rotor[0]}"
            status = protocol.status_text(state.status[0])
        rows.append(
            (
                str(motor.can_id),
                replies,
                protocol.MODES.get(mode, "?"),
                *(f"{value or np.nan:g}" for value in motor.limits),
                _type_name(motor.limits, joint_by_id.get(motor.can_id)),
                f"{watchdog:g} ms",
                *measured,
                heat,
                status,
            )
        )
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
    checks: list[Remark],
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
        checks: those of the plan that need no bus.
        inspection: answers of the motors.
        is_real: whether the motors are real ones.
        activity: what the arm does; None plays the trajectory.

    Raises:
        HardwareAbort: a check forbids the run, or the run was stopped.
        InputError: the user does not confirm, or a recording would replace a file.
    """
    console = session.console
    checks += session.inspection_checks(plan, inspection, real=is_real)
    table = motor_table(inspection.motors.values(), plan.trajectory.joints)
    console.stage(*table, *check_lines(checks))
    require_playable(checks)
    if is_real and not record_from(PlayChoices, session.values).yes:
        if not confirm():
            raise InputError("not confirmed; nothing was moved")
        # The arm may have moved or been touched in the meantime.
        inspection = inspect_bus(link)
        require_playable(session.inspection_checks(plan, inspection))
    holding = session.holding(plan)
    stop = StopRequest()
    report = run(link, plan, inspection, stop, console.stage, holding, activity)
    console.stage(*run_lines(report))


def _type_name(limits: tuple[float, ...], joint: DamiaoJoint | None) -> str:
    """Return the names of the motor types with given limits, or whether a joint's type has them.

    Args:
        limits: PMAX, VMAX and TMAX of the motor [rad, rad/s, N m].
        joint: the joint that the motor should drive, with its motor type; None where unknown.
    """
    if joint is None:
        return " or ".join(matching_types(limits)) or "unknown"
    is_same = limits_agree(joint.spec.limits, limits)
    return joint.motor_type if is_same else f"not {joint.motor_type}!"


def play_step(session: Session, plan: Plan) -> NextStep:
    """Return the step that plays a plan's trajectory, slowly unless a speed was given.

    Options that were not given get the usual channel, a low speed and a recording beside the
    trajectory.
    """
    defaults = {
        "channel": USUAL_CHANNEL,
        "speed": 0.3,
        "record": plan.trajectory.path.with_name("slow.csv"),
    }
    missing = {k: v for k, v in defaults.items() if k not in session.values}
    sentence = "Next, play it slowly"
    if "channel" in missing:
        sentence += f", on the arm at {USUAL_CHANNEL} (change --channel for another)"
    return NextStep(sentence, session.command("play", **missing))


def step_after_play(session: Session, plan: Plan, is_real: bool) -> NextStep:
    """Return the step after a trajectory was played: check motors, play again, or identify."""
    if not is_real:
        channel = session.values.get("channel", USUAL_CHANNEL)
        command = session.command(
            "check", speed=None, record=None, overwrite=None, channel=channel
        )
        return NextStep("Next, with the arm connected, check its motors", command)
    folder = plan.trajectory.path.parent
    planned = plan_settings(folder)
    purpose = planned.get("for_", "")
    record = plan.recording.record or folder / "measured.csv"
    is_slow = plan.recording.record is None or plan.settings.speed < 1.0
    if is_slow and purpose != "payload":
        sentence = "Next, play it at full speed and record it, to identify from"
        record = folder / "measured.csv"
        return NextStep(sentence, session.command("play", speed=None, record=record))
    model = session.values.get("model")
    values = {**session.values, "path": model} if model else planned
    return step_with_motion(
        "motion recorded",
        purpose,
        {"path": "arm.xml", **values},
        record.parent if planned else record.with_suffix(""),
        record,
    )
