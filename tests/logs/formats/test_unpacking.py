"""Bags whose pieces unpack to far more than a recording would are refused in each compression."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.logs.formats import ros_bag
from tests.support import recorded
from tests.support.log_files import JOINTS, motion, read_measurements

pytest.importorskip("rosbags")
BYTES = 3_000_000
FORMS = ("bz2", "lz4", "file", "message", "storage")


def bomb(folder, form):
    """A sound bag of a form, one of whose messages is nothing but zeros."""
    ros1 = form in ("bz2", "lz4")
    store = recorded.typestore(ros1)
    states = list(recorded.shuffled_states(store.types, motion(40)))
    image = store.types["std_msgs/msg/UInt8MultiArray"]
    layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    zeros = [image(layout, np.zeros(BYTES, np.uint8))]
    topics = [
        ("/joint_states", recorded.STATE, states),
        ("/zeros", "std_msgs/msg/UInt8MultiArray", zeros),
    ]
    if ros1:
        return recorded.write_bag1(folder / "log.bag", topics, store, form.upper())
    storage = "MCAP" if form == "storage" else "SQLITE3"
    topics = topics[:1] if form == "message" else topics
    if form == "message":
        states[1] = recorded.joint_state(store.types, 0.0, ["a" * BYTES], [0.0], None, None)
    return recorded.write_bag2(folder / "bag", topics, store, storage, form.upper())


# The rosbags for Python 3.9 leaves its temporary folder to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("form", FORMS)
def test_a_bag_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch, form):
    path = bomb(tmp_path, form)
    files = [path] if path.is_file() else list(path.iterdir())
    assert sum(each.stat().st_size for each in files) < BYTES / 10
    assert len(read_measurements(path, JOINTS).samples) == 40
    monkeypatch.setattr(ros_bag, "ALWAYS", 10**5)
    monkeypatch.setattr(ros_bag, "MOST_RATIO", 2)
    with pytest.raises(InputError, match="log.bag|bag as a ROS bag: a piece of it unpacks"):
        read_measurements(path, JOINTS)


@pytest.fixture(params=["bz2", "lz4.frame", "zstandard"])
def library(request):
    """What old and new releases of rosbags unpack with."""
    return pytest.importorskip(request.param)


def test_what_fits_is_unpacked_whole(library):
    content = bytes(range(256)) * 10_000
    assert ros_bag.Bounded(library).decompress(library.compress(content)) == content


def test_a_few_bytes_never_become_the_whole_memory(library):
    packed = library.compress(bytes(2 * ros_bag.ALWAYS))
    assert len(packed) < ros_bag.ALWAYS / 100
    with pytest.raises(ros_bag.TooMuchError, match="more than 100 MB"):
        ros_bag.Bounded(library).decompress(packed)


def test_the_reader_of_mcap_for_python_3_9_is_bounded():
    mcap = pytest.importorskip("rosbags.rosbag2.storage_mcap")
    if not hasattr(mcap, "zstandard"):
        pytest.skip("this rosbags has another library for zstd")
    ros_bag.bound_unpacking()
    packed = mcap.zstandard.compress(bytes(2 * ros_bag.ALWAYS))
    with pytest.raises(ros_bag.TooMuchError):
        mcap.DECOMPRESSORS["zstd"](packed, 2 * ros_bag.ALWAYS)
