"""The types of the keywords of ``robot_sysid``'s functions, made from the option records.

    python -m tests.support.keyword_types

writes ``robot_sysid/api/keyword_types.py`` anew.
"""

from __future__ import annotations

import textwrap
from collections.abc import Container, Iterator, Mapping
from typing import Any

from robot_sysid.api.keywords import ELSEWHERE, RECORDS, refused_by
from robot_sysid.records.options import Option, default_of, keys_of, options_of
from tests.support.places import ROOT

PATH = ROOT / "robot_sysid" / "api" / "keyword_types.py"
HEAD = '''"""Types of the keywords, for type checkers and editors; no run imports this.

Made from the option records by ``python -m tests.support.keyword_types``; a test holds them equal.
A class holds the keywords of one record, as far as one function or several take them.
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


def _classes(record: Any, kinds: Mapping[str, Container[str]]) -> Iterator[tuple[str, str]]:
    """Yield (class, its text), each with what is refused by all before it; "" for no keyword more.

    Args:
        kinds: name of a class to what it refuses; each refuses all that another does, or less.
    """
    fields = {
        each.key: f"    {each.key}: {type_of(each, default_of(record, attribute))}\n"
        for attribute, each in options_of(record).items()
    }
    taken = {name: {*fields} - {*refused} for name, refused in kinds.items()}
    base, told = "TypedDict", set[str]()
    for name in sorted(taken, key=lambda name: len(taken[name])):
        assert told <= taken[name]
        lines = [line for key, line in fields.items() if key in taken[name] - told]
        yield name, f"class {name}({base}, total=False):\n{''.join(lines)}" if lines else ""
        base, told = name if lines else base, taken[name]


def text() -> str:
    """Return the module: a class per record, and one per function that puts them together."""
    records = list(dict.fromkeys(each for records in RECORDS.values() for each in records))
    options = (each for record in records for each in options_of(record).values())
    aliases = (_alias(each) for each in options if _has_alias(each))
    parts = [HEAD + "".join(aliases)]
    kinds: dict[Any, dict[str, Any]] = {each: {each.__name__: ELSEWHERE} for each in records}
    functions = dict[str, list[str]]()
    for function, taken in RECORDS.items():
        if function != "identify_arm":  # the same as of identify
            refused, name = refused_by(function), function.title().replace("_", "")
            names = functions[name] = []
            for record in taken:
                partly = not keys_of(record).isdisjoint({*refused} - {*ELSEWHERE})
                names.append(f"{name * partly}{record.__name__}")
                kinds[record][names[-1]] = refused if partly else ELSEWHERE
    same, last = dict[str, str](), ""
    for record, own in kinds.items():
        for name, each in _classes(record, own):
            parts += [each] if each else []
            last = name if each else last
            same[name] = last
    alone = ""
    for name, names in functions.items():
        bases = textwrap.indent(textwrap.fill(", ".join(map(same.__getitem__, names)), 90), "    ")
        if len(names) > 1:
            parts.append(f"class {name}Keywords(\n{bases}\n): ...  # fmt: skip\n")
        else:
            alone += f"{name}Keywords = {bases.strip()}\n"
    return "\n\n".join([*parts, alone])


if __name__ == "__main__":
    PATH.write_text(text(), encoding="utf-8")
