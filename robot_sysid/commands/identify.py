"""``robot-sysid identify MODEL LOG...``: identify the terminal link from logs of the real arm."""

from __future__ import annotations

from collections.abc import Sequence

from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.commands.run import INTERRUPTED, add_logs, identify
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.logs.options import LogOptions

__all__ = ["INTERRUPTED", "build_parser", "main"]

MAIN = (
    *("mesh_dir", "joint", "output_dir", "columns", "units", "torque_scale", "delay", "cutoff"),
    *("validate", "validation_measurements", "method", "torques", "friction_model", "tilt"),
)


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "identify",
        "robot-sysid identify arm.xml log.csv",
        "Identify the terminal link from one log of the real arm, or from several "
        "together, and write a corrected model.",
        None if full else MAIN,
    )
    add_logs(parser)
    parser.add("logs", LogOptions, leave_out=("measurements",))
    parser.add("estimation", EstimationOptions)
    parser.add_console()
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    return identify(*parsed(build_parser, arguments))
