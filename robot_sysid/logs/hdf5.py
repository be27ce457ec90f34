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

ALOHA_RATE = 50.0
"""Rows per second of ALOHA's recorder [Hz]; its files hold no time."""
_ALOHA_ARRAYS = (
    *("observations/qpos", "observations/qvel", "observations/effort"),
    "action",
)
"""Arrays of ALOHA's recorder with a column per joint."""
_ALOHA_JOINTS = (
    *("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"),
    "gripper",
)
"""Names of the joints of one of ALOHA's arms."""


def hdf5_table(source: LogSource) -> LogTable:
    """Return the joint states in an HDF5 file."""
    h5py = import_optional("h5py", "hdf5")
    with h5py.File(source.path, "r") as file:
        datasets: dict[str, Any] = {}
        file.visititems(datasets.__setitem__)
        if _ALOHA_ARRAYS[0] in file:
            datasets = {name: file[name] for name in _ALOHA_ARRAYS if name in file}
        arrays = {}
        for name, data in datasets.items():
            # The group #refs# holds the cell arrays of a MATLAB file.
            if isinstance(data, h5py.Dataset) and not name.startswith("#"):
                # What is not read serves the error of a file without columns.
                arrays[name] = data[()] if can_be_column(data) else data
        if _ALOHA_ARRAYS[0] in arrays:
            return _aloha_table(source.path, arrays)
        return arrays_table(source.path, "HDF5", arrays)


def _aloha_table(path: Path, arrays: Mapping[str, Any]) -> LogTable:
    """Return ALOHA's arrays (N, joints) as a table, with its joints' names.

    For another number of joints than one or two of its arms have, they are called joint0, joint1...
    """
    width = arrays[_ALOHA_ARRAYS[0]].shape[-1]
    two_arms = map("/".join, product(("left", "right"), _ALOHA_JOINTS))
    joints = {7: [*_ALOHA_JOINTS], 14: [*two_arms]}.get(width)
    joints = joints or [f"joint{k}" for k in range(width)]
    quantities = [name.rpartition("/")[2] for name in arrays]
    titles = [f"{joint} {quantity}" for quantity, joint in product(quantities, joints)]
    layout = f"ALOHA HDF5, without time stamps: rows taken to be {ALOHA_RATE:g} Hz"
    blocks = partial(array_blocks, list(arrays.values()))
    choices = ColumnChoices(rate=ALOHA_RATE)
    return LogTable(path, layout, tuple(titles), blocks, choices)
