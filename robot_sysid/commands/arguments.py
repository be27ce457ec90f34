"""Command-line parsers made from option records, and records made from what was parsed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Callable, NoReturn

import robot_sysid.records.option_fields as options
from robot_sysid import __version__
from robot_sysid.commands import PROGRAM as PROGRAM
from robot_sysid.commands.console import Console, ConsoleOptions
from robot_sysid.commands.streams import print_line
from robot_sysid.errors import EXIT_CODES, InputError
from robot_sysid.records.file_access import read_toml

PYTHON_ONLY = ("plan_only",)
"""Keys of options that only Python programs have."""
_TYPED_ONLY = ("config", "help", "help_all", "version")


class Parser(argparse.ArgumentParser):
    """Argument parser that reports a usage error as one line and shows an example first.

    Args:
        command: its words after the program's name, "" for the program itself.
        main: keys of the options that its help shows; None shows all. The rest work as well.
    """

    def __init__(
        self,
        command: str,
        example: str,
        description: str,
        main: Collection[str] | None = None,
        epilog: str = "",
        codes: Sequence[int] = (0, 1, 2, 130),
    ) -> None:
        said = ", ".join(f"{code} {EXIT_CODES[code]}" for code in codes)
        super().__init__(
            prog=f"{PROGRAM} {command}".strip(),
            description=description,
            epilog=f"{epilog} Exit codes: {said}.".strip(),
            formatter_class=_Formatter,
            allow_abbrev=False,
            add_help=False,
        )
        self._example = example
        self._main = main

    def format_help(self) -> str:
        """Return the example, then the usage and all options."""
        return f"example: {self._example}\n\n{super().format_help()}"

    def error(self, message: str) -> NoReturn:
        """Raise InputError instead of printing the usage."""
        raise InputError(f"{message} ({self.prog} --help-all lists all options)")

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse all arguments; an unknown option is told with the known one that is nearest."""
        for word in args or ():
            if word.startswith("-") and word.endswith(
                "=--"
            ):  # argparse makes an empty list of it
                self.error(f"argument {word[:-3]}: expected a value, not --")
        known, unknown = self.parse_known_args(args, namespace)
        if unknown:
            self.error(
                f"unrecognized arguments: {' '.join(unknown)}{self._meant(unknown)}"
            )
        return known

    def with_config(self, path: Path, arguments: Sequence[str]) -> dict[str, Any]:
        """Return what a TOML file holds, and over it what was typed.

        What stands in it is typed for the user: the same parser reads it, and says the same.
        """
        words = [action for action in self._actions if not action.option_strings]
        needed = [action for action in words if action.required]
        for action in words:
            action.nargs = "*" if action.nargs == "+" else "?"
            action.required = False
            action.default = None
        stored = [*self._words_in(path)]
        try:
            held = vars(self.parse_args(stored))
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        both = (*held.items(), *vars(self.parse_args(arguments)).items())
        values = {key: value for key, value in both if value not in (None, [])}
        missing = [
            str(action.metavar) for action in needed if action.dest not in values
        ]
        if missing:
            self.error(f"the following arguments are required: {', '.join(missing)}")
        return values

    def _words_in(self, path: Path) -> Iterator[str]:
        """Yield what would be typed for the options in a file."""
        known = {
            action.dest: action
            for action in self._actions
            if action.dest not in _TYPED_ONLY
        }
        content = read_toml(path)
        for key in content:
            if key not in known:
                raise InputError(
                    f"{path}: {self.prog} has no option {key}; leave it out"
                )
        # Positional words come first.
        for key in sorted(content, key=lambda key: bool(known[key].option_strings)):
            action = known[key]
            value = content[key]
            if isinstance(value, bool) != (action.nargs == 0):
                takes = "true or false" if action.nargs == 0 else "a value"
                raise InputError(f"{path}: {key} takes {takes} (got {value!r})")
            yield from (
                _flagged(action, value) if action.option_strings else _texts(value)
            )

    def _meant(self, unknown: Sequence[str]) -> str:
        from difflib import get_close_matches

        flags = [flag for action in self._actions for flag in action.option_strings]
        for word in unknown:
            near = (
                get_close_matches(word.split("=")[0], flags, 1)
                if word[:1] == "-"
                else []
            )
            if near:
                return f"; {word.split('=')[0]}: did you mean {near[0]}?"
        return ""

    def _print_message(self, message: str, file: Any = None) -> None:
        for line in message.rstrip("\n").split("\n"):
            print_line(line, file or sys.stdout)

    def add(
        self,
        title: str,
        *records: Any,
        only: Collection[str] = (),
        leave_out: Collection[str] = (),
        usual: Mapping[str, Any] | None = None,
    ) -> Any:
        """Add the options of some records as one group and return it: ``only`` some keys, or all.

        ``usual`` are, by key, defaults that this command has in place of the records'.
        """
        group = self.add_argument_group(title)
        for record in records:
            for name, each in options.options_of(record).items():
                if each.key not in (*leave_out, *PYTHON_ONLY) and (
                    not only or each.key in only
                ):
                    default = (usual or {}).get(
                        each.key, options.default_of(record, name)
                    )
                    hidden = self._main is not None and each.key not in self._main
                    _add(group, each, default, hidden)
        return group

    def with_console(self) -> Parser:
        """Add what every command has, and return the parser."""
        group = self.add("console", ConsoleOptions)
        version = f"{PROGRAM} {__version__}"
        group.add_argument(
            "--version", action="version", version=version, help="print the version"
        )
        group.add_argument("-h", "--help", action="help", help="print the main options")
        group.add_argument("--help-all", action="help", help="print all options")
        return self


