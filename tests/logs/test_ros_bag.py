"""Messages that come late, joints in messages of their own, bags that unpack to far too much."""

from __future__ import annotations

import bz2
import contextlib
import os
import sqlite3
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.logs import ros_bag
from robot_sysid.logs.ros_bag import MessagePattern, sort_late
from tests.support import recorded
from tests.support.log_files import (
    JOINTS,
    assert_refused,
    assert_samples,
    motion,
    read_measurements,
)

DATA = motion(60)


def message(stamp: int, *joints: str):
    return (stamp, stamp), {
        (joint, "position"): float(stamp) for joint in joints or ("a",)
    }


@given(
    st.lists(st.integers(1, 99), min_size=1, max_size=5, unique=True),
    st.integers(1, 90),
)
def test_single_messages_that_come_late_take_their_place(late, by):
    """Whichever of a hundred, by however many; never more than three in a row."""
    stamps = list(range(0, 1000, 10))
    for index in sorted(late):
        stamps.insert(min(index + by, len(stamps)), stamps.pop(index))
    is_late = np.array(stamps) < np.maximum.accumulate(stamps)
    if "1111" not in "".join(map(str, is_late.astype(int))):
        assert sorted_stamps(stamps) == sorted(stamps)


def sorted_stamps(stamps):
    return [stamp for (stamp, _), _ in sort_late(map(message, stamps))]


@pytest.mark.parametrize("back", [6, 40])
def test_a_clock_that_is_set_back_stays_backwards(back):
    stamps = [*range(200), *range(200 - back, 300)]
    ordered = sorted_stamps(stamps)
    assert sorted(ordered) == sorted(stamps) and ordered != sorted(stamps)


def write_bag(path, rows):
    """A bag with one message per row: time, joint indices and joints' names, q, qd and tau."""
    pytest.importorskip("rosbags")
    store = recorded.typestore()
    messages = []
    for time, joints, *values in rows:
        selected = [np.asarray(array)[joints] for array in values]
        messages.append(recorded.joint_state(store.types, time, *selected))
    topic = ("/joint_states", recorded.STATE, messages)
    return recorded.write_bag2(path, [topic], store)


def rows_of(indices, joints=(0, 1, 2)):
    """Rows of the motion at these indices, with some of its joints."""
    selected = list(joints)
    rows = []
    for k in indices:
        row = (DATA.time[k], selected, JOINTS, DATA.q[k], DATA.qd[k], DATA.tau[k])
        rows.append(row)
    return rows


def test_a_bag_with_one_late_message_is_the_one_without(tmp_path):
    late = [*range(20), *range(21, 33), 20, *range(33, 60)]
    log = read_measurements(write_bag(tmp_path / "late", rows_of(late)), JOINTS)
    assert_samples(DATA, log.samples, ("time", "q", "tau"), atol=1e-12)
    back = [*range(40), *range(30, 60)]
    assert_refused(
        "time runs backwards at message 44", write_bag(tmp_path / "back", rows_of(back))
    )


def test_joints_in_messages_of_their_own_are_put_together(tmp_path):
    rows = []
    for k in range(60):
        rows += [*rows_of([k], [0, 1]), *rows_of([k], [2])]
    log = read_measurements(write_bag(tmp_path / "one", rows), JOINTS)
    assert_samples(DATA, log.samples, ("time", "q", "qd", "tau"), atol=1e-12)
    assert "2 kinds of message put together by their stamps" in log.notes[0]


def test_joints_that_are_sampled_at_times_of_their_own_keep_them(tmp_path):
    """The wrist comes every second time, between two rows of the others."""
    between = 0.5 * (DATA.time[:-1] + DATA.time[1:])
    rows = rows_of(range(60), [0, 1])
    for time, (_, *values) in zip(between[::2], rows_of(range(0, 59, 2), [2])):
        rows.append((time, *values))
    rows.sort(key=lambda row: row[0])
    log = read_measurements(write_bag(tmp_path / "own", rows), JOINTS)
    samples = log.samples
    np.testing.assert_allclose(samples.time, between[::2], atol=1e-9)
    np.testing.assert_allclose(samples.joint_time[:, 0], DATA.time[0:59:2], atol=1e-9)
    np.testing.assert_allclose(samples.joint_time[:, 2], between[::2], atol=1e-9)
    np.testing.assert_array_equal(samples.q, DATA.q[0:59:2])
    assert "each at its own time" in log.notes[0]


def test_a_group_that_stops_sending_leaves_a_hole():
    both = []
    for k in range(40):
        both.append(message(10**7 * k, "a"))
        if not 10 <= k < 30:
            both.append(message(10**7 * k + 10**6, "b"))
    pattern = MessagePattern.of(both, ["a", "b"])
    assert list(pattern.groups) == [{"a"}, {"b"}] and pattern.has_own_times
    times = [time for time, _ in pattern.join(iter(both))]
    assert len(times) == 20 and max(np.diff(times)) == pytest.approx(0.21)


@pytest.mark.skipif(sys.platform == "win32", reason="needs named pipes")
def test_a_pipe_beside_a_part_is_not_waited_for(tmp_path):
    folder = write_bag(tmp_path / "bag", rows_of(range(60)))
    part = next(folder.glob("*.db3"))
    assert len(read_measurements(part, JOINTS).samples) == len(DATA)
    os.mkfifo(folder / "other.db3")
    for path in (folder, part):
        assert_refused("give a bag whose parts are files", path)


BYTES = 300_000


