"""The command ``robot-sysid``: which subcommand, one handler for all errors, the exit code."""

from __future__ import annotations

import contextlib
import importlib
import os
import shlex
import signal
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from robot_sysid import __version__
from robot_sysid.commands import COMMANDS, PROGRAM
from robot_sysid.commands.streams import print_line, tolerant_output
from robot_sysid.errors import (
    INTERRUPTED,
    ColumnsError,
    InputError,
    SysidError,
    handle_stop_signals,
)

UNFINISHED = "interrupted; no unfinished file is left"
"""What an interrupted command says that says nothing else by its ``INTERRUPTED``."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code, see ``errors.EXIT_CODES``."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    tolerant_output()
    _without_what_only_costs_time()
    if "_ARGCOMPLETE" in os.environ:
        importlib.import_module("robot_sysid.commands.completion").complete()
    name = arguments.pop(0) if arguments and arguments[0] in COMMANDS else ""
    with _remembered_interrupts(ends=argv is None) as interrupts:
        interrupted = "interrupted"
        try:
            if arguments == ["--version"]:  # which takes no options
                print_line(f"{PROGRAM} {__version__}", sys.stdout)
                return 0
            if not name and arguments and not arguments[0].startswith("-"):
                _refuse_misspelt(arguments[0])
            module = COMMANDS.get(name, "run")
            command = importlib.import_module(f"robot_sysid.commands.{module}")
            interrupted = getattr(command, "INTERRUPTED", UNFINISHED)
            return int(command.main(arguments, *((name,) if module == "run" else ())))
        except SysidError as error:
            return _report(f"{error}{_drafted(error)}", error.exit_code, debug)
        except MemoryError:
            remedy = "use a shorter log or motion, or a lower rate"
            return _report(
                f"the memory is not enough; {remedy}", InputError.exit_code, debug
            )
        except (Exception, KeyboardInterrupt) as error:
            if interrupts or isinstance(error, KeyboardInterrupt):
                return _report(interrupted, INTERRUPTED, debug)
            if isinstance(error, OSError) and error.strerror:
                # Of a file that is there no more, a name that is too long, a disk that fails.
                refused = f"{error.strerror}: {error.filename or 'a temporary file'}"
                return _report(f"{refused}; check it, or choose another", 2, debug)
            hint = (
                "this is a defect in robot-sysid; run again with --debug and report it"
            )
            return _report(f"{type(error).__name__}: {error} ({hint})", 1, debug)


def _drafted(error: SysidError) -> str:
    """Write the columns file that an error brings, over no other; return what to do with it."""
    if not isinstance(error, ColumnsError) or not error.draft:
        return ""
    try:
        with open(error.name, "x", encoding="utf-8") as file:
            file.write(error.draft)
    except OSError:
        return ""
    name = shlex.quote(error.name)
    return f"; complete {name}, which was written for it, and add --columns {name}"


def _refuse_misspelt(word: str) -> None:
    """Raise InputError where a word looks like a subcommand and is no file."""
    from difflib import get_close_matches

    near = get_close_matches(word, COMMANDS, 1, 0.75)
    if near and not os.path.exists(word):
        raise InputError(
            f"there is no file and no command {word}: did you mean {near[0]}?"
        )


@contextlib.contextmanager
def _remembered_interrupts(ends: bool = False) -> Iterator[list[int]]:
    """Turn requests to stop into KeyboardInterrupt and yield a list that gets an entry with each.

    A compiled module that is interrupted while it is imported turns KeyboardInterrupt into an
    ImportError; the list tells that from a real one. For ``ends`` see ``handle_stop_signals``.
    """
    seen: list[int] = []

    def interrupt(number: int, frame: Any) -> None:
        seen.append(number)
        raise KeyboardInterrupt

    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with handle_stop_signals(interrupt, ends) if usual else contextlib.nullcontext():
        yield seen


def _without_what_only_costs_time() -> None:
    """Keep numpy from starting threads, and MuJoCo from looking for windows.

    Must come before they are imported. The matrices are small, and threads only wait for another:
    what is set for other programs does not count, as an arm of 60 joints takes fifty times as long
    with four of them. What draws chooses its renderer itself (``preview.film``).
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ[name] = "1"
    os.environ.setdefault("MUJOCO_GL", "disable")


def _report(message: str, code: int, debug: bool) -> int:
    if debug:
        import traceback

        traceback.print_exc()
    one_line = " ".join(message.split())
    beginning = 1500
    end = 400
    if len(one_line) > beginning + end:  # Nobody would read it all.
        one_line = f"{one_line[:beginning]} [...] {one_line[-end:]}"
    with contextlib.suppress(InputError):
        print_line(f"{PROGRAM}: error: {one_line}", sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
