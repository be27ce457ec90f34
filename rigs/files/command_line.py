"""Running the command in this process, and telling that it refused in one line and left nothing."""

from __future__ import annotations

import contextlib
import re
import signal
from collections.abc import Iterator
from pathlib import Path

from robot_sysid.cli import main
from robot_sysid.commands import check, example, identify, log, motors, report
from robot_sysid.records.file_access import RECORD_NAME

COMMANDS = {
    command.name: command
    for module in (identify, log, report, check, example, motors)
    for command in module.COMMANDS
}
"""Every command by its name."""
_KEYS = {
    option.key
    for command in COMMANDS.values()
    for options in command.groups.values()
    for option in options
}
# The place of an option's name in a constant: "{known_mass}", "{columns FILE}" or "{units=deg}".
_FIELD = re.compile(rf"\{{({'|'.join(sorted(_KEYS))})( [A-Z.]+|=[^{{}}]*)?\}}")
OUT = Path("sysid_output")
"""Where results are written in the working folder unless another folder is named."""


@contextlib.contextmanager
def ending_within(seconds: int) -> Iterator[None]:
    """Raise TimeoutError in a block that hangs."""

    def end(*_: object) -> None:
        raise TimeoutError(f"not done after {seconds} s")

    old_handler = signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old_handler)


def require_names(text: str) -> None:
    """Fail where a text that a person reads has a field in the place of an option's name."""
    field = _FIELD.search(text)
    assert field is None, f"{field and field[0]} is in: {text}"


def files_in(folder: Path) -> dict[str, bytes]:
    """Everything in a folder by relative path, folders with an empty content.

    The hidden record of what runs wrote there is left out.
    """
    contents = {}
    for path in sorted(folder.rglob("*")):
        if path.name == RECORD_NAME:
            continue
        name = str(path.relative_to(folder))
        contents[name] = path.read_bytes() if path.is_file() else b""
    return contents


def words_of(arguments) -> list[str]:
    """The words of a command line: a text is split at blanks, anything else is one word."""
    words = []
    for argument in arguments:
        words += argument.split(" ") if isinstance(argument, str) else [str(argument)]
    return words


class MotorsCommandLine:
    """The commands ``motors`` with the equipment of a rig.

    Args:
        capsys: pytest's capture.
        equipment: clock and adapters.
    """

    def __init__(self, capsys, equipment) -> None:
        self._capsys = capsys
        self._commands = motors.commands_with(equipment)

    def run_program(self, words):
        """Run the words behind the program's name; return exit code, output and error."""
        code = main(words, self._commands)
        return code, *self._capsys.readouterr()

    def run(self, *arguments):
        """Run words behind ``motors``; the error is one line, and a command below."""
        code, out, err = self.run_program(["motors", *words_of(arguments)])
        require_names(out + err)
        lines = err.splitlines()
        text = [line for line in lines if not line.startswith("  robot-sysid ")]
        assert len(text) <= 1, err
        return code, out, err

    def succeed(self, *arguments):
        """What words print that end well, without a word on standard error."""
        code, out, err = self.run(*arguments)
        assert (code, err) == (0, ""), err
        return out

    def fail(self, code, *arguments):
        """What words say on standard error that end with this exit code."""
        actual_code, _, err = self.run(*arguments)
        assert actual_code == code, err
        return err


class CommandLine:
    """The command in a folder.

    Args:
        folder: the working folder, which the test has changed to.
        capsys: pytest's capture.
    """

    def __init__(self, folder: Path, capsys) -> None:
        self._folder = folder
        self._capsys = capsys

    def run(self, *arguments, code: int = 0):
        """Run words, see ``words_of``; return what was printed (out, err) with that exit code."""
        self._capsys.readouterr()
        exit_code = main(words_of(arguments))
        printed = self._capsys.readouterr()
        assert exit_code == code, printed.err
        require_names(printed.out + printed.err)
        return printed

    def refused(self, *arguments, code: int = 2) -> str:
        """Return the one line of error of a run that must change nothing on disk."""
        files = files_in(self._folder)
        printed = self.run(*arguments, code=code)
        assert files_in(self._folder) == files
        lines = printed.err.splitlines()
        # Below it may stand commands that remedy it.
        beginnings = ("note: ", "  robot-sysid ")
        (error,) = [line for line in lines if not line.startswith(beginnings)]
        assert error.startswith("robot-sysid: error: ")
        return error
