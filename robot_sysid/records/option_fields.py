"""Options as fields of frozen records, each stated once with its help, its unit and its check.

The parsers of the command line, the defaults, the names in messages and the tables in the README
all come from these fields. The record of the options of a sampled motion is here, too, and so are
the files that options with one number per joint may name: torque scales and torque constants.

A torque scale says how much too large a joint's torque column reads: tau = column / scale. A torque
constant turns motor current into torque: tau = constant * current, at the joint, so with the gear
in it. A file lists them by joint, without or with their standard errors::

    {"torque_scale": {"joint1": 1.31, "joint2": 1.27}}
    {"torque_scale": {"joint1": {"value": 1.31, "standard_error": 0.004}, ...}}

A factor that a log itself showed is known no better than the masses by which it was told: stated as
"1.69+-16%", it may be so far off at all joints together.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from functools import cache
from itertools import chain
from keyword import iskeyword
from numbers import Integral, Real
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    Optional,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from robot_sysid.errors import InputError
from robot_sysid.records.file_access import (
    json_text,
    read_json,
    refuse_special_file,
    write_atomically,
)
from robot_sysid.wording import option_name, option_setting

if TYPE_CHECKING:
    from robot_sysid.records import Array

PerJoint = Union[float, tuple[float, ...]]
"""One number for all joints, or one per joint."""


@dataclass(frozen=True)
class RoughFactors:
    """Factors that may be off, all by the same share.

    Attributes:
        values: one number, or one per joint.
        error: standard deviation of what they have in common, as a share.
    """

    values: PerJoint
    error: float

    def __str__(self) -> str:
        """Return them as they are typed."""
        values = self.values if isinstance(self.values, tuple) else (self.values,)
        listed = ",".join(f"{value:.12g}" for value in values)
        return f"{listed}+-{100.0 * self.error:.12g}%"


Factor = Union[float, RoughFactors]
"""One number, which may be rough."""
Factors = Union[PerJoint, Path, RoughFactors]
"""One number for all joints, one per joint, or the file that lists them by name."""
Columns = Union[Path, str]
"""The file that says which column is what, or a line that does."""
SCALE = "torque_scale"
"""Key of the table of torque scales in a file."""
CONSTANTS = "torque_constants"
"""Key of the table of torque constants in a file [N m/A]."""
LEAST_LIKENESS = 0.7
"""How alike two words are, from 0 to 1 of ``difflib``, of which one may be meant by the other."""
MOST_SAMPLES = 1e9
"""Largest number of samples of a trajectory: a run of that many takes days."""
MOST_FACTOR = 1e9
"""Largest factor between numbers of a log or a model and SI units, that of nano: beyond it squares
of torques are zero or infinite."""
DEFAULT_MAX_VELOCITY = 2.0
"""Speed limit of hinge joints for which neither the user states one nor the model a lower one
[rad/s]."""
TOP_FREQUENCY_HZ = 0.6
"""Highest frequency of designed and random motions [Hz]. Where no acceleration limit is given, the
limit of a designed one is what full speed at this frequency needs."""
EMPTY = "A"
"""Letter of ``--order`` for a recording without the payload."""
LOADED = "B"
"""Letter of ``--order`` for a recording with the payload."""
PAYLOAD_ORDER = "ABBA"
"""Order in which a motion planned for a payload is recorded: it separates a drift of friction from
the payload."""
Check = Callable[[Any], Optional[str]]
"""Returns what is wrong with a value, as the end of a sentence that begins with the option's flag,
or None where nothing is."""
Record = TypeVar("Record")
"""Any class of records of options."""
# Name of a value, unit in brackets and range, all optional, as in "V [rad/s] > 0".
_VALUE_FORM = re.compile(r"((?![\[>])\S+)? ?(?:\[(.*)\])? ?(?:(>=?) 0)?")
# Factors and, in per cent, how far they may be off.
_ROUGH_FORM = re.compile(r"(.+?)\s*(?:\+/?-|±)\s*(.+?)\s*%")


class PathUse(Enum):
    """What a command does with the path that an option names."""

    READS = "reads the file"
    WRITES = "writes the file"
    FOLDER = "looks or writes into the folder"


@dataclass(frozen=True)
class ValueKind:
    """What the type of a field says of its option's values.

    Attributes:
        parse: turns a text into a value; None for a switch, whose flag is all.
        types: of a value; of its elements where it is a tuple.
        text: what a value is, for messages.
        annotation: the type of a value in Python, for type checkers.
        per_joint: whether a value may be a tuple with a number per joint.
    """

    parse: Callable[[str], Any] | None
    types: tuple[type, ...]
    text: str
    annotation: str
    per_joint: bool = False


@dataclass(frozen=True)
class Option:
    """One option of the command line, without its name in the record.

    Attributes:
        flag: such as "--no-friction".
        help: for the parser's help and the README.
        default: value where the option is not given.
        unit: of the value, such as "s"; "" where it has none.
        metavar: name of the value in the help; one per value where the option takes several.
        choices: the texts that the option accepts; () where it accepts any.
        parse: turns text into a value; None for a switch, and for what the field's type says.
        kind: of the values; ``options_of`` fills in what the field's type says.
        check: applied to the value, or to each element of a tuple.
        default_text: describes a default that is determined only while running.
        repeats: whether the flag may stand several times, each with one value.
        takes_many: whether any number of values may follow the flag.
        short: another flag of one letter, such as "-v"; "" for none.
        path_use: what is done with a path that is its value.
    """

    flag: str
    help: str
    default: Any = None
    unit: str = ""
    metavar: str | tuple[str, ...] | None = None
    choices: tuple[str, ...] = ()
    parse: Callable[[str], Any] | None = None
    kind: ValueKind = ValueKind(
        None,
        (object,),
        "a file, or a mapping of numbers",
        "FilePath | Mapping[str, float | Numbers] | Priors",
    )
    check: Check | None = None
    default_text: str = ""
    repeats: bool = False
    takes_many: bool = False
    short: str = ""
    path_use: PathUse = PathUse.READS

    @property
    def key(self) -> str:
        """The option's name as a keyword: no_friction for --no-friction, for_ for --for."""
        name = self.flag.lstrip("-").replace("-", "_")
        return f"{name}_" if iskeyword(name) else name

    @property
    def is_argument(self) -> bool:
        """Whether it is a positional argument, which has no flag before its value."""
        return not self.flag.startswith("-")

    @property
    def name(self) -> str:
        """The option's name for the reader of a message."""
        return option_name(self.key)


