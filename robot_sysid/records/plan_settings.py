"""The settings file that a plan leaves beside its motion, from which it can be planned again."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.records.atomic_files import PLAN_NAME
from robot_sysid.special_files import refuse_special_file

SETTINGS_NAME = Path(PLAN_NAME).with_suffix(".toml").name
"""Name of the settings file in the folder that a plan writes into."""
WEIGHT = "weight"
"""Purpose of the motion that comes first where an arm is heavier than its model says."""


def read_toml(path: Path) -> Mapping[str, Any]:
    """Return the content of a TOML file, or raise InputError that names the file."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    refuse_special_file(path, "give a TOML file")
    try:
        return dict(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
    except ValueError as error:
        raise InputError(f"{path} is no TOML file: {error}") from None


def settings_of(folder: Path) -> tuple[Path, Mapping[str, Any]] | None:
    """Return the settings file of the plan in a folder and what it asks for; None without one.

    A next step is made of it, which nobody misses where the file cannot be read.
    """
    path = folder / SETTINGS_NAME
    try:
        return (path, read_toml(path)) if path.is_file() else None
    except InputError:
        return None


def command_after_weighing(folder: Path, model: Path, written: Path) -> str:
    """Return the command that plans with the model that a log of a weighing motion has led to.

    Args:
        folder: holds the settings of the plan whose motion was recorded.
        model: the one that was identified; another arm's settings are not used.
        written: the model that the log has led to.

    Returns:
        "" where the motion was planned for something else, or by something else.
    """
    settings = settings_of(folder)
    if settings is None:
        return ""
    path, content = settings
    if content.get("for_") != WEIGHT or content.get("path") != str(model):
        return ""
    options = (
        "--config",
        str(path),
        "--for",
        "link",
        "--output-dir",
        str(folder / "planned"),
    )
    return shlex.join(("robot-sysid", "plan", str(written), *options))
