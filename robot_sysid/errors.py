"""The errors that cross this package's border.

::

    SysidError                 exit code 1: ran, but the result is not trustworthy
    ├── InputError             exit code 2: bad input or usage
    │   ├── ColumnsError       it is not known which column of a log is what
    │   └── ModelError         the model file cannot be used as it is
    │       └── AmbiguousJointError   several joints could be the terminal one
    ├── SimulationError        non-finite values while simulating
    ├── ExportError            a written file failed its own check
    └── HardwareAbort          exit code 3: a real (or simulated) arm was stopped

Every message is one line: what is wrong, where, and what to do about it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence

INTERRUPTED = 130
EXIT_CODES: Mapping[int, str] = {
    0: "done",
    1: "result not trustworthy, or something to change before playing",
    2: "bad input",
    3: "run on the arm refused or stopped",
    INTERRUPTED: "interrupted",
}
"""What a process says with its exit code."""


def words_of(error: BaseException) -> str:
    """Return what an error says, on one line; its type where it says nothing or is not ours."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__


class SysidError(Exception):
    """Base of all errors raised on purpose; carries the process exit code."""

    exit_code = 1


class InputError(SysidError):
    """Bad input or usage; the user has to change something."""

    exit_code = 2


@contextlib.contextmanager
def named(recording: str) -> Iterator[None]:
    """Let an InputError say which recording it is about."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{recording}: {error}" if recording else str(error)) from None


class ColumnsError(InputError):
    """It is not known which column of a log is what.

    Attributes:
        draft: a columns file to complete; "" where there is none.
        name: what such a file of this log may be called.
    """

    def __init__(
        self, message: str, draft: str = "", name: str = "columns.txt"
    ) -> None:
        super().__init__(message)
        self.draft = draft
        self.name = name


class ModelError(InputError):
    """A model file cannot be read, compiled or used."""


class AmbiguousJointError(ModelError):
    """Several joints could be the terminal one; lists them.

    Args:
        reason: why the tool cannot decide.
        candidates: (joint name, body name) pairs to choose from.
    """

    def __init__(self, reason: str, candidates: Sequence[tuple[str, str]]) -> None:
        self.candidates = tuple(candidates)
        listed = ", ".join(f"{joint} (body {body})" for joint, body in self.candidates)
        super().__init__(
            f"{reason}; choose one with --joint NAME. Candidates: {listed}"
        )


class SimulationError(SysidError):
    """The simulation produced values that are not finite."""


class ExportError(SysidError):
    """A written file does not reproduce what was identified."""


class HardwareAbort(SysidError):
    """A run on the arm was stopped before its end."""

    exit_code = 3