def _flagged(action: argparse.Action, value: Any) -> Iterator[str]:
    flag = action.option_strings[-1]
    if action.nargs == 0:
        yield from [flag] if value else []
        return
    repeats = isinstance(action, argparse._AppendAction) and isinstance(value, list)
    for each in value if repeats else [value]:
        if action.nargs is None:
            yield f"{flag}={','.join(_texts(each))}"
        else:
            yield from (flag, *_texts(each))


def _texts(value: Any) -> list[str]:
    return [str(each) for each in (value if isinstance(value, list) else [value])]


class _Formatter(argparse.HelpFormatter):
    """Help on wide lines: an option and what it does stand beside each other."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=100)

    def _format_usage(self, usage: Any, actions: Any, groups: Any, prefix: Any) -> str:
        positional = [action for action in actions if not action.option_strings]
        words = [self._metavar_formatter(a, a.dest)(1)[0] for a in positional]
        return f"usage: {' '.join([str(self._prog), *words])} [options]\n\n"


def described(each: options.Option, default: Any) -> str:
    """Return an option's help with unit and default."""
    unit = f" [{each.unit}]" if each.unit else ""
    usual = default_text(each, default)
    return f"{each.help}{unit}" + (f" (default: {usual})" if usual else "")


def default_text(each: options.Option, default: Any) -> str:
    """Return a default as a user would type it, or in words; "" where there is none."""
    if each.default_text:
        return each.default_text
    if default is None or isinstance(default, (bool, tuple)):
        return ""
    return f"{default:g}" if isinstance(default, float) else str(default)


def _add(group: Any, each: options.Option, default: Any, hidden: bool) -> None:
    text = argparse.SUPPRESS if hidden else described(each, default).replace("%", "%%")
    flags = [each.short, each.flag] if each.short else [each.flag]
    words: dict[str, Any] = {
        "help": text,
        "default": argparse.SUPPRESS,
        "dest": each.key,
    }
    if isinstance(default, bool):
        group.add_argument(*flags, action="store_true", **words)
        return
    if each.choices:
        words["choices"] = each.choices
        words["metavar"] = each.metavar or "{" + ",".join(each.choices) + "}"
    else:
        words["metavar"] = each.metavar or each.key.upper()
        words["type"] = _typed(each.parse or str)
    if isinstance(each.metavar, tuple):
        words["nargs"] = len(each.metavar)
    elif each.takes_many:
        words["nargs"] = "+"
    if each.repeats:
        words["action"] = "append"
    group.add_argument(*flags, **words)


def _typed(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return a parse function whose complaints argparse can name the option in."""

    def typed(text: str) -> Any:
        try:
            return parse(text)
        except InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    typed.__name__ = getattr(parse, "__name__", "value")
    return typed


def parsed(
    build_parser: Callable[[bool], Parser], arguments: Sequence[str]
) -> tuple[dict[str, Any], Console]:
    """Return (what was given, lists as tuples; what to print on).

    The parser is built with whether its help shows all options.
    """
    parser = build_parser("--help-all" in arguments)
    asked = argparse.ArgumentParser(add_help=False, formatter_class=_Formatter)
    asked.add_argument("--config", nargs="?", type=Path)
    file = asked.parse_known_args(arguments)[0].config
    given = (
        parser.with_config(file, arguments)
        if file
        else vars(parser.parse_args(arguments))
    )
    values = {key: options.immutable_value(value) for key, value in given.items()}
    console = options.record_from(Console, values)
    for name in options.options_of(Console):
        values.pop(name, None)
    return values, console
