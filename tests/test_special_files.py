"""Pipes and devices where a file leads on to others, or a Python program names one."""

from __future__ import annotations

import json
import os
import sys

import pytest

import robot_sysid as rs
from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_table
from robot_sysid.records.atomic_files import write_whole
from robot_sysid.special_files import refuse_special_file

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs named pipes")


@pytest.fixture
def pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


def test_files_folders_and_what_is_not_there_are_left_alone(tmp_path):
    (tmp_path / "a").touch()
    for path in (
        tmp_path,
        tmp_path / "a",
        tmp_path / "b",
        str(tmp_path),
        "a" * 5000,
        "a\0",
    ):
        refuse_special_file(path)


def test_a_device_is_neither_read_nor_replaced(tmp_path, pipe):
    (tmp_path / "null").symlink_to(os.devnull)
    for path in (pipe, tmp_path / "null"):
        with pytest.raises(InputError, match="is a pipe or a device; do this"):
            read_json(path, "do this")
        with pytest.raises(
            InputError, match="is a pipe or a device; choose another name"
        ):
            write_whole(path, "content")
    assert not (tmp_path / "null").is_file() and pipe.is_fifo()


def test_parts_of_a_recording_are_files(tmp_path, pipe):
    pytest.importorskip("pyarrow")
    (tmp_path / "meta").mkdir()
    (tmp_path / "data").mkdir()
    names = {"names": ["a.pos", "a.torque"]}
    content = {"features": {"observation.state": names}}
    (tmp_path / "meta" / "info.json").write_text(json.dumps(content))
    pipe.rename(tmp_path / "data" / "part.parquet")
    with pytest.raises(InputError, match="part.parquet is a pipe or a device"):
        open_table(tmp_path, ("a",), LogOptions())


def test_parts_of_a_bag_are_files(tmp_path, pipe):
    pytest.importorskip("rosbags")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    pipe.rename(tmp_path / "part.db3")
    with pytest.raises(InputError, match="part.db3 is a pipe or a device"):
        open_table(tmp_path, ("a",), LogOptions())


def test_python_programs_get_the_same_refusal(pipe):
    with pytest.raises(
        rs.InputError, match="pipe is a pipe or a device; give columns another"
    ):
        rs.identify("arm.xml", "log.csv", columns=pipe)
