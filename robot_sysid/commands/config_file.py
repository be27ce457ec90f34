"""Options in a TOML file: taken from it with --config, and written by every run to repeat it.

What stands in it is typed for the user: the same parser reads it, and says the same of mistakes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.records.options import default_of, options_of

_TYPED_ONLY = ("config", "help", "help_all", "version")


def words_in(path: Path, actions: Sequence[argparse.Action], command: str) -> list[str]:
    """Return what would be typed for the options in a file; positional words come first.

    InputError where it cannot be read, or holds something that is no option of the command.
    """
    known = {action.dest: action for action in actions if action.dest not in _TYPED_ONLY}
    positional, flagged = list[str](), list[str]()
    for key, value in _content(path).items():
        action = known.get(key)
        if action is None:
            raise InputError(f"{path}: {command} has no option {key}; leave it out")
        if isinstance(value, bool) != (action.nargs == 0):
            takes = "true or false" if action.nargs == 0 else "a value"
            raise InputError(f"{path}: {key} takes {takes} (got {value!r})")
        if action.option_strings:
            flagged += _flagged(action, value)
        else:
            positional += _texts(value)
    return positional + flagged


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


def _content(path: Path) -> Mapping[str, Any]:
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    try:
        return dict(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
    except ValueError as error:
        raise InputError(f"{path} is no TOML file: {error}") from None


def text_of(command: str, config: Any, path: Path, usual: Mapping[str, Any]) -> str:
    """Return the file, to be at a path, that asks a command ("robot-sysid plan") for this again.

    What is asked is a record of records of options, with the model's path; ``usual`` are, by key,
    defaults that the command has in place of the records'.
    """
    given = {"path": config.model.path}
    for record in vars(config).values():
        for name, each in options_of(record).items():
            if getattr(record, name) != usual.get(each.key, default_of(record, name)):
                given[each.key] = getattr(record, name)
    lines = [f"{key} = {_toml(value)}" for key, value in given.items()]
    said = f"# In {Path.cwd()}: {command} --config {quote(str(path))}"
    return "\n".join([said, *lines, ""])


def _toml(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, (bool, int, float)):
        return str(value).lower()
    import json

    return json.dumps(str(value), ensure_ascii=False)
