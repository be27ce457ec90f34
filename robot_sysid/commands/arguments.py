"""A command as one record, and the parser and the values of options that are made from it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from robot_sysid import __version__
from robot_sysid.commands import PROGRAM, Console, ConsoleOptions, print_line
from robot_sysid.errors import EXIT_CODES, InputError, prefix_input_errors
from robot_sysid.records import option_fields as options
from robot_sysid.records.file_access import begins_as_xml, read_toml
from robot_sysid.wording import with_option_names

MODEL = (
    options.Option(
        "path", "MuJoCo XML (MJCF), URDF or xacro file", metavar="MODEL", parse=Path
    ),
)
"""The model file that most commands take first."""


@dataclass(frozen=True)
class LogArgument(options.FileArguments):
    """The log that commands take which fit none."""

    log: tuple[Path, ...] = options.option(
        (),
        "file or folder of the recording; or its positions in one and its torques in another",
        "LOG",
        flag="log",
        takes_many=True,
    )


CONSOLE = options.options_of_all(ConsoleOptions)
"""Options that all commands have."""


@dataclass(frozen=True)
class Command:
    """One command: its words, its options and what runs it.

    Attributes:
        name: words behind the program's name, "" for the program itself.
        example: words behind the program's name of a complete command line.
        description: what the command does.
        groups: options by heading in the help, under which positional arguments are not listed.
        run: runs the command with the values of its options, by key, and a console; returns the
            exit code.
        main: keys of the options in the short help; empty for all. The others work as well.
        required: keys of options that have to be given.
        codes: exit codes that the command may have.
        overview: lines of the help between the example and the usage.
        interrupted: what is said where the user interrupts it.
    """

    name: str
    example: str
    description: str
    groups: Mapping[str, Iterable[options.Option]]
    run: Callable[[Mapping[str, Any], Console], int]
    main: Collection[str] = ()
    required: Collection[str] = ()
    codes: Collection[int] = (0, 1, 2, 130)
    overview: Sequence[str] = ()
    interrupted: str = "interrupted; no unfinished file is left"

    def parse(self, arguments: Sequence[str]) -> tuple[dict[str, Any], Console]:
        """Return key to value of the options in the arguments, and the console.

        Options that were not given are left out; lists are tuples. Those of the file of --config
        come first; they are checked where the options' records are made.
        """
        parser = Parser(self, "--help-all" in arguments)
        config_parser = argparse.ArgumentParser(add_help=False)
        config_parser.add_argument("--config", nargs="?", type=Path)
        path = config_parser.parse_known_args(arguments)[0].config
        content = parser.read_file(path) if path else {}
        values = {**content, **parser.given_values(arguments, content)}
        values = {key: options.immutable_value(value) for key, value in values.items()}
        console = options.record_from(Console, values)
        for option in CONSOLE:
            values.pop(option.key, None)
        return values, console


class Parser(argparse.ArgumentParser):
    """Parser of a command; it reports a usage error as one line and shows an example first.

    Args:
        command: whose parser it is.
        full: whether the help has all options, not the main ones alone.
    """

    def __init__(self, command: Command, full: bool = True) -> None:
        meanings = ", ".join(f"{code} {EXIT_CODES[code]}" for code in command.codes)
        super().__init__(
            prog=f"{PROGRAM} {command.name}".strip(),
            description=command.description,
            epilog=f"Exit codes: {meanings}.",
            # Wide lines, with an option and its meaning side by side.
            formatter_class=partial(
                argparse.HelpFormatter, max_help_position=34, width=100
            ),
            allow_abbrev=False,
            add_help=False,
        )
        self._command = command
        self._full = full
        # The positional arguments.
        self._arguments: list[argparse.Action] = []
        if not command.name:
            version = f"{PROGRAM} {__version__}"
            text = "print the version"
            self.add_argument("--version", action="version", version=version, help=text)
        for title, group in command.groups.items():
            self._add_group(title, group)
        group = self._add_group("console", CONSOLE)
        group.add_argument("-h", "--help", action="help", help="print the main options")
        group.add_argument("--help-all", action="help", help="print all options")
        names = [str(action.metavar) for action in self._arguments]
        self.usage = " ".join([self.prog, *names, "[options]"])
        if self._takes_model:
            # Which of them is missing is said where all are told apart.
            self._make_arguments_optional()

    def _add_group(self, title: str, group: Iterable[options.Option]) -> Any:
        """Add options as one group of the help, and return that."""
        main = self._command.main
        help_group = self.add_argument_group(title)
        for option in group:
            settings = argument_settings(option)
            if option.is_argument:
                self._arguments.append(self.add_argument(option.flag, **settings))
                continue
            if main and not self._full and option.key not in main:
                settings["help"] = argparse.SUPPRESS
            settings["required"] = option.key in self._command.required
            settings["default"] = argparse.SUPPRESS
            flags = filter(None, (option.short, option.flag))
            help_group.add_argument(*flags, dest=option.key, **settings)
        return help_group

    @property
    def _takes_model(self) -> bool:
        """Whether one of the positional arguments is a model."""
        return MODEL[0].key in {action.dest for action in self._arguments}

    @property
    def _takes_model_and_logs(self) -> bool:
        """Whether the positional arguments are a model and logs, which come in any order."""
        return self._takes_model and len(self._arguments) == 2

    @property
    def _log_key(self) -> str:
        """Key of the logs beside a model."""
        (key,) = {action.dest for action in self._arguments} - {MODEL[0].key}
        return key

    def _make_arguments_optional(self) -> None:
        """Let positional arguments be left out, as where a file of options has them."""
        for action in self._arguments:
            action.nargs = "*" if action.nargs in ("+", "*") else "?"
            action.required = False

    @property
    def actions(self) -> list[argparse.Action]:
        """All arguments and options, also those that the short help leaves out."""
        return self._actions

    def format_help(self) -> str:
        """Return the example, then the overview if there is one, the usage and all options."""
        example = f"example: {PROGRAM} {self._command.example}"
        overview = "\n".join(self._command.overview)
        paragraphs = (example, overview, super().format_help())
        return "\n\n".join(filter(None, paragraphs))

    def error(self, message: str) -> NoReturn:
        """Raise InputError instead of printing the usage."""
        raise InputError(f"{message} ({self.prog} --help-all lists all options)")

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse all arguments; InputError for an unknown option suggests the nearest one."""
        namespace, unknown = self.parse_known_intermixed_args(args, namespace)
        if unknown:
            flags = [flag for action in self._actions for flag in action.option_strings]
            flag = unknown[0].split("=")[0]
            hint = options.suggestion(flag, flags) if flag.startswith("-") else ""
            fault = f"unrecognized arguments: {' '.join(unknown)}"
            self.error(f"{fault}; {flag}: {hint}" if hint else fault)
        return namespace

    def read_file(self, path: Path) -> Mapping[str, Any]:
        """Return the options of a TOML file; positional arguments may then be left out."""
        self._make_arguments_optional()
        content = read_toml(path)
        known = {action.dest for action in self._actions}
        known -= {"config", "help", "help_all", "version"}
        with prefix_input_errors(f"{path}: {self.prog}"):
            options.refuse_unknown(content, known)
        return content

    def given_values(
        self, arguments: Sequence[str], content: Collection[str]
    ) -> dict[str, Any]:
        """Return the values of the options in the arguments.

        InputError where a positional argument is neither there nor in ``content``, the options of
        a file.
        """
        given = vars(self.parse_args(arguments))
        self._free_model(given)
        if self._takes_model_and_logs:
            self._tell_apart(given, content)
        missing = []
        for action in self._arguments:
            # A positional argument that was not given is None, or an empty list of many.
            if given[action.dest] in (None, []):
                del given[action.dest]
                if action.dest not in content:
                    missing.append(str(action.metavar))
        if missing:
            names = ", ".join(missing)
            self.error(f"the following arguments are required: {names}")
        return given

    def _free_model(self, given: dict[str, Any]) -> None:
        """Take a model, and what follows it, out of the files of an option before them.

        argparse gives all files that follow an option of many to that.

        Args:
            given: values by key, which are changed.
        """
        if not self._takes_model:
            return
        model_key = MODEL[0].key
        for action in self._actions:
            files = given.get(action.dest)
            if action in self._arguments or action.nargs != "+" or not files:
                continue
            at = next(
                (k for k, path in enumerate(files) if k and begins_as_xml(path)), None
            )
            if at is None:
                continue
            if self._takes_model_and_logs:
                log_key = self._log_key
                given[log_key] = [*(given[log_key] or ()), *files[at:]]
            elif given[model_key] is None and at == len(files) - 1:
                given[model_key] = files[at]
            else:
                continue
            given[action.dest] = files[:at]

    def _tell_apart(self, given: dict[str, Any], content: Collection[str]) -> None:
        """Give the model among the positional arguments to the option for it, the rest to the logs.

        A file tells by itself what it is. Where none is a model, one that cannot be read is taken
        for it, or one that is called like a model; whoever reads it says what is wrong with it.

        Args:
            given: values by key, which are changed.
            content: keys of options of a file, which may have the model.

        Raises:
            InputError: there are several models, or logs alone.
        """
        paths: list[Path] = []
        for action in self._arguments:
            value = given[action.dest]
            # Of many, argparse makes a list.
            paths += value if isinstance(value, list) else filter(None, [value])
        model_key = MODEL[0].key
        log_key = self._log_key
        models = [path for path in paths if begins_as_xml(path)]
        if len(models) > 1:
            listed = " and ".join(map(str, models))
            self.error(f"{listed} are models; give one model, and logs of the arm")
        if not models:
            models = [path for path in paths if _may_become_model(path)]
            if self._arguments[0].dest != model_key:
                models.reverse()
        if paths and not models and model_key not in content:
            listed = " and ".join(map(str, paths))
            verb = "is a log" if len(paths) == 1 else "are logs"
            self.error(
                f"{listed} {verb}; give the arm's model as well, MJCF, URDF or xacro"
            )
        given[model_key] = models[0] if models else None
        given[log_key] = [path for path in paths if path not in models[:1]]

    def _print_message(self, message: str, file: Any = None) -> None:
        for line in message.splitlines():
            print_line(line, file or sys.stdout)


