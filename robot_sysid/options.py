"""The options of ``robot-sysid``: from arguments to a configuration."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from robot_sysid import __version__
from robot_sysid.collision.halfspaces import box_from, plane_from
from robot_sysid.config import EXCITATIONS, SIMULATIONS, SysidConfig
from robot_sysid.errors import InputError
from robot_sysid.estimation.least_squares import (
    CONSISTENCY_CHOICES,
    PRIOR_CHOICES,
    EstimatorOptions,
)
from robot_sysid.estimation.registry import ESTIMATORS
from robot_sysid.excitation.information import CRITERIA
from robot_sysid.excitation.options import ENDS, ExcitationOptions
from robot_sysid.signals.process import SignalOptions
from robot_sysid.simulation.sensors import SensorOptions, parse_levels

DEFAULT_NOISE_TORQUE = 0.3
"""Torque noise that a plan predicts errors for where none is given [N m]."""
_SAME_NAME = (
    *("model", "mesh_dir", "duration", "sample_rate", "output_dir", "export_damiao", "seed"),
    *("damiao_rate", "supply", "joint", "torques", "max_velocity", "excitation", "trajectory"),
    *("save_trajectory", "plan_only", "speed", "measurements", "columns", "units"),
    *("plant_model", "simulation", "save_measurements", "friction_model", "method", "validate"),
    "validation_measurements",
)


class _Parser(argparse.ArgumentParser):
    """Argument parser that reports a usage error as one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (robot-sysid --help lists all options)")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = _Parser(
        prog="robot-sysid",
        description="Identify mass, centre of mass, inertia and friction of a robot arm's "
        "terminal link, and write a corrected model.",
        epilog="Exit codes: 0 done, 1 result not trustworthy, 2 bad input, 130 interrupted.",
        allow_abbrev=False,
    )
    parser.add_argument("model", metavar="MODEL", type=Path, help="MuJoCo XML (MJCF) or URDF file")
    _add_main(parser.add_argument)
    _add_model(parser.add_argument_group("model").add_argument)
    excitation = parser.add_argument_group("excitation")
    _add_excitation(excitation.add_argument)
    _add_trajectory(excitation.add_argument)
    _add_surroundings(parser.add_argument_group("limits of an optimal excitation").add_argument)
    _add_log(parser.add_argument_group("measurements").add_argument)
    _add_plant(parser.add_argument_group("simulated plant").add_argument)
    _add_estimation(parser.add_argument_group("estimation").add_argument)
    _add_damiao(parser.add_argument_group("Damiao motors").add_argument)
    _add_console(parser.add_argument_group("console"))
    return parser


def _add_main(add: Any) -> None:
    add("--mesh-dir", type=Path, metavar="MESH_DIR", help="folder of the meshes (default: auto)")
    add("--duration", type=float, default=15.0, help="trajectory duration in seconds (default: 15)")
    add(
        "--sample-rate",
        type=float,
        default=1000.0,
        metavar="RATE",
        help="samples per second in Hz (default: 1000)",
    )
    add("--no-friction", action="store_true", help="identify the 10 inertial parameters only")
    add(
        "--output-dir",
        type=_folder,
        default=Path("sysid_output"),
        metavar="DIR",
        help="folder for the results (default: ./sysid_output)",
    )
    add("--export-damiao", action="store_true", help="write a trajectory CSV for Damiao motors")
    add(
        "--motor-type",
        action="append",
        default=[],
        metavar="TYPE",
        help="Damiao motor type, once per joint from the base outwards (e.g. DM4340)",
    )
    add("--seed", type=int, help="random seed of trajectory and noise (default: a fresh one)")


def _add_model(add: Any) -> None:
    add("--joint", metavar="NAME", help="terminal joint (default: found)")
    add(
        "--torques",
        choices=("chain", "terminal"),
        default="chain",
        help="use the torques of all joints that carry the link, or of the last one only "
        "(default: chain)",
    )
    add(
        "--max-velocity",
        type=float,
        default=2.0,
        metavar="V",
        help="speed limit of hinge joints in rad/s (default: 2)",
    )


