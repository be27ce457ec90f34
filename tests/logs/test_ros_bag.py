"""Which topic and which joints of a bag are read."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from itertools import chain

import numpy as np
import pytest

from rigs.files.model_files import make_pipe
from rigs.files.refusals import refused
from rigs.logs import recorded
from rigs.logs.log_files import (
    JOINTS,
    assert_read,
    assert_refused,
    motion,
    notes_of,
    read_measurements,
)

DATA = motion(60)


def write_bag(path, rows):
    """A bag with one message per row: time, joints' names, q, qd and tau."""
    return recorded.write_bag(path, [topic("/joint_states", rows)])


def topic(name, rows):
    """A topic with a JointState of each row of the arguments of ``joint_state``."""

    def messages(types):
        return (recorded.joint_state(types, *row) for row in rows)

    return name, recorded.STATE, messages


def rows_of(indices, joints=(0, 1, 2)):
    """Rows of the motion at these indices, with some of its joints."""
    for k in indices:
        values = (JOINTS, DATA.q[k], DATA.qd[k], DATA.tau[k])
        yield DATA.time[k], *(np.take(array, joints) for array in values)


def test_what_is_not_in_one_message_or_not_in_order_is_refused(tmp_path):
    apart = zip(rows_of(range(60), [0, 1]), rows_of(range(60), [2]))
    path = write_bag(tmp_path / "apart", chain(*apart))
    assert_refused("have empty or NaN cells.*position and torque, in one", path)
    back = rows_of([*range(40), *range(30, 60)])
    path = write_bag(tmp_path / "back", back)
    assert "written twice, the same in all columns: 10" in notes_of(
        assert_read(path, DATA)
    )
    back = rows_of([*range(40), *range(30, 60)])
    later = [(t + 1e-3 * (k >= 40), *row) for k, (t, *row) in enumerate(back)]
    path = write_bag(tmp_path / "again", later)
    assert_refused("backwards in time.*message 41", path)


def test_messages_of_another_publisher_are_left_out_with_a_note(tmp_path):
    arm = [*rows_of(range(60))]
    gripper = [(t + 1e-3, ["f"], [0.0], [0.0], [0.0]) for t, *_ in arm]
    parts = [(t + 1e-3, ["f", JOINTS[0]], *[[0.0, 0.0]] * 3) for t, *_ in arm]
    without_effort = [(t + 1e-3, names, q, None, None) for t, names, q, *_ in arm]
    for number, others in enumerate((gripper, parts, without_effort)):
        rows = sorted([*arm, *others], key=lambda row: row[0])
        log = assert_read(write_bag(tmp_path / str(number), rows), DATA)
        assert "of another publisher, are left out" in log.notes[-1]


ZEROS = [0.0, 0.0, 0.0]
# What a second publisher sends of a message of the arm.
OTHERS = {
    "no motors": lambda t, names, q, qd, tau: (t, names, q, qd, ZEROS, "sim"),
    "a finger more, no motors": lambda t, names, q, qd, tau: (
        t,
        [*names, "finger"],
        [*q, 0.01],
        [*qd, 0.0],
        [*ZEROS, 0.0],
    ),
    "no motors that it knows": lambda t, names, q, qd, tau: (
        t,
        names,
        q,
        qd,
        [np.nan] * 3,
        "sim",
    ),
    "another frame, and fewer": lambda t, names, q, qd, tau: (
        t,
        names,
        q,
        qd,
        2.0 * tau,
        "other",
    ),
}


@pytest.mark.parametrize("storage", ["SQLITE3", "ROS1"])
@pytest.mark.parametrize("name", OTHERS)
def test_publishers_of_one_arm_are_told_apart(tmp_path, name, storage):
    arm = [*rows_of(range(60))]
    others = [OTHERS[name](row[0] + 1e-3, *row[1:]) for row in arm[::2]]
    rows = sorted([*arm, *others], key=lambda row: row[0])
    path = recorded.write_bag(tmp_path / "bag", [topic("/joint_states", rows)], storage)
    log = assert_read(path, DATA)
    said = log.notes[-1]
    assert "of another publisher, are left out" in said
    assert ("no effort but 0" in said) == ("no motors" in name)


def test_a_frame_that_counts_messages_is_no_publisher(tmp_path):
    rows = [(*row, f"frame{k}") for k, row in enumerate(rows_of(range(60)))]
    assert_read(write_bag(tmp_path / "bag", rows), DATA)


