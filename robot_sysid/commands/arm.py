"""``robot-sysid arm MODEL LOG...``: identify every link of the arm from logs of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from robot_sysid.commands.arguments import ConsoleOptions, Parser, exit_codes, parsed
from robot_sysid.commands.console import Console
from robot_sysid.commands.run import INTERRUPTED, add_model, warnings_as_notes
from robot_sysid.config import ModelOptions, OutputOptions
from robot_sysid.errors import SysidError
from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.logs.options import LogOptions
from robot_sysid.records.options import record_from

__all__ = ["INTERRUPTED", "build_parser", "main"]

MAIN = (
    *("mesh_dir", "joint", "output_dir", "columns", "units", "torque_scale"),
    *("validation_measurements", "cutoff", "friction_model", "coupling", "model_weight"),
)


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "arm",
        "robot-sysid arm arm.xml log1.csv log2.csv --validation-measurements log3.csv",
        description="Identify every link of the arm, with friction and rotor inertia of every "
        "joint, from one log or several together, and write a corrected model.",
        epilog=exit_codes(0, 1, 2, 130),
        main=None if full else MAIN,
    )
    add_model(parser)
    parser.add_argument(
        "measurements", metavar="LOG", nargs="+", type=Path, help="CSV file of the real arm"
    )
    parser.add("model and output", ModelOptions, OutputOptions)
    parser.add("logs", LogOptions, leave_out=("measurements",))
    parser.add("estimation", ArmOptions)
    parser.add_console()
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    return _identify(*parsed(build_parser, arguments))


def _identify(values: Mapping[str, Any], options: ConsoleOptions) -> int:
    output, arm = record_from(OutputOptions, values), record_from(ArmOptions, values)
    chosen = record_from(ModelOptions, values)
    logs = record_from(LogOptions, {**values, "measurements": tuple(values["measurements"])})
    console = Console(options.quiet, options.verbose)
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.identify.arm.run import run_arm
    from robot_sysid.parser import load_robot_model

    with warnings_as_notes(console, options.debug):
        path, frame = values["path"], chosen.keyframe
        robot = load_robot_model(path, chosen.mesh_dir, chosen.joint, keyframe=frame)
        for note in robot.notes:
            console.note(note)
        outcome = run_arm(robot, logs, arm, output.output_dir, chosen.mesh_dir, console)
    console.lines(outcome.report_lines(options.verbose))
    if outcome.failure:
        raise SysidError(outcome.failure)
    return 0
