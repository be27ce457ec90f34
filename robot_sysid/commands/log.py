"""``robot-sysid log LOG [MODEL]``: what is in a log, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.commands.console import Console
from robot_sysid.errors import InputError
from robot_sysid.logs import CHECKS, LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.preview import PreviewOptions, require_preview, show_preview
from robot_sysid.records.option_fields import given_options, record_from

INTERRUPTED = "interrupted; nothing was written"
LEFT_OUT = ("measurements", "validation_measurements", "verify_rollout")

READ_ALONE = ("topic", "episode")
"""Keys of options that count without a model."""


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "log",
        "robot-sysid log log.csv arm.xml",
        "Say what is in a log of the real arm: its form, its columns and their units. "
        "With a model, also look for what is wrong with it, as every identification does before it "
        f"fits: {', '.join(CHECKS)}.",
    )
    parser.add_argument(
        "log", metavar="LOG", type=Path, help="file or folder of the recording"
    )
    parser.add_argument(
        "path", metavar="MODEL", type=Path, nargs="?", help="MJCF or URDF file"
    )
    parser.add("model", ModelOptions)
    parser.add("log", LogOptions, leave_out=LEFT_OUT)
    parser.add("preview", PreviewOptions)
    return parser.with_console()


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, console = parsed(build_parser, arguments)
    log = record_from(LogOptions, values)
    preview = record_from(PreviewOptions, values)
    require_preview(preview)
    if values.get("path") is not None:
        return _checked(values, log, preview, console)
    records = preview, log, record_from(ModelOptions, values)
    for each in (given for record in records for given in given_options(record)):
        if each.key not in READ_ALONE:
            raise InputError(f"{each.flag} needs the MODEL after the log")
    from robot_sysid.logs.reader import content_lines

    lines = content_lines(values["log"], log, console)
    console.stage(*lines)
    console.result({"log": str(values["log"]), "content": lines})
    return 0


def _checked(
    values: Mapping[str, Any],
    options: LogOptions,
    preview: PreviewOptions,
    console: Console,
) -> int:
    from robot_sysid.diagnosis.log_checks import check_against_model, require_acceptable
    from robot_sysid.logs.reader import open_log
    from robot_sysid.parser import load_robot_model

    model = record_from(ModelOptions, values)
    path = values["path"]
    robot = load_robot_model(path, model.mesh_dir, model.joint, keyframe=model.keyframe)
    log = open_log(robot, values["log"], options, console)
    console.stage(*map(str, log.notes))  # details are what is asked for here
    rate = (len(log.samples) - 1) / log.duration
    console.stage(
        f"{len(log.samples)} samples in {log.duration:.4g} s, {rate:.4g} Hz on average"
    )
    found = check_against_model(robot, log.pieces, divided=log.torque_scale)
    console.stage(*(each.line() for each in found))
    if preview.view or preview.video:
        from robot_sysid.preview.film import log_preview

        show_preview(robot, log_preview(robot, log.samples), preview, console)
    named = [{**vars(each), "level": each.level.value} for each in found]
    about = {"samples": len(log.samples), "duration": log.duration, "sample_rate": rate}
    console.result(
        {"log": str(log.path), **about, "notes": log.notes, "findings": named}
    )
    require_acceptable(str(log.path), found, options.accept)
    console.stage("Usable: nothing that stops an identification was found")
    console.stage(
        f"Next: robot-sysid identify {quote(str(path))} {quote(str(log.path))}"
    )
    return 0
