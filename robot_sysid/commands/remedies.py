"""Commands that remedy an error, where the one that failed has not the options for it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.pipeline.next_steps import step_after


def add_commands(
    error: InputError, state: str, values: Mapping[str, Any], **words: Any
) -> None:
    """Add the command of a state, with each of the options that remedy an error, to the error."""
    steps = [step_after(state, values, *option, **words) for option in error.options]
    error.command_lines = [step.command[1:] for step in steps]


def add_weighing(error: InputError, values: Mapping[str, Any], log: Path) -> None:
    """Add the command that weighs torque scales to an error whose options are for ``payload``.

    Args:
        error: what stopped the reading of a log; one with options for other commands is left.
        values: see ``step_after``.
        log: of the arm without a weight.
    """
    if error.command == "payload":
        # The recording with the weight has the form of the log, and lies beside it.
        weight = log.with_name(f"weight{log.suffix}")
        add_commands(error, "torque scales unknown", values, log=log, weight=weight)
