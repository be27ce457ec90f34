"""The command ``robot-sysid``: arguments in, progress and exit code out."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

from robot_sysid.errors import InputError, SysidError

INTERRUPTED = 130


class Console:
    """Progress on standard output, notes on standard error.

    Args:
        quiet: say nothing at all.
        verbose: also say what is only of interest when something looks odd.
    """

    def __init__(self, quiet: bool, verbose: bool) -> None:
        self._quiet, self._verbose = quiet, verbose
        self._bar: Any = None

    def stage(self, message: str) -> None:
        """Print a progress line."""
        self.close()
        if not self._quiet:
            _print(message, sys.stdout)

    def track(self, items: Iterator[Any], label: str, total: int) -> Iterator[Any]:
        """Show a bar while items pass, on a terminal; leave one line behind."""
        yield from self._new_bar(label, total, items) if self._shows_bars else items
        self.stage(f"{label}: 100%")

    def advance(self, label: str, done: int, total: int, text: str) -> None:
        """Move the bar of a search, on a terminal; it is gone once the search is done."""
        if not self._shows_bars:
            return
        self._bar = self._bar or self._new_bar(label, total)
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

    def close(self) -> None:
        """Take away a bar that an early end of its search left behind."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    @property
    def _shows_bars(self) -> bool:
        return sys.stderr.isatty() and not self._quiet

    @staticmethod
    def _new_bar(label: str, total: int, items: Iterator[Any] | None = None) -> Any:
        from tqdm import tqdm

        return tqdm(items, desc=label, total=total, leave=False, delay=0.5)

    def note(self, message: str) -> None:
        """Print a sentence the user should know."""
        if not self._quiet:
            _print(f"note: {message}", sys.stderr)

    def detail(self, message: str) -> None:
        """Print a sentence that only --verbose shows."""
        if self._verbose and not self._quiet:
            _print(message, sys.stdout)


def _print(message: str, stream: Any) -> None:
    """Print a line; a reader that has gone away (``| head``) does not stop the run."""
    try:
        print(message, file=stream, flush=True)
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


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code.

    0 done; 1 ran, but the result is not trustworthy; 2 bad input or usage; 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    _tolerant_output()
    _one_blas_thread()
    with _remembered_interrupts() as interrupts:
        try:
            return _run(arguments)
        except SysidError as error:
            return _report(str(error), error.exit_code, debug)
        except (Exception, KeyboardInterrupt) as error:
            if interrupts or isinstance(error, KeyboardInterrupt):
                return _report("interrupted; no unfinished file is left", INTERRUPTED, debug)
            hint = "this is a defect in robot-sysid; run again with --debug and report it"
            return _report(f"{type(error).__name__}: {error} ({hint})", 1, debug)


@contextlib.contextmanager
def _remembered_interrupts() -> Iterator[list[int]]:
    """Yield a list that gets an entry with Ctrl-C.

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

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield seen
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _one_blas_thread() -> None:
    """Keep numpy from starting threads: the matrices are small and threads only wait for another.

    Must come before numpy is imported; whoever has set the variable keeps his value.
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def _run(arguments: list[str]) -> int:
    from robot_sysid.options import build_parser, config_from

    options = build_parser().parse_args(arguments)
    config = config_from(options)
    console = Console(options.quiet, options.verbose)
    # Imported here so that --help and usage errors do not wait for MuJoCo.
    from robot_sysid.pipeline import run

    with _warnings_as_notes(console, options.debug):
        outcome = run(config, console)
    for line in outcome.report_lines(options.verbose):
        console.stage(line)
    if outcome.failure:
        raise SysidError(outcome.failure)
    return 0


@contextlib.contextmanager
def _warnings_as_notes(console: Console, debug: bool) -> Iterator[None]:
    """Turn warnings of Python libraries into notes; --debug shows where they come from."""

    def show(message: Any, *_: Any, **__: Any) -> None:
        console.note(f"numerical warning: {message}; check the result (--debug says where)")

    with warnings.catch_warnings():
        if not debug:
            warnings.showwarning = show
        yield


def _report(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    one_line = " ".join(message.split())
    with contextlib.suppress(InputError):
        _print(f"robot-sysid: error: {one_line}", sys.stderr)
    return code


def _tolerant_output() -> None:
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


if __name__ == "__main__":
    sys.exit(main())
