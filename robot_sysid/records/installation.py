"""How an optional part of this package is installed, as a command for the user's shell."""

from __future__ import annotations

from pathlib import Path

from robot_sysid import __version__

PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
"""Folder of the package ``robot_sysid``."""


def install_hint(missing: str, extra: str) -> str:
    """Return the end of a message: what is missing, and the command that installs it.

    Args:
        missing: the missing libraries, such as "matplotlib and jinja2".
        extra: name of the optional dependencies in pyproject.toml that contain them.
    """
    return f"needs {missing}; install with:\n  {install_command(extra)}"


def install_command(extra: str, package_folder: Path = PACKAGE_FOLDER) -> str:
    """Return the command that installs this package again, with an extra.

    It names the checkout that the package's folder lies in, or else the release's wheel.
    """
    checkout = package_folder.parent
    if (checkout / "pyproject.toml").is_file():
        folder = "." if checkout == Path.cwd() else checkout
        return f'pip install -e "{folder}[{extra}]"'
    return f'pip install "robot_sysid-{__version__}-py3-none-any.whl[{extra}]"'
