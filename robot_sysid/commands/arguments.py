"""Command-line parsers made from option records, and their values."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, Callable, NoReturn

from robot_sysid.commands import PROGRAM, Console, ConsoleOptions, print_line
from robot_sysid.errors import EXIT_CODES, InputError, prefix_input_errors
from robot_sysid.records import option_fields as options
from robot_sysid.records.file_access import read_toml
from robot_sysid.wording import with_option_names


class _Formatter(argparse.HelpFormatter):
    """Help on wide lines, with an option and its meaning side by side."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=100)

    def _format_usage(self, usage: Any, actions: Any, groups: Any, prefix: Any) -> str:
        names = [str(self._prog)]
        for action in actions:
            if not action.option_strings:
                names.append(self._metavar_formatter(action, action.dest)(1)[0])
        return f"usage: {' '.join(names)} [options]\n\n"


class Parser(argparse.ArgumentParser):
    """Argument parser that reports a usage error as one line and shows an example first.

    Args:
        command: the subcommand's words after the program's name, "" for the program itself.
        example: a complete command line.
        description: what the command does.
        main: keys of the options in the help; None for all. The others work as well.
        codes: exit codes that the command may have.
        overview: lines between the example and the usage.
    """

    def __init__(
        self,
        command: str,
        example: str,
        description: str,
        main: Collection[str] | None = None,
        codes: Sequence[int] = (0, 1, 2, 130),
        overview: Sequence[str] = (),
    ) -> None:
        meanings = ", ".join(f"{code} {EXIT_CODES[code]}" for code in codes)
        super().__init__(
            prog=f"{PROGRAM} {command}".strip(),
            description=description,
            epilog=f"Exit codes: {meanings}.",
            formatter_class=_Formatter,
            allow_abbrev=False,
            add_help=False,
        )
        self._example = example
        self._overview = overview
        self._main = main

    def format_help(self) -> str:
        """Return the example, then the overview if there is one, the usage and all options."""
        overview = "\n".join(self._overview)
        paragraphs = (f"example: {self._example}", overview, super().format_help())
        return "\n\n".join(filter(None, paragraphs))

    def error(self, message: str) -> NoReturn:
        """Raise InputError instead of printing the usage."""
        raise InputError(f"{message} ({self.prog} --help-all lists all options)")

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse all arguments; InputError for an unknown option suggests the nearest one."""
        namespace, unknown = self.parse_known_args(args, namespace)
        if unknown:
            flags = [flag for action in self._actions for flag in action.option_strings]
            flag = unknown[0].split("=")[0]
            hint = options.suggestion(flag, flags) if flag.startswith("-") else ""
            fault = f"unrecognized arguments: {' '.join(unknown)}"
            self.error(f"{fault}; {flag}: {hint}" if hint else fault)
        return namespace

    def parse_with_file(self, path: Path, arguments: Sequence[str]) -> dict[str, Any]:
        """Return the options of a TOML file, replaced by those of the command line.

        The values of the file are checked where the options' records are made. A positional
        argument may come from either, so that this method makes all of them optional in this
        parser. Options that were not given are left out.
        """
        positionals = [a for a in self._actions if not a.option_strings]
        required = [action for action in positionals if action.required]
        for action in positionals:
            action.nargs = "*" if action.nargs == "+" else "?"
            action.required = False
        content = read_toml(path)
        known = {action.dest for action in self._actions}
        known -= {"config", "help", "help_all", "version"}
        with prefix_input_errors(f"{path}: {self.prog}"):
            options.refuse_unknown(content, known)
        given = vars(self.parse_args(arguments))
        # A positional argument that was not given is None, or an empty list of many.
        given = {k: value for k, value in given.items() if value not in (None, [])}
        values = {**content, **given}
        missing = [str(a.metavar) for a in required if a.dest not in values]
        if missing:
            self.error(f"the following arguments are required: {', '.join(missing)}")
        return values

    def _print_message(self, message: str, file: Any = None) -> None:
        for line in message.splitlines():
            print_line(line, file or sys.stdout)

    def add(
        self, title: str, *records: Any, only: Collection[str] = (), **defaults: Any
    ) -> Any:
        """Add the options of records as one group of the help and return the group.

        Args:
            records: classes of option records.
            only: keys of the options to add; empty for all.
            defaults: by key, defaults of this command in place of the records'.
        """
        group = self.add_argument_group(title)
        for option in options.options_of_all(records, only, **defaults):
            is_hidden = self._main is not None and option.key not in self._main
            is_flag = option.flag.startswith("-")
            _add_option(group if is_flag else self, option, is_hidden and is_flag)
        return group

    def add_console_options(self) -> Parser:
        """Add the options that every command has, and return the parser."""
        group = self.add("console", ConsoleOptions)
        group.add_argument("-h", "--help", action="help", help="print the main options")
        group.add_argument("--help-all", action="help", help="print all options")
        return self


def default_text(option: options.Option) -> str:
    """Return a default as a user would type it, or in words; "" where there is none."""
    default = option.default
    if option.default_text:
        return with_option_names(option.default_text)
    if default is None or isinstance(default, (bool, tuple)):
        return ""
    return f"{default:g}" if isinstance(default, float) else str(default)


def _help_text(option: options.Option) -> str:
    """Return an option's help with unit and default, for argparse."""
    text = with_option_names(option.help)
    if option.unit:
        text += f" [{option.unit}]"
    if default_text(option):
        text += f" (default: {default_text(option)})"
    return text.replace("%", "%%")


