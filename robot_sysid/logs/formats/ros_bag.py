"""ROS bags: ROS 2 (folder with .db3 or .mcap, or a single .mcap) and ROS 1 (.bag).

Read are sensor_msgs/JointState, control_msgs/DynamicJointState and Franka's FrankaRobotState. A
joint is found by its name in each message: the order may change from message to message, several
publishers may share a topic, and a message may hold a gripper only. Time is that of the message's
header, or where that is empty the time at which the message was recorded.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.column_file import ColumnChoices
from robot_sysid.logs.formats import table
from robot_sysid.logs.formats.extras import as_input_errors, library
from robot_sysid.logs.formats.joint_titles import renamed
from robot_sysid.logs.formats.table import Block
from robot_sysid.logs.formats.unpacking import bound_unpacking

WHAT = "a ROS bag"
QUANTITIES = ("position", "velocity", "effort", "current")
# So many messages of a topic are looked at to find out which joints it has.
_LOOKED_AT = 200
# control_msgs is not among the types that the reader knows by itself.
_DYNAMIC = (
    ("control_msgs/msg/InterfaceValue", "string[] interface_names\nfloat64[] values\n"),
    (
        "control_msgs/msg/DynamicJointState",
        "std_msgs/Header header\nstring[] joint_names\n"
        "control_msgs/InterfaceValue[] interface_values\n",
    ),
)

Sample = Mapping[tuple[str, str], float]
"""(joint, quantity) to value."""


def _joint_state(message: Any) -> Sample:
    """Return the numbers of a sensor_msgs/JointState; lists that are empty are not sent."""
    values = {}
    for quantity in QUANTITIES[:3]:
        numbers = getattr(message, quantity)
        if len(numbers) == len(message.name):
            values.update({(n, quantity): v for n, v in zip(message.name, numbers.tolist())})
    return values


def _dynamic_joint_state(message: Any) -> Sample:
    pairs = zip(message.joint_names, message.interface_values)
    return {
        (joint, interface): float(value)
        for joint, values in pairs
        for interface, value in zip(values.interface_names, values.values)
        if interface in QUANTITIES
    }


def _franka_robot_state(message: Any) -> Sample:
    return _joint_state(message.measured_joint_state)


_READERS: Mapping[str, Callable[[Any], Sample]] = {
    "sensor_msgs/msg/JointState": _joint_state,
    "control_msgs/msg/DynamicJointState": _dynamic_joint_state,
    "franka_msgs/msg/FrankaRobotState": _franka_robot_state,
}
Stamped = tuple[int, int, Sample]
"""When a message was sampled and when it was recorded [ns], and what it says."""


@dataclass(frozen=True)
class BagTable:
    """One topic of a bag.

    Attributes:
        path: the bag.
        topic, kind: the topic and its type.
        columns: (joint, quantity) of each column after the time.
        titles: time, and one title per joint and quantity, in the model's spelling.
        clock: 0 where the headers have time stamps, 1 where the time of recording stands in.
        start: the first time [ns].
    """

    path: Path
    topic: str
    kind: str
    columns: tuple[tuple[str, str], ...]
    titles: tuple[str, ...]
    clock: int
    start: int
    choices: ColumnChoices = ColumnChoices()
    word: str = "message"
    first_row: tuple[str, ...] = ()

    @property
    def layout(self) -> str:
        """The form in a few words."""
        late = ", headers without time: when it was recorded" if self.clock else ""
        return f"ROS bag, topic {self.topic} ({self.kind}), joints by name{late}"

    def blocks(self, columns: Sequence[int]) -> Iterator[Block]:
        """Yield the messages in their order."""
        place = {key: k + 1 for k, key in enumerate(self.columns)}
        with _opened(self.path) as bag:
            connections = [c for c in bag.connections if c.topic == self.topic]
            total = max(1, sum(c.msgcount for c in connections))
            messages = _messages(bag, connections, self.kind)
            done = 0
            while rows := _rows(messages, place, len(self.titles), self.clock, self.start):
                lines = np.arange(done, done + len(rows)) + 1
                done += len(rows)
                yield Block(lines, np.array(rows)[:, list(columns)], done=done / total)


def bag_table(path: Path, joint_names: Sequence[str], topic: str | None) -> BagTable:
    """Return the topic of a bag that holds the arm's joints.

    Args:
        path: folder, .mcap, .db3 or .bag file.
        joint_names: the n chain joints.
        topic: which one; None takes the only one that fits.

    Raises:
        InputError: there is none that fits, or several.
    """
    with _opened(path) as bag:
        known = {c.topic: c.msgtype for c in bag.connections if c.msgtype in _READERS}
        if topic is not None and topic not in known:
            raise InputError(
                f"{path} has no joint states in topic {topic!r}; {_topics(bag.connections)}"
            )
        wanted = [topic] if topic else sorted(known)
        tables = [_topic(path, bag, name, known[name], joint_names) for name in wanted]
        found = [each for each in tables if each is not None]
        if not found:
            raise InputError(f"{path} holds no joint states; {_topics(bag.connections)}")
    fitting = [each for each in found if _has_all(each, joint_names)] or found
    measured = [each for each in fitting if _has_torque(each, joint_names)] or fitting
    if len(measured) > 1:
        listed = ", ".join(f"{each.topic} ({each.kind})" for each in measured)
        raise InputError(f"{path}: several topics could be the arm: {listed}; choose with --topic")
    return _with_torque(measured[0], joint_names)


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag, by its content."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    with path.open("rb") as stream:
        start = stream.read(16)
    return start.startswith((b"\x89MCAP0", b"#ROSBAG V", b"SQLite format 3"))


def _has_all(found: BagTable, joint_names: Sequence[str]) -> bool:
    return {f"{joint} position" for joint in joint_names} <= set(found.titles)


def _has_torque(found: BagTable, joint_names: Sequence[str]) -> bool:
    titles = set(found.titles)
    return any({f"{joint} {q}" for joint in joint_names} <= titles for q in QUANTITIES[2:])


def _with_torque(found: BagTable, joint_names: Sequence[str]) -> BagTable:
    """Return a topic that has torque in it, or raise InputError."""
    if _has_all(found, joint_names) and not _has_torque(found, joint_names):
        raise InputError(
            f"{found.path}: topic {found.topic} has no effort of joint {joint_names[-1]}; without "
            "measured torque nothing can be identified: let the driver publish effort and record "
            "again"
        )
    return found


def _topics(connections: Sequence[Any]) -> str:
    listed = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in connections})) or "none"
    return f"its topics: {listed}"


def _topic(
    path: Path, bag: Any, topic: str, kind: str, joint_names: Sequence[str]
) -> BagTable | None:
    """Return a topic with the columns that its first messages have, or None if it has none."""
    connections = [c for c in bag.connections if c.topic == topic]
    first = list(islice(_messages(bag, connections, kind), _LOOKED_AT))
    seen = dict.fromkeys(key for _, _, sample in first for key in sample)
    if not seen:
        return None
    clock = 0 if any(sampled for sampled, _, _ in first) else 1
    start = first[0][1] if clock else first[0][0]
    names = list(dict.fromkeys(joint for joint, _ in seen))
    spelling = dict(zip(names, renamed(names, joint_names)))
    titles = tuple(f"{spelling[joint]} {quantity}" for joint, quantity in seen)
    return BagTable(path, topic, kind, tuple(seen), ("time", *titles), clock, start)


def _rows(
    messages: Iterator[Stamped],
    place: Mapping[tuple[str, str], int],
    width: int,
    clock: int,
    start: int,
) -> list[list[float]]:
    rows: list[list[float]] = []
    for sampled, recorded, sample in messages:
        row = [np.nan] * width
        row[0] = 1e-9 * ((recorded if clock else sampled) - start)
        for key, value in sample.items():
            if key in place:
                row[place[key]] = value
        rows.append(row)
        if len(rows) == table.BLOCK:
            break
    return rows


def _messages(bag: Any, connections: Sequence[Any], kind: str) -> Iterator[Stamped]:
    read = _READERS[kind]
    for connection, received, raw in bag.messages(connections=connections):
        message = bag.deserialize(raw, connection.msgtype)
        inner = getattr(message, "measured_joint_state", message)
        stamp = inner.header.stamp
        sampled = int(stamp.sec) * 10**9 + int(stamp.nanosec)
        yield sampled, int(received), read(message)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yield a bag that is open within a block; what goes wrong in it is an InputError."""
    highlevel = library("rosbags.highlevel", "rosbag", WHAT)
    typesys = library("rosbags.typesys", "rosbag", WHAT)
    single = path.suffix in (".db3", ".mcap") and (path.parent / "metadata.yaml").is_file()
    bound_unpacking()
    with as_input_errors(path, WHAT):
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        for name, text in _DYNAMIC:
            store.register(typesys.get_types_from_msg(text, name))
        bag = highlevel.AnyReader([path.parent if single else path], default_typestore=store)
        with bag:
            yield bag
