"""The file behind ``--columns``: which column of a log is what, where its titles do not tell.

Two forms. Lines of ``key = value``::

    # lines starting with # are comments
    time = Zeit
    units = deg, ms
    position = A1, A2, A3          one title per chain joint, base to terminal
    torque.joint1 = M1
    torque.joint2 = -M2            a minus flips the sign
    torque.joint3 = 0.95 * I3      a number scales
    velocity = none                keep a quantity out

or the same as JSON: ``{"time": "Zeit", "position": ["A1", "A2"], "torque": {"joint1": "M1"}}``.

Keys: time, position, velocity, acceleration, torque, joint_time (a time stamp of each joint's own),
command (position a servo is asked for), units (rad, deg; s, ms, us, ns) and rate (samples per
second, for a log without a time column).
``#3`` is the third column, for a log without titles. What the file does not name is still
recognised by its title.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json
from robot_sysid.logs.columns import QUANTITIES

_KEYS = ("time", *QUANTITIES, "units", "rate")
_SCALED = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,2})?)\s*\*\s*(.+)", re.ASCII)
_ANGLES = ("rad", "deg")
_TIMES = ("s", "ms", "us", "ns")


@dataclass(frozen=True)
class Units:
    """Declared units; None where the column titles (or SI) decide."""

    angle: str | None = None
    time: str | None = None


@dataclass(frozen=True)
class ColumnChoices:
    """What a columns file says.

    Attributes:
        time: title of the time column, or None.
        columns: quantity to joint name to title; "none" keeps a quantity out.
        units: declared units.
        rate: samples per second of a log without time stamps, or None.
    """

    time: str | None = None
    columns: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    units: Units = Units()
    rate: float | None = None


def parse_units(text: str) -> Units:
    """Return the units of a comma- or blank-separated list such as "deg,ms".

    Raises:
        InputError: a unit is unknown, or two are for the same thing.
    """
    words = [word for word in re.split(r"[,\s]+", text.strip()) if word]
    unknown = [word for word in words if word not in _ANGLES + _TIMES]
    angles, times = [w for w in words if w in _ANGLES], [w for w in words if w in _TIMES]
    if unknown or not words or len(angles) > 1 or len(times) > 1:
        raise InputError(
            f"units {text!r} are not understood; give at most one of {', '.join(_ANGLES)} and one "
            f"of {', '.join(_TIMES)}, for instance 'deg,ms'"
        )
    return Units(angles[0] if angles else None, times[0] if times else None)


def read_columns_file(path: Path, joint_names: Sequence[str]) -> ColumnChoices:
    """Read a columns file.

    Args:
        path: the file.
        joint_names: the chain's joints, base to terminal.

    Raises:
        InputError: it cannot be read, or a key, joint, unit or number in it is unknown.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the columns file {path}: {error}") from error
    is_json = text.lstrip().startswith("{")
    entries = (
        dict(read_json(path, "write 'key = value' lines, or JSON"))
        if is_json
        else _lines(path, text)
    )
    columns: dict[str, dict[str, str]] = {}
    for key, value in entries.items():
        quantity = key.split(".", 1)[0]
        if quantity not in _KEYS:
            raise InputError(f"{path}: unknown key {key!r}; valid keys: {', '.join(_KEYS)}")
        if quantity in QUANTITIES:
            columns.setdefault(quantity, {}).update(_per_joint(path, key, value, joint_names))
    units = parse_units(str(entries["units"])) if "units" in entries else Units()
    time = str(entries["time"]) if "time" in entries else None
    return ColumnChoices(time, columns, units, _rate(path, entries.get("rate")))


def scaled_title(text: str, titles: Sequence[str]) -> tuple[str, float]:
    """Return (title, factor) of "title", "-title" or "0.5 * title"; an exact title comes first."""
    if text in titles:
        return text, 1.0
    match = _SCALED.fullmatch(text)
    if match:
        return match.group(2).strip(), float(match.group(1))
    return (text[1:].strip(), -1.0) if text.startswith("-") else (text, 1.0)


def _lines(path: Path, text: str) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        # A blank before the mark makes a remark of the rest; without one it is column "#3".
        content = re.sub(r"(^|\s)#(?!\d).*", "", line).strip()
        if not content:
            continue
        key, equals, value = (part.strip() for part in content.partition("="))
        if not equals or not value or key in entries:
            raise InputError(f"{path} line {number}: expected one 'key = value' per key: {line!r}")
        entries[key] = value
    return entries


def _per_joint(path: Path, key: str, value: Any, joint_names: Sequence[str]) -> Mapping[str, str]:
    _, _, joint = key.partition(".")
    if joint:
        chosen = {joint: str(value)}
    elif isinstance(value, Mapping):
        chosen = {str(name): str(title) for name, title in value.items()}
    else:
        chosen = _listed(path, key, value, joint_names)
    unknown = [name for name in chosen if name not in joint_names]
    if unknown:
        raise InputError(
            f"{path}: {key} names the unknown joint {unknown[0]!r}; the chain's joints are "
            f"{', '.join(joint_names)}"
        )
    return chosen


def _listed(path: Path, key: str, value: Any, joint_names: Sequence[str]) -> dict[str, str]:
    titles = [str(v) for v in value] if isinstance(value, list) else str(value).split(",")
    titles = [title.strip() for title in titles]
    if titles == ["none"]:
        titles = ["none"] * len(joint_names)
    if len(titles) != len(joint_names):
        raise InputError(
            f"{path}: {key} lists {len(titles)} columns, the chain has {len(joint_names)} joints: "
            f"{', '.join(joint_names)}"
        )
    return dict(zip(joint_names, titles))


def _rate(path: Path, value: Any) -> float | None:
    if value is None:
        return None
    try:
        rate = float(value)
    except (TypeError, ValueError):
        rate = math.nan
    if not (math.isfinite(rate) and rate > 0.0):
        raise InputError(f"{path}: rate must be a positive number of samples per second: {value!r}")
    return rate
