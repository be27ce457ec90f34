"""The subcommands, and the console that all of them print on.

Imports nothing slow: errors at the very start are printed by it.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Optional

from robot_sysid.errors import InputError
from robot_sysid.records.messages import Detail, Progress, printable
from robot_sysid.records.option_fields import OptionRecord, option

PROGRAM = "robot-sysid"
COMMANDS = {
    "log": "log",
    "identify": "identify",
    "report": "report",
    "plan": "identify",
    "payload": "identify",
    "check": "check",
    "motors": "motors",
    "example": "example",
}
"""Subcommand to its module; any other first word is a model file, for the module identify."""
# Words behind the program's name to what they are for, in the order in which one needs them.
_USES = {
    "log LOG MODEL": "look for what is wrong with a log of the arm",
    "identify MODEL LOG": "correct the model: links, friction, rotor inertia",
    "report DIR": "draw the result of a run as a page",
    "plan MODEL": "plan a motion to record, where the log shows too little",
    "payload MODEL --empty LOG --loaded LOG": "weigh what is bolted on, by difference",
    "check MODEL LOG --since EARLIER": "tell whether the arm is what it was at an earlier log",
    "motors simulate|check|play FILE": "rehearse and play a planned motion on Damiao motors",
    "motors setup|map|monitor|hold|move": "set Damiao motors up, watch them, hold or move an arm",
    "MODEL": "test the identification on the model's own simulation",
    "example kinova": "copy an example with two logs, to try all this",
}
# Escape code of red, yellow, green and bold letters to the beginnings of lines that have them on a
# terminal; the first beginning that fits counts.
_COLOURS = {
    31: ("Not usable", "robot-sysid: error", "STOP"),
    33: (
        "Usable, but",
        "Usable (",
        "Usable for",
        "Watch",
        "Log can",
        "note",
        "doubts",
        "Changed",
    ),
    32: ("Usable", "Log is fine", "Self-test passed", "Unchanged"),
    1: ("Copy into", "Next", "If "),
}
COMMAND_STARTS = ("  robot-sysid ", "  pip install ", "  pip uninstall ")
"""Beginnings of lines that are a command and nothing else, which can be pasted into a shell."""
# Beginnings of lines to paste, which are never wrapped.
_SHELL_LINES = ("robot-sysid ", "  mujoco.", *COMMAND_STARTS)


def overview() -> list[str]:
    """Return one line per command with its use, under a heading."""
    width = max(map(len, _USES))
    lines = [f"{PROGRAM} COMMAND ..., in the order in which you need them:"]
    lines += [f"  {command:{width}}  {use}" for command, use in _USES.items()]
    return [*lines, "Each COMMAND has its own --help."]


def print_line(message: str, stream: Any) -> None:
    """Print a line; a reader that has gone away (``| head``) does not stop the run.

    Control characters, and ends of lines within it, are shown as "?". On a terminal a line is
    wrapped, and its beginning may have a colour.
    """
    text = printable(message)
    print_text(f"{_terminal_text(text) if stream.isatty() else text}\n", stream)


def print_text(text: str, stream: Any) -> None:
    """Print a text unchanged; InputError where the stream cannot be written (a full disk).

    A reader that has gone away does not stop the run.
    """
    try:
        stream.write(text)
        stream.flush()
    except BrokenPipeError:
        _redirect_to_devnull(stream)
    except OSError as error:
        _redirect_to_devnull(stream)
        raise InputError(
            f"cannot print: {error.strerror}; send the output elsewhere"
        ) from None


def _terminal_text(text: str) -> str:
    """Return a line wrapped to the terminal's width and coloured.

    Rows of tables and commands are not wrapped. There is no colour where NO_COLOR
    (https://no-color.org) forbids it or the terminal has none.
    """
    import shutil
    import textwrap

    width = shutil.get_terminal_size().columns
    is_wrapped = "  " not in text.strip() and not text.startswith(_SHELL_LINES)
    if len(text) > width > 20 and is_wrapped:
        indent = " " * (len(text) - len(text.lstrip()) + 2)
        lines = textwrap.wrap(
            text, width, subsequent_indent=indent, break_on_hyphens=False
        )
        text = "\n".join(lines)
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    for colour, starts in _COLOURS.items():
        for start in filter(text.startswith, starts):
            end = max(text.find(":"), len(start))
            return f"\x1b[{colour}m{text[:end]}\x1b[0m{text[end:]}"
    return text


def _redirect_to_devnull(stream: Any) -> None:
    """Discard what is still to be printed on a stream, its buffer included."""
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, stream.fileno())
    os.close(devnull)


def make_output_tolerant() -> None:
    """Let printing never fail on a missing stream, or on a terminal without a middle dot."""
    sys.stdin = sys.stdin or _open_devnull("r")
    sys.stdout = sys.stdout or _open_devnull("w")
    sys.stderr = sys.stderr or _open_devnull("w")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def _open_devnull(mode: str) -> Any:
    """Return a stream that discards all and is empty, in place of one that was closed.

    A closed stream's number would go to the next file that is opened; and a process that a library
    starts (old versions of GLFW's loader do) has to find an open one.
    """
    stream = open(os.devnull, mode)  # noqa: SIM115
    os.set_inheritable(stream.fileno(), True)
    return stream


@dataclass(frozen=True)
class ConsoleOptions(OptionRecord):
    """How much is printed.

    Attributes:
        config: TOML file with more options; None for none.
    """

    verbose: bool = option(False, "say more", short="-v")
    debug: bool = option(False, "show the traceback of an error")
    json: bool = option(
        False, "print the result as JSON on standard output, all else on standard error"
    )
    config: Optional[Path] = option(
        None,
        "take options from this TOML file too, such as the run.toml of a run",
        "FILE",
    )


class Console(ConsoleOptions, Progress):
    """Progress and results on standard output, notes on standard error.

    A message of type ``Detail`` is printed only where it is verbose.

    Attributes:
        json_lines: lines that went to standard error because the result is JSON.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self._bar: Any = None
        self._printed_at = time.monotonic()
        self._noted: set[str] = set()
        self.json_lines: list[str] = []

    @property
    def _out(self) -> Any:
        return sys.stderr if self.json else sys.stdout

    def result(self, content: Mapping[str, Any] | str) -> None:
        """Print the result of a command where JSON is wanted; a text is JSON already."""
        if self.json:
            from robot_sysid.records.file_access import json_text

            text = content if isinstance(content, str) else json_text(content)
            print_text(text, sys.stdout)

    def stage(self, *messages: str) -> None:
        """Print lines, each in place of the progress bar."""
        for message in filter(self._is_printed, messages):
            self.close()
            if self.json:
                self.json_lines.append(message)
            print_line(message, self._out)

    def advance(self, label: str, done: float, total: float, text: str) -> None:
        """Move the progress bar of a long step, on a terminal; it disappears at its end.

        Elsewhere a line is printed now and then, if there is a text, so that a log file shows that
        the run goes on.
        """
        if not sys.stderr.isatty():
            if text and done:
                self._print_progress(f"{label}: {100.0 * done / total:.0f} %, {text}")
            return
        if self._bar is None or self._bar.desc != label:
            from tqdm import tqdm

            self.close()
            self._bar = tqdm(
                desc=label,
                total=total,
                initial=done,
                delay=0.5,
                bar_format="{l_bar}{bar}| [{elapsed}<{remaining}{postfix}]",
                leave=False,
            )
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

    def _print_progress(self, line: str) -> None:
        """Print a line where none was printed for ten seconds."""
        now = time.monotonic()
        if now - self._printed_at >= 10.0:
            self._printed_at = now
            print_line(line, sys.stderr)

    def close(self) -> None:
        """Remove the progress bar, if there is one."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def note(self, *messages: str) -> None:
        """Print sentences the user should know, each once."""
        for message in filter(self._is_printed, dict.fromkeys(messages)):
            if message in self._noted:
                continue
            self._noted.add(message)
            if self._bar is not None:
                self._bar.clear()
            print_line(f"note: {message}", sys.stderr)

    def _is_printed(self, message: str) -> bool:
        return self.verbose or not isinstance(message, Detail)
