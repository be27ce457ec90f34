"""How an optional part of this package is installed, as a command for the user's shell."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import url2pathname

from robot_sysid import __version__
from robot_sysid.errors import InputError

PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
"""Folder of the package ``robot_sysid``."""


def missing_library(
    start: str, missing: str, extra: str, error_class: type[InputError] = InputError
) -> InputError:
    """Return the error for a library that is not installed, with the command that installs it.

    Args:
        start: of the sentence: what needs it.
        missing: the missing libraries, such as "matplotlib and jinja2".
        extra: name of the optional dependencies in pyproject.toml that contain them.
        error_class: of the error.
    """
    text = f"{start} needs {missing}; install with:"
    return error_class(text, install=install_command(extra))


def install_command(extra: str, package_folder: Path = PACKAGE_FOLDER) -> str:
    """Return the command that installs this package again, with an extra.

    It names the checkout that the package's folder lies in, or else the wheel that was installed.
    """
    checkout = package_folder.parent
    if (checkout / "pyproject.toml").is_file():
        folder = "." if checkout == Path.cwd() else checkout
        return f'pip install -e "{folder}[{extra}]"'
    return f'pip install "{_wheel(package_folder)}[{extra}]"'


def _wheel(package_folder: Path) -> str:
    """Return the path of the wheel that the package was installed from, or the release's name.

    pip and uv leave the path beside the package. A name alone serves in the wheel's folder only.
    """
    name = f"robot_sysid-{__version__}"
    record = package_folder.parent / f"{name}.dist-info" / "direct_url.json"
    with contextlib.suppress(OSError, ValueError, KeyError):
        url = urlparse(json.loads(record.read_text(encoding="utf-8"))["url"])
        if url.scheme == "file":
            return url2pathname(url.path)
    return f"{name}-py3-none-any.whl"
