"""Logs in HDF5 files: named arrays, also as ALOHA's recorder and MATLAB from 7.3 on write them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from robot_sysid.logs.arrays import array_blocks, arrays_table, can_be_column
from robot_sysid.logs.column_map import ColumnChoices
from robot_sysid.logs.table import LogSource, LogTable, import_optional


def hdf5_table(source: LogSource) -> LogTable:
    """Return the joint states in an HDF5 file, and ALOHA's actions where commands are read."""
    path = source.path
    h5py = import_optional("h5py", "hdf5")
    with h5py.File(path, "r") as file:
        datasets: dict[str, Any] = {}
        file.visititems(datasets.__setitem__)
        # The group #refs# holds the cell arrays of a MATLAB file.
        datasets = {
            name: member
            for name, member in datasets.items()
            if isinstance(member, h5py.Dataset) and not name.startswith("#")
        }
        is_aloha = "observations/qpos" in file
        if is_aloha:
            paths = {
                name: f"observations/{name}" for name in ("qpos", "qvel", "effort")
            }
            if source.options.commanded:
                paths["command"] = "action"
            datasets = {
                name: file[path] for name, path in paths.items() if path in file
            }
        columns = {name: data for name, data in datasets.items() if can_be_column(data)}
        arrays = {name: data[()] for name, data in columns.items()}
        if is_aloha:
            return _aloha_table(path, arrays)
        # Data sets that were not read serve the error of a file without columns.
        return arrays_table(path, "HDF5", {**datasets, **arrays})


ALOHA_RATE = 50.0
"""Rows per second of ALOHA's recorder [Hz]; its files hold no time."""
_ALOHA_JOINTS = (
    *("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"),
    "gripper",
)
"""Names of the joints of one of ALOHA's arms."""


def _aloha_table(path: Path, arrays: Mapping[str, Any]) -> LogTable:
    """Return ALOHA's arrays "qpos" and others (N, joints) as a table, with its joints' names.

    For another number of joints than one or two of its arms have, they are called joint0, joint1...
    """
    width = arrays["qpos"].shape[-1]
    joints = list(map("joint{}".format, range(width)))
    if width == len(_ALOHA_JOINTS):
        joints = list(_ALOHA_JOINTS)
    elif width == 2 * len(_ALOHA_JOINTS):
        joints = list(map("/".join, product(("left", "right"), _ALOHA_JOINTS)))
    titles = [f"{joint} {quantity}" for quantity, joint in product(arrays, joints)]
    layout = f"ALOHA HDF5, without time stamps: rows taken to be {ALOHA_RATE:g} Hz"
    blocks = partial(array_blocks, list(arrays.values()))
    choices = ColumnChoices(rate=ALOHA_RATE)
    return LogTable(path, layout, tuple(titles), blocks, choices)