def _may_become_model(path: Path) -> bool:
    """Return whether a path is of no file that can be read, or called like a model."""
    from robot_sysid.mjcf.documents import SUFFIXES

    return begins_as_xml(path) is None or path.suffix.lower() in SUFFIXES


def default_text(option: options.Option) -> str:
    """Return a default as a user would type it, or in words; "" where there is none."""
    default = option.default
    if option.default_text:
        return with_option_names(option.default_text)
    if default is None or isinstance(default, (bool, tuple)):
        return ""
    return f"{default:g}" if isinstance(default, float) else str(default)


def argument_settings(option: options.Option) -> dict[str, Any]:
    """Return the arguments of argparse's ``add_argument`` for an option, without its name.

    A truth value for its default makes it a switch without a value.
    """
    text = with_option_names(option.help)
    if option.unit:
        text += f" [{option.unit}]"
    if default_text(option):
        text += f" (default: {default_text(option)})"
    settings: dict[str, Any] = {"help": text.replace("%", "%%")}
    if isinstance(option.default, bool):
        return {**settings, "action": "store_true"}
    settings["metavar"] = option.metavar or option.key.upper()
    if option.choices:
        settings["choices"] = option.choices
        settings["metavar"] = option.metavar or "{" + ",".join(option.choices) + "}"
    else:
        settings["type"] = _argument_type(option.parse or str)
    if isinstance(option.metavar, tuple):
        settings["nargs"] = len(option.metavar)
    elif option.takes_many:
        settings["nargs"] = "+"
    if option.repeats:
        settings["action"] = "extend" if option.takes_many else "append"
    return settings


def _argument_type(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return a function like ``parse``, a text's parser, whose errors argparse prefixes with the
    option's name.
    """

    def argument_type(text: str) -> Any:
        try:
            return parse(text)
        except InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    argument_type.__name__ = getattr(parse, "__name__", "value")
    return argument_type
