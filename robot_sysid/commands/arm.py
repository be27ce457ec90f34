"""``robot-sysid arm MODEL LOG...``: identify every link of the arm from logs of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from robot_sysid.commands.arguments import ConsoleOptions, Parser, parsed
from robot_sysid.commands.console import Console
from robot_sysid.commands.report import require_report
from robot_sysid.commands.run import INTERRUPTED, add_logs, told, warnings_as_notes
from robot_sysid.config import ModelOptions, OutputOptions
from robot_sysid.errors import InputError
from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.logs.options import LogOptions
from robot_sysid.records.options import OptionRecord, given_options, record_from

__all__ = ["INTERRUPTED", "build_parser", "main"]

MAIN = (
    *("mesh_dir", "joint", "output_dir", "columns", "units", "torque_scale", "verify_rollout"),
    *("validation_measurements", "cutoff", "friction_model", "coupling", "model_weight"),
)


ABOUT_TORQUE = ("report", "plots", "keep_friction", "torque_scale", "torque_constants")
"""Keys of options that mean nothing where no torque was measured."""


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "arm",
        "robot-sysid arm arm.xml log1.csv log2.csv --validation-measurements log3.csv",
        "Identify every link of the arm, with friction and rotor inertia of every "
        "joint, from one log or several together, and write a corrected model.",
        None if full else MAIN,
    )
    add_logs(parser)
    parser.add("logs", LogOptions, leave_out=("measurements", "append"))
    parser.add("estimation", ArmOptions)
    parser.add_console()
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    return _identify(*parsed(build_parser, arguments))


def _require_no_torque(mode: str, *records: OptionRecord) -> None:
    """Raise InputError at an option that is about torques, which are not there."""
    given = [each for record in records for each in given_options(record)]
    for each in given:
        if each.key in ABOUT_TORQUE:
            raise InputError(
                f"{each.flag} is about torques; leave it off with --torque-from {mode}"
            )


def _identify(values: Mapping[str, Any], options: ConsoleOptions) -> int:
    output, arm = record_from(OutputOptions, values), record_from(ArmOptions, values)
    chosen = record_from(ModelOptions, values)
    logs = record_from(LogOptions, {**values, "measurements": tuple(values["measurements"])})
    if arm.write_offset and output.keep_friction:
        raise InputError("--write-offset is about friction; leave --keep-friction off")
    if arm.torque_from is not None:
        _require_no_torque(arm.torque_from, output, logs)
    require_report(output)
    console = Console(options.quiet, options.verbose)
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.identify.arm.run import run_arm
    from robot_sysid.parser import load_robot_model

    with warnings_as_notes(console, options.debug):
        path, frame = values["path"], chosen.keyframe
        robot = load_robot_model(path, chosen.mesh_dir, chosen.joint, keyframe=frame)
        for note in robot.notes:
            console.note(note)
        if arm.torque_from is not None:
            from robot_sysid.identify.arm.servo.run import run_servo

            where = output.output_dir, chosen.mesh_dir, console
            found = run_servo(robot, logs, *where, arm.write_delay)
            return told(found, console, options.verbose, output)
        place = output.output_dir, chosen.mesh_dir, console, output.keep_friction
        outcome = run_arm(robot, logs, arm, *place)
    return told(outcome, console, options.verbose, output, chosen.mesh_dir)
