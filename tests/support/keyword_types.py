"""The types of the keywords of ``robot_sysid``'s functions, made from the option records.

    python -m tests.support.keyword_types

writes ``robot_sysid/api/keyword_types.pyi`` anew.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

from robot_sysid.api.keywords import RECORDS, refused_by
from robot_sysid.records.option_fields import Option, default_of, options_of
from tests.support.places import ROOT

PATH = ROOT / "robot_sysid" / "api" / "keyword_types.pyi"
HEAD = '''"""Types of the keywords, a stub for type checkers and editors: there is no such module.

Made from the option records by ``python -m tests.support.keyword_types``; a test holds them equal.
A class holds the keywords of the function in its name; one with an underscore those that the
functions in its name, and what builds on them, have alike.
"""

import os
from collections.abc import Sequence
from typing import Any, Literal, TypedDict

from numpy.typing import NDArray

File = str | os.PathLike[str]
Numbers = Sequence[float] | NDArray[Any]
'''
_TYPES = {
    "float": "float", "int": "int", "parse_whole_number": "int", "str": "str", "Path": "File",
    "parse_folder": "File", "parse_numbers": "float | Numbers",
    "parse_factors": "float | Numbers | File",
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
    if option.repeats or option.takes_many:
        one = f"{one} | Sequence[{one}]"
    return f"{one} | None" if default is None else one


def _has_alias(option: Option) -> bool:
    """Tell whether choices are too many for a line: an option that repeats says them twice."""
    return len(option.choices) * (1 + option.repeats) > 6


def _alias(option: Option) -> str:
    words = textwrap.fill(
        ", ".join(map(_quoted, option.choices)), 90, break_on_hyphens=False
    )
    if "\n" not in words:
        return f"{option.key.capitalize()} = Literal[{words}]\n"
    listed = textwrap.indent(words, "    ")
    return f"{option.key.capitalize()} = Literal[\n{listed}\n]  # fmt: skip\n"


def _quoted(word: str) -> str:
    return f'"{word}"'


def text() -> str:
    """Return the module: a class for each function, and one for what several classes have alike."""
    aliases = dict[str, None]()
    lines_of = dict[str, set[str]]()
    for function, records in RECORDS.items():
        refused = refused_by(function)
        lines = lines_of.setdefault(function.title().replace("_", ""), set())
        for record in records:
            for attribute, option in options_of(record).items():
                if _has_alias(option):
                    aliases[_alias(option)] = None
                if option.key not in refused:
                    value_type = type_of(option, default_of(record, attribute))
                    lines.add(f"    {option.key}: {value_type}\n")
    names = sorted(lines_of, key=lambda name: len(lines_of[name]))
    bases = {name: list[str]() for name in names}
    new_lines = {**lines_of}
    for k, name in enumerate(names):
        for smaller in sorted(names[:k], key=lambda name: -len(lines_of[name])):
            if lines_of[smaller] <= new_lines[name]:
                bases[name].append(f"{smaller}Keywords")
                new_lines[name] = new_lines[name] - lines_of[smaller]
    shared_lines = dict[tuple[str, ...], list[str]]()
    for line in sorted(set().union(*new_lines.values())):
        owners = tuple(name for name in names if line in new_lines[name])
        shared_lines.setdefault(owners, []).append(line)
    classes = [HEAD + "".join(aliases)]
    for owners, lines in shared_lines.items():
        if len(owners) > 1:
            base = f"_{''.join(owners)}"
            classes.append(_class(base, ["TypedDict"], lines))
            for owner in owners:
                bases[owner].append(base)
    for name in names:
        lines = shared_lines.get((name,), [])
        classes.append(_class(f"{name}Keywords", bases[name] or ["TypedDict"], lines))
    return "\n".join(classes)


def _class(name: str, bases: Sequence[str], lines: Sequence[str]) -> str:
    head = ", ".join([*bases, "total=False"])
    skip = ""
    if len(f"class {name}({head}): ...") > 88:
        head = f"\n{textwrap.indent(textwrap.fill(head, 90), '    ')}\n"
        skip = "  # fmt: skip"
    body = f"{skip}\n{''.join(lines)}" if lines else " ...\n"
    return f"class {name}({head}):{body}"


if __name__ == "__main__":
    PATH.write_text(text(), encoding="utf-8")
