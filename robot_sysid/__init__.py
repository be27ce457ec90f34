"""Identify a robot arm's terminal link: inertial parameters and friction from joint torques.

``import robot_sysid as rs``, then ``rs.identify("arm.xml", "log.csv")``; see docs/python.md. The
functions are loaded when they are first used, so that the import itself takes no time.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

__version__ = "0.1.0"
FACE = (
    *("identify", "identify_arm", "identify_from", "information", "load_robot_model"),
    *("payload", "plan", "read_log"),
)
"""The functions for Python programs, in ``robot_sysid.api``; typed in ``__init__.pyi``."""


def _function(name: str) -> Any:
    return getattr(importlib.import_module("robot_sysid.api"), name)


class _Callable(ModuleType):
    """A module that bears the name of a function of the face, and is that function when called."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return _function(self.__name__.rpartition(".")[2])(*arguments, **options)

    @property
    def __wrapped__(self) -> Any:
        """The function, for its signature."""
        return _function(self.__name__.rpartition(".")[2])


class _Package(ModuleType):
    """This package: ``robot_sysid.identify`` stays the function when the folder is imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in FACE and type(value) is ModuleType:
            value.__class__ = _Callable
        super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        if name in FACE:
            return _function(name)
        raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *FACE})


sys.modules[__name__].__class__ = _Package
