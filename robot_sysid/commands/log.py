"""``robot-sysid log LOG MODEL``: what is in a log, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from robot_sysid.commands import Console
from robot_sysid.commands.arguments import Parser, parse_command
from robot_sysid.commands.remedies import add_commands, add_weighing
from robot_sysid.errors import ColumnsError, InputError
from robot_sysid.logs import CHECKS, LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.pipeline.next_steps import step_after, values_of
from robot_sysid.records.option_fields import given_values, record_from

INTERRUPTED = "interrupted; nothing was written"
"""What is said where the user interrupts the command."""


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command, whose help always has all options."""
    parser = Parser(
        "log",
        "robot-sysid log log.csv arm.xml",
        "Say what is in a log of the real arm: its form, its columns and their units, and look for "
        f"what is wrong with it, as every identification does: {', '.join(CHECKS)}.",
    )
    parser.add_argument(
        "log", metavar="LOG", type=Path, help="file or folder of the recording"
    )
    parser.add_argument("path", metavar="MODEL", type=Path, help="MJCF or URDF file")
    parser.add("model", ModelOptions, only=("mesh_dir", "joint", "mass_scale"))
    parser.add("log", LogOptions)
    return parser.add_console_options()


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, console = parse_command(build_parser, arguments)
    log_options = record_from(LogOptions, values)
    model_options = replace(record_from(ModelOptions, values), path=values["path"])
    path = values["log"]
    repeated = {**vars(model_options), **vars(log_options)}
    try:
        _check_log(path, log_options, model_options, console)
    except InputError as error:
        if error.command == "payload":
            add_weighing(error, values_of(model_options, log_options), path)
        # Only that command has these options, or who has stated columns goes on to it.
        elif error.command == "identify" or isinstance(error, ColumnsError):
            add_commands(error, "log is fine", repeated, log=path)
        raise
    console.stage("Usable: nothing that stops an identification was found")
    console.stage(*step_after("log is fine", repeated, log=path).lines())
    return 0


def _check_log(
    path: Path, log_options: LogOptions, model_options: ModelOptions, console: Console
) -> None:
    """Print a log's findings against a model.

    Args:
        path: of the log.
        log_options: how the log is read, and which findings are accepted.
        model_options: the model, and the arm in it.
        console: prints the findings, and their JSON.

    Raises:
        SysidError: a finding is not accepted; raised when all is printed.
    """
    from robot_sysid.config import with_scale_prior
    from robot_sysid.diagnosis.gate import judge, require_acceptable
    from robot_sysid.estimate.options import EstimationOptions
    from robot_sysid.estimate.questions import Question
    from robot_sysid.logs.reader import open_log
    from robot_sysid.parser import load_robot_model

    robot = load_robot_model(model_options.path, **given_values(model_options))
    log = open_log(robot, path, log_options, console)
    console.stage(*map(str, log.notes))  # As plain text: details are printed here.
    count = len(log.samples)
    rate = (count - 1) / log.duration
    console.stage(f"{count} samples in {log.duration:.4g} s, {rate:.4g} Hz on average")
    options = with_scale_prior(EstimationOptions(), log_options, robot.joint_names)
    findings = judge(robot, [log], Question(options), console).findings
    console.stage(*(finding.line() for finding in findings))
    console.result(
        {
            "log": str(log.path),
            "samples": count,
            "duration": log.duration,
            "sample_rate": rate,
            "notes": log.notes,
            "findings": [{**asdict(f), "level": f.level.value} for f in findings],
        }
    )
    require_acceptable([log], findings, log_options.accept)
