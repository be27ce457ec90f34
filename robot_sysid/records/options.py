"""Checks of single values that options share."""

from __future__ import annotations

import math
from typing import Union

from robot_sysid.errors import InputError

PerJoint = Union[float, tuple[float, ...]]
"""One number for all joints, or one per joint."""


def require_positive(value: float, option: str) -> None:
    """Raise InputError unless a number is positive and finite."""
    if not (value > 0.0 and math.isfinite(value)):
        raise InputError(f"{option} must be positive (got {value:g})")
