"""Options as fields of frozen records: each stands once, with its help, its unit and its check.

The parsers of the command line, the defaults, the names in messages and the tables in the README
all come from these fields.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cache
from keyword import iskeyword
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Optional, TypeVar, Union

from robot_sysid.errors import InputError
from robot_sysid.special_files import refuse_special_file

if TYPE_CHECKING:
    from robot_sysid.records import Array

PerJoint = Union[float, tuple[float, ...]]
"""One number for all joints, or one per joint."""
DEFAULT_MAX_VELOCITY = 2.0
"""Speed limit of hinge joints where nobody says one [rad/s]."""
Check = Callable[[Any], Optional[str]]
"""What is wrong with a value, as the end of a sentence that begins with the option; or None."""
Record = TypeVar("Record")
_VALUE = re.compile(r"((?![\[>])\S+)? ?(?:\[(.*)\])? ?(?:(>=?) 0)?")


@dataclass(frozen=True)
class Option:
    """What is said about one option beside its default.

    Attributes:
        metavar: stands for the value in the help; one per value where it takes several.
        parse: turns text into a value; by default the type that the field's annotation names.
        usual: what stands in the place of a default that is found later.
    """

    flag: str
    help: str
    unit: str = ""
    metavar: str | tuple[str, ...] | None = None
    choices: tuple[str, ...] = ()
    parse: Callable[[str], Any] | None = None
    check: Check | None = None
    usual: str = ""
    repeats: bool = False
    several: bool = False
    short: str = ""

    @property
    def key(self) -> str:
        """The option's name as a keyword: no_friction for --no-friction, for_ for --for."""
        name = self.flag.lstrip("-").replace("-", "_")
        return f"{name}_" if iskeyword(name) else name


@dataclass(frozen=True)
class OptionRecord:
    """What the records of options have in common: each checks the values of its options."""

    def __post_init__(self) -> None:
        """Raise InputError naming the first option whose value cannot be used."""
        for name, each in options_of(self).items():
            value = getattr(self, name)
            if value is None:
                continue
            for single in value if isinstance(value, tuple) else (value,):
                if each.choices and single not in each.choices:
                    listed = ", ".join(each.choices)
                    raise InputError(f"{each.flag} {single!r}: choose one of {listed}")
                if isinstance(single, Path):
                    refuse_special_file(single, f"give {each.flag} another path")
                complaint = each.check(single) if each.check else None
                if complaint:
                    raise InputError(f"{each.flag} {complaint}")


def option(
    default: Any, help: str, value: str = "", flag: str = "", **rest: Any
) -> Any:
    """Return a dataclass field that is an option of the command line.

    Args:
        value: what stands for the value in the help, its unit and its least size, where it has
            them: "FILE" or "V [rad/s] > 0".
        flag: where it is not the field's name with dashes.
    """
    parts = _VALUE.fullmatch(value)
    assert parts, value
    said = {"metavar": parts[1], "unit": parts[2], "check": _LEAST.get(parts[3])}
    given = {name: each for name, each in said.items() if each}
    return field(
        default=default, metadata={"option": Option(flag, help, **{**given, **rest})}
    )


def options_of(record: Any) -> Mapping[str, Option]:
    """Return field name to option of a record or a record's class."""
    return _options_of(record if isinstance(record, type) else type(record))


@cache
def _options_of(record: Any) -> Mapping[str, Option]:
    found = {}
    for each in fields(record):
        if "option" in each.metadata:
            stated: Option = each.metadata["option"]
            flag = stated.flag or "--" + each.name.replace("_", "-")
            # float for "tuple[float, ...] | None".
            types = (
                _TYPES[word]
                for word in re.findall(r"\w+", str(each.type))
                if word in _TYPES
            )
            parse = stated.parse or next(types, None)
            found[each.name] = replace(stated, flag=flag, parse=parse)
    return found


def default_of(record: Any, name: str) -> Any:
    """Return a field's default."""
    default = record.__dataclass_fields__[name].default
    return None if default is MISSING else default


def given_options(record: Any) -> Iterator[Option]:
    """Yield the options of a record that have another value than their default."""
    for name, each in options_of(record).items():
        if getattr(record, name) != default_of(record, name):
            yield each


def command_words(values: Mapping[str, Any], *records: Any) -> list[str]:
    """Return the words of a command line that give records' options the values of their keys."""
    words = []
    for each in (
        stated for record in records for stated in options_of(record).values()
    ):
        given = values.get(each.key)
        if given is None or given is False:
            continue
        for one in given if each.repeats else (given,):
            apart = each.several or isinstance(each.metavar, tuple)
            parts = [
                f"{part:.12g}" if isinstance(part, float) else str(part)
                for part in (one if isinstance(one, tuple) else (one,))
            ]
            said = [] if each.parse is None else parts if apart else [",".join(parts)]
            words += [each.flag, *said]
    return words


def record_from(record: type[Record], values: Mapping[str, Any]) -> Record:
    """Return a record whose options have the values of their keys, where there are any.

    A text counts as what it is on the command line, a list or array as a tuple. Raises InputError
    where a value is of another kind than its option's.
    """
    stated = {
        name: each for name, each in options_of(record).items() if each.key in values
    }
    made = {}
    for name, each in stated.items():
        given = values[each.key]
        is_default = given is None and default_of(record, name) is None
        made[name] = None if is_default else _value(each, given)
    return record(**made)


