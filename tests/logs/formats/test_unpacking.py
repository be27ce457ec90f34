"""Bags whose pieces unpack to far more than a recording would are refused in each compression."""

from __future__ import annotations

import bz2

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.logs.formats import ros_bag, table
from tests.support import recorded
from tests.support.log_files import JOINTS, motion, read_measurements

pytest.importorskip("rosbags")
BYTES = 300_000


def bomb(folder, form):
    """A sound bag of a form, one of whose messages is nothing but zeros."""
    ros1 = form in ("bz2", "lz4")
    store = recorded.typestore(ros1)
    states = list(recorded.shuffled_states(store.types, motion(40)))
    if form == "message":
        states[1] = recorded.joint_state(store.types, 0.0, ["a" * BYTES], [0.0], None, None)
    image = store.types["std_msgs/msg/UInt8MultiArray"]
    layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    zeros = [image(layout, np.zeros(BYTES, np.uint8))]
    topics = [
        ("/joint_states", recorded.STATE, states),
        *([("/zeros", "std_msgs/msg/UInt8MultiArray", zeros)] if form != "message" else []),
    ]
    if ros1:
        return recorded.write_bag1(folder / "log.bag", topics, store, form.upper())
    storage = "MCAP" if form == "storage" else "SQLITE3"
    return recorded.write_bag2(folder / "bag", topics, store, storage, form.upper())


# The rosbags for Python 3.9 leaves its temporary folder to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("form", ["bz2", "lz4", "file", "message", "storage"])
def test_a_bag_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch, form):
    path = bomb(tmp_path, form)
    np.testing.assert_array_equal(read_measurements(path, JOINTS).samples.q, motion(40).q)
    monkeypatch.setattr(table, "ALWAYS", 10**5)
    monkeypatch.setattr(table, "MOST_RATIO", 2)
    with pytest.raises(InputError, match="log.bag|bag as a ROS bag: a piece of it unpacks"):
        read_measurements(path, JOINTS)


def test_what_others_import_unpacks_as_ever():
    from rosbags.highlevel import anyreader
    from rosbags.rosbag1 import reader

    assert ros_bag.bounded_reader().Reader1 is not anyreader.Reader1 is reader.Reader
    assert reader.bz2_decompress is bz2.decompress
