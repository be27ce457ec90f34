"""``robot-sysid MODEL``: identify the terminal link of one arm, with every option there is."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from robot_sysid.commands.arguments import Parser, parsed
from robot_sysid.commands.console import Console
from robot_sysid.commands.report import report_of, require_report
from robot_sysid.config import ModelOptions, MotorOptions, OutputOptions, SysidConfig, config_from
from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.logs.options import LogOptions
from robot_sysid.motion.options import ExcitationOptions, LimitOptions, PoseOptions
from robot_sysid.records.options import given_options
from robot_sysid.records.results import MODEL_NAMES
from robot_sysid.simulation.sensors import SimulatedArmOptions
from robot_sysid.trajectory import TrajectoryOptions

EXAMPLE = "robot-sysid examples/kinova/model/kinova_fullinertia_guess.xml"
ABOUT_TORQUE = (
    *("report", "plots", "keep_friction", "keep_rotors", "keep_gravity", "keep_links"),
    *("write_offset", "links", "torque_scale", "torque_constants", "append", "save_measurements"),
)
"""Keys of options that mean nothing where no torque was measured."""
MAIN = (
    *("mesh_dir", "duration", "sample_rate", "no_friction", "output_dir", "export_damiao"),
    *("motor_type", "seed", "joint", "torques", "measurements", "plan_only", "verbose", "quiet"),
)
GROUPS = (
    ("model and output", (ModelOptions, OutputOptions)),
    ("trajectory", (TrajectoryOptions,)),
    ("excitation", (ExcitationOptions,)),
    ("plan for a payload", (PoseOptions,)),
    ("limits", (LimitOptions,)),
    ("measurements", (LogOptions,)),
    ("simulated plant", (SimulatedArmOptions,)),
    ("estimation", (EstimationOptions,)),
    ("Damiao motors", (MotorOptions,)),
)


def build_parser(full: bool = True) -> Parser:
    """Return the parser; without ``full``, one whose help shows the main options only."""
    parser = Parser(
        "",
        EXAMPLE,
        "Identify mass, centre of mass, inertia and friction of a robot arm's terminal "
        "link, and write a corrected model.",
        None if full else MAIN,
        epilog="Commands: robot-sysid plan, identify, payload, arm, log, report, motors and "
        "example; each has its own --help. A model file that is called like a command is "
        "reached as ./plan.",
    )
    add_model(parser)
    for title, records in GROUPS:
        parser.add(title, *records)
    parser.add_console()
    return parser


def add_model(parser: Parser) -> None:
    """Add the model file."""
    parser.add_argument("path", metavar="MODEL", type=Path, help="MuJoCo XML (MJCF) or URDF file")


def add_logs(parser: Parser) -> None:
    """Add the model file and the logs of the real arm, with what tells how to read them."""
    add_model(parser)
    parser.add_argument(
        "measurements", metavar="LOG", nargs="+", type=Path, help="recording of the real arm"
    )
    parser.add("model and output", ModelOptions, OutputOptions)


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    return identify(*parsed(build_parser, arguments))


def identify(
    values: Mapping[str, Any], console: Console, then: Callable[[Any, Console], None] | None = None
) -> int:
    """Run the pipeline and return the exit code.

    Args:
        then: what is to be done with the outcome once it is written.
    """
    config = config_from(**values)
    require_report(config.output)
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.pipeline import run

    with warnings_as_notes(console):
        if config.estimation.torque_from is not None:
            return told(_of_servos(config, console), console, config.output)
        outcome = run(config, console)
    if then is not None:
        then(outcome, console)
    return told(outcome, console, config.output, config.model.mesh_dir)


def _of_servos(config: SysidConfig, console: Console) -> Any:
    """Run the search for servos, where no torque was measured, and return its outcome."""
    from robot_sysid.parser import load_robot_model
    from robot_sysid.servo.run import run_servo

    model, output = config.model, config.output
    for record in (output, config.log, config.arm):
        for each in given_options(record):
            if each.key in ABOUT_TORQUE:
                raise InputError(
                    f"{each.flag} is about measured torques; leave it off with --torque-from"
                )
    robot = load_robot_model(model.path, model.mesh_dir, model.joint, keyframe=model.keyframe)
    for note in robot.notes:
        console.note(note)
    where = output.output_dir, model.mesh_dir, console
    return run_servo(robot, config.log, *where, config.estimation.write_delay)


def told(
    outcome: Any, console: Console, output: OutputOptions, mesh_dir: Path | None = None
) -> int:
    """Print what a run has to say, write report and bundle, return the exit code 0.

    Args:
        outcome: of a pipeline, with ``files``, ``failure`` and ``report_lines(verbose)``.

    Raises:
        SysidError: there is nothing to use, or no report.
    """
    console.lines(outcome.report_lines(console.verbose))
    failure = report_of(outcome, output, mesh_dir, console)
    if outcome.failure:
        raise SysidError(outcome.failure)
    if output.bundle:
        from robot_sysid.results.bundle import write_bundle

        for model in [path for path in outcome.files if path.name in MODEL_NAMES.values()]:
            console.stage(f"Bundle saved to {write_bundle(model, output.output_dir)}")
    if failure:
        raise SysidError(failure)
    return 0


@contextlib.contextmanager
def warnings_as_notes(console: Console) -> Iterator[None]:
    """Turn warnings of Python libraries into notes; --debug shows where they come from."""

    def show(message: Any, *_: Any, **__: Any) -> None:
        console.note(f"numerical warning: {message}; check the result (--debug says where)")

    with warnings.catch_warnings():
        if not console.debug:
            warnings.showwarning = show
        yield
