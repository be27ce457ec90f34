"""Commands that remedy an error, complete and quoted for a shell."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from robot_sysid.commands import PROGRAM
from robot_sysid.errors import ColumnsError, SysidError
from robot_sysid.logs.declarations import units_with
from robot_sysid.pipeline.next_steps import SAME_LOG, recording_ending, step_after
from robot_sysid.records.messages import shell_line
from robot_sysid.records.option_fields import leaves


def remedies(
    error: SysidError, name: str, arguments: Sequence[str], values: Mapping[str, Any]
) -> Iterator[str]:
    """Yield the commands that remedy an error.

    They are the one that failed, with one more option, or the one that has such an option.

    Args:
        error: what stopped the command.
        name: of the command; "" for a model file alone.
        arguments: words behind the command's name.
        values: of its options, by key; empty where it was not parsed.
    """
    if error.install:
        yield error.install
    if error.command_lines:
        for words in error.command_lines:
            yield shell_line([PROGRAM, *words])
        return
    logs = paths_of_logs(values)
    for stated in error.options:
        option = _with_units_of(values, stated)
        # A payload of known mass has all that the weighing needs, but for the first scales.
        if error.command == "payload" and logs and "known_mass" not in values:
            yield shell_line(_weighing_command(logs, values, option))
        # Only that command has these options, or who has stated columns goes on to it.
        elif name == "log" and (error.command or isinstance(error, ColumnsError)):
            step = step_after(SAME_LOG, values, *option, log=logs)
            yield shell_line(step.command)
        elif error.command in ("", name):
            typed = _without_columns(arguments, option)
            yield shell_line([PROGRAM, *name.split(), *typed, *option])


def paths_of_logs(values: Mapping[str, Any]) -> list[Path]:
    """Return the logs that a command was given first; a file may name one as a text, in no list."""
    for key in ("log", "measurements", "empty"):
        if values.get(key):
            return [*map(Path, leaves(values[key]))]
    return []


def _with_units_of(
    values: Mapping[str, Any], option: tuple[str, ...]
) -> tuple[str, ...]:
    """Return an option; one that states units states those of other kinds given before, too."""
    if option[0] == "--units" and values.get("units"):
        return "--units", units_with(option[1], values["units"])
    return option


def _weighing_command(
    logs: Sequence[Path], values: Mapping[str, Any], option: tuple[str, ...]
) -> Sequence[str]:
    """Return the command that finds the scales of torques with a weight of known mass."""
    # The recording with the weight has the form of the log, and lies beside it.
    weight = logs[0].with_name(f"weight{recording_ending(logs[0])}")
    state = "torque scales unknown"
    return step_after(state, values, *option, log=logs, weight=weight).command


def _without_columns(arguments: Sequence[str], option: tuple[str, ...]) -> list[str]:
    """Return arguments without the columns and units for which an option states others.

    Corrected columns have all that those in use have, and so have units.
    """
    words = [*arguments]
    for flag in {"--columns", "--units"} & {*words} & {*option}:
        at = words.index(flag)
        del words[at : at + 2]
    return words
