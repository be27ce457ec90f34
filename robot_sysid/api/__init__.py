"""The face for Python programs: what the commands do, with arrays in and results out.

Nothing is printed, and no file is written unless a result is asked to ``save``.
"""

from __future__ import annotations

from robot_sysid.api.calls import (
    identify,
    identify_arm,
    identify_from,
    information,
    payload,
    plan,
    read_log,
)
from robot_sysid.parser import load_robot_model

__all__ = [
    "identify",
    "identify_arm",
    "identify_from",
    "information",
    "load_robot_model",
    "payload",
    "plan",
    "read_log",
]
