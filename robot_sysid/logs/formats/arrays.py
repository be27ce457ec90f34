"""Recordings kept as named arrays: NumPy's .npz, MATLAB's .mat, HDF5 as ALOHA and robomimic write
it, and the records of 200 Hz that an xArm's controller sends.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.column_map import ColumnChoices, Units
from robot_sysid.logs.formats.table import ArrayTable, as_input_errors, library, titled_arrays

LARGEST = 1e9
"""Largest recording of arrays that is unpacked [bytes]: four hours of seven joints at 1 kHz."""
ALOHA_RATE = 50.0
"""Rows per second of ALOHA's recorder [Hz]; its files hold no time."""
_ALOHA = [*("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")]
_ROBOMIMIC = {"joint_pos": "position", "joint_vel": "velocity", "joint_torque": "torque"}


_XARM = {
    "time": (">u8", 4),
    "q": ("(7,)<f4", 116),
    "qd": ("(7,)<f4", 144),
    "current": ("(7,)<f4", 200),
    "tau": ("(7,)<f4", 228),
}
"""Type and place [bytes] of what is read of a record of port 30000; it begins with its own length
(firmware 2.1 and later: xArm-Developer/ufactory_docs, firmware/report)."""
_XARM_LENGTHS = range(256, 4096)

_MATRIX, _COMPRESSED, _STRUCT = 14, 15, 2
"""Types of an element of a .mat file, and the class of a matrix that is a struct (MAT-File Format,
MathWorks, version 5). SciPy's reader ends the process on some damaged files, so it is not used."""
NPZ = b"PK\x03\x04"
MATLAB = b"MATLAB 5.0"
HDF5 = (b"\x89HDF\r\n\x1a\n", b"MATLAB 7.3")
"""How files begin; .mat files are HDF5 since version 7.3."""
_MAT_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_MAT_NUMBERS.update({12: "i8", 13: "u8"})


def npz_table(path: Path) -> ArrayTable:
    """Return the arrays of an .npz file: time (N,), q, qd, tau (N, n), by these or like names."""
    titles, cells = titled_arrays(path, npz_arrays(path))
    return ArrayTable(path, "NumPy .npz", titles, (cells,))


def npz_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of an .npz file; nothing in it is unpickled.

    Raises:
        InputError: it cannot be read, or unpacks to more than is read.
    """
    with as_input_errors(path, "a NumPy .npz file"), path.open("rb") as stream:
        with zipfile.ZipFile(stream) as packed:
            _refuse_bomb(path, sum(each.file_size for each in packed.infolist()))
            for each in packed.namelist():
                _refuse_bomb(path, _stated_bytes(packed, each))
        stream.seek(0)
        archive = np.load(stream, allow_pickle=False)
        return {name: archive[name] for name in archive.files}


def _stated_bytes(packed: zipfile.ZipFile, name: str) -> int:
    """Return the size that an array's own head states, which NumPy would reserve; 0 for none."""
    with packed.open(name) as member:
        try:
            version = np.lib.format.read_magic(member)
            read = np.lib.format.read_array_header_1_0
            read = read if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, kind = read(member)
        except ValueError:
            return 0
    return math.prod(shape) * kind.itemsize


def matlab_table(path: Path) -> ArrayTable:
    """Return the arrays of a .mat file, also those in its structs."""
    _refuse_bomb(path, path.stat().st_size)
    with as_input_errors(path, "a MATLAB .mat file"):
        data = memoryview(path.read_bytes())
        arrays = dict(_matrices(path, data[128:], "<" if data[126:128] == b"IM" else ">"))
    titles, cells = titled_arrays(path, arrays)
    return ArrayTable(path, "MATLAB .mat", titles, (cells,))


