"""Recordings kept as named arrays: NumPy's .npz, MATLAB's .mat, HDF5 (also as ALOHA writes it),
Parquet, Feather, and LeRobot data sets: a folder with meta/info.json and Parquet files.
"""

from __future__ import annotations

import itertools
import math
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json
from robot_sysid.logs import table
from robot_sysid.logs.column_map import ColumnChoices
from robot_sysid.records import Array

ALOHA_RATE = 50.0
"""Rows per second of ALOHA's recorder [Hz]; its files hold no time."""
_ALOHA = [
    "waist",
    "shoulder",
    "elbow",
    "forearm_roll",
    "wrist_angle",
    "wrist_rotate",
    "gripper",
]

_UNPACK = """
import sys
import numpy as np
from scipy.io import loadmat, whosmat

def refuse(size):
    if size > most:
        text = f"it unpacks to {size / 1e9:.3g} GB, more than the {most / 1e9:.3g} GB that are"
        sys.exit(f"{text} read of its size; split the recording, or save it without compression")

def arrays(name, value):
    if isinstance(value, dict):
        for field, inner in value.items():
            yield from arrays(f"{name}/{field}", inner)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        yield name, value

path, unpacked, most, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3]), int(sys.argv[4])
try:
    import resource
    seconds += int(resource.getrusage(resource.RUSAGE_SELF).ru_utime)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    taken = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (int(taken + 1.2 * most + 1e8),) * 2)
except (ImportError, OSError, ValueError):
    pass
try:
    found = [each for each in whosmat(path) if each[2] not in ("cell", "char", "function")]
    refuse(sum(8.0 * float(np.prod(shape, dtype=float)) for _, shape, _ in found))
    names = [name for name, _, _ in found]
    found = dict(arrays("", loadmat(path, simplify_cells=True, variable_names=names)))
    refuse(sum(float(each.nbytes) for each in found.values()))
    np.savez(unpacked, *found.values(), names=np.array([*found], dtype=str))
except MemoryError:
    sys.exit("it asks for more memory than a recording takes; it is damaged, or too long")
except Exception as error:
    sys.exit(" ".join(str(error).split()) or type(error).__name__)
"""
"""Makes an .npz file of a .mat file; SciPy ends the process on some damaged ones."""
_LEAST_TIME = 3.0
_SLOWEST = 2e7
"""Processor time that reading a .mat file may take [s], and so many bytes more each second."""


def npz_table(asked: table.Asked) -> table.LogTable:
    """Return the arrays of an .npz file: time (N,), q, qd, tau (N, n), by these or like names."""
    return table.arrays_table(asked.path, "NumPy .npz", npz_arrays(asked.path))