def _value(stated: Option, given: Any) -> Any:
    """Return what was given as the record holds it, or raise InputError."""
    try:
        value = frozen(given, stated.parse)
    except ValueError:
        value = given
    except InputError as error:
        raise InputError(f"{stated.flag}: {error}") from None
    rows = isinstance(stated.metavar, tuple)
    alone = not isinstance(value, tuple) or (
        rows and not any(isinstance(e, tuple) for e in value)
    )
    if (stated.repeats or stated.several) and alone:
        value = (value,)
    name = getattr(stated.parse, "__name__", "bool")
    kinds, said = _KINDS.get(name, ((object,), ""))
    many = stated.repeats or stated.several or rows or said.endswith(_PER_JOINT)
    # A bool is a number to Python, and none here.
    fits = (
        isinstance(e, kinds) and isinstance(e, bool) <= (bool in kinds)
        for e in _leaves(value)
    )
    if not (many or alone) or not all(fits):
        raise InputError(f"{stated.flag} must be {said} (got {given!r:.60})")
    return value


def frozen(given: Any, parse: Callable[[str], Any] | None = None) -> Any:
    """Return lists and arrays as tuples, and texts as what they are on the command line."""
    if hasattr(given, "tolist"):  # numpy's
        given = given.tolist()
    if isinstance(given, (list, tuple)):
        return tuple(frozen(each, parse) for each in given)
    return parse(given) if isinstance(given, str) and parse is not None else given


def _leaves(value: Any) -> Iterator[Any]:
    for each in value if isinstance(value, tuple) else ():
        yield from _leaves(each)
    if not isinstance(value, tuple):
        yield value


def keys_of(*records: Any) -> set[str]:
    """Return the keys of the options of some records."""
    return {each.key for record in records for each in options_of(record).values()}


def refuse_unknown(values: Collection[str], known: Collection[str]) -> None:
    """Raise InputError naming a key that is none of the known ones, and the one that is nearest."""
    for key in sorted({*values} - {*known}):
        from difflib import get_close_matches

        near = get_close_matches(key, known, 1, 0.7)
        said = (
            f"did you mean {near[0]!r}?"
            if near
            else f"valid: {', '.join(sorted(known))}"
        )
        raise InputError(f"unknown option {key!r}; {said}")


def positive(value: float) -> str | None:
    """Complain unless a number is positive and finite."""
    return (
        None
        if value > 0.0 and math.isfinite(value)
        else f"must be positive (got {value:g})"
    )


def not_negative(value: float) -> str | None:
    """Complain unless a number is zero or more and finite."""
    fits = value >= 0.0 and math.isfinite(value)
    return None if fits else f"must be a number that is not negative (got {value:g})"


_LEAST = {">": positive, ">=": not_negative}


def speed_factor(value: float) -> str | None:
    """Complain unless a number is above 0 and at most 1."""
    return (
        None if 0.0 < value <= 1.0 else f"must be above 0 and at most 1 (got {value:g})"
    )


def per_joint(values: PerJoint, joints: int, option: str) -> Array:
    """Return one value per joint (n,) of an option that takes one number or one per joint."""
    import numpy as np

    given = np.atleast_1d(np.asarray(values, dtype=float))
    if len(given) not in (1, joints):
        raise InputError(
            f"{option} takes one number, or one for each of the {joints} joints (got {len(given)})"
        )
    return np.broadcast_to(given, (joints,)).copy()


def levels(text: str) -> PerJoint:
    """Return the numbers in a text: one for all joints, or one per joint between commas."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(
            f"{text!r} is neither a number nor a list like 0.1,0.1,0.05"
        ) from error
    return numbers[0] if len(numbers) == 1 else numbers


_TYPES: Mapping[str, Callable[[str], Any]] = {
    "PerJoint": levels, "float": float, "int": int, "str": str, "Path": Path
}  # fmt: skip


_PER_JOINT = "one per joint"
_WHOLE = ((Integral,), "a whole number")
_FILE = ((os.PathLike,), "a path")
_KINDS: Mapping[str, tuple[tuple[type, ...], str]] = {
    "float": ((Real,), "a number"),
    "int": _WHOLE,
    "whole_number": _WHOLE,
    "str": ((str,), "a text"),
    "Path": _FILE,
    "folder": _FILE,
    "levels": ((Real,), f"a number, or {_PER_JOINT}"),
    "factors_in": ((Real, os.PathLike), f"a number, a file, or {_PER_JOINT}"),
    "bool": ((bool,), "True or False"),
}
"""Name of what parses an option's text to the types of its values, and what they are in words."""


def folder(text: str) -> Path:
    """Return a path; an empty text is a shell variable that was not set."""
    if not text:
        raise InputError("the folder's name is empty; use . for the current folder")
    return Path(text)


def whole_number(text: str) -> int:
    """Return a whole number written in decimal or as 0x..."""
    try:
        return int(text, 0)
    except ValueError:
        raise InputError(f"{text!r} is not a whole number; write 3 or 0x03") from None


def processors() -> int:
    """Return how many processors this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
