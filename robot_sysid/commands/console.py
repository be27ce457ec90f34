"""What every command prints, and where: progress, notes, errors."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.records.progress import Progress


class Console(Progress):
    """Progress and results on standard output, notes on standard error.

    Args:
        quiet: say nothing at all.
        verbose: also say what is only of interest when something looks odd.
    """

    def __init__(self, quiet: bool = False, verbose: bool = False) -> None:
        self._quiet, self._verbose = quiet, verbose
        self._bar: Any = None

    def stage(self, message: str) -> None:
        """Print a progress line."""
        self.close()
        if not self._quiet:
            print_line(message, sys.stdout)

    def lines(self, messages: Iterable[str]) -> None:
        """Print several lines."""
        for message in messages:
            self.stage(message)

    def track(self, items: Iterator[Any], label: str, total: int) -> Iterator[Any]:
        """Show a bar while items pass, on a terminal; leave one line behind."""
        yield from self._new_bar(label, total, items) if self._shows_bars else items
        self.stage(f"{label}: 100%")

    def advance(self, label: str, done: float, total: float, text: str) -> None:
        """Move the bar of something long, on a terminal; it is gone once that is done."""
        if not self._shows_bars:
            return
        self._bar = self._bar or self._new_bar(label, total)
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

    def close(self) -> None:
        """Take away a bar that an early end left behind."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    @property
    def _shows_bars(self) -> bool:
        return sys.stderr.isatty() and not self._quiet

    @staticmethod
    def _new_bar(label: str, total: float, items: Iterator[Any] | None = None) -> Any:
        from tqdm import tqdm

        return tqdm(items, desc=label, total=total, leave=False, delay=0.5)

    def note(self, message: str) -> None:
        """Print a sentence the user should know."""
        if not self._quiet:
            print_line(f"note: {message}", sys.stderr)

    def detail(self, message: str) -> None:
        """Print a sentence that only --verbose shows."""
        if self._verbose and not self._quiet:
            print_line(message, sys.stdout)


def print_line(message: str, stream: Any) -> None:
    """Print a line; a reader that has gone away (``| head``) does not stop the run."""
    try:
        stream.write(f"{message}\n")
        stream.flush()
    except BrokenPipeError:
        _silence(stream)
    except OSError as error:
        _silence(stream)
        raise InputError(f"cannot print: {error.strerror}; send the output elsewhere") from None


def _silence(stream: Any) -> None:
    """Send what is still to be printed, and what waits in the buffer, to nowhere."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def tolerant_output() -> None:
    """Never fail on a terminal that cannot show a middle dot, or where there is no terminal."""
    sys.stdin = sys.stdin or _nowhere("r")
    sys.stdout = sys.stdout or _nowhere()
    sys.stderr = sys.stderr or _nowhere()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def _nowhere(mode: str = "w") -> Any:
    """Return a stream that swallows all and gives nothing, in place of one that was closed.

    A closed stream's number would go to the next file that is opened; and a process that a library
    starts (old versions of GLFW's loader do) has to find an open one.
    """
    stream = open(os.devnull, mode)  # noqa: SIM115
    os.set_inheritable(stream.fileno(), True)
    return stream