@pytest.mark.parametrize("form", ["echo", "JSON lines"])
def test_publishers_in_text_are_told_apart_alike(tmp_path, form):
    names = JOINTS
    arm = [(*row, "base") for row in rows_of(range(60))]
    other = [(t + 1e-3, n, q, qd, ZEROS, "sim") for t, n, q, qd, *_ in arm[::2]]
    lines = []
    for t, _, q, qd, tau, frame in sorted([*arm, *other], key=lambda row: row[0]):
        lists = {"position": q, "velocity": qd, "effort": tau}
        values = {key: [float(x) for x in v] for key, v in lists.items()}
        if form == "echo":
            stamp = f"sec: {int(t)}\n    nanosec: {round(1e9 * (t % 1.0))}"
            head = f"header:\n  stamp:\n    {stamp}\n  frame_id: {frame}\n"
            keys = {"name": names, **values}
            lines.append(head + "".join(f"{k}: {[*v]}\n" for k, v in keys.items()))
            lines.append("---")
        else:
            state = {"t": t, "header": {"frame_id": frame}, "name": names, **values}
            lines.append(json.dumps(state))
    path = tmp_path / "log.txt"
    path.write_text("\n".join(lines) + "\n")
    log = assert_read(path, DATA)
    assert "messages of frame 'sim' (no effort but 0" in notes_of(log)


def test_a_pipe_beside_a_part_is_not_waited_for(tmp_path):
    folder = write_bag(tmp_path / "bag", rows_of(range(60)))
    part = next(folder.glob("*.db3"))
    assert len(read_measurements(part, JOINTS)) == len(DATA)
    make_pipe(folder / "other.db3")
    for path in (folder, part):
        assert_refused("give a bag whose parts are files", path)


def test_several_topics_need_a_choice_but_not_one_without_the_arm_or_effort(tmp_path):
    gripper = [(t, ["f"], [0.0], [0.0], [0.0]) for t in DATA.time]
    desired = [(t, JOINTS, q, None, None) for t, q in zip(DATA.time, DATA.q)]
    topics = [
        topic("/gripper", gripper),
        topic("/desired", desired),
        ("/joint_states", recorded.STATE, recorded.shuffled_states(DATA)),
    ]
    path = recorded.write_bag(tmp_path / "bag", topics)
    assert "topic /joint_states" in read_measurements(path, JOINTS).notes[0]
    assert_refused("topic /desired has no effort", path, topic="/desired")
    assert_refused("no joint states in topic '/up'; its topics", path, topic="/up")
    assert len(read_measurements(path, JOINTS, topic="/joint_states")) == len(DATA)


def test_a_topic_whose_type_the_bag_does_not_define_is_left_out(tmp_path):
    """As Franka's in the .db3 of ROS 2 Humble; alone, it is refused with what to do."""
    topics = [
        ("/franka/robot_state", recorded.FRANKA, recorded.franka_states(DATA)),
        ("/joint_states", recorded.STATE, recorded.shuffled_states(DATA)),
    ]
    path = recorded.write_bag(tmp_path / "bag", topics)
    alone = recorded.write_bag(tmp_path / "alone", topics[:1])
    for folder in (path, alone):
        with contextlib.closing(sqlite3.connect(next(folder.glob("*.db3")))) as file:
            # Releases for Python 3.9 write no definitions at all.
            with contextlib.suppress(sqlite3.OperationalError):
                file.execute("delete from message_definitions")
            file.commit()
        metadata = folder / "metadata.yaml"
        metadata.write_text(metadata.read_text().replace("version: 9", "version: 5"))
    assert_read(path, DATA)
    assert_refused("FrankaRobotState. without its definition: .*-s mcap", alone)


def states_of(quantity, shift=0.0):
    """A function of the types that yields JointStates of one quantity, at its times."""

    def messages(types):
        for time, q, tau in zip(DATA.time + shift, DATA.q, DATA.tau):
            lists = (q, None, None) if quantity == "position" else (None, None, tau)
            yield recorded.joint_state(types, time, JOINTS, *lists)

    return messages


def arrays_of_torques(types):
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    for tau in DATA.tau:
        yield types["std_msgs/msg/Float64MultiArray"](layout, tau)


def remarks(types):
    """Messages of another type."""
    for _ in range(20):
        yield types["std_msgs/msg/String"]("a remark")


def test_torques_of_another_topic_are_joined_by_time(tmp_path):
    topics = [
        ("/joint_states", recorded.STATE, states_of("position")),
        ("/joint_torques", recorded.STATE, states_of("effort")),
    ]
    path = recorded.write_bag(tmp_path / "bag", topics)
    log = assert_read(path, DATA)
    assert "joint_states and torques of " in notes_of(log)
    topics[1] = ("/desired_torques", *topics[1][1:])
    path = recorded.write_bag(tmp_path / "commanded", topics)
    assert_refused("no effort of the arm's joints; let the driver", path)


