"""Identify a robot arm's terminal link: inertial parameters and friction from joint torques.

``import robot_sysid as rs``, then ``rs.identify("arm.xml", "log.csv")``; see docs/python.md. The
functions are loaded when they are first used, so that the import itself takes no time.
"""

from __future__ import annotations

import importlib

__version__ = "0.1.0"
FUNCTIONS = {
    "identify": "api.calls",
    "identify_from": "api.calls",
    "information": "api.calls",
    "joint_torque_regressor": "api.calls",
    "load_robot_model": "parser",
    "payload": "api.calls",
    "plan": "api.calls",
    "read_log": "api.calls",
}
"""Function for Python programs to the module that defines it; typed in ``__init__.pyi``."""
ERRORS = (
    "SysidError",
    "InputError",
    "ColumnsError",
    "ModelError",
    "AmbiguousJointError",
    "SimulationError",
    "ExportError",
    "HardwareAbort",
)
"""Exceptions that the functions raise, in ``robot_sysid.errors``."""


def __getattr__(name: str) -> object:
    if name == "motors":
        return importlib.import_module("robot_sysid.api.motors")
    if name in FUNCTIONS:
        return getattr(importlib.import_module(f"robot_sysid.{FUNCTIONS[name]}"), name)
    if name in ERRORS:
        return getattr(importlib.import_module("robot_sysid.errors"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *FUNCTIONS, *ERRORS, "motors"})
