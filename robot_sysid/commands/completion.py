"""What a shell offers to complete a command line: that of the parser of the command in it."""

from __future__ import annotations

import argparse
import importlib
import os
from collections.abc import Sequence
from typing import Any

from argcomplete import autocomplete
from argcomplete.completers import FilesCompleter

from robot_sysid.commands import COMMANDS


def complete() -> None:
    """Answer a shell that asks (``register-python-argcomplete robot-sysid``), and end."""
    before = os.environ["COMP_LINE"][: int(os.environ["COMP_POINT"])]
    done = f"{before}|".split()[1:-1]
    parser, words, offered = _parser(done)
    # A subcommand is completed as a program of its own: so many words belong to its name.
    os.environ["_ARGCOMPLETE"] = str(words)
    autocomplete(parser, default_completer=_Words(offered))


class _Words(FilesCompleter):
    """Files and some words."""

    def __init__(self, words: Sequence[str]) -> None:
        super().__init__()
        self.words = words

    def __call__(self, prefix: str, **_: Any) -> list[str]:
        return [*self.words, *super().__call__(prefix)]


def _parser(done: Sequence[str]) -> tuple[argparse.ArgumentParser, int, Sequence[str]]:
    """Return what parses a line of complete words, how many name it, and words beside files."""
    name = done[0] if done and done[0] in COMMANDS else ""
    kind = COMMANDS.get(name, "run")
    module = importlib.import_module(f"robot_sysid.commands.{kind}")
    if name == "motors":
        if len(done) > 1 and done[1] in module.COMMANDS:
            return module.build_parser(done[1]), 3, ()
        choice = argparse.ArgumentParser()
        choice.add_argument("command", choices=module.COMMANDS)
        return choice, 2, ()
    asked = (name,) if kind == "run" else ()
    return (
        module.build_parser(*asked),
        2 if name else 1,
        () if done else tuple(COMMANDS),
    )
