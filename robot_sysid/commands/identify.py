"""``robot-sysid MODEL``, ``plan``, ``identify`` and ``payload``: their options and runs."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from robot_sysid.commands import PROGRAM, Console, overview
from robot_sysid.commands.arguments import MODEL, Command
from robot_sysid.commands.report import draw_report
from robot_sysid.config import (
    Config,
    IdentifyConfig,
    MotionConfig,
    PayloadConfig,
    PlanConfig,
    SelfTestConfig,
)
from robot_sysid.errors import SysidError
from robot_sysid.records import file_access
from robot_sysid.records.messages import Progress, printable, quoted_text, shell_line
from robot_sysid.records.option_fields import given_values
from robot_sysid.report.drawing import require_matplotlib


def run_config(
    config_class: type[Config], name: str, values: Mapping[str, Any], console: Console
) -> int:
    """Run a command, print what it has written, draw its report; return the exit code.

    The verdict is printed last, and not at all where the run failed: the error states it then.

    Args:
        config_class: class of the options of the command.
        name: "plan", "identify" or "payload"; "" for ``robot-sysid MODEL`` alone.
        values: of the options, by key.
        console: prints the result.

    Raises:
        SysidError: the run failed, its result cannot be used, or a wanted report is missing.
    """
    config = config_class.of(**values)
    if config.output.report:
        require_matplotlib()
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.pipeline.stages import run

    # No output replaces the file that the options came from.
    config = replace(config, output=replace(config.output, config=console.config))
    if isinstance(config, MotionConfig):
        config = config.with_seed()
    with file_access.claim(config.written_files(), console.note):
        return _run_claimed(config, name, run, console)


def _run_claimed(
    config: Config, name: str, run: Callable[[Config, Progress], Any], console: Console
) -> int:
    """Run a command whose files are held, print what it has written, draw its report.

    ``run``: the pipeline, which returns what was written. Returns the exit code.
    """
    with library_warnings_as_notes(console):
        written = run(config, console)
    console.stage(*written.lines)
    answer = written.result
    for path in written.files:
        if path.name in (file_access.PARAMS_NAME, file_access.SERVO_NAME):
            answer = path.read_text(encoding="utf-8")
    console.result(answer)
    if written.files:
        _write_settings(config, name)
    missing = None
    if config.output.report:
        missing = draw_report(config, written.verdict, console)
    if written.failure:
        raise SysidError(" ".join(written.verdict))
    console.stage(*written.verdict)
    if missing:
        raise SysidError(missing)
    return 0


def _command(
    name: str,
    config: type[Config],
    example: str,
    description: str,
    main: str,
    overview: Sequence[str] = (),
) -> Command:
    """Return the command that runs with a class of options; ``main``: keys of its main options."""
    return Command(
        name,
        example,
        description,
        {"": MODEL, **config.options()},
        partial(run_config, config, name),
        main=main.split(),
        overview=overview,
    )


COMMANDS = (
    _command(
        "",
        SelfTestConfig,
        "identify arm.xml log.csv",
        "With a model alone: simulate it along a random motion and identify its terminal link from "
        "that, as a test of the program. A model file that is called like a command is reached as "
        "./plan.",
        "mesh_dir duration sample_rate no_friction output_dir export_damiao motor_type "
        "seed joint",
        overview(),
    ),
    _command(
        "plan",
        PlanConfig,
        "plan arm.xml --save-trajectory plan.json",
        "Design a trajectory that tells most about the terminal link, check it against "
        "all limits, say what it promises, and write it. --trajectory checks one that was saved.",
        "mesh_dir joint output_dir duration seed speed trajectory save_trajectory "
        "excitation max_velocity max_torque workspace keep_out export_damiao motor_type",
    ),
    _command(
        "identify",
        IdentifyConfig,
        "identify arm.xml log.csv",
        "Identify an arm from one log of it, or from several together: the terminal link, every "
        "other link with --links, friction and rotor inertia. Write a corrected model.",
        "mesh_dir joint output_dir columns units torque_scale validation_measurements "
        "friction_model links keep",
    ),
    _command(
        "payload",
        PayloadConfig,
        "payload arm.xml --empty a.csv d.csv --loaded b.csv c.csv --order ABBA",
        "Identify what is bolted to the flange from logs without and with it, and "
        "write a model that carries it and a card for controllers.",
        "mesh_dir joint output_dir empty loaded order flange as_body known_mass "
        "save_torque_scale columns units torque_scale",
    ),
)


def _write_settings(config: Config, command: str) -> None:
    """Write the file that repeats a run, but not over the file of its own --config."""
    path = config.settings_file
    if path is None:
        return
    words = [PROGRAM, *command.split(), "--config", str(path)]
    text = f"# In {printable(str(Path.cwd()))}: {shell_line(words)}\n"
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
    return quoted_text(str(value))


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
