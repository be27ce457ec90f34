"""``robot-sysid log LOG [MODEL]``: what is in a log, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from robot_sysid.commands.arguments import Parser, exit_codes, parsed
from robot_sysid.commands.console import Console
from robot_sysid.config import ModelOptions
from robot_sysid.logs.options import CHECKS, LogOptions
from robot_sysid.records.options import record_from

INTERRUPTED = "interrupted; nothing was written"
LEFT_OUT = ("measurements", "validation_measurements")


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "log",
        "robot-sysid log log.csv arm.xml",
        description="Say what is in a log of the real arm: its form, its columns and their units. "
        "With a model, also look for what is wrong with it, as every identification does before it "
        f"fits: {', '.join(CHECKS)}.",
        epilog=exit_codes(0, 1, 2, 130),
    )
    parser.add_argument("log", metavar="LOG", type=Path, help="file or folder of the recording")
    parser.add_argument("path", metavar="MODEL", type=Path, nargs="?", help="MJCF or URDF file")
    parser.add("model", ModelOptions)
    parser.add("log", LogOptions, leave_out=LEFT_OUT)
    parser.add_console()
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, options = parsed(build_parser, arguments)
    console = Console(options.quiet, options.verbose)
    log = record_from(LogOptions, values)
    if values.get("path") is None:
        from robot_sysid.logs.contents import content_lines

        console.lines(content_lines(values["log"], log, console))
        return 0
    return _checked(values, log, console)


def _checked(values: Mapping[str, Any], options: LogOptions, console: Console) -> int:
    """Look at a log against a model."""
    from robot_sysid.checks.finding import require_acceptable
    from robot_sysid.checks.run import check_against_model
    from robot_sysid.identify.measured import open_log
    from robot_sysid.parser import load_robot_model

    model = values["path"], values.get("mesh_dir"), values.get("joint")
    robot = load_robot_model(*model)
    log = open_log(robot, options, values["log"], console)
    console.lines(log.notes)
    rate = (len(log.samples) - 1) / log.duration
    console.stage(f"{len(log.samples)} samples in {log.duration:.4g} s, {rate:.4g} Hz on average")
    found = check_against_model(robot, log.pieces)
    console.lines(each.line() for each in found)
    require_acceptable(str(log.path), found, options.accept)
    console.stage("nothing that stops an identification was found")
    return 0
