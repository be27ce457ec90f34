"""``robot-sysid example NAME``: a copy of an example, and the commands that walk through it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robot_sysid.commands import Console
from robot_sysid.commands.arguments import Command
from robot_sysid.config import OutputOptions, SelfTestConfig
from robot_sysid.errors import InputError, error_text
from robot_sysid.records.drafts import temporary_folder
from robot_sysid.records.file_access import claim
from robot_sysid.records.installation import PACKAGE_FOLDER
from robot_sysid.records.messages import shell_word
from robot_sysid.records.option_fields import (
    OptionRecord,
    option,
    options_of_all,
    record_from,
)

EXAMPLES = ("kinova",)
GUESS = "kinova_fullinertia_guess.xml"
TRUTH = "kinova_fullinertia.xml"
LOG = "true_arm.csv"
EMPTY_LOG = "empty_arm.csv"
PLANTS = {LOG: TRUTH, EMPTY_LOG: "kinova_empty_gripper.xml"}
"""Log to the model that is simulated in it."""
RECORDING = {"duration": 15.0, "sample_rate": 200.0, "noise_torque": 0.1}
"""Options of the simulation: a log that is small enough to open in a spreadsheet."""
WALKTHROUGH = {
    "1. Self-test: the model's own numbers have to come back from its own simulation": (
        f"robot-sysid {{model}}/{GUESS}"
    ),
    "2. Identify the true arm from a noisy log of it, starting from the guess": (
        f"robot-sysid identify {{model}}/{GUESS} {{log}} --output-dir found"
    ),
    "3. Weigh a payload: the true arm without and with a steel block of 0.306 kg": (
        f"robot-sysid payload {{model}}/{GUESS} --empty {{empty}} --loaded {{log}} "
        "--output-dir weighed"
    ),
}
"""Heading to command, with the copied files in braces."""


@dataclass(frozen=True)
class ExampleName(OptionRecord):
    """Which example is copied."""

    name: str = option("", ", ".join(EXAMPLES), "NAME", flag="name", choices=EXAMPLES)


def run(values: Mapping[str, Any], console: Console) -> int:
    """Run the command and return its exit code."""
    name = record_from(ExampleName, values).name
    folder = Path(name)
    if "output_dir" in values:
        folder = record_from(OutputOptions, values).output_dir
    if folder.exists():
        raise InputError(
            f"{folder} exists; choose another folder with --output-dir DIR"
        )
    source = source_folder(name)
    console.stage(f"Simulating {len(PLANTS)} logs of the example's arm...")
    # Nothing is in its place, so that the claim is one on the name alone.
    with claim([("example", folder)], console.note):
        _copy_example(source, folder)
    console.stage(f"Example copied to {folder}. What to do with it:")
    names = {"model": "model", "log": LOG, "empty": EMPTY_LOG}
    paths = {key: shell_word(str(folder / name)) for key, name in names.items()}
    commands = []
    for heading, template in WALKTHROUGH.items():
        commands.append(template.format(**paths))
        console.stage("", f"# {heading}", commands[-1])
    console.result({"folder": str(folder), "commands": commands})
    return 0


COMMANDS = (
    Command(
        "example",
        "example kinova",
        "Copy an example out of the package, with two logs of its true arm, and print "
        "the commands that walk through it.",
        {
            "": options_of_all(ExampleName),
            "output": options_of_all(
                OutputOptions, only=("output_dir",), output_dir="the example's name"
            ),
        },
        run,
        main=("output_dir",),
        codes=(0, 2, 130),
    ),
)


def _copy_example(source: Path, folder: Path) -> None:
    """Copy an example and record its logs; the folder appears complete or not at all."""
    ignored = shutil.ignore_patterns("__pycache__", "images")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(folder.parent) as parent:
            draft = shutil.copytree(source, parent / folder.name, ignore=ignored)
            _record_logs(draft / "model", draft)
            os.rename(draft, folder)
    except OSError as error:
        raise InputError(
            f"cannot copy the example to {folder}: {error_text(error)}"
        ) from None


def source_folder(name: str, package: Path = PACKAGE_FOLDER) -> Path:
    """Return an example's folder: in the installed package, or beside it in a checkout."""
    for parent in (package, package.parent):
        folder = parent / "examples" / name
        if (folder / "model").is_dir():
            return folder
    raise InputError(
        f"the example {name} is not in this installation; install it again"
    )


def _record_logs(model_folder: Path, folder: Path) -> None:
    """Simulate the true arm on random trajectories and write its logs into ``folder``."""
    from robot_sysid.pipeline import stages

    for seed, (log, plant) in enumerate(PLANTS.items(), start=1):
        with temporary_folder() as discarded:
            config = SelfTestConfig.of(
                model_folder / GUESS,
                **RECORDING,
                plant_model=model_folder / plant,
                save_measurements=folder / log,
                seed=seed,
                output_dir=discarded,
            )
            stages.run(config)