def _add_excitation(add: Any) -> None:
    add(
        "--excitation",
        choices=EXCITATIONS,
        default="sines",
        help="random sinusoids, or a trajectory designed to tell most (default: sines)",
    )
    add(
        "--criterion",
        choices=tuple(CRITERIA),
        default="D",
        help="what the design makes small: summed variances (A), their volume (D), or the "
        "condition number (default: D)",
    )
    add(
        "--excitation-time-budget",
        type=float,
        default=60.0,
        metavar="S",
        help="cut the design after this many seconds (default: 60)",
    )
    add(
        "--harmonics", type=int, metavar="K", help="harmonics of the design (default: up to 0.6 Hz)"
    )
    add(
        "--base-frequency",
        type=float,
        metavar="F",
        help="first harmonic in Hz (default: one period in the duration)",
    )
    add(
        "--excitation-ends",
        choices=ENDS,
        default="faded",
        help="bring a designed trajectory to rest by a fade, or by its periodic shape "
        "(default: faded)",
    )


def _add_trajectory(add: Any) -> None:
    add("--plan-only", action="store_true", help="make, check and write the trajectory, then stop")
    add(
        "--save-trajectory",
        type=Path,
        metavar="FILE",
        help="write the trajectory's coefficients as JSON, and its samples as CSV beside it",
    )
    add("--trajectory", type=Path, metavar="FILE", help="use a trajectory that was saved")
    add(
        "--speed",
        type=float,
        default=1.0,
        metavar="FACTOR",
        help="slow the whole trajectory down, for a first run on the arm (default: 1)",
    )


def _add_surroundings(add: Any) -> None:
    add(
        "--max-acceleration",
        type=float,
        metavar="A",
        help="acceleration limit of hinge joints in rad/s^2",
    )
    add(
        "--max-torque",
        type=_levels("--max-torque"),
        metavar="T",
        help="torque limit in N m beside the model's own, one number or one per joint",
    )
    add(
        "--workspace",
        type=float,
        nargs=6,
        metavar=("XMIN", "XMAX", "YMIN", "YMAX", "ZMIN", "ZMAX"),
        help="box in metres that the terminal link must stay in",
    )
    add(
        "--keep-out",
        type=float,
        nargs=4,
        action="append",
        default=[],
        metavar=("NX", "NY", "NZ", "OFFSET"),
        help="plane no moving part may cross: points x with N.x >= OFFSET are allowed",
    )
    add(
        "--clearance",
        type=float,
        default=0.01,
        metavar="D",
        help="least distance in metres between parts that are apart at rest (default: 0.01)",
    )


def _add_log(add: Any) -> None:
    add("--measurements", type=Path, metavar="LOG.csv", help="analyse this log of the real arm")
    add("--columns", type=Path, metavar="FILE", help="file that says which column is what")
    add("--units", metavar="UNITS", help="units of the log, such as deg or deg,ms")
    add("--cutoff", type=float, metavar="HZ", help="low-pass for all signals (default: from data)")
    add(
        "--velocity-deadband",
        type=_levels("--velocity-deadband"),
        metavar="V",
        help="leave out rows with moments in which a joint is slower than this, in rad/s; one "
        "number or one per joint (default: 0.5 %% of its peak speed)",
    )
    add(
        "--delay",
        choices=("off", "auto"),
        default="off",
        help="estimate how much torque lags position (default: off)",
    )
    add(
        "--tilt",
        choices=("off", "auto"),
        default="off",
        help="estimate how much the base is tilted (default: off)",
    )
    add(
        "--validate",
        type=float,
        default=0.2,
        metavar="FRACTION",
        help="share at the end of the log that only tests the result (default: 0.2)",
    )
    add(
        "--validation-measurements",
        type=Path,
        metavar="LOG.csv",
        help="another log that only tests the result",
    )


def _add_plant(add: Any) -> None:
    add("--plant-model", type=Path, metavar="TRUTH.xml", help="model that plays the real arm")
    add(
        "--simulation",
        choices=SIMULATIONS,
        default="inverse",
        help="plant by inverse dynamics, or in closed loop forward in time (default: inverse)",
    )
    add(
        "--noise-torque",
        type=_levels("--noise-torque"),
        default=0.0,
        metavar="S",
        help="standard deviation of torque noise in N m, one number or one per joint",
    )
    add(
        "--noise-position",
        type=_levels("--noise-position"),
        default=0.0,
        metavar="S",
        help="standard deviation of position noise in rad, one number or one per joint",
    )
    add("--encoder-resolution", type=float, default=0.0, metavar="R", help="encoder step in rad")
    add("--torque-delay", type=float, default=0.0, metavar="S", help="torque lag in seconds")
    add(
        "--save-measurements",
        type=Path,
        metavar="FILE",
        help="write the measurements as a log that --measurements reads",
    )


