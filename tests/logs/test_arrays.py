"""Recordings of arrays however they lie, and those that must not be believed."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.io import savemat

from rigs.logs import recorded
from rigs.logs.log_files import (
    JOINTS,
    assert_read,
    assert_refused,
    assert_samples,
    motion,
    read_measurements,
)
from robot_sysid.logs import LogOptions, arrays
from robot_sysid.logs.reader import open_table
from robot_sysid.logs.table import ROWS, beginning
from robot_sysid.signals.resampling import split_at_gaps

DATA = motion()
COLUMNS = {"t": DATA.time[:, None], "q": DATA.q, "qd": DATA.qd, "tau": DATA.tau}
SAMPLES = ("time", "q", "qd", "tau")
EXTRAS = {
    "gains": np.ones(7),
    "limits": np.ones((7, 2)),
    "name": "arm",
    "cells": [1, "a"],
}


@pytest.fixture(name="h5py")
def h5py_module():
    return pytest.importorskip("h5py")


def parquet(path, row_group_size=None, **arrays):
    """Write a Parquet file, with lists of three in the cells of arrays of three columns."""
    pa = pytest.importorskip("pyarrow")
    lists = pa.FixedSizeListArray.from_arrays
    cells = {}
    for name, values in arrays.items():
        is_wide = getattr(values, "ndim", 1) == 2
        cells[name] = lists(pa.array(values.ravel()), 3) if is_wide else values
    pytest.importorskip("pyarrow.parquet").write_table(
        pa.table(cells), path, row_group_size=row_group_size
    )


def test_lists_of_unequal_length_are_refused(tmp_path):
    """Their numbers are as many as those of equal lists, and would stand in wrong rows."""
    pa = pytest.importorskip("pyarrow")
    q = [[1.0, 2.0], [3.0], [4.0, 5.0, 6.0], [7.0, 8.0]]
    time = [0.0, 0.1, 0.2, 0.3]
    parquet(tmp_path / "log", time=time, q=pa.array(q))
    assert_refused("cannot read .* as a Parquet file", tmp_path / "log")


def test_parquet_is_read_some_rows_at_a_time(tmp_path):
    """Not even its first rows take the memory of the whole file."""
    path = tmp_path / "log"
    time = np.arange(3 * ROWS - 5) / 1000.0
    parquet(path, time=time, q=np.outer(time, [1.0, 2.0, 3.0]))
    blocks = [*open_table(path, JOINTS, LogOptions()).blocks([0, 3])]
    assert [len(block.lines) for block in blocks] == [ROWS, ROWS, ROWS - 5]
    assert blocks[2].lines[0] == 2 * ROWS + 1
    assert_array_equal(blocks[2].cells[:, 1], 3.0 * time[2 * ROWS :])


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_row_groups_of_any_size_are_one_table(tmp_path, size):
    path = tmp_path / "log"
    parquet(path, row_group_size=size, **{**COLUMNS, "t": DATA.time})
    table = open_table(path, JOINTS, LogOptions())
    parts = [f"{name}[{k}]" for name in ("q", "qd", "tau") for k in range(3)]
    assert table.titles == ("t", *parts)
    expected = np.column_stack([*COLUMNS.values()])
    assert_array_equal(table.cells(range(10)), expected)


@pytest.mark.parametrize("size", [1, 7, ROWS])
def test_the_beginning_of_chunks_of_any_size_shows_the_columns(size):
    rows = np.arange(3.0 * ROWS)
    arrays_of_rows = rows, np.outer(rows, [1.0, 2.0])
    edges = range(0, len(rows), size)
    chunks = ([array[k : k + size] for array in arrays_of_rows] for k in edges)
    first = beginning(chunks)
    assert ROWS <= len(first[0]) < ROWS + size
    for found, array in zip(first, arrays_of_rows):
        assert_array_equal(found, array[: len(found)])
    assert beginning([]) == beginning([[], []]) == []


class Harmless:
    """Would be made anew, by code of the file's choosing, if pickles were loaded."""

    loaded = False

    def __reduce__(self):
        return setattr, (Harmless, "loaded", True)


def test_a_pickled_object_is_never_loaded(tmp_path):
    path = tmp_path / "log.npz"
    objects = np.array([Harmless()], dtype=object)
    np.savez(path, time=np.arange(3.0), q=objects)
    assert_refused("one position column", path)
    np.savez(path, **COLUMNS, objects=objects)
    log = read_measurements(path, JOINTS)
    assert "arrays that are no columns of numbers are not used: objects" in log.notes
    assert not Harmless.loaded


def test_an_archive_of_something_else_is_refused(tmp_path):
    path = tmp_path / "log.zip"
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("log.csv", "time,q1\n")
    assert_refused("holds no arrays with a row per sample: log.csv", path)


def test_matlab_7_3_is_hdf5_whose_arrays_are_turned(h5py, tmp_path):
    """A data set may be empty, too."""
    path = tmp_path / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in COLUMNS.items():
            file.create_dataset(f"log/{name}", data=values.T, compression="gzip")
        file["nothing"] = h5py.Empty("f8")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")
    assert_read(path, DATA, SAMPLES)


ORDER = [2, 0, 1]
BY_NAME = {**COLUMNS, **{name: COLUMNS[name][:, ORDER] for name in ("q", "qd", "tau")}}
NAMES = [JOINTS[k] for k in ORDER]


