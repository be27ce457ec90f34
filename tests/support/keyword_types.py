"""The types of the keywords of ``robot_sysid``'s functions, made from the option records.

    python -m tests.support.keyword_types

writes ``robot_sysid/api/keyword_types.py`` anew.
"""

from __future__ import annotations

import textwrap
from typing import Any

from robot_sysid.api.keywords import RECORDS, refused_by
from robot_sysid.records.options import Option, default_of, options_of
from tests.support.places import ROOT

PATH = ROOT / "robot_sysid" / "api" / "keyword_types.py"
HEAD = '''"""Types of the keywords, for type checkers and editors; no run imports this.

Made from the option records by ``python -m tests.support.keyword_types``; a test holds them equal.
A class holds the keywords that the functions in its name take, and no others.
"""
# ruff: noqa: D101

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Literal, TypedDict, Union

from numpy.typing import NDArray

File = Union[str, "os.PathLike[str]"]
Numbers = Union[Sequence[float], NDArray[Any]]
'''
_TYPES = {
    "float": "float", "int": "int", "whole_number": "int", "str": "str", "Path": "File",
    "folder": "File", "levels": "float | Numbers", "factors_in": "float | Numbers | File",
}  # fmt: skip


def type_of(option: Option, default: Any) -> str:
    """Return the type of what an option may be given in Python."""
    if option.parse is None:
        return "bool"
    one = _TYPES[option.parse.__name__]
    if option.choices:
        one = f"Literal[{', '.join(map(_quoted, option.choices))}]"
    if isinstance(option.metavar, tuple):
        one = "Numbers"
    if _has_alias(option):
        one = option.key.capitalize()
    if option.repeats or option.several:
        one = f"{one} | Sequence[{one}]"
    return f"{one} | None" if default is None else one


def _has_alias(option: Option) -> bool:
    """Tell whether choices are too many for a line: an option that repeats says them twice."""
    return len(option.choices) * (1 + option.repeats) > 6


def _alias(option: Option) -> str:
    words = textwrap.fill(", ".join(map(_quoted, option.choices)), 90)
    if "\n" not in words:
        return f"{option.key.capitalize()} = Literal[{words}]\n"
    listed = textwrap.indent(words, "    ")
    return f"{option.key.capitalize()} = Literal[\n{listed}\n]  # fmt: skip\n"


def _quoted(word: str) -> str:
    return f'"{word}"'


def text() -> str:
    """Return the module: a class for what the same functions take, and one for each function."""
    aliases, takers = dict[str, None](), dict[str, list[str]]()
    for function, records in RECORDS.items():
        refused, name = refused_by(function), function.title().replace("_", "")
        named = [(each, n, o) for each in records for n, o in options_of(each).items()]
        aliases.update((_alias(option), None) for _, _, option in named if _has_alias(option))
        lines = {
            f"    {option.key}: {type_of(option, default_of(record, attribute))}\n"
            for record, attribute, option in named
            if option.key not in refused
        }
        for line in sorted(lines) if function != "identify_arm" else ():  # the same as of identify
            takers.setdefault(line, []).append(name)
    shared = dict[tuple[str, ...], str]()
    for line, names in takers.items():
        shared[tuple(names)] = shared.get(tuple(names), "") + line
    parts = [HEAD + "".join(aliases)]
    for names, lines in shared.items():
        parts.append(f"class _{''.join(names)}(TypedDict, total=False):\n{lines}")
    for name in dict.fromkeys(name for names in shared for name in names):
        bases = ", ".join(f"_{''.join(names)}" for names in shared if name in names)
        wrapped = textwrap.indent(textwrap.fill(bases, 90), "    ")
        parts.append(f"class {name}Keywords(\n{wrapped}\n): ...  # fmt: skip\n")
    return "\n\n".join(parts)


if __name__ == "__main__":
    PATH.write_text(text(), encoding="utf-8")
