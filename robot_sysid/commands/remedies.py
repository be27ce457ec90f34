"""Commands that remedy an error, complete and quoted for a shell."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from robot_sysid.commands import PROGRAM
from robot_sysid.errors import ColumnsError, InputError, SysidError
from robot_sysid.pipeline.next_steps import SAME_LOG, step_after
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
    if not isinstance(error, InputError):
        return
    for words in error.command_lines:
        yield shlex.join([PROGRAM, *words])
    if error.command_lines:
        return
    # A file may name one log as a text, not as a list.
    keys = ("log", "measurements", "empty")
    logs = next(filter(None, map(values.get, keys)), ())
    paths = [*map(Path, leaves(logs))]
    typed = [PROGRAM, *name.split(), *arguments]
    for option in error.options:
        if option[0] == "--units" and values.get("units"):
            option = ("--units", f"{values['units']},{option[1]}")
        # A payload of known mass has all that the weighing needs, but for the first scales.
        if error.command == "payload" and paths and "known_mass" not in values:
            # The recording with the weight has the form of the log, and lies beside it.
            weight = paths[0].with_name(f"weight{paths[0].suffix}")
            state = "torque scales unknown"
            step = step_after(state, values, *option, log=paths, weight=weight)
            yield shlex.join(step.command)
        # Only that command has these options, or who has stated columns goes on to it.
        elif name == "log" and (error.command or isinstance(error, ColumnsError)):
            step = step_after(SAME_LOG, values, *option, log=paths)
            yield shlex.join(step.command)
        elif error.command in ("", name):
            words = [*typed]
            # Corrected columns have all that those in use have, and so have units.
            for flag in {"--columns", "--units"} & {*typed} & {*option}:
                at = words.index(flag)
                del words[at : at + 2]
            yield shlex.join([*words, *option])
