"""Libraries that only some forms of recording need."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from robot_sysid.errors import InputError, SysidError, words_of


def library(module: str, extra: str, what: str) -> Any:
    """Return a module that is not always installed.

    Args:
        module: its name.
        extra: of this package's extras, the one that brings it.
        what: the form of recording that needs it.

    Raises:
        InputError: it is not installed; says the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        name = module.split(".")[0]
        raise InputError(
            f"reading {what} needs {name}: pip install 'robot-sysid[{extra}]'"
        ) from None


@contextlib.contextmanager
def as_input_errors(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a library complains about in a file into an InputError."""
    try:
        yield
    except SysidError:
        raise
    except MemoryError:
        raise InputError(
            f"{path} asks for more memory than there is; it is damaged, or too long"
        ) from None
    except Exception as error:
        raise InputError(f"cannot read {path} as {what}: {words_of(error)}") from error