def _add_option(group: Any, option: options.Option, is_hidden: bool) -> None:
    """Add an option to a group of a parser.

    Args:
        group: group of an argparse parser, which is changed.
        option: to add; a truth value for its default makes it a switch without a value.
        is_hidden: whether the help leaves the option out.
    """
    flags = [option.short, option.flag] if option.short else [option.flag]
    settings: dict[str, Any] = {
        "help": argparse.SUPPRESS if is_hidden else _help_text(option),
        "default": argparse.SUPPRESS,
    }
    if option.flag.startswith("-"):
        settings["dest"] = option.key
    if isinstance(option.default, bool):
        group.add_argument(*flags, action="store_true", **settings)
        return
    if option.choices:
        settings["choices"] = option.choices
        settings["metavar"] = option.metavar or "{" + ",".join(option.choices) + "}"
    else:
        settings["metavar"] = option.metavar or option.key.upper()
        settings["type"] = _argument_type(option.parse or str)
    if isinstance(option.metavar, tuple):
        settings["nargs"] = len(option.metavar)
    elif option.takes_many:
        settings["nargs"] = "+"
    if option.repeats:
        settings["action"] = "append"
    group.add_argument(*flags, **settings)


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


def parse_command(
    build_parser: Callable[[bool], Parser], arguments: Sequence[str]
) -> tuple[dict[str, Any], Console]:
    """Parse the arguments of a command, and the file of its --config.

    Args:
        build_parser: makes the command's parser; its argument says whether its help has all
            options.
        arguments: words behind the command's name.

    Returns:
        Key to value of the options that were given, lists as tuples; the console.
    """
    parser = build_parser("--help-all" in arguments)
    config_parser = argparse.ArgumentParser(add_help=False, formatter_class=_Formatter)
    config_parser.add_argument("--config", nargs="?", type=Path)
    path = config_parser.parse_known_args(arguments)[0].config
    if path:
        parsed_values = parser.parse_with_file(path, arguments)
    else:
        parsed_values = vars(parser.parse_args(arguments))
    values = {
        key: options.immutable_value(value) for key, value in parsed_values.items()
    }
    console = options.record_from(Console, values)
    for key in options.options_of(Console):
        values.pop(key, None)
    return values, console
