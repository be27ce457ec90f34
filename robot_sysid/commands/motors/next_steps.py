"""What to do after a motors command: check, play slowly, play and record, identify."""

from __future__ import annotations

from robot_sysid.commands.motors.session import Session
from robot_sysid.damiao.settings import Plan
from robot_sysid.model import ModelOptions
from robot_sysid.records.file_access import plan_settings
from robot_sysid.records.messages import NextStep
from robot_sysid.records.option_fields import command_arguments
from robot_sysid.results.next_steps import step_after

USUAL_CHANNEL = "can0"
"""CAN interface in a printed command where the user has named none."""
_FIRST_SPEED = 0.3
"""Share of its speed with which a motion is played for the first time."""


def play_step(session: Session, plan: Plan) -> NextStep:
    """Return the step that plays a plan's trajectory, slowly unless a speed was given.

    Options that were not given get the usual channel, a low speed and a recording beside the
    trajectory.
    """
    defaults = {
        "channel": USUAL_CHANNEL,
        "speed": _FIRST_SPEED,
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
        command = session.command("check", speed=None, record=None, channel=channel)
        return NextStep("Next, with the arm connected, check its motors", command)
    folder = plan.trajectory.path.parent
    settings = plan_settings(folder)
    planned = {} if settings is None else settings[1]
    is_payload = planned.get("for_") == "payload"
    record = plan.recording.record or folder / "measured.csv"
    is_slow = plan.recording.record is None or plan.settings.speed < 1.0
    if is_slow and not is_payload:
        sentence = "Next, play it at full speed and record it, to identify from"
        record = folder / "measured.csv"
        return NextStep(sentence, session.command("play", speed=None, record=record))
    arm = session.values if session.values.get("model") else planned
    options = command_arguments(arm, ModelOptions)
    state = "motion recorded"
    if is_payload:
        state = "motion planned for payload"
    elif planned.get("for_") == "arm":
        options.append("--links")
    return step_after(
        state,
        model=str(arm.get("model") or arm.get("path", "arm.xml")),
        log=str(record),
        options=options,
        folder=record.parent if planned else record.with_suffix(""),
    )
