"""Identify a robot arm's terminal link: inertial parameters and friction from joint torques.

``import robot_sysid as rs``, then ``rs.identify("arm.xml", "log.csv")``; see docs/python.md. The
functions are loaded when they are first used, so that the import itself takes no time.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

__version__ = "0.1.0"
_CALLS = ("identify", "identify_from", "information", "payload", "plan", "read_log")
FACE = {
    **dict.fromkeys(_CALLS, "api.calls"),
    "load_robot_model": "parser",
    "regressor": "api.equations",
}
"""The functions for Python programs, and the module each is in; typed in ``__init__.pyi``."""
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
"""What they raise, in ``robot_sysid.errors``."""


def __getattr__(name: str) -> object:
    if name == "motors":
        return importlib.import_module("robot_sysid.api.motors")
    if name in FACE:
        return getattr(importlib.import_module(f"robot_sysid.{FACE[name]}"), name)
    if name in ERRORS:
        return getattr(importlib.import_module("robot_sysid.errors"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *FACE, *ERRORS, "motors"})


class _Called(ModuleType):
    """A module of the name of a function of the face: calling it calls the function."""

    def __call__(self, *given: object, **options: object) -> object:
        return self._function()(*given, **options)

    @property
    def __signature__(self) -> object:
        return self._function().__signature__

    def _function(self):  # type: ignore[no-untyped-def]
        return __getattr__(self.__name__.rpartition(".")[2])


class _Package(ModuleType):
    """This package, whose functions stay callable when a module of their name is imported."""

    def __setattr__(self, name: str, value: object) -> None:
        if name in FACE and isinstance(value, ModuleType):
            value.__class__ = _Called
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