def npz_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of an .npz file, or raise InputError; nothing in it is unpickled."""
    with table.as_input_errors(path, "a NumPy .npz file"), path.open("rb") as stream:
        with zipfile.ZipFile(stream) as packed:
            names = packed.namelist()
            size = path.stat().st_size
            table.refuse_bomb(
                path, sum(i.file_size for i in packed.infolist()), size, len(names)
            )
            if not any(name.endswith(".npy") for name in names):
                is_sheet = "[Content_Types].xml" in names
                remedy = (
                    "export it as CSV"
                    if is_sheet
                    else "unpack it, and give the log in it"
                )
                inside = ", ".join(names[:3]) or "nothing"
                raise InputError(
                    f"{path} is no recording but an archive of {inside}; {remedy}"
                )
            table.refuse_bomb(
                path, sum(_stated_bytes(packed, each) for each in names), size
            )
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


def matlab_table(asked: table.Asked) -> table.LogTable:
    """Return the arrays of a .mat file, also those in its structs."""
    complaints = table.as_input_errors(asked.path, "a MATLAB .mat file")
    with complaints, tempfile.TemporaryDirectory() as folder:
        unpacked = Path(folder, "log.npz")
        size = asked.path.stat().st_size
        most = table.most_bytes(size)
        seconds = math.ceil(_LEAST_TIME + size / _SLOWEST)
        files = [str(asked.path), str(unpacked)]
        bounds = [str(most), str(seconds)]
        call = [sys.executable, "-Wignore", "-c", _UNPACK, *files, *bounds]
        one_thread = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        ended = subprocess.run(call, capture_output=True, text=True, env=one_thread)
        if ended.returncode:
            damaged = "it takes longer than a recording does, or is damaged"
            raise ValueError((ended.stderr.splitlines() or [damaged])[-1])
        cells = npz_arrays(unpacked)
    named = {str(name): cells[f"arr_{k}"] for k, name in enumerate(cells["names"])}
    return table.arrays_table(asked.path, "MATLAB .mat", named)


def hdf5_table(asked: table.Asked) -> table.LogTable:
    """Return the joint states in an HDF5 file, and ALOHA's actions where commands are asked for.

    Only what is in the file itself is read: no link to another one is followed.
    """
    path = asked.path
    found = {}
    links: list[str] = []
    h5py = table.library("h5py", "hdf5", "an HDF5 file")
    seen = itertools.count()

    def collect(name: str, member: Any) -> None:
        table.refuse_bomb(path, 0.0, 0.0, next(seen))
        # What is called #refs# holds the cells of a MATLAB file.
        if isinstance(member, h5py.Dataset) and not name.startswith("#"):
            found[name] = member
        for key in member if isinstance(member, h5py.Group) else ():
            link = member.get(key, getlink=True)
            if isinstance(link, h5py.ExternalLink) and len(links) < _NAMED:
                links.append(_linked(f"{name}/{key}".lstrip("/"), link))

    with table.as_input_errors(path, "an HDF5 file"), h5py.File(path, "r") as file:
        is_aloha = _member(h5py, file, "observations/qpos") is not None
        if is_aloha:
            names = {n: f"observations/{n}" for n in ("qpos", "qvel", "effort")}
            names.update({"command": "action"} if asked.options.commanded else {})
            members = {
                name: _member(h5py, file, place) for name, place in names.items()
            }
            found.update(
                {name: data for name, data in members.items() if data is not None}
            )
        else:
            collect("", file)
            file.visititems(collect)
        columns = {name: data for name, data in found.items() if table.is_column(data)}
        for name, data in columns.items():
            _require_own(path, name, data)
        # A chunk is unpacked whole, however little of it belongs to the array.
        chunks = (
            math.prod(d.chunks or ()) * d.dtype.itemsize for d in columns.values()
        )
        sizes = (max(d.nbytes, chunk) for d, chunk in zip(columns.values(), chunks))
        table.refuse_bomb(path, size := float(sum(sizes)), path.stat().st_size)
        with table.bounded_memory(size):
            arrays = {name: data[()] for name, data in columns.items()}
        if is_aloha and "qpos" in arrays:
            return _aloha(path, arrays)
        elsewhere = f"{'; '.join(links)}; {_COPY}" if links else ""
        if links and not arrays:
            raise InputError(f"{path}: {elsewhere}")
        made = table.arrays_table(
            path, "; ".join(("HDF5", *links)), {**found, **arrays}
        )
        return replace(made, elsewhere=elsewhere)


def _member(h5py: Any, file: Any, place: str) -> Any:
    """Return what a file holds in a place, through links within the file; None for nothing."""
    group = file
    rest = place.split("/")
    links = 0
    while rest and isinstance(group, h5py.Group):
        name = rest.pop(0)
        link = group.get(name, getlink=True) if name else None
        if isinstance(link, h5py.ExternalLink):
            raise InputError(f"{file.filename}: {_linked(name, link)}; {_COPY}")
        if isinstance(link, h5py.SoftLink) and links < 50:
            links += 1
            group = file if link.path.startswith("/") else group
            rest = [*link.path.split("/"), *rest]
        elif name:
            group = group[name] if isinstance(link, h5py.HardLink) else None
    return None if rest else group


def _linked(name: str, link: Any) -> str:
    return f"{name} is a link to another file, {link.filename}"


_NAMED = 3
"""So many links to other files are named."""
_COPY = "copy what is in it into this one (h5copy -f ext, or h5repack)"


def _require_own(path: Path, name: str, data: Any) -> None:
    """Raise InputError for a data set whose numbers are in other files."""
    others = [str(place[0]) for place in data.external or ()]
    others += [s.file_name for s in (data.virtual_sources() if data.is_virtual else ())]
    for other in (other for other in others if other != "."):
        raise InputError(
            f"{path}: {name} has its numbers in another file, {other}; {_COPY}"
        )


def _aloha(path: Path, arrays: Mapping[str, Any]) -> table.LogTable:
    if not {"effort", "command"} & {*arrays}:
        raise InputError(
            f"{path} has no /observations/effort, no measured torque; record effort"
        )
    if (
        len({values.shape for values in arrays.values()}) > 1
        or arrays["qpos"].ndim != 2
    ):
        shapes = ", ".join(f"{name} {values.shape}" for name, values in arrays.items())
        raise InputError(
            f"{path} does not hold the same joints in {shapes}; record them together"
        )
    width = arrays["qpos"].shape[1]
    both = [f"{side}/{joint}" for side in ("left", "right") for joint in _ALOHA]
    known = {len(_ALOHA): _ALOHA, len(both): both}
    names = known.get(width, [f"joint{k}" for k in range(width)])
    titles = tuple(f"{name} {quantity}" for quantity in arrays for name in names)
    rate = ColumnChoices(rate=ALOHA_RATE)
    layout = f"ALOHA HDF5, without time stamps: rows taken to be {ALOHA_RATE:g} Hz"
    return table.pieces_table(path, layout, titles, [list(arrays.values())], rate)


_OF_NUMBERS = re.compile(
    r"((fixed_size_|large_)?list<[^<]*)?(u?int\d+|float|double|halffloat|timestamp|duration)\b.*"
)
"""Types of Arrow that make columns: numbers, times, and lists of numbers."""


def parquet_table(asked: table.Asked) -> table.LogTable:
    """Return the columns of numbers of a Parquet file; a list in a cell is a column each."""
    path = asked.path
    what = "a Parquet file"
    parquet = table.library("pyarrow.parquet", "parquet", what)
    with table.as_input_errors(path, what):
        names = _numeric(parquet.read_schema(path))
        unpacked = _unpacked_bytes(parquet.read_metadata(path), names)
        table.refuse_bomb(path, unpacked, path.stat().st_size, len(names))
        return _arrow_table(path, "Parquet", parquet.read_table(path, columns=names))


def feather_table(asked: table.Asked) -> table.LogTable:
    """Return the columns of numbers of a Feather file, an Arrow table in a file."""
    path = asked.path
    what = "a Feather file"
    size = asked.path.stat().st_size
    feather = table.library("pyarrow.feather", "parquet", what)
    ipc = table.library("pyarrow.ipc", "parquet", what)
    with (
        table.as_input_errors(path, what),
        table.bounded_memory(table.most_bytes(size)),
    ):
        with ipc.open_file(str(path)) as file:
            names = _numeric(file.schema)
        table.refuse_bomb(path, 0.0, size, len(names))
        columns = feather.read_table(str(path), columns=names, memory_map=False)
        table.refuse_bomb(path, float(columns.nbytes), size)
        return _arrow_table(path, "Feather", columns)


def _numeric(schema: Any) -> list[str]:
    return [field.name for field in schema if _OF_NUMBERS.fullmatch(str(field.type))]


def _arrow_table(path: Path, layout: str, columns: Any) -> table.LogTable:
    named = zip(columns.column_names, columns.columns)
    return table.arrays_table(
        path, layout, {name: _array(name, column) for name, column in named}
    )


LEROBOT = "a LeRobot data set"
STATE = "observation.state"
# What a name in a feature ends in, and the title that says quantity and unit.
_ENDINGS = {"pos": "position [deg]", "vel": "velocity [deg/s]", "current": "current"}
_ENDINGS.update(torque="torque [Nm]", effort="torque [Nm]")
# Features of their own, whose names are joints.
_FEATURES = {"observation.velocity": "velocity", "observation.effort": "torque"}
ACTION = "action"


def lerobot_table(asked: table.Asked) -> table.LogTable:
    """Return the episodes of a data set that are asked for, or all, each a piece."""
    path = asked.path
    joint_names = asked.joint_names
    commanded = asked.options.commanded
    info = _mapping(
        read_json(path / "meta" / "info.json", "download the data set whole")
    )
    features = _mapping(info.get("features"))
    read = (STATE, ACTION) if commanded else (STATE, *_FEATURES)
    titles = {name: _titles(features, name, joint_names) for name in read}
    said = " ".join(title for names in titles.values() for title in names)
    if not commanded and "torque" not in said and "current" not in said:
        raise InputError(
            f"{path} holds no torque ({STATE}: {', '.join(titles[STATE]) or 'nothing'}); record it "
            "too: for OpenArm use_velocity_and_torque=true of the robot's configuration, for other "
            "robots an observation whose names end in .torque"
        )
    present = [name for name in titles if titles[name]]
    frames = _frames(path, ["timestamp", "episode_index", *present])
    index = frames.pop("episode_index").astype(int)
    found = sorted(set(index.tolist()))
    wanted = asked.options.episode
    if not found:
        raise InputError(f"{path} holds no frames; download the data set whole")
    missing = sorted(set(wanted) - set(found))
    if missing:
        raise InputError(
            f"{path} has no episode {missing[0]}; it has {found[0]} to {found[-1]}"
        )
    pieces = [
        [v[index == episode] for v in frames.values()] for episode in wanted or found
    ]
    width = sum(values.reshape(len(values), -1).shape[1] for values in frames.values())
    version = info.get("codebase_version", "?")
    fps = info.get("fps", "unknown")
    layout = f"LeRobot data set {version} at {fps} Hz, {len(pieces)} episodes"
    flat = tuple(title for name in present for title in titles[name])
    if width != 1 + len(flat):
        fault = (
            f"names {len(flat)} numbers of a frame in meta/info.json, not {width - 1}"
        )
        raise InputError(f"{path} {fault}; download the data set whole")
    return table.pieces_table(path, layout, ("timestamp [s]", *flat), pieces)


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _titles(
    features: Mapping[str, Any], name: str, joint_names: Sequence[str]
) -> list[str]:
    names = _mapping(features.get(name)).get("names")
    if isinstance(names, dict):
        names = [
            each
            for group in names.values()
            if isinstance(group, list)
            for each in group
        ]
    names = names if isinstance(names, list) else []
    pairs = [str(each).rpartition(".") for each in names]
    stems = [
        stem if ending in _ENDINGS else str(n)
        for (stem, _, ending), n in zip(pairs, names)
    ]
    plain = _FEATURES.get(name, "position")
    ends = [_ENDINGS.get(ending, plain) for _, _, ending in pairs]
    known = dict(
        zip(
            dict.fromkeys(stems), table.renamed(list(dict.fromkeys(stems)), joint_names)
        )
    )
    if name == ACTION:
        ends = [end.replace("position", "command") for end in ends]
    return [f"{known[stem]} {end}" for stem, end in zip(stems, ends)]


def _frames(path: Path, columns: Sequence[str]) -> dict[str, Array]:
    """Return the columns of all files, lists as (N, k)."""
    parquet = table.library("pyarrow.parquet", "lerobot", LEROBOT)
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise InputError(
            f"{path} has no Parquet files in data/; download the data set whole"
        )
    parts: list[dict[str, Array]] = []
    unpacked = 0.0
    packed = sum(file.stat().st_size for file in files)
    for file in files:
        with table.as_input_errors(file, LEROBOT):
            unpacked += _unpacked_bytes(parquet.read_metadata(file), columns)
    table.refuse_bomb(path, unpacked, packed)
    for file in files:
        with table.as_input_errors(file, LEROBOT):
            read = parquet.read_table(file, columns=list(columns))
            parts.append({name: _array(name, read.column(name)) for name in columns})
    with table.as_input_errors(path, LEROBOT):
        return {
            name: np.concatenate([part[name] for part in parts]) for name in columns
        }


def _unpacked_bytes(metadata: Any, columns: Sequence[str]) -> float:
    """Return what columns of a Parquet file take [bytes]: as numbers, and while put together."""
    # Pages of equal numbers say a few bytes of thousands; a page may hold more than its numbers.
    size = 0.0
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for chunk in map(group.column, range(group.num_columns)):
            # Of a list: its name, then such as ".list.element".
            if any(
                f"{chunk.path_in_schema}.".startswith(f"{name}.") for name in columns
            ):
                size += max(
                    16.0 * chunk.num_values, 2.0 * chunk.total_uncompressed_size
                )
    return size


def _array(name: str, column: Any) -> Array:
    """Return a column (N,), or (N, k) of one with lists; NaN for a list that is missing."""
    combined = column.combine_chunks()
    if "list" not in str(combined.type):
        return _numbers(combined)
    there = combined.drop_null()
    fixed = not hasattr(there, "offsets")
    widths = (
        [there.type.list_size] if fixed else np.unique(np.diff(there.offsets)).tolist()
    )
    if len(widths) > 1:
        fault = f"column {name} holds lists of {widths[0]} to {widths[-1]} numbers"
        raise ValueError(f"{fault}; write as many in each row, or leave the column out")
    values = _numbers(there.flatten())
    rows = np.full((len(combined), *widths), np.nan).astype(values.dtype)
    is_there = combined.is_valid().to_numpy(zero_copy_only=False)
    rows[is_there] = values.reshape(len(there), *widths)
    return rows


def _numbers(column: Any) -> Array:
    values = column.to_numpy(zero_copy_only=False)
    return values if values.dtype.kind in "Mm" else np.asarray(values, float)
