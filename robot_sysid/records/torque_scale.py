"""What a joint's torque column has to be divided by (or multiplied with) to be N m at the joint.

A scale says how much too large the column reads: tau = column / scale. A torque constant turns
motor current into torque: tau = constant * current, at the joint, so with the gear in it. Both are
one number for all joints, one per joint, or a file; in version 2 each has its standard error::

    {"version": 1, "torque_scale": {"joint1": 1.31, "joint2": 1.27}}
    {"version": 2, "torque_scale": {"joint1": {"value": 1.31, "standard_error": 0.004}, ...}}
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Union

from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json
from robot_sysid.records.atomic_files import write_whole
from robot_sysid.records.options import PerJoint, levels, per_joint

if TYPE_CHECKING:
    from robot_sysid.records import Array

VERSION = 2
SCALE = "torque_scale"
CONSTANTS = "torque_constants"
Factors = Union[PerJoint, Path]
"""One number for all joints, one per joint, or the file that lists them by name."""


def factors_in(text: str) -> Factors:
    """Return the numbers in a text, or the file that it names."""
    try:
        return levels(text)
    except InputError:
        if not os.path.isfile(text):
            raise InputError(
                f"{text!r} is neither a number, nor a list like 1.3,1.2,1.3, nor a file"
            ) from None
        return Path(text)


def usable_factor(value: float | Path) -> str | None:
    """Complain unless a value is a file or a positive number."""
    if isinstance(value, Path) or (value > 0.0 and math.isfinite(value)):
        return None
    return f"must be positive (got {value:g}); turn a sign round in the columns file"


def joint_factors(given: Factors, joint_names: Sequence[str], table: str) -> Array:
    """Return each joint's factor and its standard error, NaN where no file tells it: (2, n).

    ``SCALE`` or ``CONSTANTS`` is the table of a file and the name of the option. Raises InputError.
    """
    import numpy as np

    if not isinstance(given, Path):
        typed = per_joint(given, len(joint_names), "--" + table.replace("_", "-"))
        return np.array([typed, np.full(len(typed), np.nan)])
    values = read_factors(given, table)
    missing = [name for name in joint_names if name not in values]
    if missing:
        raise InputError(
            f"{given} has no {table} of joint {missing[0]}; it lists {', '.join(values) or 'none'}"
        )
    return np.array([values[name] for name in joint_names]).T


def read_factors(path: Path, table: str = SCALE) -> Mapping[str, tuple[float, float]]:
    """Return joint name to factor and standard error of one table of a file, or raise InputError.

    The error is not a number where the file is of version 1, which has none.
    """
    form = f'{{"version": 1, "{table}": {{"JOINT": 1.3, ...}}}}'
    content = read_json(path, f"torque factors have the form {form}")
    if not isinstance(content, dict) or not isinstance(content.get(table), dict):
        raise InputError(f"{path} holds no {table}; its form is {form}")
    version = content.get("version")
    if version not in range(1, VERSION + 1):
        raise InputError(
            f"{path} has version {version!r}, this program reads up to {VERSION}: {form}"
        )
    found = {}
    for joint, each in content[table].items():
        error = math.nan
        if version == VERSION:
            each = each if isinstance(each, dict) else {}
            error = _factor(path, joint, each.get("standard_error"))
            each = each.get("value")
        found[str(joint)] = _factor(path, joint, each), error
    return found


def write_torque_scale(path: Path, scale: Mapping[str, tuple[float, float]]) -> None:
    """Write what ``--torque-scale`` reads: joint to its scale and the standard error of that."""
    checked = {
        joint: {
            "value": _factor(path, joint, value),
            "standard_error": _factor(path, joint, error),
        }
        for joint, (value, error) in scale.items()
    }
    write_whole(path, json.dumps({"version": VERSION, SCALE: checked}, indent=2) + "\n")


def _factor(path: Path, joint: str, value: object) -> float:
    number = float(value) if isinstance(value, (int, float)) else math.nan
    complaint = usable_factor(number)
    if complaint:
        raise InputError(f"{path}: the factor of joint {joint} {complaint}")
    return number
