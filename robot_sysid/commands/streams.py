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


def print_line(message: str, stream: Any) -> None:
    """Print a line; a reader that has gone away (``| head``) does not stop the run.

    Control characters, and ends of lines within it, are shown as "?".
    """
    try:
        stream.write(f"{message.translate(_CONTROL)}\n")
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
