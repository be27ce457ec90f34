"""Logs are read as they are written, torque scaled, and written back without losing a digit."""

from __future__ import annotations

import io
import os
import sys
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_sysid.errors import ColumnsError, InputError
from robot_sysid.logs import reader
from tests.support import recorded
from tests.support.log_files import (
    JOINTS,
    assert_refused,
    assert_samples,
    motion,
    read_measurements,
    table,
    write,
)

DATA = motion(60)


def test_a_log_without_titles_needs_a_columns_file_and_one_without_time_a_rate(
    tmp_path,
):
    data = motion(30)
    path = write(tmp_path / "log.csv", table(data), titles=())
    assert_refused("no column titles.*7 columns.*--columns", path)
    columns = tmp_path / "columns.txt"
    columns.write_text("rate = 200\nposition = #2-4\ntorque = #5, #6 - #7\n")
    log = read_measurements(path, JOINTS, columns=columns)
    assert_samples(replace(data, qd=None), log.samples, atol=1e-15)


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (None, "cannot read the log"),
        (b"# only\n# comments\n", "holds no rows"),
        (b"time,q1,q2,q3,tau1,tau2,tau3\n", "header but no rows"),
        (b"\x00\x01\x02binary", "not a text file"),
    ],
)
def test_files_without_a_table_are_refused(tmp_path, content, fault):
    path = tmp_path / "log.csv"
    if content is not None:
        path.write_bytes(content)
    assert_refused(fault, path)


@pytest.mark.skipif(sys.platform == "win32", reason="needs named pipes")
def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "log.csv")
    assert_refused("log.csv is a pipe or a device", tmp_path / "log.csv")


def test_a_log_is_read_from_a_pipe(tmp_path, monkeypatch):
    path = write(tmp_path / "log.csv", table(motion(50)))
    for content in (path.read_bytes(), None):
        reader._piped_file.cache_clear()
        pipe = io.BytesIO(content or b"")
        stdin = SimpleNamespace(buffer=pipe, isatty=partial(bool, content is None))
        monkeypatch.setattr(sys, "stdin", stdin)
        if content is None:
            assert_refused("a log that is piped in, and nothing is", "-")
        else:
            expected = read_measurements(path, JOINTS)
            for _ in range(2):
                piped = read_measurements("-", JOINTS)
                assert_samples(piped.samples, expected.samples)
            assert reader.origin_of([expected, piped]).files == (str(path), "-")
            with pytest.raises(ColumnsError) as caught:
                read_measurements("-", ("a", "b"))
            assert caught.value.name == "log_columns.txt"


POSITIVE = st.lists(st.floats(1e-2, 1e2), min_size=3, max_size=3).map(tuple)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(scale=POSITIVE, constants=POSITIVE)
def test_torque_is_divided_by_scale_and_multiplied_with_constants(
    tmp_path, scale, constants
):
    path = write(tmp_path / "log.csv", table(motion(20)))
    log = read_measurements(
        path, JOINTS, torque_scale=scale, torque_constants=constants
    )
    expected = motion(20).tau * constants / np.array(scale)
    np.testing.assert_allclose(log.samples.tau, expected, rtol=1e-14)
    np.testing.assert_array_equal(log.samples.q, motion(20).q)
    np.testing.assert_array_equal(log.torque_scale, scale)
    notes = " ".join(read_measurements(path, JOINTS, torque_scale=2.0).notes)
    assert "'tau1', 'tau2', 'tau3' (each x 0.5)" in notes


@pytest.mark.parametrize("form", recorded.FORMS)
def test_every_form_reads_the_same_without_options(tmp_path, form):
    for library in ("rosbags", "pyarrow", "h5py"):
        pytest.importorskip(library)
    log = read_measurements(recorded.FORMS[form](tmp_path, DATA), JOINTS)
    assert_samples(DATA, log.samples, ("time", "q", "qd", "tau"), atol=1e-12)


def test_what_is_no_recording_is_refused_in_one_line(tmp_path):
    assert_refused("folder of no known form; a log is a text table", tmp_path)
    assert_refused("cannot read the log .*too long", tmp_path / ("a" * 5000))


@pytest.mark.parametrize(
    ("first_bytes", "form"),
    [
        (b"\x89MCAP0\r\n", "a ROS bag"),
        (b"#ROSBAG V2.0\n", "a ROS bag"),
        (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
        (b"PK\x03\x04", "a NumPy .npz file"),
        (b"PAR1", "a Parquet file"),
        (b"ARROW1\x00\x00", "a Feather file"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path, first_bytes, form):
    for library in ("rosbags", "pyarrow", "h5py"):
        pytest.importorskip(library)
    path = tmp_path / "log.bag"
    path.write_bytes(first_bytes + b" rubbish")
    assert_refused(f"as {form}", path)


def test_a_library_that_is_missing_is_named_with_the_command(tmp_path, monkeypatch):
    pytest.importorskip("rosbags")
    path = recorded.FORMS["ROS 1 bag"](tmp_path, DATA)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match=r'\n  pip install -e ".*\[rosbag\]"$'):
        read_measurements(path, JOINTS)


def test_motor_currents_are_taken_with_torque_constants_only(tmp_path):
    path = recorded.rtde(tmp_path, DATA, torque="actual_current")
    assert_refused("motor currents: give --torque-constants", path)
    log = read_measurements(path, JOINTS, torque_constants=(10.0, 20.0, 30.0))
    np.testing.assert_allclose(
        log.samples.tau, DATA.tau * [10.0, 20.0, 30.0], rtol=1e-14
    )


def test_a_validation_log_with_the_samples_of_a_fitted_log_is_refused(tmp_path):
    log = read_measurements(write(tmp_path / "log.csv", table(DATA)), JOINTS)
    other = read_measurements(write(tmp_path / "other.csv", table(motion(50))), JOINTS)
    copy = replace(log, path=tmp_path / "copy.csv")
    reader.refuse_fitted_log(other, [log])
    with pytest.raises(InputError, match="the samples of .*log.csv, which is fitted"):
        reader.refuse_fitted_log(copy, [other, log])
