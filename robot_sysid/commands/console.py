"""What every command prints, and where: progress, notes, errors."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robot_sysid.commands.streams import print_line, print_text
from robot_sysid.errors import InputError
from robot_sysid.records.messages import Detail, Progress
from robot_sysid.records.option_fields import OptionRecord, option

TOLD_EVERY = 10.0
"""Time between two lines of progress where there is no terminal [s]."""


@dataclass(frozen=True)
class ConsoleOptions(OptionRecord):
    """How much is printed."""

    verbose: bool = option(False, "say more", short="-v")
    quiet: bool = option(False, "print errors only")
    debug: bool = option(False, "show the traceback of an error")
    json: bool = option(
        False, "print the result as JSON on standard output, all else on standard error"
    )
    config: Path | None = option(
        None,
        "take options from this TOML file too, such as the run.toml of a run",
        "FILE",
    )


class Console(ConsoleOptions, Progress):
    """Progress and results on standard output, notes on standard error.

    A ``Detail`` among them only shows where it is verbose. ``said`` are the lines that went to
    standard error because the result is JSON.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.verbose and self.quiet:
            raise InputError("--verbose and --quiet exclude each other; choose one")
        self._bar: Any = None
        self._told_at = 0.0
        self.said: list[str] = []

    @property
    def _out(self) -> Any:
        return sys.stderr if self.json else sys.stdout

    def result(self, content: Mapping[str, Any] | str) -> None:
        """Print what a command found, where it is asked for as JSON; text is JSON already."""
        if self.json:
            from robot_sysid.export import json_text

            text = content if isinstance(content, str) else json_text(content)
            print_text(text, sys.stdout)

    def stage(self, *messages: str) -> None:
        """Print lines."""
        for message in filter(self._is_wanted, messages):
            self.close()
            self.said += [message] if self.json else []
            print_line(message, self._out)

    def back(self, lines: int) -> None:
        """Have what comes next take the place of the last lines, on a terminal."""
        if self._out.isatty() and not self.quiet:
            self._out.write(f"\x1b[{lines}A")

    def advance(self, label: str, done: float, total: float, text: str) -> None:
        """Move the bar of something long, on a terminal; it is gone once that is done.

        Elsewhere what has a text is told now and then, so that a log file shows that it lives.
        """
        if self.quiet or not sys.stderr.isatty():
            if text and not self.quiet:
                self._tell(f"{label}: {100.0 * done / total:.0f} %, {text}")
            return
        if self._bar is None or self._bar.desc != label:
            from tqdm import tqdm

            self.close()
            look = {
                "bar_format": "{l_bar}{bar}| [{elapsed}<{remaining}{postfix}]",
                "leave": False,
            }
            self._bar = tqdm(desc=label, total=total, initial=done, delay=0.5, **look)
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

    def _tell(self, line: str) -> None:
        """Print a line, unless one was printed, or might have been for the first time, just now."""
        now = time.monotonic()
        self._told_at = self._told_at or now
        if now - self._told_at >= TOLD_EVERY:
            self._told_at = now
            print_line(line, sys.stderr)

    def close(self) -> None:
        """Take away a bar that an early end left behind."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def note(self, *messages: str) -> None:
        """Print sentences the user should know."""
        for message in filter(self._is_wanted, messages):
            if self._bar is not None:
                self._bar.clear()
            print_line(f"note: {message}", sys.stderr)

    def _is_wanted(self, message: str) -> bool:
        return not self.quiet and (self.verbose or not isinstance(message, Detail))
