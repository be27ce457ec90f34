"""``robot-sysid plan MODEL``: design, check, save and export a trajectory."""

from __future__ import annotations

from collections.abc import Sequence

from robot_sysid.commands.arguments import Parser, exit_codes, parsed
from robot_sysid.commands.run import INTERRUPTED, add_model, identify
from robot_sysid.config import ModelOptions, MotorOptions, OutputOptions
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.excitation.options import ExcitationOptions, LimitOptions
from robot_sysid.excitation.static.options import PoseOptions
from robot_sysid.simulation.sensors import SimulatedArmOptions
from robot_sysid.trajectory import TrajectoryOptions

__all__ = ["INTERRUPTED", "build_parser", "main"]

MAIN = (
    *("mesh_dir", "joint", "output_dir", "duration", "seed", "speed", "trajectory"),
    *("save_trajectory", "excitation", "excitation_time_budget", "max_velocity", "max_torque"),
    *("workspace", "keep_out", "export_damiao", "motor_type"),
)
USUAL = {"excitation": "optimal"}
"""What this command does where a user does not say otherwise."""


def build_parser(full: bool = True) -> Parser:
    """Return the parser of this command."""
    parser = Parser(
        "plan",
        "robot-sysid plan arm.xml --save-trajectory plan.json",
        description="Design a trajectory that tells most about the terminal link, check it against "
        "all limits, say what it promises, and write it. --trajectory checks one that was saved.",
        epilog=exit_codes(0, 1, 2, 130),
        main=None if full else MAIN,
    )
    add_model(parser)
    parser.add("model and output", ModelOptions, OutputOptions)
    parser.add("trajectory", TrajectoryOptions, leave_out=("plan_only",))
    parser.add("excitation", ExcitationOptions, usual=USUAL)
    parser.add("plan for a payload", PoseOptions)
    parser.add("limits", LimitOptions)
    parser.add(
        "prediction",
        *(EstimationOptions, SimulatedArmOptions),
        only=("torques", "noise_torque"),
    )
    parser.add("Damiao motors", MotorOptions)
    parser.add_console()
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, options = parsed(build_parser, arguments)
    usual = {} if "trajectory" in values or "static" in values else USUAL
    return identify({**usual, **values, "plan_only": True}, options)