def bomb(folder, form):
    """A sound bag of a form, one of whose messages is nothing but zeros."""
    pytest.importorskip("rosbags")
    ros1 = form in ("bz2", "lz4")
    store = recorded.typestore(ros1)
    states = list(recorded.shuffled_states(store.types, motion(40)))
    if form == "message":
        states[1] = recorded.joint_state(
            store.types, 0.0, ["a" * BYTES], [0.0], None, None
        )
    image = store.types["std_msgs/msg/UInt8MultiArray"]
    layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    zeros = [image(layout, np.zeros(BYTES, np.uint8))]
    topics = [("/joint_states", recorded.STATE, states)]
    if form != "message":
        topics.append(("/zeros", "std_msgs/msg/UInt8MultiArray", zeros))
    if ros1:
        return recorded.write_bag1(folder / "log.bag", topics, store, form.upper())
    storage = "MCAP" if form == "storage" else "SQLITE3"
    return recorded.write_bag2(folder / "bag", topics, store, storage, form.upper())


# The rosbags for Python 3.9 leaves its temporary folder to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("form", ["bz2", "lz4", "file", "message", "storage"])
def test_a_bag_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch, form):
    path = bomb(tmp_path, form)
    np.testing.assert_array_equal(
        read_measurements(path, JOINTS).samples.q, motion(40).q
    )
    monkeypatch.setattr(ros_bag, "ALWAYS_ALLOWED", 10**5)
    monkeypatch.setattr(ros_bag, "MAX_RATIO", 2)
    assert_refused("log.bag|bag as a ROS bag: a piece of it unpacks", path)


def test_what_others_import_unpacks_as_ever():
    pytest.importorskip("rosbags")
    from rosbags.highlevel import anyreader
    from rosbags.rosbag1 import reader

    assert ros_bag.bounded_reader().Reader1 is not anyreader.Reader1 is reader.Reader
    assert reader.bz2_decompress is bz2.decompress


def test_several_topics_need_a_choice_but_not_one_without_the_arm_or_effort(tmp_path):
    pytest.importorskip("rosbags")
    store = recorded.typestore()
    types = store.types
    state = recorded.joint_state
    gripper = [state(types, t, ["f"], [0.0], [0.0], [0.0]) for t in DATA.time]
    pairs = zip(DATA.time, DATA.q)
    desired = [state(types, t, JOINTS, q, None, None) for t, q in pairs]
    measured = list(recorded.shuffled_states(types, DATA))
    topics = [
        ("/gripper", recorded.STATE, gripper),
        ("/desired", recorded.STATE, desired),
        ("/joint_states", recorded.STATE, measured),
    ]
    path = recorded.write_bag2(tmp_path / "bag", topics, store)
    assert "topic /joint_states" in read_measurements(path, JOINTS).notes[0]
    assert_refused("topic /desired has no effort", path, topic="/desired")
    assert_refused("no joint states in topic '/up'; its topics", path, topic="/up")
    mirrored = list(recorded.shuffled_states(types, replace(DATA, q=-DATA.q)))
    both = [("/left", recorded.STATE, measured), ("/right", recorded.STATE, mirrored)]
    path = recorded.write_bag2(tmp_path / "both", both, store)
    assert_refused(r"/left .*/right .*--topic", path)
    assert len(read_measurements(path, JOINTS, topic="/right").samples) == len(DATA)


def test_names_that_differ_in_a_prefix_are_the_models_unless_two_do(tmp_path):
    pytest.importorskip("rosbags")
    store = recorded.typestore()
    left = [f"left_{joint}" for joint in JOINTS]
    right = [f"right_{joint}" for joint in JOINTS]
    q, qd, tau = np.tile((DATA.q, DATA.qd, DATA.tau), 2)
    wide = []
    for time, *row in zip(DATA.time, q, qd, tau):
        wide.append(recorded.joint_state(store.types, time, [*left, *right], *row))
    path = recorded.write_bag2(tmp_path / "bag", [("/js", recorded.STATE, wide)], store)
    assert_refused(
        "left_base, left_elbow, left_wrist and right_base, right_elbow, right_wrist",
        path,
    )
    np.testing.assert_array_equal(read_measurements(path, left).samples.q, DATA.q)


def test_a_topic_whose_type_the_bag_does_not_define_is_left_out(tmp_path):
    """As Franka's in the .db3 of ROS 2 Humble; alone, it is refused with what to do."""
    pytest.importorskip("rosbags")
    store = recorded.typestore()
    states = list(recorded.shuffled_states(store.types, DATA))
    frankas = []
    for state in states:
        header = state.header
        frankas.append(store.types[recorded.FRANKA](header, state, state, 0.0))
    topics = [
        ("/franka/robot_state", recorded.FRANKA, frankas),
        ("/joint_states", recorded.STATE, states),
    ]
    path = recorded.write_bag2(tmp_path / "bag", topics, store)
    alone = recorded.write_bag2(tmp_path / "alone", topics[:1], store)
    for folder in (path, alone):
        with contextlib.closing(sqlite3.connect(next(folder.glob("*.db3")))) as file:
            # Releases for Python 3.9 write no definitions at all.
            with contextlib.suppress(sqlite3.OperationalError):
                file.execute("delete from message_definitions")
            file.commit()
        metadata = folder / "metadata.yaml"
        metadata.write_text(metadata.read_text().replace("version: 9", "version: 5"))
    log = read_measurements(path, JOINTS)
    np.testing.assert_array_equal(log.samples.q, DATA.q)
    assert_refused("FrankaRobotState. without its definition: .*-s mcap", alone)
