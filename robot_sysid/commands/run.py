"""Commands that identify and plan: their parsers, and what all of them do with an outcome."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

from robot_sysid.commands.arguments import PROGRAM, Parser, parsed
from robot_sysid.commands.console import Console
from robot_sysid.commands.report import report_of, require_report
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
from robot_sysid.errors import SysidError
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.logs import LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.motion.plan_options import ExcitationOptions, LimitOptions, PoseOptions
from robot_sysid.preview import PreviewOptions, require_preview, show_plan
from robot_sysid.records import file_access
from robot_sysid.records.option_fields import (
    TrajectoryOptions,
    default_of,
    keys_of,
    options_of,
    record_from,
)
from robot_sysid.simulation import SimulatedArmOptions


class Question(NamedTuple):
    """What a command asks, an example, what its help says, and its options: the main ones, all.

    Of some groups ``only`` some keys are options, and none in any of those ``left_out``; ``usual``
    are, by key, defaults that it has in place of the records'.
    """

    config: Any
    example: str
    description: str
    main: Collection[str]
    groups: Mapping[str, Sequence[Any]]
    only: Mapping[str, Collection[str]] = {}
    left_out: Collection[str] = ()
    usual: Mapping[str, Any] = {}
    epilog: str = ""


ALONE = Question(
    SysidConfig.of,
    "robot-sysid examples/kinova/model/kinova_fullinertia_guess.xml",
    "Identify mass, centre of mass, inertia and friction of a robot arm's terminal "
    "link, and write a corrected model.",
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
        "torques",
        "measurements",
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
    epilog="Commands: robot-sysid plan, identify, payload, log, report, motors and "
    "example; each has its own --help. A model file that is called like a command is "
    "reached as ./plan.",
)
PLAN = Question(
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
        "preview": (PreviewOptions,),
    },
    only={"prediction": PREDICTED},
    left_out=("keep", "links", "bundle", "report", "plots"),
    usual=PLANNED,
)
IDENTIFY = Question(
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
    left_out=("measurements",),
)
PAYLOAD = Question(
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
    left_out=("links", "measurements", "validation_measurements", "verify_rollout"),
)
QUESTIONS = {"": ALONE, "plan": PLAN, "identify": IDENTIFY, "payload": PAYLOAD}
"""By the command's name; "" is the program with a model alone."""


def build_parser(command: str = "", full: bool = True) -> Parser:
    """Return the parser of a command; without ``full``, its help shows the main options only."""
    asked = QUESTIONS[command]
    main = None if full else asked.main
    parser = Parser(command, asked.example, asked.description, main, asked.epilog)
    parser.add_argument(
        "path", metavar="MODEL", type=Path, help="MuJoCo XML (MJCF) or URDF file"
    )
    if command == "identify":
        logs = "recording of the real arm"
        parser.add_argument(
            "measurements", metavar="LOG", nargs="+", type=Path, help=logs
        )
    for title, records in asked.groups.items():
        only = asked.only.get(title, ())
        parser.add(
            title, *records, only=only, leave_out=asked.left_out, usual=asked.usual
        )
    return parser.with_console()


def main(arguments: Sequence[str], command: str = "") -> int:
    """Run a command and return its exit code."""
    values, console = parsed(partial(build_parser, command), arguments)
    preview = record_from(PreviewOptions, values)
    require_preview(preview)
    own = {
        key: value
        for key, value in values.items()
        if key not in keys_of(PreviewOptions)
    }
    return carry_out(QUESTIONS[command].config(**own), console, preview)


def carry_out(config: Config, console: Console, preview: PreviewOptions) -> int:
    """Run what was asked for, show and print what it says, write report and bundle; return 0.

    SysidError where it failed, there is nothing to use, or no report.
    """
    require_report(config.output)
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.pipeline.stages import run

    config = replace(config, output=replace(config.output, config=console.config))
    if isinstance(config, SysidConfig):
        config = config.seeded()
    with warnings_as_notes(console):
        outcome = run(config, console)
    show_plan(outcome.checked, preview, console)
    saved = outcome.files if outcome.checked else ()
    console.stage(*outcome.lines, *(f"Trajectory saved to {path}" for path in saved))
    console.result(_answer(outcome))
    if outcome.files:
        _repeatable(config)
    failure = report_of(outcome, config.output, config.model.mesh_dir, console)
    if outcome.failure:
        raise SysidError(" ".join(outcome.verdict) or outcome.failure)
    if config.output.bundle:
        from robot_sysid.results.written_model import write_bundle

        names = file_access.MODEL_NAMES.values()
        for model in [path for path in outcome.files if path.name in names][:1]:
            console.stage(
                f"Bundle saved to {write_bundle(model, config.output.output_dir)}"
            )
    console.stage(*outcome.verdict)
    if failure:
        raise SysidError(failure)
    return 0


def _repeatable(config: Config) -> None:
    """Write the file that repeats a run, but not over the one that it was asked with."""
    path = config.output.output_dir / file_access.RUN_NAME
    command = PROGRAM
    usual: Mapping[str, Any] = {}
    if isinstance(config, PayloadConfig):
        command += " payload"
    elif isinstance(config, SysidConfig) and config.trajectory.plan_only:
        assert config.plan_file is not None
        path = config.plan_file.with_suffix(".toml")
        command = f"{command} plan"
        usual = PLANNED
    given = config.output.config
    if given is None or not (path.exists() and path.samefile(given)):
        file_access.write_atomically(path, text_of(command, config, path, usual))


def text_of(command: str, config: Any, path: Path, usual: Mapping[str, Any]) -> str:
    """Return the file, to be at a path, that asks a command ("robot-sysid plan") for this again.

    What is asked is a record of records of options, with the model's path; ``usual`` are, by key,
    defaults that the command has in place of the records'.
    """
    given = {"path": config.model.path}
    for record in vars(config).values():
        for name, each in options_of(record).items():
            if getattr(record, name) != usual.get(each.key, default_of(record, name)):
                given[each.key] = getattr(record, name)
    lines = [f"{key} = {_toml(value)}" for key, value in given.items()]
    said = f"# In {Path.cwd()}: {command} --config {quote(str(path))}"
    return "\n".join([said, *lines, ""])


def _toml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, (bool, int, float)):
        return str(value).lower()
    import json

    return json.dumps(str(value), ensure_ascii=False)


def _answer(outcome: Any) -> Mapping[str, Any] | str:
    """Return what --json prints: the result's file, or what there is to say of a plan."""
    for path in outcome.files:
        if path.name in (file_access.PARAMS_NAME, file_access.SERVO_NAME):
            return str(path.read_text(encoding="utf-8"))
    return {
        "verdict": outcome.verdict,
        "failure": outcome.failure,
        "prediction": outcome.lines,
        "files": [str(path) for path in outcome.files],
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