def write_hdf5(path, content):
    with pytest.importorskip("h5py").File(path, "w") as file:
        for name, values in content.items():
            file[f"log/{name}"] = values


@pytest.mark.parametrize("key", ["joint_names", "names", "joints"])
@pytest.mark.parametrize(
    ("write", "names"),
    [
        (lambda path, content: np.savez(path, **content), np.array(NAMES)),
        (lambda path, content: savemat(path, {"a": content}), np.array(NAMES, object)),
        (write_hdf5, NAMES),
    ],
    ids=["npz", "mat", "hdf5"],
)
def test_names_of_joints_beside_arrays_outrank_their_order(tmp_path, write, names, key):
    path = tmp_path / "log.npz"
    write(path, {**BY_NAME, key: names})
    assert_read(path, DATA, SAMPLES)
    write(path, {**BY_NAME, key: ["x", "y", "z"]})
    assert_refused("one position column for each joint", path)


def test_two_arrays_of_one_name_are_told_apart_and_what_is_no_array_is_no_column(
    tmp_path,
):
    path = tmp_path / "log.npz"
    np.savez(path, **COLUMNS)
    with zipfile.ZipFile(path, "a") as packed:
        packed.writestr("notes.txt", "recorded on a Monday")
    assert_read(path, DATA, SAMPLES)
    twice = {f"train/{name}": values for name, values in COLUMNS.items()}
    twice.update({f"test/{name}": values for name, values in COLUMNS.items()})
    np.savez(path, **twice)
    assert_refused(r"train/q\[\*\] .*test/q\[\*\] ", path)


@pytest.mark.parametrize(
    "start", [np.datetime64("2024-05-01", "ns"), np.timedelta64(0, "ns")]
)
def test_dates_in_arrays_are_seconds_from_the_first(start):
    dates = start + (DATA.time * 1e9).round().astype("m8[ns]")
    note = np.array(["x"] * len(DATA), object)
    table = arrays.arrays_table(
        Path("arrays"), "arrays", {**COLUMNS, "t": dates, "note": note}
    )
    assert table.titles[0] == "t" and "note" not in table.titles
    (block,) = table.blocks([0])
    assert_allclose(block.cells[:, 0], DATA.time, atol=1e-9)


def test_arrays_of_a_matlab_struct_are_read_and_cells_are_not(tmp_path):
    path = tmp_path / "log.mat"
    columns = {**COLUMNS, "q": DATA.q.T}
    saved = {"log": {"arm": columns, **EXTRAS}, "note": "text"}
    savemat(path, saved, do_compression=True)
    assert_read(path, DATA, SAMPLES)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_every_episode_is_a_piece(tmp_path, version):
    long = motion(1000)
    path = recorded.lerobot(tmp_path, long, version, 3)
    log = read_measurements(path, JOINTS)
    pieces = split_at_gaps(log)
    assert [len(piece) for piece in pieces] == [1000] * 3
    notes = "\n".join(log.notes)
    assert "in 3 pieces" in notes
    assert "missing" not in notes
    assert_allclose(pieces[2].q, long.q, rtol=0, atol=1e-12)
    for once in ((1,), (1, 1)):
        assert len(read_measurements(path, JOINTS, episode=once)) == 1000
    assert_refused("no episode 7; it has 3, the last of which is 2", path, episode=(7,))


@pytest.mark.parametrize(
    ("features", "fault"),
    [
        ("none", "one position column"),
        ({"observation.state": {"names": 3}}, "one position column"),
        ({"observation.state": {"names": ["wrist.torque"]}}, "names 1 numbers"),
    ],
)
def test_an_odd_description_is_refused(tmp_path, features, fault):
    path = recorded.lerobot(tmp_path, DATA)
    (path / "meta" / "info.json").write_text(json.dumps({"features": features}))
    assert_refused(fault, path)


def test_actions_are_commands(tmp_path):
    goals = np.roll(DATA.q, 3, axis=0)
    action = [f"{joint}.pos" for joint in JOINTS], np.degrees(goals)
    path = recorded.lerobot(tmp_path, DATA, action=action)
    log = read_measurements(path, JOINTS, commanded=True)
    assert_allclose(log.q, DATA.q, atol=1e-9)
    assert_allclose(log.command, goals, atol=1e-9)


def test_alohas_two_arms_are_told_apart_by_name_and_time_is_its_rate(h5py, tmp_path):
    path = tmp_path / "episode_0.hdf5"
    goals = np.roll(DATA.q, 2, axis=0)
    measured = {"qpos": DATA.q, "qvel": DATA.qd, "effort": DATA.tau}
    arrays = {f"observations/{name}": values for name, values in measured.items()}
    with h5py.File(path, "w") as file:
        for name, values in {**arrays, "action": goals}.items():
            file[name] = np.pad(values, ((0, 0), (7, 4)))
    names = ("right/waist", "right/shoulder", "right/elbow")
    log = read_measurements(path, names)
    assert_samples(DATA, log, ("q", "tau"))
    assert_allclose(log.time, np.arange(len(DATA)) / 50.0, atol=1e-12)
    of_servos = read_measurements(path, names, commanded=True)
    assert_array_equal(of_servos.command, goals)
    assert_array_equal(of_servos.motor_torque, DATA.tau)
    left = [name.replace("right", "left") for name in names]
    assert_refused("torque of joint left/waist is zero|at rest", path, left)