def _matrices(path: Path, data: memoryview, order: str) -> Iterator[tuple[str, Any]]:
    size = 0
    for kind, content in _elements(data, order):
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            unpacked = unpacker.decompress(content, int(LARGEST))
            size += len(unpacked)
            _refuse_bomb(path, math.inf if unpacker.unconsumed_tail else size)
            content = memoryview(unpacked)[8:]
        if kind in (_MATRIX, _COMPRESSED):
            yield from _matrix(content, order)


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield (type, content); a small element has both, and its size, in eight bytes."""
    at = 0
    while at < len(data):
        kind, size = (int(word) for word in np.frombuffer(data[at : at + 8], f"{order}u4"))
        begin, after = at + 8, at + 8 + size + (0 if kind == _COMPRESSED else -size % 8)
        if kind >= 1 << 16:
            kind, size, begin, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if begin + size > len(data):
            raise ValueError("it is cut off")
        yield kind, data[begin : begin + size]
        at = after


def _matrix(content: memoryview, order: str, name: str = "") -> Iterator[tuple[str, Any]]:
    (_, flags), (_, sizes), (_, own), *parts = _elements(content, order)
    name = name or bytes(own).decode("latin-1")
    shape = tuple(np.frombuffer(sizes, f"{order}i4"))
    is_struct = np.frombuffer(flags, f"{order}u4")[0] & 0xFF == _STRUCT
    if is_struct and math.prod(shape) == 1:
        (_, width), (_, names), *fields = parts
        length = max(1, int(np.frombuffer(width, f"{order}i4")[0]))
        for k, (_, field) in enumerate(fields):
            called = bytes(names[k * length : (k + 1) * length]).split(b"\0")[0].decode("latin-1")
            yield from _matrix(field, order, f"{name}/{called}") if len(field) else ()
    elif not is_struct and parts and parts[0][0] in _MAT_NUMBERS:
        kind, numbers = parts[0]
        values = np.frombuffer(numbers, order + _MAT_NUMBERS[kind])
        if math.prod(shape) == len(values):
            yield name, values.reshape(shape, order="F")


def is_xarm(path: Path, start: bytes) -> bool:
    """Return whether a file is a row of records that each begin with their length."""
    length = int.from_bytes(start[:4], "big")
    if length not in _XARM_LENGTHS:
        return False
    with path.open("rb") as stream:
        stream.seek(length)
        return stream.read(4) == start[:4]


def xarm_table(path: Path) -> ArrayTable:
    """Return what an xArm's controller sent, as it came from the socket."""
    _refuse_bomb(path, path.stat().st_size)
    with as_input_errors(path, "an xArm report"):
        data = path.read_bytes()
    length = int.from_bytes(data[:4], "big")
    fields = {"length": (">u4", 0), **_XARM}
    formats, offsets = zip(*fields.values())
    kind = {"names": [*fields], "formats": formats, "offsets": offsets, "itemsize": length}
    records: Any = np.frombuffer(data, np.dtype(cast(Any, kind)), len(data) // length)
    lost = np.flatnonzero(records["length"] != length)
    if len(lost):
        raise InputError(
            f"{path}: record {lost[0] + 1} does not begin with its length, so bytes were lost "
            "before it; record anew, every byte that the port sends"
        )
    # Joints that an arm of five or six does not have are sent as zeros.
    there = np.any(records["q"] != 0.0, axis=0) | np.any(records["tau"] != 0.0, axis=0)
    joints = ("q", "qd", "tau", "current")
    arrays: dict[str, Any] = {name: records[name][:, there] for name in joints}
    titles, cells = titled_arrays(path, {"time": records["time"], **arrays})
    return ArrayTable(
        path, "xArm report, time in us", titles, (cells,), ColumnChoices(units=Units(time="us"))
    )


def hdf5_table(path: Path, commanded: bool = False) -> ArrayTable:
    """Return the joint states in an HDF5 file; with ``commanded`` actions, and no torque."""
    h5py = library("h5py", "hdf5", "an HDF5 file")
    with as_input_errors(path, "an HDF5 file"), h5py.File(path, "r") as file:
        if "observations/qpos" in file:
            action = _whole(path, file["action"]) if commanded and "action" in file else None
            return _aloha(path, file["observations"], action)
        if "data" in file and isinstance(file["data"], h5py.Group):
            return _robomimic(path, file["data"])
        found: dict[str, Any] = {}
        # What is called #refs# holds the cells of a MATLAB file.
        file.visititems(
            lambda name, member: (
                found.update({name: member})
                if isinstance(member, h5py.Dataset) and not name.startswith("#")
                else None
            )
        )
        _refuse_bomb(path, sum(data.nbytes for data in found.values()))
        arrays = {name: data[()] for name, data in found.items()}
    titles, cells = titled_arrays(path, arrays)
    return ArrayTable(path, "HDF5", titles, (cells,))


def _refuse_bomb(path: Path, size: float) -> None:
    """Refuse a small file that unpacks to more than any recording holds."""
    if size > LARGEST:
        raise InputError(
            f"{path} unpacks to {size / 1e9:.3g} GB, more than the {LARGEST / 1e9:g} GB that are "
            "read; split the recording"
        )


def _whole(path: Path, dataset: Any) -> Any:
    """Return all of a data set, unless it is too large."""
    _refuse_bomb(path, dataset.nbytes)
    return dataset[()]


def _aloha(path: Path, group: Any, action: Any = None) -> ArrayTable:
    if "effort" not in group and action is None:
        raise InputError(
            f"{path} has no /observations/effort; without measured torque nothing can be "
            "identified: record effort"
        )
    arrays = {n: _whole(path, group[n]) for n in ("qpos", "qvel", "effort") if n in group}
    arrays.update({} if action is None else {"command": action})
    width = arrays["qpos"].shape[1]
    both = [f"{side}/{joint}" for side in ("left", "right") for joint in _ALOHA]
    known = {len(_ALOHA): _ALOHA, len(both): both}
    names = known.get(width, [f"joint{k}" for k in range(width)])
    titles = tuple(f"{name} {quantity}" for quantity in arrays for name in names)
    cells = np.hstack([np.asarray(values, float) for values in arrays.values()])
    rate = ColumnChoices(rate=ALOHA_RATE)
    layout = f"ALOHA HDF5, without time stamps: rows taken to be {ALOHA_RATE:g} Hz"
    return ArrayTable(path, layout, titles, (cells,), rate)


def _robomimic(path: Path, group: Any) -> ArrayTable:
    """Return every demonstration as a piece; arrays are called such as robot0_joint_pos."""
    titles: tuple[str, ...] = ()
    pieces = []
    for name in sorted(group, key=lambda n: (len(n), n)):
        observed = {f"/{n}": d for n, d in group[name].get("obs", {}).items()}
        arrays = {
            title: _whole(path, observed[n])
            for part, title in _ROBOMIMIC.items()
            for n in observed
            if n.endswith(part)
        }
        times = {"time": _whole(path, observed["/time"])} if "/time" in observed else {}
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
