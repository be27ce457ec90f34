"""The file beside a trajectory that says what carries and accelerates the arm in it.

::

    # trajectory_sha256=9f86d081884c7d65...
    # weight_slope=0.00,49.82,...                   N m/rad
    time,j0_weight,j0_inertia,j1_weight,...        s, N m
    0.000,0.0000,0.0000,-11.2047,...

A trajectory's torque is that of its own speed: played slower, its motion needs less. What it needs
at any speed follows from the two columns of a joint. ``weight`` holds the arm at rest in the row's
pose (gravity and springs), ``inertia`` is what its accelerations, Coriolis and rotors add at the
trajectory's own speed; friction and damping are in neither. ``weight_slope`` is by how much each
joint's weight grows at most as it sinks: a stiffness below that lets it topple.

The hash says to which trajectory they belong: the weight of another one is never used.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array
from robot_sysid.records.file_access import file_sha256, read_text

if TYPE_CHECKING:
    from robot_sysid.pipeline.motors import WeightChunk

# The comment line with the hash of the trajectory.
_OWNER = re.compile(r"#\s*trajectory_sha256=([0-9a-f]{64})\s*")
_SLOPE = re.compile(r"#\s*weight_slope=([-+.,\deE]+)\s*")
# Lines of the head: the hash, the slopes, and the titles of the columns.
_HEAD_LINES = 3


def weight_path(trajectory: str | os.PathLike[str]) -> Path:
    """Return where the weight of a trajectory's file stands: NAME_weight.csv beside NAME.csv."""
    path = Path(trajectory)
    return path.with_name(f"{path.stem}_weight.csv")


def weight_columns(n_joints: int) -> list[str]:
    """Return the titles j0_weight, j0_inertia, j1_weight, ... of the columns of n joints."""
    columns = []
    for j in range(n_joints):
        columns += [f"j{j}_weight", f"j{j}_inertia"]
    return columns


def export_weight(
    weight_chunks: Iterable[WeightChunk],
    weight_slope: Array,
    trajectory_sha256: str,
    file: TextIO,
) -> None:
    """Write what carries and accelerates an arm in a trajectory.

    Args:
        weight_chunks: successive pieces of the trajectory: time (N,) [s], and the torques (N, n)
            of weight and of accelerations [N m]. They are written one after the other.
        weight_slope: by how much each joint's weight grows as it sinks (n,) [N m/rad].
        trajectory_sha256: hash of the trajectory's file, in hexadecimal digits.
        file: to write to.

    Raises:
        InputError: a value is not finite.
    """
    file.write(f"# trajectory_sha256={trajectory_sha256}\n")
    file.write(f"# weight_slope={','.join(f'{slope:.2f}' for slope in weight_slope)}\n")
    has_titles = False
    for time, weight, inertia in weight_chunks:
        rows, n_joints = weight.shape
        if not has_titles:
            file.write(",".join(["time", *weight_columns(n_joints)]) + "\n")
            has_titles = True
        # Weight and inertia of each joint side by side.
        cells = np.stack([weight, inertia], axis=-1).reshape(rows, -1)
        if not np.all(np.isfinite(cells)):
            raise InputError("the weight to export has values that are not finite")
        # Adding zero turns the -0.0 that rounding leaves into 0.0.
        table = np.column_stack([time, np.round(cells, 4) + 0.0])
        formats = ["%.6f"] + ["%.4f"] * cells.shape[1]
        np.savetxt(file, table, formats, delimiter=",")


def belongs_to(path: Path, trajectory: Path) -> bool:
    """Return whether a file says that it is the weight of a trajectory's file as it now is."""
    lines = read_text(path, "remove it").splitlines()
    owner = _OWNER.fullmatch(lines[0]) if lines else None
    return owner is not None and owner[1] == file_sha256(trajectory)


def read_weight(path: Path, n_rows: int, n_joints: int) -> tuple[Array, Array, Array]:
    """Return the torques (N, n) of weight and accelerations in a file [N m], and the slopes (n,).

    Args:
        path: file that belongs to the trajectory.
        n_rows: number N of the trajectory's rows.
        n_joints: number n of its joints.

    Raises:
        InputError: the file cannot be read, or is not that of such a trajectory.
    """
    lines = read_text(path, "remove it").splitlines()
    titles = ["time", *weight_columns(n_joints)]
    remedy = "remove it, or export the trajectory again"
    match = _SLOPE.fullmatch("".join(lines[1:2]))
    slopes = match[1].split(",") if match else []
    if len(slopes) != n_joints:
        raise InputError(
            f"{path}, line 2: expected weight_slope= with {n_joints} numbers; {remedy}"
        )
    if [title.strip() for title in "".join(lines[2:3]).split(",")] != titles:
        raise InputError(
            f"{path}, line {_HEAD_LINES}: expected the columns time,j0_weight,j0_inertia,... for "
            f"{n_joints} joints; {remedy}"
        )
    try:
        slope = np.array(slopes, float)
        table = np.loadtxt(lines, delimiter=",", skiprows=_HEAD_LINES, ndmin=2)
    except ValueError as error:
        # Behind the semicolon is advice for programmers.
        reason = str(error).partition(";")[0]
        raise InputError(f"{path}, below line {_HEAD_LINES}: {reason}") from None
    shape = n_rows, len(titles)
    is_finite = np.all(np.isfinite(table)) and np.all(np.isfinite(slope))
    if table.shape != shape or not is_finite:
        raise InputError(
            f"{path}: expected {n_rows} rows of {len(titles)} finite numbers, as many rows as its "
            f"trajectory has; {remedy}"
        )
    return table[:, 1::2], table[:, 2::2], slope
