"""What to do after a command: a sentence and one command for each state that needs another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Union

from robot_sysid.motion import PAYLOAD_ORDER
from robot_sysid.records.messages import NextStep

_WEIGHED = (
    "payload {model} --empty {folder}/empty.csv {folder}/empty_again.csv --loaded "
    f"{{folder}}/loaded.csv {{folder}}/loaded_again.csv --order {PAYLOAD_ORDER} {{options}} "
    "--output-dir {folder}"
)
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
        "motors simulate {trajectory} --model {model} {options}",
    ),
    "log is fine": ("Next, identify the arm", "identify {model} {log} {options}"),
    "motion recorded": (
        "Next, identify the arm",
        "identify {model} {log} {options} --output-dir {folder}",
    ),
    "torque scales unknown": (
        "Next, compare with a known mass",
        "payload {model} --empty {log} --loaded {weight} --known-mass 1 {options} "
        "--save-torque-scale torque_scale/torque_scale.json --output-dir torque_scale",
    ),
    "mass not known": (
        "Next, plan a motion that shows the mass better, and compare the ± that it promises",
        "plan {model} {options} --output-dir {folder}/planned",
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
Words = Union[str, Path, Sequence[str]]
"""What fills a place of a template: a word, or several of them."""


def step_after(state: str, **words: Words) -> NextStep:
    """Return the sentence and the command of a state in ``STEPS``, filled with words."""
    sentence, template = STEPS[state]
    command = ["robot-sysid"]
    for part in template.split():
        filling = words.get(part.strip("{}"))
        if isinstance(filling, (list, tuple)):
            command += filling
            continue
        filled = part.format(**words)
        command.append(str(Path(filled)) if "{folder}" in part else filled)
    return NextStep(sentence.format(**words), tuple(command))
