"""One command line of ``robot-sysid motors``: what it asks for, and asking who sits there."""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from robot_sysid.commands.arguments import PROGRAM
from robot_sysid.commands.console import Console
from robot_sysid.commands.streams import print_line
from robot_sysid.damiao.bus import BusAddress
from robot_sysid.damiao.execution import MotorRun
from robot_sysid.damiao.preflight import Permissions
from robot_sysid.damiao.protocol.frames import BusTiming
from robot_sysid.damiao.recorder import Aside, RecordingOptions
from robot_sysid.damiao.settings import PlaySettings, SecondArm
from robot_sysid.damiao.trajectory import LIMITS
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.model.options import ModelOptions
from robot_sysid.motion.options import LimitOptions
from robot_sysid.records.options import command_words
from robot_sysid.results.verdict import two_lines


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


_WHERE = BusAddress, BusTiming
_HOW = ModelOptions, SecondArm, PlaySettings, Permissions, RecordingOptions


class Asked(MotorRun):
    """One command line of ``motors``, as records."""

    def __init__(self, values: Mapping[str, Any], console: Console) -> None:
        super().__init__(values, _hanging)
        self.console = console
        self.verdict: tuple[str, ...] = ()

    def conclude(self, use: str, following: Sequence[str], why: str = "") -> None:
        """Note what came of it, and the words of the next command: that is said at the end."""
        self.verdict = two_lines(use, shlex.join(following) + why)

    def command(self, name: str, *leave_out: str, **more: Any) -> list[str]:
        """Return the words of a command of motors, with all that was given for this one.

        Keys in ``leave_out`` are not given again, but some are ``more``.
        """
        values = {key: value for key, value in self.values.items() if key not in leave_out} | more
        words, files = [PROGRAM, "motors", name], ("model", "joint_map")
        words += [str(values[key]) for key in ("trajectory",) if values.get(key)]
        words += command_words(values, *_WHERE)
        for key in (key for key in files if values.get(key)):
            words += [f"--{key.replace('_', '-')}", str(values[key])]
        limits = {key: values[key] for key in LIMITS if key in values}
        return [*words, *command_words(values, *_HOW), *command_words(limits, LimitOptions)]

    def play_words(self) -> list[str]:
        """Return the words of the command that plays what was checked, slowly at first."""
        usual = {"channel": ("CHANNEL",), "speed": 0.3, "record": "slow.csv"}
        return self.command("play", **{k: v for k, v in usual.items() if k not in self.values})