@dataclass(frozen=True)
class OptionRecord:
    """Base of all records of options; checks the values of its options on construction."""

    def __post_init__(self) -> None:
        """Raise InputError naming the first option whose value cannot be used."""
        for name, stated in options_of(self).items():
            value = getattr(self, name)
            if value is None:
                continue
            for single in value if isinstance(value, tuple) else (value,):
                if stated.choices and single not in stated.choices:
                    choices = ", ".join(stated.choices)
                    setting = option_setting(stated.key, repr(single))
                    raise InputError(f"{setting}: choose one of {choices}")
                if isinstance(single, Path):
                    refuse_special_file(single, f"give {stated.name} another path")
                complaint = stated.check(single) if stated.check else None
                if complaint:
                    raise InputError(f"{stated.name} {complaint}")


@dataclass(frozen=True)
class FileArguments(OptionRecord):
    """Base of records of files that are passed on: whoever reads one says what it has to be."""

    def __post_init__(self) -> None:
        """Check nothing."""


def option(
    default: Any, help: str, value: str = "", flag: str = "", **attributes: Any
) -> Any:
    """Return a dataclass field that is an option of the command line.

    Args:
        default: value of the field where the option is not given.
        help: for the parser's help and the README.
        value: name of the value in the help, its unit and its range, as far as it has them:
            "FILE" or "V [rad/s] > 0".
        flag: such as "--trajectory"; "" makes it the field's name with dashes.
        attributes: further attributes of ``Option``; they overrule what ``value`` says.
    """
    form = _VALUE_FORM.fullmatch(value)
    assert form, value
    name, unit, sign = form.groups()
    attributes.setdefault("metavar", name)
    attributes.setdefault("unit", unit or "")
    attributes.setdefault("check", _RANGE_CHECKS.get(sign))
    stated = Option(flag, help, default, **attributes)
    return field(default=default, metadata={"option": stated})


