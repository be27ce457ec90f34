"""What a user, or the form of a file, declares on a log's columns and their units.

``--columns`` declares columns that titles do not determine, as ``key = value``, in a file with a
line each or in one line with commas between them::

    # lines starting with # are comments
    time = Zeit
    units = deg, ms
    position = actuators[*].position   * is the joint's number or name
    position = #2..#7              columns by their numbers, base to terminal
    position = A1, A2, A3          one title per chain joint, base to terminal
    torque.joint1 = M1
    torque.joint2 = -M2            a minus flips the sign
    torque.joint3 = 0.95 * I3      a number scales
    torque.joint4 = none           the joint has no motor, or no sensor
    position.joint4 = 0.7          it has no column, and stands still there, in the log's unit
    velocity = none                keep a quantity out
    zero = 2048                    what positions and commands read at zero: one number, or n

Keys: time, position, velocity, acceleration (accepted but not used), torque, joint_time (a time
stamp of each joint's own), command (commanded position of a servo), zero, units (of angles, slides
and time) and rate (samples per second, for a log without a time column). ``#3`` is the third
column, for a log without titles.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.logs.titles import TIME_UNITS
from robot_sysid.records.file_access import read_text
from robot_sysid.records.messages import visible

JOINT_COLUMNS = ("position", "velocity", "torque", "joint_time", "command")
"""Keys of declarations that are quantities with a column per joint."""
# All keys of declarations.
_KEYS = ("time", *JOINT_COLUMNS, "zero", "acceleration", "units", "rate")
# A factor and a title: "0.95 * I3", or a title with a minus: "-M2".
_SCALED = re.compile(
    r"(?:([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,2})?)\s*\*|-)\s*(.+)", re.ASCII
)
# A number in the place of a column.
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,2})?", re.ASCII)
# Titles that a line does not take for a number, a list, another key or a blank.
_PLAIN_TITLE = re.compile(r"[^\s#,=?]([^#,=?\x00-\x1f]*[^\s#,=?])?")
# Kind of unit to those that a user may declare.
_UNIT_FORMS = {
    "angle_unit": re.compile(
        r"rad|mrad|deg|cdeg|rev|[1-9]\d{0,8}(\.\d+)?/rev", re.ASCII
    ),
    "length_unit": re.compile("m|mm"),
    "time_unit": re.compile("|".join(TIME_UNITS)),
}


@dataclass(frozen=True)
class ColumnChoices:
    """Declarations on a log's columns, by the user or by the form of a file; None for undeclared.

    Attributes:
        entries: key to value of a columns file, also of a single joint: "torque.elbow".
        angle_unit: "rad", "mrad", "deg", "cdeg", "rev", or counts such as "4096/rev".
        length_unit: of slides, "m" or "mm".
        time_unit: "s", "ms", "us" or "ns".
        rate: samples per second of a log without a time column [Hz].
        currents: whether columns of motor currents are read in place of torques.
        commanded: whether columns of commanded positions are read in place of torques.
    """

    entries: Mapping[str, str] = field(default_factory=dict)
    angle_unit: str | None = None
    length_unit: str | None = None
    time_unit: str | None = None
    rate: float | None = None
    currents: bool = False
    commanded: bool = False

    def of(self, key: str) -> Mapping[str, str]:
        """Return joint to what is declared of it for a key; the joint "" stands for all."""
        names = [name.partition(".") for name in self.entries]
        return {j: self.entries[k + dot + j] for k, dot, j in names if k == key}

    @property
    def standing(self) -> Mapping[str, float]:
        """Joint to where it stands still, in the log's unit: a number in the place of a column."""
        numbers = {}
        for joint, value in self.of("position").items():
            if joint and _NUMBER.fullmatch(value):
                numbers[joint] = float(value)
        return numbers

    def over(self, fallback: ColumnChoices) -> ColumnChoices:
        """Return these choices, with those of the fallback where these are undeclared."""
        stated = {name: value for name, value in vars(self).items() if value}
        return replace(fallback, **stated)


def stated_choices(options: LogOptions, joint_names: Sequence[str]) -> ColumnChoices:
    """Return what options declare, for a chain with these joints (n,), or raise InputError."""
    choices = read_columns(options.columns or "", joint_names)
    return replace(
        parse_units(options.units or "").over(choices),
        currents=options.torque_constants is not None,
        commanded=options.commanded,
    )


