"""Logs in the form of named arrays: NumPy's .npz, MATLAB's .mat, Parquet, LeRobot data sets, which
are folders with meta/info.json and Parquet files, and HDF5, also as ALOHA's recorder and MATLAB
from 7.3 on write it.
"""

from __future__ import annotations

import contextlib
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.logs.declarations import ColumnChoices
from robot_sysid.logs.joint_names import join_names
from robot_sysid.logs.table import (
    ROWS,
    BlockReader,
    Chunk,
    LogTable,
    as_input_errors,
    beginning,
    chunk_blocks,
    import_optional,
    make_table,
    nested_name,
)
from robot_sysid.logs.text import is_names
from robot_sysid.logs.titles import read_title
from robot_sysid.records import Array
from robot_sysid.records.data import shift_behind
from robot_sysid.records.file_access import read_json

# Name of an array of the names of joints.
_JOINT_NAMES = re.compile(r"joints?([_ ]?names?)?$|(^|/)names?$", re.IGNORECASE)


def arrays_table(
    path: Path,
    layout: str,
    arrays: Mapping[str, Any],
    blocks: BlockReader | None = None,
    choices: ColumnChoices | None = None,
) -> LogTable:
    """Return a recording of named arrays with one row, or one column, per sample.

    A column of a two-dimensional array ``q`` is called ``q[0]``, or ``elbow/q`` where an array such
    as ``joint_names`` names them; dates become seconds from the first. An array of another length
    or shape, or without numbers, is left out. ``group/q`` is called ``q`` unless another array has
    that last name. InputError where no array has rows.

    ``blocks`` and ``choices``: see ``make_table``.
    """
    uses = Counter(name.rpartition("/")[2] for name in arrays)
    columns = {}
    names_of: dict[int, list[str]] = {}
    left_out = []
    starts = {}
    for name, values in arrays.items():
        short_name = name.rpartition("/")[2]
        title = short_name if uses[short_name] == 1 else name
        if isinstance(values, np.ndarray) and values.size:
            start = values.flat[0]
            if values.dtype.kind == "M" and not np.isnat(start):
                starts[title] = int(start.astype("M8[ns]").astype(np.int64))
            values = _in_seconds(values, start)
        if can_be_column(values):
            columns[title] = values
            continue
        elements: Any = getattr(values, "tolist", list)()
        if _JOINT_NAMES.search(name) and is_names(elements):
            names_of[len(elements)] = elements
        else:
            left_out.append(name)
    # The longer side of an array are the samples. Their number is that of the times, else the most
    # frequent one.
    times = [n for n in columns if read_title(n).quantity == "time"]
    lengths = [max(columns[name].shape) for name in times or columns]
    if not lengths:
        listed = ", ".join(arrays) or "nothing"
        raise InputError(f"{path} holds no arrays with a row per sample: {listed}")
    import statistics  # slow to import

    n_rows = statistics.mode(lengths)
    samples = []
    for name, values in columns.items():
        rows = values if len(values) == n_rows else values.T
        if len(rows) == n_rows:
            samples.append((name, rows))
    unused = join_names(left_out)
    note = f"arrays that are no columns of numbers are not used: {unused}"
    notes = (note,) if left_out else ()
    return make_table(
        path, layout, samples, names_of, blocks, choices, notes=notes, starts=starts
    )


def can_be_column(array: Any) -> bool:
    """Return whether an array or data set may hold columns of a log; reads none of its elements."""
    # Floats, integers with and without sign, and truth values.
    is_numbers = hasattr(array, "dtype") and array.dtype.kind in "fiub"
    # An empty data set of HDF5 has no shape.
    return is_numbers and len(array.shape or ()) in (1, 2) and array.size > 1


def npz_table(path: Path, *_: Any) -> LogTable:
    """Return an .npz file as a table: time (N,), q, qd, tau (N, n), by these or similar names."""
    arrays: dict[str, Any] = {}
    with path.open("rb") as stream, np.load(stream) as content:
        for name in content.files:
            arrays[name] = None
            # Nothing in it is unpickled: an array of objects is left out.
            with contextlib.suppress(ValueError):
                arrays[name] = content[name]
    return arrays_table(path, "NumPy .npz", arrays)


def matlab_table(path: Path, *_: Any) -> LogTable:
    """Return the arrays of a .mat file, also those in its structs, as a table."""
    from scipy.io import loadmat  # slow to import

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        content = loadmat(path, simplify_cells=True)
    arrays = {n: v for n, v in fields(content) if isinstance(v, np.ndarray)}
    return arrays_table(path, "MATLAB .mat", arrays)