def options_of(record: Any) -> Mapping[str, Option]:
    """Return field name to option of a record or of a record's class, in the order of the fields.

    The mapping is cached and shared: callers must not change it.
    """
    return _options_of_class(record if isinstance(record, type) else type(record))


@cache
def _options_of_class(record_class: Any) -> Mapping[str, Option]:
    """Return field name to option, with flag and parser completed, of a class of records."""
    options = {}
    field_types = get_type_hints(record_class)
    for record_field in fields(record_class):
        stated = record_field.metadata.get("option")
        if stated is None:
            continue
        name = record_field.name
        value_type = _single_type(field_types[name])
        # A type that is no kind, such as another record, comes with a parser of its own.
        if value_type in _KINDS:
            kind = _KINDS[value_type]
            stated = replace(stated, kind=kind, parse=stated.parse or kind.parse)
        elif stated.parse is None:
            raise TypeError(
                f"{record_class.__name__}.{name}: no option is {value_type}"
            )
        flag = stated.flag or "--" + name.replace("_", "-")
        options[name] = replace(stated, flag=flag)
    return options


def _single_type(field_type: Any) -> Any:
    """Return the type of one value of a field: float for ``Optional[tuple[float, ...]]``."""
    if get_origin(field_type) is Union:
        members = [each for each in get_args(field_type) if each is not type(None)]
        field_type = Union[tuple(members)]
    # A name such as PerJoint is a kind of its own, of which a tuple is one form.
    while get_origin(field_type) is tuple:
        field_type = get_args(field_type)[0]
    return field_type


def given_values(record: Any) -> dict[str, Any]:
    """Return key to value of the options of a record that differ from their defaults."""
    values = {}
    for name, stated in options_of(record).items():
        value = getattr(record, name)
        if value != stated.default:
            values[stated.key] = value
    return values


def command_arguments(
    values: Mapping[str, Any], options: Iterable[Option]
) -> list[str]:
    """Return the arguments of a command line that state some options.

    ``values``: option's key to its value; an option without a value, or with None or False, is left
    out. Floats are written with 12 digits.
    """
    arguments = []
    for stated in options:
        value = values.get(stated.key)
        if value is None or value is False:
            continue
        for single in value if stated.repeats else (value,):
            if not stated.is_argument:
                arguments.append(stated.flag)
            # A switch, which parses nothing, is its flag alone.
            if stated.parse is None:
                continue
            texts = []
            for leaf in leaves(single):
                texts.append(f"{leaf:.12g}" if isinstance(leaf, float) else str(leaf))
            if stated.takes_many or isinstance(stated.metavar, tuple):
                arguments += texts
            else:
                arguments.append(",".join(texts))
    return arguments


def record_from(
    record_class: type[Record], values: Mapping[str, Any], default: Record | None = None
) -> Record:
    """Return a record of a class, with a value for each option that ``values`` has by its key.

    All other options have their defaults, or are those of the record ``default``; keys that are no
    options of this class are ignored. A text is parsed as on the command line, a list or array
    becomes a tuple. Raises InputError where a value has another type than its option, or fails its
    check.
    """
    arguments = {}
    for name, stated in options_of(record_class).items():
        if stated.key in values:
            value = values[stated.key]
            is_default = value is None and stated.default is None
            arguments[name] = None if is_default else _checked_value(stated, value)
    if default is not None:
        return replace(default, **arguments)  # type: ignore[type-var]
    return record_class(**arguments)


