"""The program ``robot-sysid``: finds the subcommand, handles all errors, returns the exit code."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from robot_sysid import __version__
from robot_sysid.commands import (
    COMMANDS,
    PROGRAM,
    make_output_tolerant,
    overview,
    print_line,
    print_text,
)
from robot_sysid.commands.arguments import Command
from robot_sysid.commands.remedies import paths_of_logs, remedies
from robot_sysid.errors import (
    INTERRUPTED,
    AmbiguousJointError,
    ColumnsError,
    InputError,
    SysidError,
    handle_stop_signals,
)
from robot_sysid.pipeline.motors import motors_required
from robot_sysid.records.file_access import write_atomically
from robot_sysid.records.option_fields import suggestion

# MuJoCo 4 spreads its files over three packages. Where pip upgrades release 3 in place, it installs
# these first and then removes the files of release 3, among them those of the same names.
_DAMAGED_MUJOCO = (
    "MuJoCo does not load; pip leaves it so where it upgrades release 3 to 4. "
    "Install it anew:"
)
_INSTALL_ANEW = (
    "pip uninstall -y mujoco mujoco-core mujoco-studio",
    "pip install mujoco",
)


def main(argv: Sequence[str] | None = None, commands: Sequence[Command] = ()) -> int:
    """Run a command and return its exit code, see ``errors.EXIT_CODES``.

    Args:
        argv: arguments without the program's name; default those of this process, which is then
            expected to end.
        commands: commands of a program that calls this one, each in place of the one of its name.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    make_output_tolerant()
    _limit_libraries()
    name = ""
    values: Mapping[str, Any] = {}
    interrupted = "interrupted"
    with record_interrupts(process_ends=argv is None) as interrupts:
        try:
            if arguments == ["--version"]:  # It takes no options.
                print_line(f"{PROGRAM} {__version__}", sys.stdout)
                return 0
            if not arguments:
                # Not 0: a script whose variable for the model is empty has run nothing.
                print_text("\n".join([*overview(), ""]), sys.stdout)
                return InputError.exit_code
            if arguments == ["motors"]:
                arguments.append("--help")
            command = _find_command(arguments, commands)
            name = command.name
            interrupted = command.interrupted
            arguments = arguments[len(name.split()) :]
            values, console = command.parse(arguments)
            return command.run(values, console)
        except SysidError as error:
            stated = _with_columns_file(_with_named_arm(error, values))
            lines = [*remedies(stated, name, arguments, values)]
            return _report_error(stated.sentence, error.exit_code, debug, lines)
        except MemoryError:
            remedy = "use a shorter log or motion, or a lower rate"
            message = f"the memory is not enough; {remedy}"
            return _report_error(message, InputError.exit_code, debug)
        except (Exception, KeyboardInterrupt) as error:
            if interrupts or isinstance(error, KeyboardInterrupt):
                return _report_error(interrupted, INTERRUPTED, debug)
            return _report_unexpected(error, debug)


def _with_named_arm(error: SysidError, values: Mapping[str, Any]) -> SysidError:
    """Return an error; where a model has several arms, the one that names the arm of the logs."""
    logs = paths_of_logs(values)
    if not isinstance(error, AmbiguousJointError) or not logs:
        return error
    from robot_sysid.pipeline.named_arm import error_of_named_arm

    return error_of_named_arm(error, logs, values)


def _with_columns_file(error: SysidError) -> SysidError:
    """Write the columns file that puts a log right, and return the error that says so.

    Without the file no option remedies the error. Any other error is returned as it is.
    """
    if not isinstance(error, ColumnsError):
        return error
    path = Path(error.name)
    try:
        # A file that exists has this text, whoever wrote it.
        if not path.exists():
            write_atomically(path, error.draft)
    except InputError:
        return InputError(str(error))
    text = f"{error.sentence}. {error.name} has the columns put right: read it, and go on with it:"
    return error.with_message(text, error.command_lines)


