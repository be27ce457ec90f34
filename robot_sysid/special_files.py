"""Pipes and devices, to which a path may lead as well as to a file.

Reading one may never end or never begin, and a file that takes the place of a device is missed by
the whole system.
"""

from __future__ import annotations

import os
import stat

from robot_sysid.errors import InputError


def refuse_special_file(
    path: str | os.PathLike[str], remedy: str = "give a file"
) -> None:
    """Raise InputError where a path leads to a pipe, a device or a socket.

    Folders, and what cannot be looked at, are left to what opens them.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise InputError(f"{path} is a pipe or a device; {remedy}")