def _checked_value(stated: Option, raw_value: Any) -> Any:
    """Return the value of an option in the form that its record holds.

    A single value of an option that takes several becomes a tuple of one.

    Args:
        stated: the option.
        raw_value: value of a keyword: of the option's type, a text, a list or an array.

    Raises:
        InputError: the value is of another type than the option's.
    """
    try:
        value = immutable_value(raw_value, stated.parse)
    except ValueError:
        # A text that is no number: it stays a text, which the check of types below refuses.
        value = raw_value
    except InputError as error:
        raise InputError(f"{stated.name}: {error}") from None
    # An option with several names in the help, such as LINK KG, takes rows, each of them a tuple.
    has_rows = isinstance(stated.metavar, tuple)
    takes_many = stated.repeats or stated.takes_many
    # Whether the value is one value, or one row: a tuple that holds no tuple.
    is_single = not isinstance(value, tuple)
    if has_rows and not is_single:
        is_single = not isinstance(value[:1] and value[0], tuple)
    if takes_many and is_single:
        value = (value,)
    takes_many = takes_many or has_rows or stated.kind.per_joint
    # Python counts a bool as a number; an option does not.
    fits = takes_many or is_single
    for leaf in leaves(value):
        fits &= isinstance(leaf, stated.kind.types) and (
            bool in stated.kind.types or not isinstance(leaf, bool)
        )
    if not fits:
        raise InputError(
            f"{stated.name} must be {stated.kind.text} (got {raw_value!r:.60})"
        )
    return value


def immutable_value(value: Any, parse: Callable[[str], Any] | None = None) -> Any:
    """Return lists and arrays as tuples, nested ones too, and texts as ``parse`` reads them.

    Anything else, and texts without ``parse``, are returned unchanged.
    """
    # numpy's arrays and scalars.
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return tuple(immutable_value(item, parse) for item in value)
    return parse(value) if isinstance(value, str) and parse is not None else value


def leaves(value: Any) -> Iterator[Any]:
    """Yield the values inside nested tuples; a value that is no tuple is yielded as it is."""
    if isinstance(value, tuple):
        for item in value:
            yield from leaves(item)
    else:
        yield value


def keys_of(*records: Any) -> set[str]:
    """Return the keys of all options of some records, or of their classes."""
    return {stated.key for stated in options_of_all(*records)}


def options_of_all(
    *records: Any, only: Collection[str] = (), **defaults: Any
) -> list[Option]:
    """Return the options of some records, or of their classes, in the order of the records.

    Args:
        records: the records.
        only: keys of the options to return; empty for all.
        defaults: by key, defaults in place of the records'.
    """
    options = chain.from_iterable(options_of(record).values() for record in records)
    return [
        replace(stated, default=defaults.get(stated.key, stated.default))
        for stated in options
        if not only or stated.key in only
    ]


def refuse_unknown(keys: Collection[str], valid_keys: Collection[str]) -> None:
    """Raise InputError naming a key that is not valid, and the valid one that is most like it."""
    for key in sorted({*keys} - {*valid_keys}):
        hint = suggestion(key, valid_keys) or f"valid: {', '.join(sorted(valid_keys))}"
        raise InputError(f"unknown option {key!r}; {hint}")


def suggestion(word: str, valid_words: Iterable[str]) -> str:
    """Return "did you mean X?" with the valid word that is most like a word, "" for none."""
    from difflib import get_close_matches

    matches = get_close_matches(word, valid_words, n=1, cutoff=LEAST_LIKENESS)
    return f"did you mean {matches[0]}?" if matches else ""


def check_positive(value: float) -> str | None:
    """Return a complaint unless a number is positive and finite; None where it is."""
    fits = 0.0 < value < math.inf
    return None if fits else f"must be positive (got {value:g})"


def check_not_negative(value: float) -> str | None:
    """Return a complaint unless a number is zero or more and finite; None where it is."""
    fits = 0.0 <= value < math.inf
    return None if fits else f"must be a number that is not negative (got {value:g})"


