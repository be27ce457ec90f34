"""One command line of ``robot-sysid motors``: what it asks for, and asking who sits there."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Mapping
from functools import partial
from typing import Any

from robot_sysid.commands.console import Console
from robot_sysid.commands.streams import print_line
from robot_sysid.damiao.execution import MotorRun
from robot_sysid.damiao.recorder import Aside
from robot_sysid.damiao.settings import SecondArm
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.model.options import ModelOptions
from robot_sysid.records.options import given_options, record_from


def answer(prompt: str) -> str:
    """Return what a person types."""
    with contextlib.suppress(EOFError):
        return input(prompt)
    raise InputError("not confirmed: standard input has ended")


def said_yes(question: str, hint: str = "") -> bool:
    """Ask a person, who has to sit at a terminal."""
    if not sys.stdin.isatty():
        raise InputError(f"nobody can confirm: standard input is no terminal{hint}")
    return answer(f"{question} Type yes: ").strip().lower() == "yes"


# What printing a line may take [s].
_PATIENCE = 1.0


def _hanging(words: str, last: bool) -> None:
    """Say what hangs, and end the program: its main thread cannot any more."""
    # A terminal that takes nothing must not keep it from ending.
    aside = Aside(threaded=True)
    aside(partial(print_line, f"robot-sysid: {'error' if last else 'note'}: {words}", sys.stderr))
    aside.finish(_PATIENCE)
    if last:
        os._exit(HardwareAbort.exit_code)


class Asked(MotorRun):
    """One command line of ``motors``, as records."""

    def __init__(self, values: Mapping[str, Any], console: Console) -> None:
        super().__init__(values, _hanging)
        self.console = console

    def arm_words(self) -> list[str]:
        """Return the words of the command line that say which arm it is."""
        records = (record_from(record, self.values) for record in (ModelOptions, SecondArm))
        chosen = [each.key for record in records for each in given_options(record)]
        keys = [key for key in ("model", "joint_map") if self.values.get(key)] + chosen
        flags = [f"--{key.replace('_', '-')}" for key in keys]
        return [str(w) for flag, key in zip(flags, keys) for w in (flag, self.values[key])]
