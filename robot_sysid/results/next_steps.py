"""What to do after a command: the file to use, and one command for each state that needs another.

Nothing is suggested after a result that may be used, because what another recording would show is
not known before it is planned.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Union

from robot_sysid.dynamics.inverse_dynamics import MUJOCO_VERSION
from robot_sysid.motion import PAYLOAD_ORDER
from robot_sysid.records import ITSELF
from robot_sysid.records.file_access import CARD_NAME, models_in
from robot_sysid.records.messages import NextStep
from robot_sysid.results.content import Content
from robot_sysid.results.verdict import verdict_line

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


def use_lines(path: Path) -> tuple[str, str, str]:
    """Return which model file to use, which MuJoCo loads it, and a line of Python that does.

    ``path`` is that of the written file, which has been compiled by the installed MuJoCo.
    """
    text = json.dumps(str(path), ensure_ascii=False)
    return (
        f"Use this file: {path}",
        f"  mujoco.MjModel.from_xml_path({text})",
        "It loads in every MuJoCo from 3.0 on that loads your model (checked with "
        f"{MUJOCO_VERSION})",
    )


def last_lines(
    content: Content, files: Sequence[Path], step: NextStep | None
) -> tuple[str, ...]:
    """Return the last lines of the console: the verdict, which files to use, and the next step.

    Args:
        content: of params.json.
        files: the written files, among them the model and a payload's card.
        step: the next step, or None.
    """
    lines = [verdict_line(content)]
    if content["failure"] is not None:
        return tuple(lines)
    # A self-test writes back what its model says already.
    if content["source"] != ITSELF:
        for path in models_in(files)[:1]:
            lines += use_lines(path)
    if content["payload"] is not None:
        flange = content["payload"]["flange"]["name"]
        start = f"Copy into the controller, in the frame of {flange}"
        lines += [f"{start}: {path}" for path in files if path.name == CARD_NAME]
    lines += step.lines() if step else ()
    return tuple(lines)
