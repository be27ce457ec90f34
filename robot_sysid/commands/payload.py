"""``robot-sysid payload MODEL``: a payload from logs without and with it."""

from __future__ import annotations

from collections.abc import Sequence

from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.commands.run import EXCITATION, add_model, carry_out
from robot_sysid.config import NOT_OF_A_PAYLOAD, OutputOptions, PayloadConfig, PayloadOptions
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.logs.options import LogOptions
from robot_sysid.model.options import ModelOptions
from robot_sysid.motion.options import ExcitationOptions, LimitOptions
from robot_sysid.records.sampling import TrajectoryOptions
from robot_sysid.simulation.options import SimulatedArmOptions

MAIN = (
    *("mesh_dir", "joint", "output_dir", "empty", "loaded", "order", "flange", "as_body"),
    *("known_mass", "save_torque_scale", "static", "empty_model", "loaded_model"),
    *("columns", "units", "torque_scale", "scale_uncertainty"),
)
ESTIMATION = (
    *("cutoff", "velocity_deadband", "friction_model", "link_uncertainty"),
    *("scale_uncertainty", "zero_uncertainty", "gravity_uncertainty", "delay_uncertainty"),
)
NOT_HERE = (*NOT_OF_A_PAYLOAD, *("measurements", "validation_measurements", "verify_rollout"))


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "payload",
        "robot-sysid payload arm.xml --empty a.csv d.csv --loaded b.csv c.csv --order ABBA",
        "Identify what is bolted to the flange from logs without and with it, and "
        "write a model that carries it and a card for controllers.",
        None if full else MAIN,
    )
    add_model(parser)
    parser.add("recordings and payload", PayloadOptions)
    parser.add("model and output", ModelOptions, OutputOptions, leave_out=NOT_HERE)
    parser.add("logs", LogOptions, leave_out=NOT_HERE)
    parser.add("estimation", EstimationOptions, only=ESTIMATION)
    parser.add("trajectory of a simulation", TrajectoryOptions, leave_out=NOT_HERE)
    parser.add("excitation", ExcitationOptions, only=EXCITATION)
    parser.add("limits", LimitOptions)
    parser.add("sensors of a simulation", SimulatedArmOptions, leave_out=NOT_HERE)
    parser.add_console()
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, console = parsed(build_parser, arguments)
    return carry_out(PayloadConfig.of(**values), console)
