"""The errors that cross this package's border, and the requests to stop that end a run.

::

    SysidError                 exit code 1: ran, but the result is not trustworthy
    ├── InputError             exit code 2: bad input or usage
    │   ├── ColumnsError       columns of a log contradict the model
    │   └── ModelError         the model file cannot be used as it is
    │       └── AmbiguousJointError   several joints could be the terminal one
    ├── SimulationError        non-finite values while simulating
    ├── ExportError            a written file failed its own check
    └── HardwareAbort          exit code 3: a real (or simulated) arm was stopped

Every message is one line: what is wrong, where, and what to do about it. A command to run for that
follows alone on a line of its own, after two blanks. It never stands in the message, which may hold
names that a stranger chose.

A request to stop is a signal (Ctrl-C, kill, a closed terminal). Python turns it into
KeyboardInterrupt in the main thread; the context managers at the end say when it has to wait.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from robot_sysid.wording import option_name

INTERRUPTED = 130
"""Exit code of a process that a signal stopped."""
EXIT_CODES: Mapping[int, str] = {
    0: "done",
    1: "not usable",
    2: "bad input",
    3: "run on the arm refused or stopped",
    INTERRUPTED: "interrupted",
}
"""Exit code of a process to its meaning."""


def error_text(error: BaseException) -> str:
    """Return an error's message on one line: an OSError's without its number and path, and the
    name of its type for an error without message.
    """
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__


class SysidError(Exception):
    """Base of all errors raised on purpose; carries the process exit code, and what remedies it.

    Attributes:
        options: options that remedy it, each with its value as words of a command line: added to
            the command that failed, one of them lets it go on. Empty where options do not help.
        command: name of the only command that has these options; "" where every one has them.
        command_lines: complete commands that remedy it, each as words, in place of ``options``.
        install: command of the user's shell that installs what is missing; "" for nothing.
    """

    exit_code = 1

    def __init__(
        self,
        message: str,
        options: Sequence[tuple[str, ...]] = (),
        command: str = "",
        command_lines: Sequence[Sequence[str]] = (),
        install: str = "",
    ) -> None:
        super().__init__(message)
        self.options = tuple(options)
        self.command = command
        self.command_lines = tuple(command_lines)
        self.install = install

    def __str__(self) -> str:
        return "\n  ".join(filter(None, (self.sentence, self.install)))

    @property
    def sentence(self) -> str:
        """The message without commands below it."""
        return str(self.args[0])

    def with_message(
        self, message: str, command_lines: Sequence[Sequence[str]] = ()
    ) -> SysidError:
        """Return an error with the same remedies and another message, such as a longer one."""
        remedies = self.options, self.command, command_lines, self.install
        return SysidError(message, *remedies)


class InputError(SysidError):
    """Bad input or usage; the user has to change something."""

    exit_code = 2

    def with_message(
        self, message: str, command_lines: Sequence[Sequence[str]] = ()
    ) -> InputError:
        """Return such an error with the same remedies and another message."""
        remedies = self.options, self.command, command_lines, self.install
        return InputError(message, *remedies)


@contextlib.contextmanager
def prefix_input_errors(recording: str) -> Iterator[None]:
    """Put a recording's name before the message of an InputError raised inside the block.

    An empty name leaves the message as it is.
    """
    try:
        yield
    except InputError as error:
        message = ": ".join(filter(None, (recording, error.sentence)))
        remedies = error.options, error.command, error.command_lines, error.install
        raise InputError(message, *remedies) from None


class ColumnsError(InputError):
    """The columns of a log contradict the model, and others put it right.

    Attributes:
        draft: text of a columns file with the columns put right.
        name: file name to write the draft to.
        options, command, command_lines: see ``SysidError``.
    """

    def __init__(
        self,
        message: str,
        draft: str,
        name: str,
        options: Sequence[tuple[str, ...]] = (),
        command: str = "",
        command_lines: Sequence[Sequence[str]] = (),
    ) -> None:
        super().__init__(message, options, command, command_lines)
        self.draft = draft
        self.name = name

    def with_message(
        self, message: str, command_lines: Sequence[Sequence[str]] = ()
    ) -> InputError:
        """Return an error with the same draft and remedies and another message."""
        remedies = self.options, self.command, command_lines
        return ColumnsError(message, self.draft, self.name, *remedies)


class ModelError(InputError):
    """A model file cannot be read, compiled or used."""


class AmbiguousJointError(ModelError):
    """Several joints could be the terminal one; lists them.

    Args:
        reason: why the program cannot decide.
        candidates: (joint name, body name) pairs to choose from.
    """

    def __init__(self, reason: str, candidates: Sequence[tuple[str, str]]) -> None:
        self.candidates = tuple(candidates)
        joints = ", ".join(f"{joint} (body {body})" for joint, body in self.candidates)
        super().__init__(
            f"{reason}; choose one with {option_name('joint', 'NAME')}. Candidates: {joints}",
            options=[("--joint", joint) for joint, _ in self.candidates],
        )


class SimulationError(SysidError):
    """The simulation produced values that are not finite."""


class ExportError(SysidError):
    """A written file does not reproduce the identified model."""


class HardwareAbort(SysidError):
    """A run on the arm was stopped before its end.

    Attributes:
        report: how the run went until then (PlayReport); None where it had not begun.
    """

    exit_code = 3

    def __init__(self, message: str, report: Any = None) -> None:
        super().__init__(message)
        self.report = report


def _signals(*names: str) -> tuple[signal.Signals, ...]:
    """Return those of the named signals that the system has."""
    return tuple(getattr(signal, name) for name in names if hasattr(signal, name))


STOP_SIGNALS = _signals("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2")
"""Signals by which a user or the system asks a program to end, and which end it by default."""
SUSPENSION = _signals("SIGTSTP")
"""The signal by which a terminal suspends a program (Ctrl-Z)."""


def _in_main_thread() -> bool:
    """Tell whether the caller runs in the main thread, the only one that may set handlers."""
    return threading.current_thread() is threading.main_thread()


@contextlib.contextmanager
def handle_stop_signals(
    handler: Callable[[int, Any], object],
    ignore_afterwards: bool = False,
    further: tuple[signal.Signals, ...] = (),
) -> Iterator[None]:
    """Have the stop signals call ``handler(number, frame)`` inside the block.

    A signal that is ignored stays ignored: nohup, or a shell's ``&``, wants it so. Outside of the
    main thread nothing is changed.

    Args:
        ignore_afterwards: ignore the signals after the block instead of restoring their handlers,
            for a process about to end: a signal in Python's own shutdown would replace its exit
            code.
        further: signals that are to do the same.
    """
    previous = {}
    for number in (*STOP_SIGNALS, *further) if _in_main_thread() else ():
        if signal.getsignal(number) is not signal.SIG_IGN:
            previous[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old_handler in previous.items():
            signal.signal(number, signal.SIG_IGN if ignore_afterwards else old_handler)


@contextlib.contextmanager
def delay_signals() -> Iterator[None]:
    """Hold the stop signals back inside the block, and raise those that arrived when it ends."""
    # Numbers of the signals that arrived: setdefault(number, frame) is called as their handler.
    arrived: dict[int, Any] = {}
    try:
        with handle_stop_signals(arrived.setdefault):
            yield
    finally:
        for number in arrived:
            signal.raise_signal(number)


@contextlib.contextmanager
def ignore_repeated_ctrl_c() -> Iterator[None]:
    """Ignore every Ctrl-C in the block after the first one that raises an exception.

    A stopped run needs a moment to save its results; a second Ctrl-C must not lose them.
    """
    handler = signal.getsignal(signal.SIGINT)
    # Not callable: SIGINT is ignored, or a program that embeds Python handles it.
    if not _in_main_thread() or not callable(handler):
        yield
        return

    def stop(number: int, frame: Any) -> None:
        """Ignore further signals while the earlier handler runs, which may raise an exception."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        handler(number, frame)
        # The handler raised nothing, so nothing was stopped.
        signal.signal(signal.SIGINT, stop)

    signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
