"""Models by name: the files of the package robot_descriptions, which fetches them from GitHub."""

from __future__ import annotations

import contextlib
import importlib
import os
import pkgutil
import re
import sys
from difflib import get_close_matches
from pathlib import Path

from robot_sysid.errors import InputError, words_of

PACKAGE = "robot_descriptions"
_NAME = re.compile(r"\w+_description", re.ASCII)
"""``ur5e_mj_description``, an MJCF, and ``panda_description``, a URDF."""


def model_file(path: Path) -> Path:
    """Return a path as it is, or, where nothing is there, the file of the model of that name;
    InputError if robot_descriptions is missing, knows no such model, or cannot fetch it.
    """
    name = str(path)
    if not _NAME.fullmatch(name) or os.path.lexists(path):
        return path
    try:
        package = importlib.import_module(PACKAGE)
    except ImportError:
        remedy = "models by name need pip install 'robot-sysid[descriptions]'"
        raise InputError(f"there is no file {name}; {remedy}") from None
    names = [each.name for each in pkgutil.iter_modules(package.__path__)]
    if name not in names:
        near = get_close_matches(name, names, 3)
        meant = f"did you mean {' or '.join(near)}?" if near else "its page lists those it has"
        raise InputError(f"there is no file {name}, and no such model in {PACKAGE}; {meant}")
    try:
        with contextlib.redirect_stdout(sys.stderr):  # it tells what it fetches
            found = importlib.import_module(f"{PACKAGE}.{name}")
    except Exception as error:
        # Whatever git says where there is no network, or no git.
        fault = f"{PACKAGE} cannot fetch {name}: {words_of(error)}"
        raise InputError(f"{fault}; check the network, or give a model file") from None
    place = getattr(found, "MJCF_PATH", None) or getattr(found, "URDF_PATH", None)
    if place is None:
        raise InputError(f"{PACKAGE} has {name} as Xacro only; make a URDF of it and give that")
    return Path(place)
