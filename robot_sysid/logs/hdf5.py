"""Logs in HDF5 files: named arrays, also as ALOHA's recorder and MATLAB from 7.3 on write them.

Only numbers in the file itself are read: no link to another file is followed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.logs.arrays import (
    arrays_table,
    can_be_column,
    list_shapes,
    recordings_table,
)
from robot_sysid.logs.column_map import ColumnChoices
from robot_sysid.logs.table import (
    LogSource,
    LogTable,
    import_optional,
    memory_limit,
    refuse_bomb,
    refuse_many_arrays,
)
from robot_sysid.records import Array

_MAX_LINKS = 3
"""Largest number of links to other files that a message names."""
_COPY = "copy what is in it into this one (h5copy -f ext, or h5repack)"
"""Remedy for numbers that are in another file."""


def hdf5_table(source: LogSource) -> LogTable:
    """Return the joint states in an HDF5 file, and ALOHA's actions where commands are read.

    Data sets that are links to other files are named in the table, but not read.
    """
    path = source.path
    h5py = import_optional("h5py", "hdf5")
    with h5py.File(path, "r") as file:
        links: list[str] = []
        is_aloha = _find_member(h5py, file, "observations/qpos") is not None
        if is_aloha:
            datasets = _find_aloha_arrays(h5py, file, source.options.commanded)
        else:
            datasets, links = _list_datasets(h5py, path, file)
        arrays = _read_datasets(path, datasets)
        if is_aloha and "qpos" in arrays:
            return _aloha_table(path, arrays)
        external_links = f"{'; '.join(links)}; {_COPY}" if links else ""
        if links and not arrays:
            raise InputError(f"{path}: {external_links}")
        layout = "; ".join(("HDF5", *links))
        # Data sets that were not read serve the error of a file without columns.
        table = arrays_table(path, layout, {**datasets, **arrays})
        return replace(table, external_links=external_links)


def _list_datasets(
    h5py: Any, path: Path, file: Any
) -> tuple[dict[str, Any], list[str]]:
    """Return name to data set of an HDF5 file, and descriptions of its links to other files.

    At most ``_MAX_LINKS`` links are described. InputError where the file has too many members.
    """
    members = [("", file)]

    def visit(name: str, member: Any) -> None:
        """Add a data set or group to ``members``, unless these are too many for a log."""
        refuse_many_arrays(path, len(members))
        members.append((name, member))

    file.visititems(visit)
    datasets = {}
    links: list[str] = []
    for name, member in members:
        # The group #refs# holds the cell arrays of a MATLAB file.
        if isinstance(member, h5py.Dataset) and not name.startswith("#"):
            datasets[name] = member
        for key in member if isinstance(member, h5py.Group) else ():
            link = member.get(key, getlink=True)
            if isinstance(link, h5py.ExternalLink) and len(links) < _MAX_LINKS:
                links.append(_link_text(f"{name}/{key}".lstrip("/"), link))
    return datasets, links


def _read_datasets(path: Path, datasets: Mapping[str, Any]) -> dict[str, Array]:
    """Return the numbers of the data sets that can be columns of a log, by name.

    InputError where they take too much memory, or where the numbers of one are in another file.
    """
    columns = {name: data for name, data in datasets.items() if can_be_column(data)}
    unpacked = 0.0
    for name, data in columns.items():
        files = [str(file) for file, *_ in data.external or ()]
        if data.is_virtual:
            files += [source.file_name for source in data.virtual_sources()]
        for file in files:
            if file != ".":  # the file itself
                fault = f"{name} has its numbers in another file, {file}"
                raise InputError(f"{path}: {fault}; {_COPY}")
        # A chunk is unpacked completely, however little of it belongs to the array.
        chunk = math.prod(data.chunks or ()) * data.dtype.itemsize
        unpacked += max(data.nbytes, chunk)
    refuse_bomb(path, unpacked, path.stat().st_size)
    with memory_limit(unpacked):
        return {name: data[()] for name, data in columns.items()}


def _find_member(h5py: Any, file: Any, member_path: str) -> Any:
    """Return the group or data set at a path of an HDF5 file, or None.

    Links within the file are followed, at most 50; InputError for a link to another file.
    """
    group = file
    names = member_path.split("/")
    links = 0
    while names and isinstance(group, h5py.Group):
        name = names.pop(0)
        link = group.get(name, getlink=True) if name else None
        if isinstance(link, h5py.ExternalLink):
            raise InputError(f"{file.filename}: {_link_text(name, link)}; {_COPY}")
        if isinstance(link, h5py.SoftLink) and links < 50:
            # The link's own path comes first, from the file's root or from this group.
            links += 1
            group = file if link.path.startswith("/") else group
            names = [*link.path.split("/"), *names]
        elif name:
            group = group[name] if isinstance(link, h5py.HardLink) else None
    return None if names else group


def _link_text(name: str, link: Any) -> str:
    """Return a description of an HDF5 link of this name to another file."""
    return f"{name} is a link to another file, {link.filename}"


ALOHA_RATE = 50.0
"""Rows per second of ALOHA's recorder [Hz]; its files hold no time."""
_ALOHA_JOINTS = (
    *("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"),
    "gripper",
)
"""Names of the joints of one of ALOHA's arms."""


def _find_aloha_arrays(h5py: Any, file: Any, commanded: bool) -> dict[str, Any]:
    """Return name to data set of those of ALOHA's data sets that a file has.

    ``commanded``: whether its actions are among them, as "command".
    """
    paths = {name: f"observations/{name}" for name in ("qpos", "qvel", "effort")}
    if commanded:
        paths["command"] = "action"
    datasets = {}
    for name, member_path in paths.items():
        data = _find_member(h5py, file, member_path)
        if data is not None:
            datasets[name] = data
    return datasets


def _aloha_table(path: Path, arrays: Mapping[str, Any]) -> LogTable:
    """Return ALOHA's arrays "qpos" and others (N, joints) as a table, with its joints' names.

    For another number of joints than one or two of its arms have, they are called joint0, joint1...
    """
    if "effort" not in arrays and "command" not in arrays:
        raise InputError(
            f"{path} has no /observations/effort, no measured torque; record effort"
        )
    shapes = {values.shape for values in arrays.values()}
    if len(shapes) > 1 or arrays["qpos"].ndim != 2:
        raise InputError(
            f"{path} does not hold the same joints in {list_shapes(arrays)}; record them together"
        )
    width = arrays["qpos"].shape[1]
    joints = list(map("joint{}".format, range(width)))
    if width == len(_ALOHA_JOINTS):
        joints = list(_ALOHA_JOINTS)
    elif width == 2 * len(_ALOHA_JOINTS):
        joints = list(map("/".join, product(("left", "right"), _ALOHA_JOINTS)))
    titles = [f"{joint} {quantity}" for quantity, joint in product(arrays, joints)]
    layout = f"ALOHA HDF5, without time stamps: rows taken to be {ALOHA_RATE:g} Hz"
    table = recordings_table(path, layout, titles, [list(arrays.values())])
    return replace(table, choices=ColumnChoices(rate=ALOHA_RATE))
