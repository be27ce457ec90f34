"""``robot-sysid identify MODEL LOG...``: identify the arm from logs of it."""

from __future__ import annotations

from collections.abc import Sequence

from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.commands.run import add_logs, identify
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.logs.options import LogOptions

MAIN = (
    *("mesh_dir", "joint", "output_dir", "columns", "units", "torque_scale", "delay", "cutoff"),
    *("validation_measurements", "friction_model", "links", "coupling", "verify_rollout"),
    *("keep_friction", "keep_gravity", "keep_links"),
)


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    return parser_of(
        "identify",
        "Identify an arm from one log of it, or from several together: the terminal link, every "
        "other link with --links, friction and rotor inertia. Write a corrected model.",
        full,
    )


def parser_of(command: str, description: str, full: bool) -> Parser:
    """Return the parser of this command by one of its names."""
    example = f"robot-sysid {command} arm.xml log.csv"
    parser = Parser(command, example, description, None if full else MAIN)
    add_logs(parser)
    parser.add("logs", LogOptions, leave_out=("measurements",))
    parser.add("estimation", EstimationOptions)
    parser.add_console()
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    return identify(*parsed(build_parser, arguments))
