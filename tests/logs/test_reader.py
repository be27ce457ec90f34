"""Logs are read as they are written, torque scaled, and written back without losing a digit."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from operator import attrgetter

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from rigs.files.model_files import LFS_POINTER, write_files
from rigs.files.refusals import refused
from rigs.logs import recorded
from rigs.logs.log_files import (
    JOINTS,
    arm_of,
    assert_read,
    assert_refused,
    motion,
    open_log,
    read_measurements,
    table,
    write,
)
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions, arrays, documents, reader, ros_bag
from robot_sysid.records.messages import Progress

DATA = motion(60)


def test_a_path_that_is_no_file_is_refused_in_one_line(tmp_path):
    assert_refused("folder of no known form; a log is a text table", tmp_path)
    assert_refused("cannot read the log .*too long", tmp_path / ("a" * 5000))


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
    assert_allclose(log.tau, expected, rtol=1e-14)
    assert_array_equal(log.q, motion(20).q)
    notes = " ".join(read_measurements(path, JOINTS, torque_scale=2.0).notes)
    assert "torque from 'tau1' x 0.5 ... 'tau3' x 0.5" in notes


@pytest.mark.parametrize("form", recorded.FORMS)
def test_every_form_reads_the_same_without_options(tmp_path, form):
    path = recorded.FORMS[form](tmp_path, DATA)
    log = assert_read(path, DATA, ("q", "qd", "tau"), atol=1e-12)
    # Seconds since 1970 have 52 bits.
    precision = 5e-7 if log.time[0] else 1e-12
    assert_allclose(log.time - log.time[0], DATA.time, rtol=0.0, atol=precision)


BAG_TYPES = "rosbags.typesys.get_typestore"
PARQUET_FILE = "pyarrow.parquet.ParquetFile"
STACK = "numpy.column_stack"
FILES_AND_CALLS = {
    ros_bag.bag_table: ("ROS 1 bag", BAG_TYPES, BAG_TYPES),
    arrays.matlab_table: ("MATLAB", "scipy.io.loadmat", STACK),
    arrays.hdf5_table: ("HDF5", "h5py.File", STACK),
    arrays.npz_table: ("npz", "numpy.load", STACK),
    arrays.parquet_table: ("Parquet", PARQUET_FILE, STACK),
    arrays.lerobot_table: ("LeRobot", PARQUET_FILE, STACK),
    documents.text_table: ("libfranka", "csv.reader", "numpy.loadtxt"),
    documents.json_table: ("JSON lines", "json.JSONDecoder", STACK),
    documents.echo_table: ("echo", "re.findall", STACK),
    documents.excel_table: ("Excel", "openpyxl.load_workbook", STACK),
    documents.mcap_table: ("MCAP of JSON", "mcap.reader.make_reader", STACK),
}
"""Reader to the form of ``rigs.logs.recorded`` that it reads, and two functions of libraries: that
it calls as the log is opened, and as its blocks are read."""


def test_every_form_is_tested():
    forms = (*reader.FILES.values(), *reader.FOLDERS.values())
    assert {read for _, read in forms} == set(FILES_AND_CALLS)


@pytest.mark.parametrize(
    "fault",
    [
        TypeError("'NoneType' object is not iterable"),
        KeyError("x"),
        AssertionError(),
        MemoryError(),
        RecursionError("too deep"),
        OSError("odd"),
    ],
    ids=repr,
)
@pytest.mark.parametrize("table_reader", FILES_AND_CALLS, ids=attrgetter("__name__"))
def test_whatever_a_library_raises_is_an_input_error_that_names_the_file(
    tmp_path, table_reader, fault
):
    form, *calls = FILES_AND_CALLS[table_reader]

    def fail(*_, **__):
        raise fault

    path = recorded.FORMS[form](tmp_path, DATA)
    log_table = reader.open_table(path, JOINTS, LogOptions())
    for call, source in zip(calls, (path, log_table)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(call, fail)
            text = assert_refused(re.escape(str(path)), source)
    assert f"({type(fault).__name__})" in text


LFS_FILES = [
    {"log.csv": LFS_POINTER},
    {"log.mcap": LFS_POINTER},
    {"log.npz": LFS_POINTER},
    {"log/metadata.yaml": "", "log/log_0.mcap": LFS_POINTER},
    {"log/metadata.yaml": LFS_POINTER},
    {"log/meta/info.json": LFS_POINTER},
    {
        "log/meta/info.json": '{"features": {"observation.state": {"names": ["a.torque"]}}}',
        "log/data/chunk-000/file-000.parquet": LFS_POINTER,
    },
]


@pytest.mark.parametrize("files", LFS_FILES, ids=list)
def test_a_pointer_of_lfs_is_named_under_any_name_and_in_a_folder(tmp_path, files):
    for library in ("rosbags", "pyarrow"):
        pytest.importorskip(library)
    write_files(tmp_path, files)
    *_, name = files
    fault = f"{name} is a pointer of Git LFS.* git lfs pull"
    assert_refused(fault, tmp_path / name.split("/")[0])


def test_a_library_that_is_missing_is_named_with_the_command(tmp_path, monkeypatch):
    path = recorded.FORMS["ROS 1 bag"](tmp_path, DATA)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match=r'\n  pip install -e ".*\[rosbag\]"$'):
        read_measurements(path, JOINTS)


def test_logs_with_the_same_samples_are_refused(tmp_path):
    log = read_measurements(write(tmp_path / "log.csv", table(DATA)), JOINTS)
    other = read_measurements(write(tmp_path / "other.csv", table(motion(50))), JOINTS)
    copy = replace(log, name=str(tmp_path / "copy.csv"))
    reader.refuse_repeated_logs([other, log])
    with refused("copy.csv has the samples of .*log.csv: "):
        reader.refuse_repeated_logs([other, log, copy])


def test_a_console_that_closes_is_no_fault_of_the_log(tmp_path):
    class Closed(Progress):
        def advance(self, *_):
            raise BrokenPipeError

    path = write(tmp_path / "log.csv", table(DATA))
    with pytest.raises(BrokenPipeError):
        open_log(arm_of(JOINTS), path, LogOptions(), Closed())
