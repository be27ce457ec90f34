"""Recordings of arrays however they lie, and those that must not be unpacked or believed."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest
from scipy.io import savemat

from robot_sysid.errors import InputError
from robot_sysid.logs.formats import arrays
from tests.support.log_files import JOINTS, motion, read_measurements

DATA = motion()
COLUMNS = {"t": DATA.time[:, None], "q": DATA.q, "qd": DATA.qd, "tau": DATA.tau}
EXTRAS = {"gains": np.ones(7), "limits": np.ones((7, 2)), "name": "arm", "cells": [1, "a"]}


class Harmless:
    """Would be made anew, by code of the file's choosing, if pickles were loaded."""

    loaded = False

    def __reduce__(self):
        return setattr, (Harmless, "loaded", True)


def test_a_pickled_object_is_never_loaded(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, time=np.arange(3.0), q=np.array([Harmless()], dtype=object))
    with pytest.raises(InputError, match="cannot read .*log.npz as a NumPy .npz file"):
        read_measurements(path, JOINTS)
    assert not Harmless.loaded


def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "log.npz"
    np.savez_compressed(path, time=np.zeros(200_000))
    assert path.stat().st_size < 10_000
    monkeypatch.setattr(arrays, "LARGEST", 1e6)
    with pytest.raises(InputError, match="unpacks to 0.0016 GB, more than"):
        read_measurements(path, JOINTS)


def test_an_array_that_only_says_it_is_huge_is_refused(tmp_path):
    array = io.BytesIO()
    np.save(array, np.zeros((24, 3)))
    said = array.getvalue().replace(b"(24, 3), }" + b" " * 10, b"(90000000000, 3), } ")
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as packed:
        packed.writestr("q.npy", said)
    with pytest.raises(InputError, match=r"unpacks to 2.16e\+03 GB"):
        read_measurements(tmp_path / "log.npz", JOINTS)


@pytest.mark.parametrize("names", [("a/q", "a/tau"), ("observations/qpos", "observations/effort")])
def test_hdf5_whose_arrays_are_too_much_together_is_refused(tmp_path, names):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "log.hdf5"
    with h5py.File(path, "w") as file:
        for name in names:
            file.create_dataset(name, (10**7, 7), "f8", chunks=(1024, 7))
    with pytest.raises(InputError, match="unpacks to 1.12 GB"):
        read_measurements(path, JOINTS)


def assert_read(path):
    (piece,) = read_measurements(path, JOINTS).pieces
    for name in ("time", "q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(piece, name), getattr(DATA, name))


def test_arrays_of_matlab_are_found_in_a_struct_on_their_side(tmp_path):
    columns = {n: a.T if n == "q" else a for n, a in COLUMNS.items()}
    saved = {"log": {"arm": columns, **EXTRAS}, "note": "text"}
    savemat(tmp_path / "log.mat", saved, do_compression=True)
    assert_read(tmp_path / "log.mat")


def test_matlab_7_3_is_hdf5_whose_arrays_are_turned(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in COLUMNS.items():
            file[f"log/{name}"] = values.T
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")
    assert_read(path)


def test_two_arrays_of_one_name_are_told_apart_and_what_is_no_array_is_no_column(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, **COLUMNS)
    with zipfile.ZipFile(path, "a") as packed:
        packed.writestr("notes.txt", "recorded on a Monday")
    assert_read(path)
    np.savez(path, **{f"{part}/{n}": a for part in ("train", "test") for n, a in COLUMNS.items()})
    with pytest.raises(InputError, match=r"train/q\[0\], .*test/q\[0\]"):
        read_measurements(path, JOINTS)


def test_a_matlab_file_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    several = {f"q{k}": np.zeros(100_000) for k in range(3)}
    savemat(tmp_path / "log.mat", {"log": {"arm": several}}, do_compression=True)
    assert (tmp_path / "log.mat").stat().st_size < 10_000
    monkeypatch.setattr(arrays, "LARGEST", 1e6)
    with pytest.raises(InputError, match="unpacks to 0.0024 GB, more than"):
        read_measurements(tmp_path / "log.mat", JOINTS)


def test_a_matlab_file_that_is_cut_off_is_one_line(tmp_path):
    path = tmp_path / "log.mat"
    savemat(path, COLUMNS, do_compression=True)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InputError) as caught:
        read_measurements(path, JOINTS)
    assert "\n" not in str(caught.value)
