"""Which form a recording has, by its content."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from robot_sysid.errors import InputError
from robot_sysid.logs.formats import arrays
from robot_sysid.logs.formats.dialect import read_dialect
from robot_sysid.logs.formats.known_text import known_text
from robot_sysid.logs.formats.lerobot import is_lerobot, lerobot_table
from robot_sysid.logs.formats.ros_bag import bag_table, is_bag
from robot_sysid.logs.formats.sage import HEADER, sage_table
from robot_sysid.logs.formats.table import LogTable
from robot_sysid.logs.formats.text import TextTable
from robot_sysid.logs.options import LogOptions

FORMS = (
    "a text table (CSV), a ROS 1 or ROS 2 bag, a LeRobot data set, HDF5 (ALOHA, robomimic), "
    "NumPy .npz, MATLAB .mat or an xArm report"
)


def open_table(path: Path, joint_names: Sequence[str], options: LogOptions) -> LogTable:
    """Return a recording as a table.

    Args:
        path: file or folder.
        joint_names: the n chain joints.
        options: what was said of the log.

    Raises:
        InputError: it cannot be read, or has no form that is known.
    """
    found = _binary_table(path, joint_names, options)
    if found is not None:
        return found
    dialect = read_dialect(path)
    if tuple(title.lower() for title in dialect.header[:5]) == HEADER:
        return sage_table(dialect, joint_names)
    currents = options.torque_constants is not None
    return TextTable(dialect, *known_text(dialect.header, joint_names, currents))


def _binary_table(path: Path, joint_names: Sequence[str], options: LogOptions) -> LogTable | None:
    """Return a recording that is no text file, or None."""
    start = _start(path)
    bag = is_bag(path)
    lerobot = path.is_dir() and is_lerobot(path)
    for given, fits, name, what in (
        (options.topic, bag, "--topic", "a ROS bag"),
        (options.episode, lerobot, "--episode", "a LeRobot data set"),
    ):
        if given and not fits:
            raise InputError(f"{name} is about {what}, and {path} is none; leave it off")
    if bag:
        return bag_table(path, joint_names, options.topic)
    if lerobot:
        return lerobot_table(path, joint_names, options.episode, options.commanded)
    if path.is_dir():
        raise InputError(f"{path} is a folder of no known form; a log is {FORMS}")
    if arrays.is_matlab(start):
        return arrays.matlab_table(path)
    if arrays.is_hdf5(start) or arrays.is_matlab_hdf5(start):
        return arrays.hdf5_table(path, options.commanded)
    if arrays.is_xarm(path, start):
        return arrays.xarm_table(path)
    return arrays.npz_table(path) if arrays.is_npz(start) else None


def _start(path: Path) -> bytes:
    """Return the first bytes of a file; nothing of a folder."""
    if os.path.isdir(path):  # Path.is_dir raises where a name is too long
        return b""
    try:
        with path.open("rb") as stream:
            return stream.read(16)
    except OSError as error:
        raise InputError(f"cannot read the log {path}: {error.strerror or error}") from error
