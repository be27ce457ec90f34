"""The command ``robot-sysid``: which subcommand, one handler for all errors, the exit code."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from typing import Any

from robot_sysid.commands.streams import print_line, tolerant_output
from robot_sysid.errors import INTERRUPTED, InputError, SysidError
from robot_sysid.interrupts import STOPPING

COMMANDS = ("plan", "identify", "arm", "payload", "log", "motors")
"""Subcommands, each a module of its name; any other first word is a model file."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code, see ``errors.EXIT_CODES``."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    tolerant_output()
    _one_blas_thread()
    name = arguments.pop(0) if arguments and arguments[0] in COMMANDS else "run"
    with _remembered_interrupts() as interrupts:
        interrupted = "interrupted"
        try:
            command = importlib.import_module(f"robot_sysid.commands.{name}")
            interrupted = command.INTERRUPTED
            return int(command.main(arguments))
        except SysidError as error:
            return _report(str(error), error.exit_code, debug)
        except MemoryError:
            remedy = "use a shorter log or motion, or a lower rate"
            return _report(f"the memory is not enough; {remedy}", InputError.exit_code, debug)
        except (Exception, KeyboardInterrupt) as error:
            if interrupts or isinstance(error, KeyboardInterrupt):
                return _report(interrupted, INTERRUPTED, debug)
            hint = "this is a defect in robot-sysid; run again with --debug and report it"
            return _report(f"{type(error).__name__}: {error} ({hint})", 1, debug)


@contextlib.contextmanager
def _remembered_interrupts() -> Iterator[list[int]]:
    """Turn requests to stop into KeyboardInterrupt and yield a list that gets an entry with each.

    A compiled module that is interrupted while it is imported turns KeyboardInterrupt into an
    ImportError; the list tells that from a real one.
    """
    seen: list[int] = []
    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not usual or threading.current_thread() is not threading.main_thread():
        yield seen
        return

    def interrupt(number: int, frame: Any) -> None:
        seen.append(number)
        raise KeyboardInterrupt

    # What nohup or a shell makes a process ignore stays ignored.
    heard = [number for number in STOPPING if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, interrupt) for number in heard}
    try:
        yield seen
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _one_blas_thread() -> None:
    """Keep numpy from starting threads: the matrices are small and threads only wait for another.

    Must come before numpy is imported; whoever has set the variable keeps his value.
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def _report(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    one_line = " ".join(message.split())
    with contextlib.suppress(InputError):
        print_line(f"robot-sysid: error: {one_line}", sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