def check_finite(value: float) -> str | None:
    """Return a complaint unless a number is finite; None where it is."""
    return None if math.isfinite(value) else f"must be a number (got {value:g})"


def check_speed_factor(value: float) -> str | None:
    """Return a complaint unless a number is above 0 and at most 1; None where it is."""
    fits = 0.0 < value <= 1.0
    return None if fits else f"must be above 0 and at most 1 (got {value:g})"


# Sign before the 0 in the ``value`` of ``option`` to the check that it asks for.
_RANGE_CHECKS = {">": check_positive, ">=": check_not_negative}


def joint_values(values: PerJoint, n_joints: int, name: str) -> Array:
    """Return the values (n,) of an option that takes one number for all joints, or one per joint.

    Raises InputError, naming the option, where the number of values does not fit.
    """
    import numpy as np

    numbers = np.atleast_1d(np.asarray(values, dtype=float))
    if len(numbers) not in (1, n_joints):
        raise InputError(
            f"{name} takes one number, or one per joint of the chain, which has {n_joints} "
            f"(got {len(numbers)})"
        )
    return np.broadcast_to(numbers, (n_joints,)).copy()


def parse_numbers(text: str) -> PerJoint:
    """Return the numbers in a text: one for all joints, or one per joint between commas."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError as error:
        raise InputError(
            f"{text!r} is neither a number nor a list like 0.1,0.1,0.05"
        ) from error
    return numbers[0] if len(numbers) == 1 else numbers


def parse_factor(text: str) -> Factor:
    """Return the number in a text, such as "1.69" or "1.69+-16%"."""
    rough = _rough_factors(text)
    if rough is None:
        return float(text)
    if isinstance(rough.values, tuple):
        raise InputError(f"{text!r} has more than one number")
    return rough


def _rough_factors(text: str) -> RoughFactors | None:
    """Return the factors in a text that states how far they may be off; None for another one."""
    form = _ROUGH_FORM.fullmatch(text)
    if form is None:
        return None
    error = parse_numbers(form[2])
    if isinstance(error, tuple):
        raise InputError(f"{text!r} has more than one error; all numbers share one")
    return RoughFactors(parse_numbers(form[1]), error / 100.0)


def parse_factors(text: str) -> Factors:
    """Return the numbers in a text, or the file that it names."""
    rough = _rough_factors(text)
    if rough is not None:
        return rough
    try:
        return parse_numbers(text)
    except InputError:
        if not os.path.isfile(text):
            raise InputError(
                f"{text!r} is neither a number, nor a list like 1.3,1.2,1.3, nor a file"
            ) from None
        return Path(text)


def parse_columns(text: str) -> Columns:
    """Return a line of settings such as "position = q[*]", or the file that a text names."""
    return text if "=" in text and not os.path.exists(text) else Path(text)


def check_scale(value: Factor) -> str | None:
    """Return a complaint unless a value has positive numbers only; None where it has."""
    if not isinstance(value, RoughFactors):
        return _check_factor_size(value)
    complaints = [*map(_check_factor_size, leaves(value.values))]
    return next(filter(None, [*complaints, check_positive(value.error)]), None)


def _check_factor_size(value: float) -> str | None:
    """Return a complaint unless a factor is one between two units; None where it is."""
    fits = 1.0 / MOST_FACTOR <= value <= MOST_FACTOR
    text = f"must be positive, from {1.0 / MOST_FACTOR:g} to {MOST_FACTOR:g} (got {value:g})"
    return None if fits else text


def check_factor(value: Factor | Path) -> str | None:
    """Return a complaint unless a value is a file or a positive number; None where it is."""
    complaint = None if isinstance(value, Path) else check_scale(value)
    return complaint and f"{complaint}; turn a sign round in the columns file"


def factor_with_error(factor: Factor | None) -> tuple[float, float]:
    """Return a factor, one for None, and by which share it may be off."""
    if not isinstance(factor, RoughFactors):
        return factor or 1.0, 0.0
    (value,) = leaves(factor.values)
    return float(value), factor.error


def shared_error(factors: Factors | None) -> float:
    """Return by which share all of some factors may be off together; zero where none is stated."""
    return factors.error if isinstance(factors, RoughFactors) else 0.0


def joint_factors(
    factors: Factors | None, joint_names: Sequence[str], table: str
) -> Array:
    """Return (2, n): the factor of each joint, and its standard error or NaN where none is stated.

    Args:
        factors: numbers, or the file to read them from; None for ones.
        joint_names: the n joints, in the order of the columns that are returned.
        table: ``SCALE`` or ``CONSTANTS``, the key in the file and the name of the option.

    Raises:
        InputError: the number of values does not fit, or the file lacks a joint or cannot be read.
    """
    import numpy as np

    if not isinstance(factors, Path):
        stated = factors.values if isinstance(factors, RoughFactors) else factors
        values = joint_values(stated or 1.0, len(joint_names), option_name(table))
        return np.array([values, np.full(len(values), np.nan)])
    by_joint = read_factors(factors, table)
    for name in joint_names:
        if name not in by_joint:
            listed = ", ".join(by_joint) or "none"
            raise InputError(
                f"{factors} has no {table} of joint {name}; it lists {listed}"
            )
    return np.array([by_joint[name] for name in joint_names]).T


def read_factors(path: Path, table: str = SCALE) -> Mapping[str, tuple[float, float]]:
    """Return joint name to factor and standard error of one table of a file, or raise InputError.

    The error is NaN where the file states none.

    ``table``: ``SCALE`` or ``CONSTANTS``, the table's key in the file.
    """
    form = f'{{"{table}": {{"JOINT": 1.3, ...}}}}'
    content = read_json(path, f"torque factors have the form {form}")
    if not isinstance(content, dict) or not isinstance(content.get(table), dict):
        raise InputError(f"{path} holds no {table}; its form is {form}")
    factors = {}
    for joint, entry in content[table].items():
        stated = entry if isinstance(entry, dict) else {"value": entry}
        error = math.nan
        if "standard_error" in stated:
            error = _checked_factor(
                path, joint, stated["standard_error"], check_positive
            )
        factors[str(joint)] = _checked_factor(path, joint, stated.get("value")), error
    return factors


def write_torque_scale(path: Path, scales: Mapping[str, tuple[float, float]]) -> None:
    """Write the file that ``--torque-scale`` reads: joint to its scale and its standard error.

    InputError where one of them is not positive, or the file cannot be written.
    """
    entries = {}
    for joint, (scale, error) in scales.items():
        entries[joint] = {
            "value": _checked_factor(path, joint, scale),
            "standard_error": _checked_factor(path, joint, error, check_positive),
        }
    write_atomically(path, json_text({"version": 2, SCALE: entries}))


def _checked_factor(
    path: Path, joint: str, value: object, check: Check = check_factor
) -> float:
    """Return a factor or standard error of a file; InputError where its check complains.

    ``joint``: the name of the joint that it belongs to, for the message.
    """
    factor = float(value) if isinstance(value, (int, float)) else math.nan
    complaint = check(factor)
    if complaint:
        raise InputError(f"{path}: the factor of joint {joint} {complaint}")
    return factor


def parse_folder(text: str) -> Path:
    """Return a path; InputError for an empty text, such as a shell variable that is not set."""
    if not text:
        raise InputError("the folder's name is empty; use . for the current folder")
    return Path(text)


def parse_whole_number(text: str) -> int:
    """Return a whole number written in decimal or as 0x..."""
    try:
        return int(text, 0)
    except ValueError:
        raise InputError(f"{text!r} is not a whole number; write 3 or 0x03") from None


_KINDS: Mapping[Any, ValueKind] = {
    PerJoint: ValueKind(
        parse_numbers,
        (Real,),
        "a number, or one per joint",
        "float | Numbers",
        per_joint=True,
    ),
    Factors: ValueKind(
        parse_factors,
        (Real, os.PathLike, RoughFactors),
        "a number, a file, or one per joint",
        "float | Numbers | FilePath | RoughFactors",
        per_joint=True,
    ),
    Factor: ValueKind(
        parse_factor, (Real, RoughFactors), "a number", "float | str | RoughFactors"
    ),
    Columns: ValueKind(
        parse_columns,
        (str, os.PathLike),
        "a file, or a line such as 'position = q[*]'",
        "FilePath",
    ),
    float: ValueKind(float, (Real,), "a number", "float"),
    int: ValueKind(parse_whole_number, (Integral,), "a whole number", "int"),
    str: ValueKind(str, (str,), "a text", "str"),
    Path: ValueKind(Path, (os.PathLike,), "a path", "FilePath"),
    bool: ValueKind(None, (bool,), "True or False", "bool"),
}
"""Type of one value of an option, as its field states it, to what it says of the values."""


def value_text(stated: Option) -> str:
    """Return what an option's value is in Python, such as "a number [s]"."""
    text = stated.kind.text
    if stated.choices:
        *quoted, last = (f'"{choice}"' for choice in stated.choices)
        text = f"{', '.join(quoted)} or {last}"
    elif isinstance(stated.metavar, tuple):
        text = f"{len(stated.metavar)} numbers {' '.join(stated.metavar)}"
    if stated.unit:
        text += f" [{stated.unit}]"
    return f"{text}, or a list of them" if stated.repeats or stated.takes_many else text