def parse_units(text: str) -> ColumnChoices:
    """Return the units of a list with commas or blanks such as "deg,ms", or raise InputError."""
    chosen: dict[str, str] = {}
    units = re.findall(r"[^,\s]+", text)
    for unit in units:
        kinds = [kind for kind, form in _UNIT_FORMS.items() if form.fullmatch(unit)]
        chosen.update(dict.fromkeys(kinds, unit))
    if len(units) > len(chosen) or (text and not units):
        raise InputError(
            f"units {text!r} are not understood; give at most one of rad, mrad, deg, cdeg, rev and "
            "counts such as 4096/rev for angles, one of m and mm for slides, and one of "
            f"{', '.join(TIME_UNITS)} for time, as in 'deg,ms'"
        )
    # Mypy takes the values of ``**`` to be those of any field.
    return ColumnChoices(**chosen)  # type: ignore[arg-type]


def units_with(stated: str, given: str) -> str:
    """Return the units of a list with those given before, but for those of the same kind."""
    replaced = {kind for kind, unit in vars(parse_units(stated)).items() if unit}
    kept = [
        unit
        for kind, unit in vars(parse_units(given)).items()
        if kind in _UNIT_FORMS and unit and kind not in replaced
    ]
    return ",".join([*kept, stated])


def declarations(source: Path | str) -> Mapping[str, str]:
    """Return key to value as a columns file, or a text in its place, states them.

    InputError where the file cannot be read, or an entry is no ``key = value``, or a blank.
    """
    place = "columns"
    if isinstance(source, Path):
        place = str(source)
        source = read_text(source, "give a columns file, or its lines")
    # "#" begins a comment at the start of a line or behind a blank, unless it is column "#3".
    text = re.sub(r"(?m)(^|[^\S\n])#(?!\d).*", "", visible(source))
    values: dict[str, str] = {}
    # A comma before the next "key =" ends an entry; titles may hold others.
    for entry in re.split(r"\n|,\s*(?=[a-z_]+(?:\.[^,=\n]*)?\s*=)", text):
        if not entry.strip():
            continue
        key, equals, value = map(str.strip, entry.partition("="))
        if not equals or not value or key in values:
            raise InputError(
                f"{place}: expected 'key = value', once per key: {entry!r}"
            )
        if key.partition(".")[0] not in _KEYS:
            raise InputError(
                f"{place}: unknown key {key!r}; valid keys: {', '.join(_KEYS)}"
            )
        if "?" in value.replace(",", " ").split():
            raise InputError(
                f"{place}: {key} = {value} is a blank: put what it is in the place of the '?'"
            )
        values[key] = value
    return values


def split_factor(text: str, titles: Sequence[str]) -> tuple[str, float]:
    """Return title and factor of "title", "-title" or "0.5 * title".

    ``titles``: of the log, of which one may look like a title with a factor.
    """
    scaled = _SCALED.fullmatch(text)
    if text in titles or not scaled:
        return text, 1.0
    return scaled[2], float(scaled[1] or -1.0)


def is_plain_title(text: str) -> bool:
    """Return whether a line can state a title, or a pattern of titles, as it is."""
    is_other = text == "none" or _SCALED.fullmatch(text)
    return bool(_PLAIN_TITLE.fullmatch(text)) and not is_other


def column_text(titles: Sequence[str], index: int) -> str:
    """Return what a line calls a column: its title, or its number where that would not do."""
    title = titles[index]
    is_clear = is_plain_title(title) and titles.count(title) == 1
    return title if is_clear else f"#{index + 1}"


def read_columns(source: Path | str, joint_names: Sequence[str]) -> ColumnChoices:
    """Return the declarations of a columns file or line, for a chain with these joints (n,).

    InputError where it cannot be read, or a key, joint, unit or number in it is unknown.
    """
    entries = declarations(source)
    for key in entries:
        joint = key.partition(".")[2]
        if joint and joint not in joint_names:
            valid = f"the chain's joints are {', '.join(joint_names)}"
            raise InputError(
                f"columns: {key} names the unknown joint {joint!r}; {valid}"
            )
    units = parse_units(entries.get("units", ""))
    rate = None
    if "rate" in entries:
        rate = 0.0
        with contextlib.suppress(ValueError):
            rate = float(entries["rate"])
        if not 0.0 < rate < math.inf:
            raise InputError(
                "columns: rate must be a positive number of samples per second"
            )
    return replace(units, entries=entries, rate=rate)
