"""Messages that come late, joints in messages of their own, bags that unpack to far too much."""

from __future__ import annotations

import bz2

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.logs import ros_bag
from robot_sysid.logs.ros_bag import MessagePattern, sort_late
from tests.support import recorded
from tests.support.log_files import JOINTS, motion, read_measurements

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
    """Whichever of a hundred, by however many; never two in a row."""
    stamps = list(range(0, 1000, 10))
    for place in sorted(late):
        stamps.insert(min(place + by, len(stamps)), stamps.pop(place))
    if all(
        b >= a or d >= c
        for a, b, c, d in zip(stamps, stamps[1:], stamps[2:], stamps[3:])
    ):
        ordered = [stamps for (stamps, _), _ in sort_late(map(message, stamps))]
        assert ordered == sorted(stamps)


@pytest.mark.parametrize("back", [6, 40])
def test_a_clock_that_is_set_back_stays_backwards(back):
    stamps = [*range(200), *range(200 - back, 300)]
    ordered = [stamps for (stamps, _), _ in sort_late(map(message, stamps))]
    assert sorted(ordered) == sorted(stamps) and ordered != sorted(stamps)


def bag(path, messages):
    pytest.importorskip("rosbags")
    store = recorded.typestore()
    made = [
        recorded.joint_state(
            store.types, time, *(np.asarray(each)[which] for each in values)
        )
        for time, which, *values in messages
    ]
    return recorded.write_bag2(path, [("/joint_states", recorded.STATE, made)], store)


def rows(times, which=(0, 1, 2)):
    """Messages with some joints of the motion at some of its rows."""
    wanted = list(which)
    return [
        (DATA.time[k], wanted, JOINTS, DATA.q[k], DATA.qd[k], DATA.tau[k])
        for k in times
    ]


def test_a_bag_with_one_late_message_is_the_one_without(tmp_path):
    late = [*range(20), *range(21, 33), 20, *range(33, 60)]
    log = read_measurements(bag(tmp_path / "late", rows(late)), JOINTS)
    for name in ("time", "q", "tau"):
        got = getattr(log.samples, name)
        expected = getattr(DATA, name)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
    back = [*range(40), *range(30, 60)]
    with pytest.raises(InputError, match="time runs backwards at message 44"):
        read_measurements(bag(tmp_path / "back", rows(back)), JOINTS)


def test_joints_in_messages_of_their_own_are_put_together(tmp_path):
    split = [each for k in range(60) for each in (*rows([k], [0, 1]), *rows([k], [2]))]
    log = read_measurements(bag(tmp_path / "one", split), JOINTS)
    for name in ("time", "q", "qd", "tau"):
        got = getattr(log.samples, name)
        expected = getattr(DATA, name)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
    assert "2 kinds of message put together by their stamps" in log.notes[0]


def test_joints_that_are_sampled_at_times_of_their_own_keep_them(tmp_path):
    """The wrist comes every second time, between two rows of the others."""
    between = 0.5 * (DATA.time[:-1] + DATA.time[1:])
    wrist = [(between[k], *rows([k], [2])[0][1:]) for k in range(0, 59, 2)]
    split = sorted([*rows(range(60), [0, 1]), *wrist], key=lambda each: each[0])
    log = read_measurements(bag(tmp_path / "own", split), JOINTS)
    samples = log.samples
    np.testing.assert_allclose(samples.time, between[::2], atol=1e-9)
    np.testing.assert_allclose(samples.joint_time[:, 0], DATA.time[0:59:2], atol=1e-9)
    np.testing.assert_allclose(samples.joint_time[:, 2], between[::2], atol=1e-9)
    np.testing.assert_array_equal(samples.q, DATA.q[0:59:2])
    assert "each at its own time" in log.notes[0]


def test_a_part_that_stops_speaking_leaves_a_hole():
    both = [message(10**7 * k, "a") for k in range(40)]
    both += [message(10**7 * k + 10**6, "b") for k in (*range(10), *range(30, 40))]
    both.sort(key=lambda each: each[0])
    arm = MessagePattern.of(both, ["a", "b"])
    assert list(arm.groups) == [{"a"}, {"b"}] and arm.has_own_times
    times = [time for time, _ in arm.join(iter(both))]
    assert len(times) == 20 and max(np.diff(times)) == pytest.approx(0.21)


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
    topics = [
        ("/joint_states", recorded.STATE, states),
        *(
            [("/zeros", "std_msgs/msg/UInt8MultiArray", zeros)]
            if form != "message"
            else []
        ),
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
    np.testing.assert_array_equal(
        read_measurements(path, JOINTS).samples.q, motion(40).q
    )
    monkeypatch.setattr(ros_bag, "ALWAYS_ALLOWED", 10**5)
    monkeypatch.setattr(ros_bag, "MAX_RATIO", 2)
    with pytest.raises(
        InputError, match="log.bag|bag as a ROS bag: a piece of it unpacks"
    ):
        read_measurements(path, JOINTS)


def test_what_others_import_unpacks_as_ever():
    pytest.importorskip("rosbags")
    from rosbags.highlevel import anyreader
    from rosbags.rosbag1 import reader

    assert ros_bag.bounded_reader().Reader1 is not anyreader.Reader1 is reader.Reader
    assert reader.bz2_decompress is bz2.decompress
