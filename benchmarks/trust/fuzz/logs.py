"""Logs in every form: tables of text by the cell, the others by the byte, archives by the array."""

from __future__ import annotations

import functools
import io
import json
import tempfile
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from random import Random

import numpy as np

from benchmarks.trust.fuzz.harness import Case, write_case
from benchmarks.trust.fuzz.mutations import (
    NUMBERS,
    TEXTS,
    damage_bytes,
    damaged_json,
    damaged_table,
    odd,
)
from rigs.logs import log_files, recorded
from robot_sysid.logs import LogOptions

ROWS = 24
_ARM = log_files.arm_of(log_files.JOINTS, log_files.limits())
_ARROW = ("Parquet",)
_TEXT = (
    *("libfranka", "RTDE", "PlotJuggler", "lists in cells"),
    *("rows of signals", "rows of joints", "echo CSV"),
)
_JSON = ("JSON lines", "JSON states", "JSON arrays")
_ARRAYS = ("npz", "ALOHA", *_ARROW, *_JSON, "echo", "Excel")
_ARRAYS += ("MCAP of JSON", "MCAP of protobuf")
_SLOW = (*(name for name in recorded.FORMS if "ROS" in name), "LeRobot")
SLOW_SHARE = 0.02
"""Bags and data sets take a tenth of a second, a table a thousandth."""


@functools.cache
def seeds() -> Mapping[str, tuple[str, Case]]:
    """Return, by format, the path that is read and the files of a recording."""
    data = log_files.motion(ROWS, 40.0)
    with tempfile.TemporaryDirectory() as name:
        recordings = {}
        for form, write in recorded.FORMS.items():
            folder = Path(name) / form
            folder.mkdir()
            path = write(folder, data)
            files = {str(p.relative_to(folder)): p.read_bytes() for p in _files(folder)}
            recordings[form] = str(path.relative_to(folder)), files
        folder = Path(name)
        table = log_files.write(
            folder / "plain.csv", log_files.table(data).tolist()
        ).read_bytes()
        recordings["plain"] = "plain.csv", {"plain.csv": table}
        recordings["ALOHA"] = (
            "episode.hdf5",
            {"episode.hdf5": _aloha(folder / "episode.hdf5")},
        )
    return recordings


def _files(folder: Path) -> list[Path]:
    """Return all files below a folder."""
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _aloha(path: Path) -> bytes:
    """Write a recording as ALOHA does; return its bytes."""
    import h5py

    with h5py.File(path, "w") as file:
        motion = log_files.motion(ROWS, 40.0).q
        for name in ("qpos", "qvel", "effort"):
            file.create_dataset(f"observations/{name}", data=motion, chunks=(8, 3))
        file["observations/qpos"].attrs["unit"] = "rad"
        file["action"] = motion
    return path.read_bytes()


def case(random: Random) -> Case:
    """Return the files of a log; "read" holds the path that is read."""
    draw = random.random()
    if draw < 0.35:
        form = "plain"
    elif draw < 0.65:
        form = random.choice(_TEXT)
    else:
        form = random.choice(_SLOW if random.random() < SLOW_SHARE / 0.35 else _ARRAYS)
    name, files = seeds()[form]
    if form == "npz" and random.random() < 0.6:
        files = {name: _archive(random)}
    else:
        file_name = random.choice(list(files))
        files = {**files, file_name: _damaged_file(random, file_name, files[file_name])}
    return {**files, "read": name.encode()}


def _damaged_file(random: Random, name: str, content: bytes) -> bytes:
    """Return a file of a recording with damage that suits its format."""
    if name.endswith(".csv"):
        return damaged_table(
            random, content.decode(), " " if name == "rtde.csv" else ","
        )
    if name.endswith(".json"):
        return damaged_json(random, json.loads(content))
    return damage_bytes(random, content, 8)


def _archive(random: Random) -> bytes:
    """Return an .npz file with arrays of odd types and shapes, or one that claims to be huge."""
    buffer = io.BytesIO()
    method = random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", method) as packed:
        warnings.simplefilter("ignore")  # names that are there twice
        for name in ("time", "q", "tau", random.choice(("qd", "q", odd(random)[:99]))):
            packed.writestr(name + ".npy", _array(random, name))
    data = buffer.getvalue()
    return damage_bytes(random, data) if random.random() < 0.3 else data


def _array(random: Random, name: str) -> bytes:
    """Return an .npy file of odd type and shape."""
    columns = 3 if random.random() < 0.7 else random.choice((1, 0, 7, 600))
    shape: tuple[int, ...] = (ROWS,) if name == "time" else (ROWS, columns)
    if random.random() < 0.08:
        shape = random.choice(((), (0,), (ROWS, 3, 3), (1, 3), (3, ROWS), (ROWS,)))
    dtype = "<f8"
    step = 0.025
    if random.random() < 0.15:
        dtype = random.choice((">f4", "<i4", "<u1", "|b1", "<c16", "<U4", "<M8[s]"))
    if random.random() < 0.1:
        step = random.choice((0.0, 1e300, -1.0, np.nan, 1e9))
    ramp = np.arange(np.prod(shape, dtype=int)).reshape(shape) * step
    with np.errstate(all="ignore"):
        values = (
            ramp.astype("<i8").astype(dtype) if "M8" in dtype else ramp.astype(dtype)
        )
    if random.random() < 0.02:
        values = np.array(
            [random.choice((*NUMBERS, *TEXTS)), {}, None] * 8, dtype=object
        )
    buffer = io.BytesIO()
    np.save(buffer, values, allow_pickle=True)
    data = buffer.getvalue()
    if random.random() < 0.05:
        length = str(ROWS).encode()
        data = data.replace(
            length, str(random.choice((10**10, -1, 10**30, 0))).encode(), 1
        )
    return damage_bytes(random, data) if random.random() < 0.05 else data


def use(case: Case, folder: Path) -> None:
    """Recognise, check and read the log."""
    files = {name: text for name, text in case.items() if name != "read"}
    input_folder = write_case(files, folder)
    currents = (1.0,) if len(case["read"]) % 2 else None
    path = input_folder / case["read"].decode()
    log_files.open_log(
        _ARM,
        path,
        LogOptions(torque_constants=currents if "npz" in path.name else None),
    )
