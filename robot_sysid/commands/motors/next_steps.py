"""What to do after a motors command: rehearse, check, play slowly, play and record, identify."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robot_sysid.commands.motors.session import Session
from robot_sysid.damiao.settings import Plan
from robot_sysid.model import ModelOptions
from robot_sysid.records.file_access import plan_settings
from robot_sysid.records.messages import NextStep
from robot_sysid.records.option_fields import command_arguments
from robot_sysid.results.next_steps import (
    EMPTY_NAME,
    PAYLOAD_RECORDINGS,
    RunWords,
    step_after_recording,
)

USUAL_CHANNEL = "can0"
"""CAN interface in a printed command where the user has named none."""
_FIRST_SPEED = 0.3
"""Share of its speed with which a motion is played for the first time."""

_BETWEEN = (
    "Next, bolt on what is to be weighed, and play it again",
    "Next, play it once more like this",
    "Next, take off again what is to be weighed, and play it",
)
"""What to do after each of the recordings of a payload but the last one."""


def play_step(session: Session, plan: Plan) -> NextStep:
    """Return the step that plays a plan's trajectory, slowly unless a speed was given.

    Options that were not given get the usual channel, a low speed and a recording beside the
    trajectory.
    """
    defaults = {
        "channel": (USUAL_CHANNEL,),
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
    record = plan.recording.record
    folder = plan.trajectory.path.parent
    settings = None
    if not plan.trajectory.has_two_arms:
        settings = plan_settings(folder)
    planned = {} if settings is None else settings[1]
    if not is_real:
        # The rehearsal's model stands for the arm; the motion was planned with another one.
        missing = {} if "channel" in session.values else {"channel": (USUAL_CHANNEL,)}
        command = session.command("check", "speed", "record", **missing)
        sentence = "Next, with the arm connected, check its motors"
        if missing:
            sentence += f" (at {USUAL_CHANNEL}; change --channel for another)"
        return NextStep(sentence, command)
    is_weighing = planned.get("for_") == "payload"
    if record is None or plan.settings.speed < 1.0:
        # The option --speed is left out.
        name = EMPTY_NAME if is_weighing else "measured.csv"
        command = session.command("play", "speed", record=folder / name)
        sentence = "Next, play it at full speed and record it, to identify from"
        if is_weighing:
            sentence = "Next, without what is bolted on, play it at full speed"
        return NextStep(sentence, command)
    if is_weighing and record.name in PAYLOAD_RECORDINGS[:-1]:
        number = PAYLOAD_RECORDINGS.index(record.name)
        following = record.with_name(PAYLOAD_RECORDINGS[number + 1])
        return NextStep(_BETWEEN[number], session.command("play", record=following))
    run = _planned_run(session, record, planned)
    return step_after_recording(run, record, str(planned.get("for_", "link")))


def _planned_run(
    session: Session, record: Path, planned: Mapping[str, Any]
) -> RunWords:
    """Return what an identification of a recorded motion repeats.

    Args:
        session: run of the command, whose model is that of the arm.
        record: the recording; without a plan, results go to a folder of its name.
        planned: options of the plan of the motion; {} where they are not known.
    """
    arm = session.values
    model = arm.get("model")
    if model is None:
        arm = planned
        model = planned.get("path", "arm.xml")
    folder = record.parent if planned else record.with_suffix("")
    arm_words = command_arguments(arm, ModelOptions)
    is_static = bool(planned.get("static", False))
    return RunWords(str(model), tuple(arm_words), folder=folder, is_static=is_static)
