"""``robot-sysid identify MODEL LOG...``: identify the arm from logs of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.commands.run import add_model, carry_out
from robot_sysid.config import OutputOptions, SysidConfig
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.logs.options import LogOptions
from robot_sysid.model.options import ModelOptions

MAIN = (
    *("mesh_dir", "joint", "output_dir", "columns", "units", "torque_scale", "delay", "cutoff"),
    *("validation_measurements", "friction_model", "links", "coupling", "verify_rollout", "keep"),
)


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "identify",
        "robot-sysid identify arm.xml log.csv",
        "Identify an arm from one log of it, or from several together: the terminal link, every "
        "other link with --links, friction and rotor inertia. Write a corrected model.",
        None if full else MAIN,
    )
    add_model(parser)
    logs = "recording of the real arm"
    parser.add_argument("measurements", metavar="LOG", nargs="+", type=Path, help=logs)
    parser.add("model and output", ModelOptions, OutputOptions)
    parser.add("logs", LogOptions, leave_out=("measurements",))
    parser.add("estimation", EstimationOptions)
    parser.add_console()
    return parser


def main(arguments: Sequence[str], with_links: bool = False) -> int:
    """Run the command, by its older name ``arm`` with the links, and return its exit code."""
    values, console = parsed(build_parser, arguments)
    if with_links:
        console.note("arm is identify --links now; both do the same")
        # Where no torque was measured, links are not sought.
        values["links"] = "torque_from" not in values
    return carry_out(SysidConfig.of(**values), console)
