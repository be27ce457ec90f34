"""``robot-sysid MODEL``: identify the terminal link of one arm; what commands that run share."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robot_sysid.commands.arguments import PROGRAM, Parser, parsed
from robot_sysid.commands.config_file import text_of
from robot_sysid.commands.console import Console
from robot_sysid.commands.report import report_of, require_report
from robot_sysid.config import (
    PLANNED,
    Config,
    MotorOptions,
    OutputOptions,
    PayloadConfig,
    SysidConfig,
)
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.logs.options import LogOptions
from robot_sysid.model.options import ModelOptions
from robot_sysid.motion.options import ExcitationOptions, LimitOptions
from robot_sysid.records import atomic_files
from robot_sysid.records.sampling import TrajectoryOptions
from robot_sysid.simulation.options import SimulatedArmOptions

MAIN = (
    *("mesh_dir", "duration", "sample_rate", "no_friction", "output_dir", "export_damiao"),
    *("motor_type", "seed", "joint", "torques", "measurements", "verbose", "quiet"),
)
EXCITATION = ("excitation", "excitation_time_budget")
"""Keys of the excitation's options where a motion is made on the way; ``plan`` has all."""
GROUPS: Mapping[str, tuple[Any, ...]] = {
    "model and output": (ModelOptions, OutputOptions),
    "trajectory": (TrajectoryOptions,),
    "excitation": (ExcitationOptions,),
    "limits": (LimitOptions,),
    "measurements": (LogOptions,),
    "simulated plant": (SimulatedArmOptions,),
    "estimation": (EstimationOptions,),
    "Damiao motors": (MotorOptions,),
}


def build_parser(full: bool = True) -> Parser:
    """Return the parser; without ``full``, one whose help shows the main options only."""
    parser = Parser(
        "",
        "robot-sysid examples/kinova/model/kinova_fullinertia_guess.xml",
        "Identify mass, centre of mass, inertia and friction of a robot arm's terminal "
        "link, and write a corrected model.",
        None if full else MAIN,
        epilog="Commands: robot-sysid plan, identify, payload, arm, log, report, motors and "
        "example; each has its own --help. A model file that is called like a command is "
        "reached as ./plan.",
    )
    add_model(parser)
    for title, records in GROUPS.items():
        parser.add(title, *records, only=EXCITATION if title == "excitation" else ())
    parser.add_console()
    return parser


def add_model(parser: Parser) -> None:
    """Add the model file."""
    parser.add_argument("path", metavar="MODEL", type=Path, help="MuJoCo XML (MJCF) or URDF file")


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    values, console = parsed(build_parser, arguments)
    return carry_out(SysidConfig.of(**values), console)


def carry_out(
    config: Config, console: Console, then: Callable[[Any, Console], None] | None = None
) -> int:
    """Run what was asked for, print what it says, write report and bundle; return exit code 0.

    Once the outcome is written, ``then`` is called with it. SysidError where it failed, there is
    nothing to use, or no report.
    """
    require_report(config.output)
    config = replace(config.seeded(), output=replace(config.output, config=console.config))
    with warnings_as_notes(console):
        outcome = _outcome(config, console)
    if then is not None:
        then(outcome, console)
    console.lines(outcome.report_lines())
    console.result(_answer(outcome))
    if outcome.files:
        _repeatable(config)
    failure = report_of(outcome, config.output, config.model.mesh_dir, console)
    if outcome.failure:
        raise SysidError(" ".join(outcome.verdict) or outcome.failure)
    if config.output.bundle:
        from robot_sysid.results.model import write_bundle

        names = atomic_files.MODEL_NAMES.values()
        for model in (path for path in outcome.files if path.name in names):
            console.stage(f"Bundle saved to {write_bundle(model, config.output.output_dir)}")
    console.lines(outcome.verdict)
    if failure:
        raise SysidError(failure)
    return 0


def _repeatable(config: Config) -> None:
    """Write the file that repeats a run, but not over the one that it was asked with."""
    path, command = config.output.output_dir / atomic_files.RUN_NAME, PROGRAM
    usual: Mapping[str, Any] = {}
    if isinstance(config, PayloadConfig):
        command += " payload"
    elif isinstance(config, SysidConfig) and config.trajectory.plan_only:
        assert config.plan_file is not None
        path, command, usual = config.plan_file.with_suffix(".toml"), f"{command} plan", PLANNED
    given = config.output.config
    if given is None or not (path.exists() and path.samefile(given)):
        atomic_files.write_whole(path, text_of(command, config, path, usual))


def _answer(outcome: Any) -> Mapping[str, Any] | str:
    """Return what --json prints: the result's file, or what there is to say of a plan."""
    for path in outcome.files:
        if path.name in (atomic_files.PARAMS_NAME, atomic_files.SERVO_NAME):
            return str(path.read_text(encoding="utf-8"))
    return {
        "verdict": outcome.verdict,
        "failure": outcome.failure,
        "promised": outcome.lines,
        "files": [str(path) for path in outcome.files],
    }


def _outcome(config: Config, console: Console) -> Any:
    """Run the stages that a question takes; return their ``files``, ``failure`` and lines."""
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    if isinstance(config, SysidConfig) and config.estimation.torque_from is not None:
        from robot_sysid.model.compilation import meshes_not_kept
        from robot_sysid.pipeline import load
        from robot_sysid.servo.run import run_servo

        with meshes_not_kept():
            robot, rest = load(config, console), (config.model.mesh_dir, console, console.config)
            return run_servo(robot, config.log, config.output.output_dir, *rest)
    from robot_sysid.pipeline import run

    return run(config, console)


@contextlib.contextmanager
def warnings_as_notes(console: Console) -> Iterator[None]:
    """Turn warnings of Python libraries into notes; --debug shows where they come from."""

    def show(message: Any, *_: Any, **__: Any) -> None:
        console.note(f"numerical warning: {message}; check the result (--debug says where)")

    with warnings.catch_warnings():
        if not console.debug:
            warnings.showwarning = show
        yield
