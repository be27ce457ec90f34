"""``robot-sysid MODEL``, ``plan``, ``identify`` and ``payload``: parsers, runs and outcomes."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

from robot_sysid.commands import PROGRAM, Console, overview
from robot_sysid.commands.arguments import Parser, parse_command
from robot_sysid.commands.report import require_report, write_outcome_report
from robot_sysid.config import (
    PLANNED,
    PREDICTED,
    Config,
    MotorOptions,
    OutputOptions,
    PayloadConfig,
    PayloadOptions,
    SysidConfig,
)
from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.logs import LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.motion import ExcitationOptions, LimitOptions, PoseOptions, ViewOptions
from robot_sysid.records import file_access
from robot_sysid.records.option_fields import TrajectoryOptions, default_of, options_of
from robot_sysid.simulation import SimulatedArmOptions


class CommandSpec(NamedTuple):
    """Help and options of one command.

    Attributes:
        config: makes the run's configuration of a model file and options by key.
        example: a complete command line.
        description: what the command does.
        main: keys of the options in the short help.
        groups: heading in the help to classes of option records.
        only: heading to keys of the only options that are added of the group; default all.
        leave_out: keys of options of the groups that the command does not have.
        defaults: by key, defaults in place of the records'.
        overview: lines of the help before the usage.
    """

    config: Any
    example: str
    description: str
    main: Collection[str]
    groups: Mapping[str, Sequence[Any]]
    only: Mapping[str, Collection[str]] = {}
    leave_out: Collection[str] = ()
    defaults: Mapping[str, Any] = {}
    overview: Sequence[str] = ()


ALONE = CommandSpec(
    SysidConfig.of,
    "robot-sysid identify arm.xml log.csv",
    "With a model alone: simulate it along a random motion and identify its terminal link from "
    "that, as a test of the program. A model file that is called like a command is reached as "
    "./plan.",
    (
        "mesh_dir",
        "duration",
        "sample_rate",
        "no_friction",
        "output_dir",
        "export_damiao",
        "motor_type",
        "seed",
        "joint",
        "verbose",
        "quiet",
    ),
    {
        "model and output": (ModelOptions, OutputOptions),
        "trajectory": (TrajectoryOptions,),
        "excitation": (ExcitationOptions,),
        "limits": (LimitOptions,),
        "measurements": (LogOptions,),
        "simulated plant": (SimulatedArmOptions,),
        "estimation": (EstimationOptions,),
        "Damiao motors": (MotorOptions,),
    },
    only={"excitation": ("excitation", "excitation_time_budget")},
    overview=overview(),
)
PLAN = CommandSpec(
    SysidConfig.of_plan,
    "robot-sysid plan arm.xml --save-trajectory plan.json",
    "Design a trajectory that tells most about the terminal link, check it against "
    "all limits, say what it promises, and write it. --trajectory checks one that was saved.",
    (
        "mesh_dir",
        "joint",
        "output_dir",
        "duration",
        "seed",
        "speed",
        "trajectory",
        "save_trajectory",
        "excitation",
        "excitation_time_budget",
        "max_velocity",
        "max_torque",
        "workspace",
        "keep_out",
        "export_damiao",
        "motor_type",
    ),
    {
        "model and output": (ModelOptions, OutputOptions),
        "trajectory": (TrajectoryOptions,),
        "excitation": (ExcitationOptions,),
        "plan for a payload": (PoseOptions,),
        "limits": (LimitOptions,),
        "prediction": (EstimationOptions, SimulatedArmOptions),
        "Damiao motors": (MotorOptions,),
        "preview": (ViewOptions,),
    },
    only={"prediction": PREDICTED},
    leave_out=("keep", "links", "bundle", "report"),
    defaults=PLANNED,
)
IDENTIFY = CommandSpec(
    SysidConfig.of,
    "robot-sysid identify arm.xml log.csv",
    "Identify an arm from one log of it, or from several together: the terminal link, every "
    "other link with --links, friction and rotor inertia. Write a corrected model.",
    (
        "mesh_dir",
        "joint",
        "output_dir",
        "columns",
        "units",
        "torque_scale",
        "delay",
        "cutoff",
        "validation_measurements",
        "friction_model",
        "links",
        "coupling",
        "verify_rollout",
        "keep",
    ),
    {
        "model and output": (ModelOptions, OutputOptions),
        "logs": (LogOptions,),
        "estimation": (EstimationOptions,),
    },
    leave_out=("measurements",),
)
PAYLOAD = CommandSpec(
    PayloadConfig.of,
    "robot-sysid payload arm.xml --empty a.csv d.csv --loaded b.csv c.csv --order ABBA",
    "Identify what is bolted to the flange from logs without and with it, and "
    "write a model that carries it and a card for controllers.",
    (
        "mesh_dir",
        "joint",
        "output_dir",
        "empty",
        "loaded",
        "order",
        "flange",
        "as_body",
        "known_mass",
        "save_torque_scale",
        "static",
        "columns",
        "units",
        "torque_scale",
        "scale_uncertainty",
    ),
    {
        "recordings and payload": (PayloadOptions,),
        "model and output": (ModelOptions, OutputOptions),
        "logs": (LogOptions,),
        "estimation": (EstimationOptions,),
    },
    only={
        "estimation": (
            "cutoff",
            "friction_model",
            "link_uncertainty",
            "scale_uncertainty",
            "zero_uncertainty",
            "gravity_uncertainty",
            "delay_uncertainty",
        )
    },
    leave_out=("links", "measurements", "validation_measurements", "verify_rollout"),
)
SPECS = {"": ALONE, "plan": PLAN, "identify": IDENTIFY, "payload": PAYLOAD}
"""Name of the command to its specification; "" is the program with a model alone."""


def build_parser(command: str = "", full: bool = True) -> Parser:
    """Return the parser of a command; without ``full``, its help has the main options only."""
    spec = SPECS[command]
    main = None if full else spec.main
    parser = Parser(
        command, spec.example, spec.description, main, overview=spec.overview
    )
    parser.add_argument(
        "path", metavar="MODEL", type=Path, help="MuJoCo XML (MJCF) or URDF file"
    )
    if command == "identify":
        parser.add_argument(
            "measurements",
            metavar="LOG",
            nargs="+",
            type=Path,
            help="recording of the real arm",
        )
    for title, records in spec.groups.items():
        parser.add(
            title,
            *records,
            only=spec.only.get(title, ()),
            leave_out=spec.leave_out,
            defaults=spec.defaults,
        )
    return parser.add_console_options()


def main(arguments: Sequence[str], command: str = "") -> int:
    """Run a command of ``SPECS`` and return its exit code.

    Args:
        arguments: words behind the command's name on the command line.
        command: "plan", "identify" or "payload"; "" for ``robot-sysid MODEL`` alone.
    """
    values, console = parse_command(partial(build_parser, command), arguments)
    view = values.pop("view", False)
    if view:
        from robot_sysid.motion.viewer import require_display

        require_display()
    run_command(SPECS[command].config(**values), console, view)
    return 0


def run_command(config: Config, console: Console, view: bool = False) -> None:
    """Run a command, print its outcome and write its report and bundle.

    The verdict is printed last, and not at all where the run failed: the error states it then.

    Args:
        config: options of the run.
        console: prints the outcome; the TOML file that the options came from is not replaced.
        view: whether a planned motion is played in MuJoCo's viewer.

    Raises:
        SysidError: the run failed, its result cannot be used, or a wanted report is missing.
    """
    require_report(config.output)
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.pipeline.run_words import add_weighing_commands
    from robot_sysid.pipeline.stages import run

    config = replace(config, output=replace(config.output, config=console.config))
    if isinstance(config, SysidConfig):
        config = config.with_seed()
    output = config.output
    with warnings_as_notes(console):
        try:
            outcome = run(config, console)
        except InputError as error:
            logs = config.log.measurements
            is_static = isinstance(config, PayloadConfig) and config.payload.static
            # A payload of known mass has all that the weighing needs, but for the first scales.
            if isinstance(config, PayloadConfig) and config.payload.known_mass is None:
                logs = config.payload.empty
            for log in logs[:1]:
                add_weighing_commands(error, config.model, config.log, log, is_static)
            raise
    checked = outcome.checked
    if view and checked is not None and checked.problem is not None:
        from robot_sysid.motion.viewer import play_in_viewer

        play_in_viewer(checked.problem.robot, checked.plan)
    console.stage(*outcome.lines)
    for path in outcome.files if outcome.checked else ():
        console.stage(f"Trajectory saved to {path}")
    console.result(_json_answer(outcome))
    if outcome.files:
        _write_settings(config)
    failure = write_outcome_report(outcome, output, config.model.mesh_dir, console)
    if outcome.failure:
        raise SysidError(" ".join(outcome.verdict) or outcome.failure)
    if output.bundle:
        from robot_sysid.results.written_model import write_bundle

        # The first one is the file to use; a URDF beside it would replace its bundle.
        for path in file_access.models_in(outcome.files)[:1]:
            bundle = write_bundle(path, output.output_dir)
            console.stage(f"Bundle saved to {bundle}")
    console.stage(*outcome.verdict)
    if failure:
        raise SysidError(failure)


def _write_settings(config: Config) -> None:
    """Write the file that repeats a run, but not over the file of its own --config."""
    path = config.output.output_dir / file_access.RUN_NAME
    command = PROGRAM
    defaults: Mapping[str, Any] = {}
    if isinstance(config, PayloadConfig):
        command = f"{PROGRAM} payload"
    elif isinstance(config, SysidConfig) and config.trajectory.plan_only:
        assert config.plan_file is not None
        path = config.plan_file.with_suffix(".toml")
        command = f"{PROGRAM} plan"
        defaults = PLANNED
    if not file_access.is_same_file(path, config.output.config):
        heading = f"{command} --config {quote(str(path))}"
        records = vars(config).values()
        text = settings_text(heading, config.model.path, records, defaults)
        file_access.write_atomically(path, text)


def settings_text(
    command: str, model: Path, records: Collection[Any], defaults: Mapping[str, Any]
) -> str:
    """Return the TOML text of a command's options that differ from their defaults.

    Args:
        command: command line that reads the file, for its first line, a comment.
        model: the model file.
        records: the option records.
        defaults: by key, defaults of the command in place of the records'.
    """
    lines = [f"# In {Path.cwd()}: {command}", f"path = {_toml_value(model)}"]
    for record in records:
        for name, option in options_of(record).items():
            value = getattr(record, name)
            if value != defaults.get(option.key, default_of(record, name)):
                lines.append(f"{option.key} = {_toml_value(value)}")
    return "\n".join([*lines, ""])


def _toml_value(value: Any) -> str:
    """Return an option's value as TOML text."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, (bool, int, float)):
        return str(value).lower()
    return json.dumps(str(value), ensure_ascii=False)


def _json_answer(outcome: Any) -> Mapping[str, Any] | str:
    """Return the output of --json: the text of the result's file, or the summary of a plan.

    ``outcome`` is that of ``pipeline.stages.run``; its ``files`` are the paths that were written.
    """
    for path in outcome.files:
        if path.name in (file_access.PARAMS_NAME, file_access.SERVO_NAME):
            return str(path.read_text(encoding="utf-8"))
    return {
        "verdict": outcome.verdict,
        "next_step": outcome.next_step and vars(outcome.next_step),
        "failure": outcome.failure,
        "prediction": outcome.lines,
        "files": list(map(str, outcome.files)),
    }


@contextlib.contextmanager
def warnings_as_notes(console: Console) -> Iterator[None]:
    """Turn warnings of Python libraries into notes; --debug shows where they come from."""

    def show(message: Any, *_: Any, **__: Any) -> None:
        console.note(
            f"numerical warning: {message}; check the result (--debug says where)"
        )

    with warnings.catch_warnings():
        if not console.debug:
            warnings.showwarning = show
        yield