def _find_command(arguments: Sequence[str], others: Sequence[Command]) -> Command:
    """Return the command with the longest name that the arguments begin with.

    One of ``others`` stands in place of the one of its name.

    InputError where the first word resembles a command and is no file.
    """
    word = arguments[0]
    is_file = word.startswith("-") or os.path.exists(word)
    hint = "" if is_file or word in COMMANDS else suggestion(word, COMMANDS)
    if hint:
        raise InputError(f"there is no file and no command {word}: {hint}")
    name = COMMANDS.get(word, COMMANDS["identify"])
    with motors_required():
        module = importlib.import_module(f"robot_sysid.commands.{name}")
    names = {command.name: command for command in (*module.COMMANDS, *others)}
    for count in (2, 1):
        name = " ".join(arguments[:count])
        if name in names:
            return names[name]
    return names[""]


@contextlib.contextmanager
def record_interrupts(process_ends: bool = False) -> Iterator[list[int]]:
    """Turn stop signals into KeyboardInterrupt; yield a list to which each signal is added.

    A compiled module that is interrupted while it is imported turns KeyboardInterrupt into an
    ImportError; the list tells that from a real one. A program that handles SIGINT itself keeps
    its handlers.

    Args:
        process_ends: ignore the signals after the block, see ``handle_stop_signals``.
    """
    numbers = []

    def interrupt(number: int, frame: Any) -> None:
        """Note the signal and stop the command."""
        numbers.append(number)
        raise KeyboardInterrupt

    handling: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        handling = handle_stop_signals(interrupt, ignore_afterwards=process_ends)
    with handling:
        yield numbers


def _limit_libraries() -> None:
    """Keep numpy from starting threads, and MuJoCo from looking for windows.

    Sets environment variables, so it must be called before either library is imported. Threads only
    wait for each other on matrices this small: an arm of 60 joints takes fifty times as long with
    four threads, so values that are set for other programs are replaced. Code that draws chooses
    its own renderer (``report.studio``).
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ[name] = "1"
    os.environ.setdefault("MUJOCO_GL", "disable")


def _report_unexpected(error: BaseException, debug: bool) -> int:
    """Print an error that is not raised on purpose and return the exit code.

    It is that of InputError where the system refused a file or MuJoCo does not load, else that of
    SysidError.
    """
    if isinstance(error, OSError) and error.strerror:
        # A file that is gone, a name that is too long, a disk that fails.
        fault = f"{error.strerror}: {error.filename or 'a temporary file'}"
        message = f"{fault}; check it, or choose another"
        return _report_error(message, InputError.exit_code, debug)
    if isinstance(error, ImportError) and not _is_mujoco_whole():
        code = InputError.exit_code
        return _report_error(_DAMAGED_MUJOCO, code, debug, _INSTALL_ANEW)
    hint = "this is a defect in robot-sysid; run again with --debug and report it"
    message = f"{type(error).__name__}: {error} ({hint})"
    return _report_error(message, SysidError.exit_code, debug)


def _is_mujoco_whole() -> bool:
    """Return whether MuJoCo can be imported, whatever else cannot."""
    try:
        importlib.import_module("mujoco")
    except ImportError:
        return False
    return True


def _report_error(
    message: str, code: int, debug: bool, commands: Sequence[str] = ()
) -> int:
    """Print an error, and commands that remedy it below; return the exit code.

    ``debug``: print its traceback, too.
    """
    if debug:
        import traceback

        traceback.print_exc()
    with contextlib.suppress(InputError):
        print_line(on_one_line(f"{PROGRAM}: error: {message}"), sys.stderr)
        for command in commands:
            print_line(f"  {command}", sys.stderr)
    return code


def on_one_line(message: str) -> str:
    """Return a text without ends of lines, and a very long one without its middle."""
    text = " ".join(message.split())
    return text if len(text) <= 1900 else f"{text[:1500]} [...] {text[-400:]}"


if __name__ == "__main__":
    sys.exit(main())