def fields(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (name, value) of the fields of nested structures, as ``group/q``."""
    if isinstance(value, dict):
        for key, content in value.items():
            yield from fields(content, nested_name(name, key))
    else:
        yield name, value


# Types of Arrow that make columns: numbers, times, and lists of numbers.
_NUMERIC_TYPE = re.compile(
    r"((fixed_size_|large_)?list<[^<]*)?(u?int\d+|float|double|halffloat|timestamp|duration)\b.*"
)


def parquet_table(path: Path, *_: Any) -> LogTable:
    """Return the columns of numbers of a Parquet file; a list in a cell is a column each."""
    metadata = import_optional("pyarrow.parquet", "parquet").read_metadata(path)
    schema = metadata.schema.to_arrow_schema()
    names = [f.name for f in schema if _NUMERIC_TYPE.fullmatch(str(f.type))]
    read = partial(_read_parquet, [path], names)
    first_rows = beginning(read())
    blocks = partial(chunk_blocks, partial(_chunks_in_seconds, read), metadata.num_rows)
    return arrays_table(path, "Parquet", dict(zip(names, first_rows)), blocks)


def _read_parquet(files: Sequence[Path], columns: Sequence[str]) -> Iterator[Chunk]:
    """Yield columns of Parquet files, one after the other, in chunks of rows.

    A column is (R,), or (R, k) for lists; dates are NumPy's. InputError where a file cannot be
    read.
    """
    parquet = import_optional("pyarrow.parquet", "parquet")
    for path in files:
        with as_input_errors(path, "a Parquet file"), parquet.ParquetFile(path) as file:
            for batch in file.iter_batches(ROWS, columns=list(columns)):
                yield [_arrow_array(batch.column(name)) for name in columns]


def _chunks_in_seconds(read: Callable[[], Iterable[Chunk]]) -> Iterator[Chunk]:
    """Yield the chunks that a function reads, dates as seconds from the first of their column."""
    starts: list[Any] = []
    for chunk in read():
        starts = starts or [values[0] for values in chunk]
        yield [*map(_in_seconds, chunk, starts)]


def _arrow_array(column: Any) -> Array:
    """Return an Arrow column as (R,), dates and durations as NumPy's, or (R, k) for lists of k
    numbers; ValueError where the lists are not of one length.
    """
    if "list" in str(column.type):
        return np.array(column.to_pylist(), dtype=float)
    values = column.to_numpy(zero_copy_only=False)
    return values if values.dtype.kind in "Mm" else values.astype(float)


def _in_seconds(values: Array, start: Any) -> Array:
    """Return dates as seconds from a first one, and other values as they are."""
    if values.dtype.kind not in "Mm":
        return values
    return np.asarray((values - start) / np.timedelta64(1, "s"))


# Feature (array of a frame) of a LeRobot data set to the quantity of each name in it.
_FEATURES = {
    "observation.state": "position",
    "action": "command",
    "observation.velocity": "velocity",
    "observation.effort": "torque",
}
# Last word of a name in a feature, such as "pos" in "elbow.pos", to the title's quantity and unit.
_SUFFIXES = {
    "pos": "position [deg]",
    "vel": "velocity [deg/s]",
    "current": "current",
    "torque": "torque [Nm]",
    "effort": "torque [Nm]",
}
# Names of LeRobot's robots that record positions in degrees or in per cent, by a setting.
_PER_CENT_ARMS = re.compile(r"so\d{3}|so_follower|koch|lekiwi|omx")
_DEGREES_NOTE = (
    "positions of the data set are taken to be degrees: if use_degrees was false in the robot's "
    "configuration, as by default in many releases, they are per cent of each joint's range, and "
    "all results are wrong"
)
# Remedy for a data set of which files or numbers are missing.
_DOWNLOAD = "download the data set whole"


def lerobot_table(path: Path, _: Sequence[str], options: LogOptions) -> LogTable:
    """Return the selected episodes of a LeRobot data set, or all, one after the other.

    InputError where it holds no frames, or not the selected episodes.
    """
    info = _as_mapping(read_json(path / "meta" / "info.json", _DOWNLOAD))
    descriptions = _as_mapping(info.get("features"))
    titles = {}
    for feature, quantity in _FEATURES.items():
        names = _as_mapping(descriptions.get(feature)).get("names")
        if feature_titles := _lerobot_titles(names, quantity):
            titles[feature] = feature_titles
    columns = ["timestamp [s]", *chain(*titles.values())]
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise InputError(f"{path} has no Parquet files in data/; {_DOWNLOAD}")
    names = ["timestamp", "episode_index", *titles]
    arrays = map(np.concatenate, zip(*_read_parquet(files, names)))
    frames = dict(zip(names, arrays))
    episode_index = frames.pop("episode_index").astype(int)
    available = np.unique(episode_index).tolist()
    # An episode that is named twice counts once.
    episodes = list(dict.fromkeys(options.episode)) or available
    missing = sorted({*episodes} - {*available})
    if missing or not available:
        raise InputError(
            f"{path} has no episode {', '.join(map(str, missing))}; it has {len(available)}, the "
            f"last of which is {max(available, default='none')}; {_DOWNLOAD}"
        )
    time = frames["timestamp"]
    recordings: list[Any] = []
    for episode in episodes:
        rows = np.flatnonzero(episode_index == episode)
        if recordings:
            # An episode has a clock of its own.
            time[rows] += shift_behind(time[recordings[-1][-1]], time[rows[0]])
        recordings.append(rows)
    # The numbers of a frame, its time included.
    width = sum(values[0].size for values in frames.values())
    if width != len(columns):
        fault = f"names {len(columns) - 1} numbers of a frame in meta/info.json, not {width - 1}"
        raise InputError(f"{path} {fault}; {_DOWNLOAD}")
    layout = (
        f"LeRobot data set {info.get('codebase_version', '?')} at {info.get('fps', 'unknown')} Hz, "
        f"{len(recordings)} episodes"
    )
    rows = np.concatenate(recordings)
    samples = np.column_stack([values[rows] for values in frames.values()])
    is_per_cent = _PER_CENT_ARMS.search(str(info.get("robot_type")))
    notes = (_DEGREES_NOTE,) if is_per_cent else ()
    return make_table(path, layout, zip(columns, samples.T), notes=notes)


def _as_mapping(value: Any) -> Mapping[str, Any]:
    """Return a JSON object, or an empty one in the place of any other value."""
    return value if isinstance(value, dict) else {}


def _lerobot_titles(names: Any, quantity: str) -> list[str]:
    """Return titles such as "elbow position [deg]" of the columns of a LeRobot feature.

    Args:
        names: of the numbers, such as ["elbow.pos"], or a JSON object of such lists; anything else
            makes no titles.
        quantity: of a name without a suffix of _SUFFIXES; "command" of all positions.
    """
    titles = []
    for group in names.values() if isinstance(names, dict) else [names]:
        for name in group if isinstance(group, list) else ():
            stem, _, suffix = str(name).rpartition(".")
            meaning = _SUFFIXES.get(suffix, quantity)
            if quantity == "command":
                meaning = meaning.replace("position", quantity)
            titles.append(f"{stem if suffix in _SUFFIXES else name} {meaning}")
    return titles


# Arrays of ALOHA's recorder with a column per joint.
_ALOHA_ARRAYS = (
    "observations/qpos",
    "observations/qvel",
    "observations/effort",
    "action",
)
# Rate of ALOHA's recorder [Hz]: its files hold no time.
_ALOHA_RATE = 50.0
# Names of the joints of one of ALOHA's arms.
_ALOHA_JOINTS = (
    "waist",
    "shoulder",
    "elbow",
    "forearm_roll",
    "wrist_angle",
    "wrist_rotate",
    "gripper",
)


def hdf5_table(path: Path, *_: Any) -> LogTable:
    """Return the joint states in an HDF5 file, of ALOHA's recorder with its joints' names.

    Another number of joints than one or two of ALOHA's arms have stays without names.
    """
    h5py = import_optional("h5py", "hdf5")
    layout = "HDF5"
    choices = ColumnChoices()
    arrays: dict[str, Any] = {}
    with h5py.File(path, "r") as file:
        datasets: dict[str, Any] = {}
        file.visititems(datasets.__setitem__)
        if _ALOHA_ARRAYS[0] in file:
            datasets = {name: file[name] for name in _ALOHA_ARRAYS if name in file}
            rate = f"{_ALOHA_RATE:g} Hz"
            layout = f"ALOHA HDF5, without time stamps: rows taken to be {rate}"
            choices = ColumnChoices(rate=_ALOHA_RATE)
            joints = [*_ALOHA_JOINTS]
            if datasets[_ALOHA_ARRAYS[0]].shape[-1] > len(joints):
                joints = [*map("/".join, product(("left", "right"), joints))]
            arrays["joint_names"] = np.array(joints)
        for name, data in datasets.items():
            # The group #refs# holds the cell arrays of a MATLAB file.
            if isinstance(data, h5py.Dataset) and not name.startswith("#"):
                # What is not read serves the error of a file without columns.
                is_text = data.shape and h5py.check_string_dtype(data.dtype)
                source = data.asstr() if is_text else data
                arrays[name] = source[()] if is_text or can_be_column(data) else data
        return arrays_table(path, layout, arrays, choices=choices)
