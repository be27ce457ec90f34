"""What to do after a command: a sentence and one command for each state that needs another."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from robot_sysid.logs import LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.records.messages import NextStep
from robot_sysid.records.option_fields import (
    PAYLOAD_ORDER,
    command_arguments,
    options_of_all,
)

_WEIGHED = (
    "payload {model} --empty {folder}/empty.csv {folder}/empty_again.csv --loaded "
    f"{{folder}}/loaded.csv {{folder}}/loaded_again.csv --order {PAYLOAD_ORDER} {{options}} "
    "--output-dir {folder}"
)
_WEIGHING = "payload {model} --empty {empty} --loaded {log} {options} --output-dir {folder}/weighed"
SAME_LOG = "log is fine"
"""State after which the command is about the log that was read."""


class Step(NamedTuple):
    """What to do after a command. Names in braces stand for what ``step_after`` is given for them.

    Attributes:
        sentence: what to do, and what for.
        command: words of the command that does it, behind the program's name.
        reads_same_log: whether it is about the log that was read, so that options of that hold.
        starts_motion: whether it plans or plays a motion, which may start at a keyframe.
    """

    sentence: str
    command: str
    reads_same_log: bool = False
    starts_motion: bool = False


STEPS: Mapping[str, Step] = {
    "self-test passed": Step(
        "Next, plan a motion for the arm, to record it",
        "plan {model} {options} --output-dir {folder}/planned",
        starts_motion=True,
    ),
    "motion planned": Step(
        "Next, play it, record it as {log}, and identify the arm",
        "identify {model} {log} {options} --output-dir {folder}",
    ),
    "motion planned for payload": Step(
        "Next, play it without what is bolted on and record it as {folder}/empty.csv, then twice "
        "with it as {folder}/loaded.csv and {folder}/loaded_again.csv, once more without it as "
        "{folder}/empty_again.csv, and weigh the difference",
        _WEIGHED,
    ),
    "motion planned for servos": Step(
        "Next, play {folder}/goals.csv on the servos, record goals and positions as {log} (with "
        "LeRobot: docs/servos.md), and identify the servos",
        "identify {model} {log} --torque-from position-error {options} --output-dir {folder}",
    ),
    "load not seen": Step(
        "Next, plan a longer motion, which is expected to show it to {share}",
        "plan {model} {options} {plan_options}",
        starts_motion=True,
    ),
    "motion planned for motors": Step(
        "Next, rehearse the motion on simulated motors",
        "motors simulate {trajectory} --model {model} {options} --record {folder}/rehearsed.csv",
        starts_motion=True,
    ),
    SAME_LOG: Step(
        "Next, identify the arm",
        "identify {model} {log} {options}",
        reads_same_log=True,
    ),
    "motion recorded": Step(
        "Next, identify the arm",
        "identify {model} {log} {options} --output-dir {folder}",
    ),
    "torque scales unknown": Step(
        "Next, compare with a known mass",
        "payload {model} --empty {log} --loaded {weight} --known-mass 1 {options} "
        "--save-torque-scale torque_scale/torque_scale.json --output-dir torque_scale",
    ),
    "further motion": Step(
        "If {now} on other motions is too much, plan another motion: with its log about "
        "{expected} there",
        "plan {model} {options} --output-dir {folder}/planned",
        starts_motion=True,
    ),
    "further motion recorded": Step(
        "Record it as {folder}/planned/log{ending}, and identify the arm from all logs",
        "identify {model} {log} {folder}/planned/log{ending} {options} --output-dir {folder}/both",
    ),
    "part bolted on": Step(
        "Next, if what is bolted on can be taken off, record the motion without it as {empty}, and "
        "weigh it by difference",
        _WEIGHING,
    ),
    "part not seen": Step(
        "If something is bolted on all the same, record the motion without it as {empty} and weigh "
        "it by difference",
        _WEIGHING,
    ),
    "servo sizes unknown": Step(
        "Next, fix {mass} kg to the last link at {place} m in the frame of {body}, record the same "
        "motion once more as {folder}/weight{ending}, and fit both: absolute sizes of {joints} "
        "{now} -> {after}",
        "identify {model} {log} {folder}/weight{ending} --torque-from position-error {options} "
        "--output-dir {folder}/weighed",
    ),
    "torque scales known": Step(
        "Next, identify the arm with these torque scales, as in every later run",
        "identify {model} {log} {options} --torque-scale {scales}",
    ),
}
"""State after a command to what to do next."""


def step_after(
    state: str, values: Mapping[str, Any], *further: str, **words: Any
) -> NextStep:
    """Return the sentence and the command of a state in ``STEPS``.

    Args:
        state: of ``STEPS``.
        values: "path" to the model file, and the keys of options to their values. The command
            repeats those that choose the arm and say how its logs are read, but for options that
            it states itself, or that another log lacks.
        further: more arguments of the command.
        words: what fills the other names in braces, a word, a path, or several of them. New
            recordings get the ending of the log that was read.
    """
    step = STEPS[state]
    parts = step.command.split()
    stated = {*parts, *further}
    if not step.starts_motion:
        stated.add("--keyframe")
    if not step.reads_same_log:
        # They hold for one log.
        stated.update(("--episode", "--accept"))
    every = options_of_all(ModelOptions, LogOptions)
    repeated = [option for option in every if option.flag not in stated]
    options = command_arguments(values, repeated)
    words = {"model": values["path"], "options": [*options, *further], **words}
    words["ending"] = _ending_of(words.get("log"))
    words["empty"] = _empty_log_beside(words.get("log"))
    command = ["robot-sysid"]
    for part in parts:
        filling = words.get(part.strip("{}"))
        if isinstance(filling, (list, tuple)):
            command += map(str, filling)
            continue
        filled = part.format(**words)
        command.append(str(Path(filled)) if "{folder}" in part else filled)
    return NextStep(step.sentence.format(**words), tuple(command))


def _ending_of(logs: Any) -> str:
    """Return the ending of new recordings beside a log, or the first of several, as a path.

    It is that of a table of text where there is none, or one that a program holds.
    """
    log = logs[0] if isinstance(logs, (list, tuple)) else logs
    return recording_ending(Path(log)) if isinstance(log, (str, Path)) else ".csv"


def _empty_log_beside(logs: Any) -> str:
    """Return a path for a log of the arm without what is bolted on, beside the log or the first.

    It is of no file that exists, and not in a folder of results, where runs replace files.
    """
    log = logs[0] if isinstance(logs, (list, tuple)) else logs
    folder = Path(log).parent if isinstance(log, (str, Path)) else Path()
    names = (f"empty{number or ''}{_ending_of(logs)}" for number in itertools.count())
    return str(next(p for p in map(folder.joinpath, names) if not os.path.lexists(p)))


def recording_ending(log: Path) -> str:
    """Return what ends the names of recordings of a log's form; "" for folders, such as bags."""
    return "" if os.path.isdir(log) else log.suffix


def step_with_motion(
    state: str, purpose: str, values: Mapping[str, Any], folder: Path, log: Path
) -> NextStep:
    """Return what to do with a motion: identify the arm, or weigh a payload, from logs of it.

    Args:
        state: of ``STEPS``, where the motion is for no payload.
        purpose: what the motion was planned for.
        values: see ``step_after``.
        folder: for the logs and the results.
        log: that the motion is recorded in.
    """
    if purpose == "payload":
        return step_after("motion planned for payload", values, folder=folder)
    return step_after(state, values, folder=folder, log=log)