def value_annotation(stated: Option) -> str:
    """Return the type of an option's value in Python, with the names of ``api.keyword_types``."""
    text = stated.kind.annotation
    if stated.choices:
        text = f"Literal{[*stated.choices]}"
    elif isinstance(stated.metavar, tuple):
        text = "Numbers"
    if stated.repeats or stated.takes_many:
        text += " | Numbers" if text == "float" else f" | Sequence[{text}]"
    return f"{text} | None" if stated.default is None else text


@dataclass(frozen=True)
class TrajectoryOptions(OptionRecord):
    """Options on the trajectory that the arm moves along, and on its sampling."""

    duration: float = option(
        15.0, "length; longer gives better conditioning", "[s] > 0"
    )
    sample_rate: float = option(
        1000.0, "samples per second; higher gives more equations", "RATE [Hz] > 0"
    )
    seed: Optional[int] = option(
        None,
        "seed of the random trajectory and of simulated noise",
        ">= 0",
        default_text="a fresh one",
    )
    speed: float = option(
        1.0,
        "slow the whole motion down, for a first run",
        "FACTOR",
        check=check_speed_factor,
    )
    file: Optional[Path] = option(
        None, "use a trajectory that was saved", "FILE", flag="--trajectory"
    )
    save: Optional[Path] = option(
        None,
        "write the trajectory as JSON (coefficients), and as CSV (samples) beside it",
        "FILE",
        flag="--save-trajectory",
        path_use=PathUse.WRITES,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.duration * self.sample_rate < 1.0:
            raise InputError(
                f"{option_name('duration')} times {option_name('sample_rate')} gives less than two "
                "samples; raise one of them"
            )
        require_countable(self.duration / self.speed, self.sample_rate)


def require_countable(duration: float, sample_rate: float) -> None:
    """Raise InputError where a trajectory has more samples than a run can take, or a NaN number.

    Args:
        duration: of the trajectory as it is played, at ``--speed`` [s].
        sample_rate: number of samples per second [Hz].
    """
    count = duration * sample_rate
    if not count <= MOST_SAMPLES:
        raise InputError(
            f"a trajectory of {duration:.3g} s with "
            f"{option_name('sample_rate', f'{sample_rate:g}')} has {count:.3g} samples, more than "
            f"the {MOST_SAMPLES:.0e} a run can take; shorten it, raise {option_name('speed')} "
            "where that slows it down, or lower the rate"
        )
