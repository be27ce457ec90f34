"""Factors from a joint's torque column to N m at the joint: torque scales and torque constants.

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
from robot_sysid.records.file_access import read_json, write_atomically
from robot_sysid.records.option_fields import PerJoint, joint_values, parse_numbers

if TYPE_CHECKING:
    from robot_sysid.records import Array

VERSION = 2
"""Version of the files that are written, and the newest that is read."""
SCALE = "torque_scale"
"""Key of the table of torque scales in a file."""
CONSTANTS = "torque_constants"
"""Key of the table of torque constants in a file [N m/A]."""
Factors = Union[PerJoint, Path]
"""One number for all joints, one per joint, or the file that lists them by name."""


def parse_factors(text: str) -> Factors:
    """Return the numbers in a text, or the file that it names."""
    try:
        return parse_numbers(text)
    except InputError:
        if not os.path.isfile(text):
            raise InputError(
                f"{text!r} is neither a number, nor a list like 1.3,1.2,1.3, nor a file"
            ) from None
        return Path(text)


def check_factor(value: float | Path) -> str | None:
    """Return a complaint unless a value is a file or a positive number; None where it is."""
    if isinstance(value, Path) or (value > 0.0 and math.isfinite(value)):
        return None
    return f"must be positive (got {value:g}); turn a sign round in the columns file"


def joint_factors(factors: Factors, joint_names: Sequence[str], table: str) -> Array:
    """Return (2, n): the factor of each joint, and its standard error or NaN where none is stated.

    Args:
        factors: numbers, or the file to read them from.
        joint_names: the n joints, in the order of the columns that are returned.
        table: ``SCALE`` or ``CONSTANTS``, the key in the file and the name of the option.

    Raises:
        InputError: the number of values does not fit, or the file lacks a joint or cannot be read.
    """
    import numpy as np

    if not isinstance(factors, Path):
        flag = "--" + table.replace("_", "-")
        values = joint_values(factors, len(joint_names), flag)
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

    The error is NaN where the file is of version 1, which states none.
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
    factors = {}
    for joint, value in content[table].items():
        error = math.nan
        if version == VERSION:
            fields = value if isinstance(value, dict) else {}
            error = _checked_factor(path, joint, fields.get("standard_error"))
            value = fields.get("value")
        factors[str(joint)] = _checked_factor(path, joint, value), error
    return factors


def write_torque_scale(path: Path, scales: Mapping[str, tuple[float, float]]) -> None:
    """Write the file that ``--torque-scale`` reads: joint to its scale and its standard error."""
    entries = {}
    for joint, (scale, error) in scales.items():
        entries[joint] = {
            "value": _checked_factor(path, joint, scale),
            "standard_error": _checked_factor(path, joint, error),
        }
    content = {"version": VERSION, SCALE: entries}
    write_atomically(path, json.dumps(content, indent=2) + "\n")


def _checked_factor(path: Path, joint: str, value: object) -> float:
    """Return a factor of a file, or raise InputError where it is no positive number."""
    factor = float(value) if isinstance(value, (int, float)) else math.nan
    complaint = check_factor(factor)
    if complaint:
        raise InputError(f"{path}: the factor of joint {joint} {complaint}")
    return factor
