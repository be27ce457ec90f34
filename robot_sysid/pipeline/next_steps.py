"""What to do after a command: a sentence and one command for each state that needs another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robot_sysid.logs import LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.motion import PAYLOAD_ORDER
from robot_sysid.records.messages import NextStep
from robot_sysid.records.option_fields import command_arguments, options_of_all

_WEIGHED = (
    "payload {model} --empty {folder}/empty.csv {folder}/empty_again.csv --loaded "
    f"{{folder}}/loaded.csv {{folder}}/loaded_again.csv --order {PAYLOAD_ORDER} {{options}} "
    "--output-dir {folder}"
)
SAME_LOG = "log is fine"
"""State after which the command is about the log that was read."""
STEPS: Mapping[str, tuple[str, str]] = {
    "self-test passed": (
        "Next, plan a motion for the arm, to record it",
        "plan {model} {options} --output-dir {folder}/planned",
    ),
    "motion planned": (
        "Next, play it, record it as {log}, and identify the arm",
        "identify {model} {log} {options} --output-dir {folder}",
    ),
    "motion planned for payload": (
        "Next, play it without what is bolted on and record it as {folder}/empty.csv, then twice "
        "with it as {folder}/loaded.csv and {folder}/loaded_again.csv, once more without it as "
        "{folder}/empty_again.csv, and weigh the difference",
        _WEIGHED,
    ),
    "motion planned for motors": (
        "Next, rehearse the motion on simulated motors",
        "motors simulate {trajectory} --model {model} {options} --record {folder}/rehearsed.csv",
    ),
    SAME_LOG: ("Next, identify the arm", "identify {model} {log} {options}"),
    "motion recorded": (
        "Next, identify the arm",
        "identify {model} {log} {options} --output-dir {folder}",
    ),
    "torque scales unknown": (
        "Next, compare with a known mass",
        "payload {model} --empty {log} --loaded {weight} --known-mass 1 {options} "
        "--save-torque-scale torque_scale/torque_scale.json --output-dir torque_scale",
    ),
    "further motion": (
        "If {now} on other motions is too much, plan a second motion: with both logs about "
        "{expected} is expected there",
        "plan {model} {options} --output-dir {folder}/planned",
    ),
    "further motion recorded": (
        "Record it as {folder}/planned/log.csv, and identify the arm from both logs",
        "identify {model} {log} {folder}/planned/log.csv {options} --output-dir {folder}/both",
    ),
    "part bolted on": (
        "Next, if what is bolted on can be taken off, record {folder}/empty.csv without it and "
        "weigh it by difference: one log shows its mass times its distance far better than its "
        "mass",
        "payload {model} --empty {folder}/empty.csv --loaded {log} {options} --output-dir "
        "{folder}/weighed",
    ),
    "torque scales known": (
        "Next, identify the arm with these torque scales, as in every later run",
        "identify {model} {log} {options} --torque-scale {scales}",
    ),
}
"""State after a command to a sentence on what to do next and the words of the command that does it,
behind the program's name. A name in braces stands for what ``step_after`` is given for it."""


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
        words: what fills the other names in braces, a word, a path, or several of them.
    """
    sentence, template = STEPS[state]
    parts = template.split()
    stated = {*parts, *further}
    if parts[0] in ("identify", "payload"):
        # Only a motion starts at a keyframe.
        stated.add("--keyframe")
    if state != SAME_LOG:
        # They hold for one log.
        stated.update(("--episode", "--accept"))
    every = options_of_all(ModelOptions, LogOptions)
    repeated = [option for option in every if option.flag not in stated]
    options = command_arguments(values, repeated)
    words = {"model": values["path"], "options": [*options, *further], **words}
    command = ["robot-sysid"]
    for part in parts:
        filling = words.get(part.strip("{}"))
        if isinstance(filling, (list, tuple)):
            command += map(str, filling)
            continue
        filled = part.format(**words)
        command.append(str(Path(filled)) if "{folder}" in part else filled)
    return NextStep(sentence.format(**words), tuple(command))


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
