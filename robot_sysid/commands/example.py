"""``robot-sysid example NAME``: a copy of an example, and the commands that walk through it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

import robot_sysid
from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.config import SysidConfig
from robot_sysid.errors import InputError, error_text
from robot_sysid.records.file_access import draft_folder, temporary_folder
from robot_sysid.records.option_fields import (
    OptionRecord,
    option,
    parse_folder,
    record_from,
)

EXAMPLES = ("kinova",)
MAIN = ("output_dir",)
GUESS = "kinova_fullinertia_guess.xml"
TRUTH = "kinova_fullinertia.xml"
LOG = "true_arm.csv"
EMPTY_LOG = "empty_arm.csv"
PLAYED = {LOG: TRUTH, EMPTY_LOG: "kinova_empty_gripper.xml"}
"""Log to the model that plays in it."""
RECORDING = {"duration": 15.0, "sample_rate": 200.0, "noise_torque": 0.1}
"""How they are recorded: small enough to open in a spreadsheet."""
NEXT = {
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


@dataclass(frozen=True)
class ExampleOptions(OptionRecord):
    """Where an example goes."""

    output_dir: Path | None = option(
        None,
        "folder for the copy",
        "DIR",
        parse=parse_folder,
        default_text="the example's name",
    )


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "example",
        "robot-sysid example kinova",
        "Copy an example out of the package, with two logs of its true arm, and print "
        "the commands that walk through it.",
        None if full else MAIN,
        codes=(0, 2, 130),
    )
    parser.add_argument(
        "name", metavar="NAME", choices=EXAMPLES, help=", ".join(EXAMPLES)
    )
    parser.add("output", ExampleOptions)
    return parser.with_console()


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, console = parsed(build_parser, arguments)
    place = record_from(ExampleOptions, values).output_dir or Path(values["name"])
    if place.exists():
        raise InputError(f"{place} exists; choose another folder with --output-dir DIR")
    _copy(_home(values["name"]), place)
    console.stage(f"Example copied to {place}. What to do with it:")
    files = {"model": "model", "log": LOG, "empty": EMPTY_LOG}
    named = {key: quote(str(place / name)) for key, name in files.items()}
    commands = [line.format(**named) for line in NEXT.values()]
    for words, line in zip(NEXT, commands):
        console.stage("", f"# {words}", line)
    console.result({"folder": str(place), "commands": commands})
    return 0


def _copy(home: Path, place: Path) -> None:
    """Let a copy of the example appear, all of it at once."""
    ignored = shutil.ignore_patterns("__pycache__", "images")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with draft_folder(place) as draft:
            shutil.copytree(home, draft, ignore=ignored, dirs_exist_ok=True)
            _record(draft / "model", draft)
            os.rename(draft, place)
    except OSError as error:
        raise InputError(
            f"cannot copy the example to {place}: {error_text(error)}"
        ) from None


def _home(name: str) -> Path:
    """Return an example's folder: in the installed package, or beside it in a checkout."""
    package = Path(robot_sysid.__file__).parent
    for place in (package / "examples" / name, package.parent / "examples" / name):
        if (place / "model").is_dir():
            return place
    raise InputError(
        f"the example {name} is not in this installation; install it again"
    )


def _record(model: Path, place: Path) -> None:
    """Let the true arm of the example play trajectories and write what its sensors say."""
    from robot_sysid.pipeline.stages import run

    for seed, (log, played) in enumerate(PLAYED.items(), start=1):
        arm = {
            "plant_model": model / played,
            "save_measurements": place / log,
            "seed": seed,
        }
        with temporary_folder() as nowhere:
            run(SysidConfig.of(model / GUESS, **RECORDING, **arm, output_dir=nowhere))
