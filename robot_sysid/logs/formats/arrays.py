"""Recordings kept as named arrays: NumPy's .npz, and HDF5 as ALOHA and robomimic write it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.column_file import ColumnChoices
from robot_sysid.logs.formats.extras import as_input_errors, library
from robot_sysid.logs.formats.table import ArrayTable, titled_arrays

ALOHA_RATE = 50.0
"""Rows per second of ALOHA's recorder [Hz]; its files hold no time."""
_ALOHA = (
    *("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper"),
)
_ROBOMIMIC = {"joint_pos": "position", "joint_vel": "velocity", "joint_torque": "torque"}


def is_npz(start: bytes) -> bool:
    """Return whether a file that begins so is a zip archive, as .npz files are."""
    return start.startswith(b"PK\x03\x04")


def is_hdf5(start: bytes) -> bool:
    """Return whether a file that begins so is HDF5."""
    return start.startswith(b"\x89HDF\r\n\x1a\n")


def npz_table(path: Path) -> ArrayTable:
    """Return the arrays of an .npz file: time (N,), q, qd, tau (N, n), by these or like names."""
    with as_input_errors(path, "a NumPy .npz file"), path.open("rb") as stream:
        archive = np.load(stream, allow_pickle=False)
        arrays = {name: archive[name] for name in archive.files}
    titles, cells = titled_arrays(path, {n: a for n, a in arrays.items() if _is_numeric(a)})
    return ArrayTable(path, "NumPy .npz", titles, (cells,))


def hdf5_table(path: Path) -> ArrayTable:
    """Return the joint states in an HDF5 file.

    Raises:
        InputError: it cannot be read, or holds none.
    """
    h5py = library("h5py", "hdf5", "an HDF5 file")
    with as_input_errors(path, "an HDF5 file"), h5py.File(path, "r") as file:
        if "observations/qpos" in file:
            return _aloha(path, file["observations"])
        if "data" in file and isinstance(file["data"], h5py.Group):
            return _robomimic(path, file["data"])
        arrays = {n: d[()] for n, d in file.items() if isinstance(d, h5py.Dataset)}
    titles, cells = titled_arrays(path, {n: a for n, a in arrays.items() if _is_numeric(a)})
    return ArrayTable(path, "HDF5", titles, (cells,))


def _aloha(path: Path, group: Any) -> ArrayTable:
    if "effort" not in group:
        raise InputError(
            f"{path} has no /observations/effort; without measured torque nothing can be "
            "identified: record effort"
        )
    arrays = {n: group[n][()] for n in ("qpos", "qvel", "effort") if n in group}
    width = arrays["qpos"].shape[1]
    titles, cells = [], []
    for quantity, values in arrays.items():
        titles += [f"{name} {quantity}" for name in _aloha_names(width)]
        cells.append(np.asarray(values, float))
    rate = ColumnChoices(rate=ALOHA_RATE)
    layout = f"ALOHA HDF5, without time stamps: rows taken to be {ALOHA_RATE:g} Hz"
    return ArrayTable(path, layout, tuple(titles), (np.hstack(cells),), rate)


def _aloha_names(width: int) -> list[str]:
    """Return the names of ALOHA's columns, where they are those of one arm or of two."""
    if width == len(_ALOHA):
        return list(_ALOHA)
    if width == 2 * len(_ALOHA):
        return [f"{side}/{joint}" for side in ("left", "right") for joint in _ALOHA]
    return [f"joint{k}" for k in range(width)]


def _robomimic(path: Path, group: Any) -> ArrayTable:
    """Return every demonstration as a piece; arrays are called such as robot0_joint_pos."""
    titles: tuple[str, ...] = ()
    pieces = []
    for name in sorted(group, key=lambda n: (len(n), n)):
        observed = {f"/{n}": d for n, d in group[name].get("obs", {}).items()}
        arrays = {
            title: observed[n][()]
            for part, title in _ROBOMIMIC.items()
            for n in observed
            if n.endswith(part)
        }
        times = {"time": observed["/time"][()]} if "/time" in observed else {}
        if "position" not in arrays or "torque" not in arrays:
            raise InputError(
                f"{path}: demonstration {name} has no joint torques (an array whose name ends in "
                "joint_torque); without measured torque nothing can be identified: record it"
            )
        titles, cells = titled_arrays(path, {**times, **arrays})
        pieces.append(cells)
    if not pieces:
        raise InputError(f"{path} holds no demonstrations in /data")
    return ArrayTable(path, f"robomimic HDF5, {len(pieces)} demonstrations", titles, tuple(pieces))


def _is_numeric(values: Any) -> bool:
    return np.asarray(values).dtype.kind in "fiu"
