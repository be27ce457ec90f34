"""``robot-sysid MODEL``, ``plan``, ``identify`` and ``payload``: their parsers and runs."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

from robot_sysid import __version__
from robot_sysid.commands import PROGRAM, Console, overview
from robot_sysid.commands.arguments import Parser, parse_command
from robot_sysid.commands.remedies import add_weighing
from robot_sysid.commands.report import draw_report
from robot_sysid.config import (
    Config,
    IdentifyConfig,
    LogConfig,
    MotionConfig,
    PayloadConfig,
    PlanConfig,
    SelfTestConfig,
)
from robot_sysid.errors import InputError, SysidError
from robot_sysid.pipeline.next_steps import values_of
from robot_sysid.records import file_access
from robot_sysid.records.option_fields import given_values
from robot_sysid.report.drawing import require_matplotlib


class CommandSpec(NamedTuple):
    """Help and options of one command.

    Attributes:
        config: class of the record of the command's options.
        example: a complete command line.
        description: what the command does.
        main: keys of the options in the short help.
        overview: lines of the help before the usage.
    """

    config: type[Config]
    example: str
    description: str
    main: Collection[str]
    overview: Sequence[str] = ()


SPECS = {
    "": CommandSpec(
        SelfTestConfig,
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
        ),
        overview=overview(),
    ),
    "plan": CommandSpec(
        PlanConfig,
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
            "max_velocity",
            "max_torque",
            "workspace",
            "keep_out",
            "export_damiao",
            "motor_type",
        ),
    ),
    "identify": CommandSpec(
        IdentifyConfig,
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
            "validation_measurements",
            "friction_model",
            "links",
            "keep",
        ),
    ),
    "payload": CommandSpec(
        PayloadConfig,
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
            "columns",
            "units",
            "torque_scale",
        ),
    ),
}
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
    for title, record in spec.config.records().items():
        parser.add(title, record, only=spec.config.option_keys())
    if not command:
        version = f"{PROGRAM} {__version__}"
        parser.add_argument(
            "--version", action="version", version=version, help="print the version"
        )
    return parser.add_console_options()


def main(arguments: Sequence[str], command: str = "") -> int:
    """Run a command of ``SPECS``, print what it has written, draw its report; return the exit code.

    The verdict is printed last, and not at all where the run failed: the error states it then.

    Args:
        arguments: words behind the command's name on the command line.
        command: "plan", "identify" or "payload"; "" for ``robot-sysid MODEL`` alone.

    Raises:
        SysidError: the run failed, its result cannot be used, or a wanted report is missing.
    """
    values, console = parse_command(partial(build_parser, command), arguments)
    config = SPECS[command].config.of(**values)
    if config.output.report:
        require_matplotlib()
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.pipeline.stages import run

    # No output replaces the file that the options came from.
    config = replace(config, output=replace(config.output, config=console.config))
    if isinstance(config, MotionConfig):
        config = config.with_seed()
    with library_warnings_as_notes(console):
        try:
            written = run(config, console)
        except InputError as error:
            if isinstance(config, LogConfig):
                _add_weighing(error, config)
            raise
    console.stage(*written.lines)
    answer = written.result
    for path in written.files:
        if path.name in (file_access.PARAMS_NAME, file_access.SERVO_NAME):
            answer = path.read_text(encoding="utf-8")
    console.result(answer)
    if written.files:
        _write_settings(config, command)
    missing = None
    if config.output.report:
        missing = draw_report(config, console)
    if written.failure:
        raise SysidError(" ".join(written.verdict))
    console.stage(*written.verdict)
    if missing:
        raise SysidError(missing)
    return 0


def _add_weighing(error: InputError, config: LogConfig) -> None:
    """Add the command that weighs torque scales to an error that asks for it."""
    logs: Sequence[Path] = ()
    if isinstance(config, IdentifyConfig):
        logs = config.log.measurements
    elif isinstance(config, PayloadConfig):
        # A payload of known mass has all that the weighing needs, but for the first scales.
        logs = () if config.payload.known_mass else config.payload.empty
    for log in logs[:1]:
        add_weighing(error, values_of(config.model, config.log), log)


def _write_settings(config: Config, command: str) -> None:
    """Write the file that repeats a run, but not over the file of its own --config."""
    path = config.output.output_dir / file_access.RUN_NAME
    if isinstance(config, PlanConfig):
        path = config.plan_file.with_suffix(".toml")
    if path.resolve() == Path(config.output.config or "").resolve():
        return
    words = f"{PROGRAM} {command}".strip()
    text = f"# In {Path.cwd()}: {words} --config {quote(str(path))}\n"
    file_access.write_atomically(path, text + settings_text(config))


def settings_text(config: Config) -> str:
    """Return the TOML text of a command's options that differ from their defaults."""
    lines = [f"path = {_toml_value(config.model.path)}"]
    for name in config.records():
        for key, value in given_values(getattr(config, name)).items():
            lines.append(f"{key} = {_toml_value(value)}")
    return "\n".join([*lines, ""])


def _toml_value(value: Any) -> str:
    """Return an option's value as TOML text."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, (bool, int, float)):
        return str(value).lower()
    return json.dumps(str(value), ensure_ascii=False)


@contextlib.contextmanager
def library_warnings_as_notes(console: Console) -> Iterator[None]:
    """Turn warnings of Python libraries into notes; --debug shows where they come from."""

    def show(message: Any, *_: Any, **__: Any) -> None:
        console.note(
            f"numerical warning: {message}; check the result (--debug says where)"
        )

    with warnings.catch_warnings():
        if not console.debug:
            warnings.showwarning = show
        yield