def timed_arrays(types):
    """Arrays, and when they were sent."""
    yield from zip(DATA.time, arrays_of_torques(types))


def reversed_states(types):
    """Positions, the tip's first."""
    for time, q in zip(DATA.time, DATA.q):
        yield recorded.joint_state(
            types, time, JOINTS[::-1], q[::-1].copy(), None, None
        )


ARRAYS = "std_msgs/msg/Float64MultiArray"


def test_torques_in_an_array_are_read_where_it_is_called_so(tmp_path):
    topics = [
        ("/joint_states", recorded.STATE, states_of("position")),
        ("/joint_torques", ARRAYS, timed_arrays),
        ("/temperatures", ARRAYS, timed_arrays),
        ("/commands", ARRAYS, timed_arrays),
    ]
    path = recorded.write_bag(tmp_path / "bag", topics)
    log = read_measurements(path, JOINTS)
    np.testing.assert_allclose(log.q, DATA.q[1:], atol=1e-9)
    # An array has no stamp of its own, and arrives a while after.
    sent = DATA.time[1:] - recorded.LATENCY_NS * 1e-9
    for k in range(3):
        expected = np.interp(sent, DATA.time, DATA.tau[:, k])
        np.testing.assert_allclose(log.tau[:, k], expected, atol=1e-3)
    assert "torques are the numbers of data in /joint_torques, base first" in notes_of(
        log
    )


@pytest.mark.parametrize(
    ("states", "arrays"),
    [
        # Its order could be another one, it is called nothing, or there are two.
        (reversed_states, {"/joint_torques": timed_arrays}),
        (states_of("position"), {"/numbers": timed_arrays}),
        (
            states_of("position"),
            {"/joint_torques": timed_arrays, "/efforts": timed_arrays},
        ),
    ],
)
def test_torques_in_another_message_are_named_with_their_size(states, arrays, tmp_path):
    topics = [
        ("/joint_states", recorded.STATE, states),
        *((name, ARRAYS, messages) for name, messages in arrays.items()),
        ("/commands", ARRAYS, timed_arrays),
        ("/remarks", "std_msgs/msg/String", remarks),
    ]
    path = recorded.write_bag(tmp_path / "bag", topics)
    message = assert_refused("has no effort of the arm's joints", path)
    assert "/commands" not in message
    for name in arrays:
        assert f"{name} ({ARRAYS}: 3 numbers in data, 60 messages)" in message


def torque_rows(indices=range(60)):
    """Rows of torques alone."""
    return [(t, names, None, None, tau) for t, names, *_, tau in rows_of(indices)]


def position_rows(effort=None):
    """Rows of positions with an effort of zero, or none."""
    return [(*row[:4], effort) for row in rows_of(range(60))]


@pytest.mark.parametrize("effort", [None, ZEROS])
def test_a_topic_of_positions_is_joined_with_that_of_torques(tmp_path, effort):
    """Also where the one or the other is chosen."""
    topics = [
        topic("/joint_states", position_rows(effort)),
        topic("/torques", torque_rows()),
    ]
    path = recorded.write_bag(tmp_path / "bag", topics)
    for options in ({}, {"topic": "/joint_states"}, {"topic": "/torques"}):
        log = assert_read(path, DATA, **options)
        assert "are one log, joined" in notes_of(log)


@pytest.mark.parametrize("effort", [None, ZEROS])
def test_of_several_topics_of_torques_one_is_chosen(tmp_path, effort):
    names = ("/a/torques", "/b/torques")
    topics = [topic("/joint_states", position_rows(effort))]
    topics += [topic(name, torque_rows()) for name in names]
    path = recorded.write_bag(tmp_path / "bag", topics)
    with refused("torques may be in /a/torques .*choose theirs with --topic") as caught:
        read_measurements(path, JOINTS)
    assert caught.value.options == tuple(("--topic", name) for name in names)
    for name in names:
        assert_read(path, DATA, topic=name)


def test_messages_of_another_type_on_the_topic_are_left_alone(tmp_path):
    states = topic("/joint_states", rows_of(range(60)))
    other = ("/joint_states", "std_msgs/msg/String", remarks)
    path = recorded.write_bag(tmp_path / "bag", [other, states])
    assert_read(path, DATA)
