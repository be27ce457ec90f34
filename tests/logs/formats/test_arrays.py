"""Recordings of arrays that must not be unpacked, or not be believed."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.logs.formats import arrays
from tests.support.log_files import read_measurements
from tests.support.recorded import xarm_record


class Harmless:
    """Would be made anew, by code of the file's choosing, if pickles were loaded."""

    loaded = False

    def __reduce__(self):
        return setattr, (Harmless, "loaded", True)


def test_a_pickled_object_is_never_loaded(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, time=np.arange(3.0), q=np.array([Harmless()], dtype=object))
    with pytest.raises(InputError, match="cannot read .*log.npz as a NumPy .npz file"):
        arrays.npz_table(path)
    assert not Harmless.loaded


def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "log.npz"
    np.savez_compressed(path, time=np.zeros(200_000))
    assert path.stat().st_size < 10_000
    monkeypatch.setattr(arrays, "LARGEST", 1e6)
    with pytest.raises(InputError, match="unpacks to 0.0016 GB, more than"):
        arrays.npz_table(path)


def test_an_array_that_only_says_it_is_huge_is_refused(tmp_path):
    array = io.BytesIO()
    np.save(array, np.zeros((24, 3)))
    said = array.getvalue().replace(b"(24, 3), }" + b" " * 10, b"(90000000000, 3), } ")
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as packed:
        packed.writestr("q.npy", said)
    with pytest.raises(InputError, match=r"unpacks to 2.16e\+03 GB"):
        arrays.npz_table(tmp_path / "log.npz")


def test_hdf5_that_holds_nothing_but_a_size_is_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "log.hdf5"
    with h5py.File(path, "w") as file:
        for name in ("qpos", "effort"):
            file.create_dataset(f"observations/{name}", (10**10, 7), "f8", chunks=(1024, 7))
    with pytest.raises(InputError, match="unpacks to 560 GB"):
        arrays.hdf5_table(path)


def xarm_file(path, joints=7, length=784):
    time = 1e5 + np.arange(4000) / 200.0
    there = (np.arange(7) < joints).astype(float)
    q = there * np.sin(np.outer(time, 1.0 + 0.3 * np.arange(7)))
    tau = there * (5.0 * q + np.random.default_rng(0).normal(size=q.shape))
    rows = zip(time, q, 0.1 * q, tau, 0.2 * tau)
    path.write_bytes(b"".join(xarm_record(*row, length=length) for row in rows) + b"cut off")
    return time, q.astype("f4"), tau.astype("f4")


@pytest.mark.parametrize(("joints", "length"), [(7, 784), (6, 800)])
def test_an_xarm_report_is_read_as_the_controller_sends_it(tmp_path, joints, length):
    time, q, tau = xarm_file(tmp_path / "arm.bin", joints, length)
    names = [f"joint{k + 1}" for k in range(joints)]
    log = read_measurements(tmp_path / "arm.bin", names)
    np.testing.assert_allclose(log.samples.time, time, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(log.samples.q, q[:, :joints])
    np.testing.assert_array_equal(log.samples.tau, tau[:, :joints])
    assert "log layout: xArm report, time in us" in log.notes
    constants = (2.0,) * joints
    currents = read_measurements(tmp_path / "arm.bin", names, torque_constants=constants)
    np.testing.assert_allclose(currents.samples.tau, 0.4 * tau[:, :joints], rtol=1e-6)


def test_an_xarm_report_that_lost_bytes_is_refused(tmp_path):
    xarm_file(tmp_path / "arm.bin")
    content = (tmp_path / "arm.bin").read_bytes()
    (tmp_path / "arm.bin").write_bytes(content[:8000] + content[8010:])
    with pytest.raises(InputError, match="record 12 does not begin with its length"):
        read_measurements(tmp_path / "arm.bin", [f"joint{k + 1}" for k in range(7)])
