"""Writing to standard output and error, also where nobody reads them any more.

Imports nothing that takes time: what goes wrong at the very start is told with it.
"""

from __future__ import annotations

import os
import sys
from typing import Any

from robot_sysid.errors import InputError

# What a title or a path from a file could do to a terminal; the last two ranges are line ends and
# marks by which text runs from right to left.
_MARKS = (*range(32), *range(127, 160), *range(0x2028, 0x202F), *range(0x2066, 0x206A))
_CONTROL = {code: "?" for code in _MARKS if chr(code) != "\t"}
_GREEN = 32
_YELLOW = 33
_RED = 31
_BOLD = 1
_COLOURS = {
    **dict.fromkeys(("Not usable", "robot-sysid: error", "STOP"), _RED),
    **dict.fromkeys(("Usable, but", "Usable (", "Usable for", "note", "warn"), _YELLOW),
    **dict.fromkeys(("Usable", "Self-test passed"), _GREEN),
    "Next": _BOLD,
}
"""How a line begins to the colour of its beginning on a terminal."""
_COMMANDS = ("robot-sysid ", "Next: robot-sysid ")


def print_line(message: str, stream: Any) -> None:
    """Print a line; a reader that has gone away (``| head``) does not stop the run.

    Control characters, and ends of lines within it, are shown as "?". On a terminal a line is made
    to fit, and its beginning may have a colour.
    """
    text = message.translate(_CONTROL)
    print_text(f"{_on_terminal(text) if stream.isatty() else text}\n", stream)


def print_text(text: str, stream: Any) -> None:
    """Print a text as it is; errors as in ``print_line``."""
    try:
        stream.write(text)
        stream.flush()
    except BrokenPipeError:
        _silence(stream)
    except OSError as error:
        _silence(stream)
        raise InputError(
            f"cannot print: {error.strerror}; send the output elsewhere"
        ) from None


def _on_terminal(text: str) -> str:
    """Return a line wrapped to the terminal's width, but for rows of a table and commands, and in
    colour unless NO_COLOR (https://no-color.org) or a terminal without any forbids it."""
    import shutil
    import textwrap

    width = shutil.get_terminal_size().columns
    indent = len(text) - len(text.lstrip())
    whole = "  " in text.strip() or text.startswith(_COMMANDS)
    if len(text) > width > 20 and not whole:
        rest = " " * (indent + 2)
        lines = textwrap.wrap(
            text, width, subsequent_indent=rest, break_on_hyphens=False
        )
        text = "\n".join(lines)
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    start = next((start for start in _COLOURS if text.startswith(start)), None)
    if start is None:
        return text
    end = max(text.find(":"), len(start))
    return f"\x1b[{_COLOURS[start]}m{text[:end]}\x1b[0m{text[end:]}"


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
