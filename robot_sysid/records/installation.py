"""How an optional part of this package is installed, as a command for the user's shell."""

from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from robot_sysid import __version__

_PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
"""Folder of the package ``robot_sysid``."""


def install_hint(missing: str, extra: str) -> str:
    """Return the end of a message: what is missing, and the command that installs it.

    Args:
        missing: the missing libraries, such as "matplotlib and jinja2".
        extra: name of the optional dependencies in pyproject.toml that contain them.
    """
    return f"needs {missing}; install with:\n  {install_command(extra)}"


def install_command(extra: str) -> str:
    """Return the command that installs this package again, with an extra.

    It names what this package was installed from: the checkout, or the release's wheel.
    """
    checkout = _PACKAGE_FOLDER.parent
    if (checkout / "pyproject.toml").is_file():
        folder = "." if checkout == Path.cwd() else checkout
        return f'pip install -e "{folder}[{extra}]"'
    return f'pip install "{_installed_from()}[{extra}]"'


def _installed_from() -> str:
    """Return the file or folder that pip installed this package from; else a wheel's name."""
    wheel_name = f"robot_sysid-{__version__}-py3-none-any.whl"
    try:
        record = metadata.distribution("robot-sysid").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return wheel_name
    # An index leaves no such record: this package is on none, so it was a folder of wheels.
    url = urlsplit(json.loads(record)["url"]) if record else urlsplit("")
    if url.scheme != "file":
        return wheel_name
    path = url2pathname(url.path)
    return path if Path(path).exists() else wheel_name