def _add_estimation(add: Any) -> None:
    add(
        "--method",
        choices=tuple(ESTIMATORS),
        help="least squares: plain, weighted by each joint's noise, or robust against outliers "
        "(default: wls for measured data, else ols)",
    )
    add(
        "--consistency",
        choices=CONSISTENCY_CHOICES,
        default="auto",
        help="whether the result must be a possible rigid body: where needed, always, never "
        "(default: auto)",
    )
    add("--prior", choices=PRIOR_CHOICES, default="none", help="pull towards the model's body")
    add("--prior-weight", type=float, default=1.0, metavar="W", help="how strongly (default: 1)")
    add(
        "--friction-model",
        metavar="TERMS",
        help="friction terms of every joint, such as coulomb-viscous-offset, or auto "
        "(default for measured data: coulomb-viscous-offset)",
    )


def _add_damiao(add: Any) -> None:
    add(
        "--can-id",
        type=_id,
        action="append",
        default=[],
        metavar="ID",
        help="CAN id of a joint's motor, once per joint (default: 1, 2, 3, ...)",
    )
    add(
        "--master-id",
        type=_id,
        action="append",
        default=[],
        metavar="ID",
        help="id a joint's motor answers on, once per joint (default: CAN id + 0x10)",
    )
    add(
        "--damiao-rate",
        type=float,
        metavar="HZ",
        help="rows per second of the motor trajectory (default: the sample rate)",
    )
    add(
        "--supply",
        type=float,
        metavar="V",
        help="supply voltage of the motors, to judge their top speed",
    )


def _id(text: str) -> int:
    """Return an id written in decimal or as 0x..."""
    try:
        return int(text, 0)
    except ValueError:
        raise InputError(f"{text!r} is not a CAN id; write 3 or 0x03") from None


def _add_console(group: argparse._ArgumentGroup) -> None:
    volume = group.add_mutually_exclusive_group()
    volume.add_argument("-v", "--verbose", action="store_true", help="say more")
    volume.add_argument("--quiet", action="store_true", help="print errors only")
    group.add_argument("--debug", action="store_true", help="show the traceback of an error")
    group.add_argument("--version", action="version", version=f"robot-sysid {__version__}")


def _folder(text: str) -> Path:
    """Return a path; an empty text is a shell variable that was not set."""
    if not text:
        raise argparse.ArgumentTypeError("is empty; use . for the current folder")
    return Path(text)


def _levels(option: str) -> Any:
    """Return an argument type: one number, or one per joint between commas."""
    return lambda text: parse_levels(text, option)


def config_from(options: argparse.Namespace) -> SysidConfig:
    """Return the run's configuration; raises InputError for values that make no sense."""
    same = {name: getattr(options, name) for name in _SAME_NAME}
    return SysidConfig(
        **same,
        friction=not options.no_friction,
        motor_types=tuple(options.motor_type),
        can_ids=tuple(options.can_id),
        master_ids=tuple(options.master_id),
        design=_design(options),
        sensors=SensorOptions(
            options.noise_torque,
            options.noise_position,
            options.encoder_resolution,
            options.torque_delay,
        ),
        signals=SignalOptions(options.cutoff, options.velocity_deadband),
        estimate_delay=options.delay == "auto",
        estimate_tilt=options.tilt == "auto",
        estimator=EstimatorOptions(options.consistency, options.prior, options.prior_weight),
    )


def _design(options: argparse.Namespace) -> ExcitationOptions:
    noise = np.atleast_1d(options.noise_torque)
    torque = () if options.max_torque is None else np.atleast_1d(options.max_torque)
    return ExcitationOptions(
        criterion=options.criterion,
        duration=options.duration,
        sample_rate=options.sample_rate,
        harmonics=options.harmonics,
        base_frequency=options.base_frequency,
        ends=options.excitation_ends,
        max_acceleration=options.max_acceleration,
        max_torque=tuple(float(limit) for limit in torque),
        noise_torque=tuple(map(float, noise)) if np.all(noise > 0.0) else (DEFAULT_NOISE_TORQUE,),
        clearance=options.clearance,
        workspace=None if options.workspace is None else box_from(tuple(options.workspace)),
        keep_out=tuple(plane_from(tuple(plane)) for plane in options.keep_out),
        torques=options.torques,
        time_budget=options.excitation_time_budget,
        workers=os.cpu_count() or 1,
    )
