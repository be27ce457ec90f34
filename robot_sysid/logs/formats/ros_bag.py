"""ROS bags: ROS 2 (folder with .db3 or .mcap, or a single .mcap) and ROS 1 (.bag).

Read are sensor_msgs/JointState, control_msgs/DynamicJointState and Franka's FrankaRobotState. A
joint is found by its name in each message: the order may change from message to message, several
publishers may share a topic, and a message may hold a gripper only. Time is that of the message's
header, or where that is empty the time at which the message was recorded.

``rosbags`` unpacks each chunk, message or file whole, whatever comes out: a few kilobytes may
become the computer's whole memory, or disk. So what it unpacks with gets a bound.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.formats import table
from robot_sysid.logs.formats.table import Asked, Block, LogTable, as_input_errors, library, renamed

WHAT = "a ROS bag"
QUANTITIES = ("position", "velocity", "effort", "current")
_BEGINNINGS = (b"\x89MCAP0", b"#ROSBAG V", b"SQLite format 3")
# So many messages of a topic are looked at to find out which joints it has.
_LOOKED_AT = 200
# control_msgs is not among the types that the reader knows by itself.
_DYNAMIC = {
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    "control_msgs/msg/DynamicJointState": "std_msgs/Header header\nstring[] joint_names\n"
    "control_msgs/InterfaceValue[] interface_values\n",
}

Key = tuple[str, str]
"""Joint and quantity."""
Sample = Mapping[Key, float]


def _joint_state(message: Any) -> Sample:
    """Return the numbers of a sensor_msgs/JointState; lists that are empty are not sent."""
    values = {}
    for quantity in QUANTITIES[:3]:
        numbers = getattr(message, quantity)
        if len(numbers) == len(message.name):
            values.update({(n, quantity): v for n, v in zip(message.name, numbers.tolist())})
    return values


def _dynamic_joint_state(message: Any) -> Sample:
    return {
        (joint, interface): float(value)
        for joint, values in zip(message.joint_names, message.interface_values)
        for interface, value in zip(values.interface_names, values.values)
        if interface in QUANTITIES
    }


_READERS: Mapping[str, Callable[[Any], Sample]] = {
    "sensor_msgs/msg/JointState": _joint_state,
    "control_msgs/msg/DynamicJointState": _dynamic_joint_state,
    "franka_msgs/msg/FrankaRobotState": lambda message: _joint_state(message.measured_joint_state),
}
Stamped = tuple[tuple[int, int], Sample]
"""When a message was sampled and when it was recorded [ns], and what it says."""


def bag_table(asked: Asked) -> LogTable | None:
    """Return the topic of a bag with the arm's joints: that asked for, or the only one that fits.

    A bag is known by its content.
    """
    path, joint_names, topic = asked.path, asked.joint_names, asked.options.topic
    if not (asked.start.startswith(_BEGINNINGS) or (path / "metadata.yaml").is_file()):
        return None
    with _opened(path) as bag:
        known = {c.topic: c.msgtype for c in bag.connections if c.msgtype in _READERS}
        topics = sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections})
        listed = f"its topics: {', '.join(topics) or 'none'}"
        if topic is not None and topic not in known:
            raise InputError(f"{path} has no joint states in topic {topic!r}; {listed}")
        wanted = [topic] if topic else sorted(known)
        tables = {name: _topic(path, bag, name, joint_names) for name in wanted}
    found = {name: each for name, each in tables.items() if each is not None}
    if not found:
        raise InputError(f"{path} holds no joint states; {listed}")
    positions, torques = (
        [name for name in found if _has(found[name], joint_names, quantities)]
        for quantities in (QUANTITIES[:1], QUANTITIES[2:])
    )
    fitting = positions or list(found)
    measured = [name for name in fitting if name in torques] or fitting
    if len(measured) > 1:
        listed = ", ".join(f"{name} ({known[name]})" for name in measured)
        raise InputError(f"{path}: several topics could be the arm: {listed}; choose with --topic")
    chosen = measured[0]
    if chosen in positions and chosen not in torques:
        raise InputError(
            f"{path}: topic {chosen} has no effort of joint {joint_names[-1]}; without "
            "measured torque nothing can be identified: let the driver publish effort and record "
            "again"
        )
    return found[chosen]


def _has(topic: LogTable, joint_names: Sequence[str], quantities: Sequence[str]) -> bool:
    titles = set(topic.titles)
    return any({f"{joint} {q}" for joint in joint_names} <= titles for q in quantities)


def _topic(path: Path, bag: Any, topic: str, joint_names: Sequence[str]) -> LogTable | None:
    """Return a topic with time and a column per joint and quantity in its first messages."""
    connections = [c for c in bag.connections if c.topic == topic]
    first = list(islice(_messages(bag, connections), _LOOKED_AT))
    seen = dict.fromkeys(key for _, sample in first for key in sample)
    if not seen:
        return None
    # Where no header has a time stamp, the time of recording stands in.
    clock = 0 if any(stamps[0] for stamps, _ in first) else 1
    names = list(dict.fromkeys(joint for joint, _ in seen))
    spelling = dict(zip(names, renamed(names, joint_names)))
    titles = ("time", *(f"{spelling[joint]} {quantity}" for joint, quantity in seen))
    late = ", headers without time: when it was recorded" if clock else ""
    layout = f"ROS bag, topic {topic} ({connections[-1].msgtype}), joints by name{late}"
    read = partial(_blocks, path, topic, list(seen), clock, first[0][0][clock])
    return LogTable(path, layout, titles, read, word="message")


def _blocks(
    path: Path, topic: str, keys: Sequence[Key], clock: int, start: int, columns: Sequence[int]
) -> Iterator[Block]:
    """Yield the messages of a topic in their order, by one of their clocks from a start [ns]."""
    place = {key: k + 1 for k, key in enumerate(keys)}
    with _opened(path) as bag:
        connections = [c for c in bag.connections if c.topic == topic]
        total = max(1, sum(c.msgcount for c in connections))
        messages, done = _messages(bag, connections), 0
        while batch := list(islice(messages, table.BLOCK)):
            cells = np.full((len(batch), 1 + len(keys)), np.nan)
            for row, (stamps, sample) in zip(cells, batch):
                row[0] = 1e-9 * (stamps[clock] - start)
                known = [key for key in sample if key in place]
                row[[place[key] for key in known]] = [sample[key] for key in known]
            lines = np.arange(done, done + len(batch)) + 1
            done += len(batch)
            yield Block(lines, cells[:, list(columns)], done=done / total)


def _messages(bag: Any, connections: Sequence[Any]) -> Iterator[Stamped]:
    for connection, received, raw in bag.messages(connections=connections):
        message = bag.deserialize(raw, connection.msgtype)
        stamp = getattr(message, "measured_joint_state", message).header.stamp
        sampled = int(stamp.sec) * 10**9 + int(stamp.nanosec)
        yield (sampled, int(received)), _READERS[connection.msgtype](message)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yield a bag that is open within a block; what goes wrong in it is an InputError."""
    highlevel = library("rosbags.highlevel", "rosbag", WHAT)
    typesys = library("rosbags.typesys", "rosbag", WHAT)
    single = path.suffix in (".db3", ".mcap") and (path.parent / "metadata.yaml").is_file()
    bound_unpacking()
    with as_input_errors(path, WHAT):
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        for name, text in _DYNAMIC.items():
            store.register(typesys.get_types_from_msg(text, name))
        bag = highlevel.AnyReader([path.parent if single else path], default_typestore=store)
        with bag:
            yield bag


MOST_RATIO, ALWAYS = 100, 10**8
"""Recordings shrink to a tenth; a piece may unpack to 100 times its size, or to 100 MB."""
_BLOCK = 2**20


class TooMuchError(Exception):
    """A piece of a bag unpacks to more than the bound."""


def bound_unpacking() -> None:
    """Have ``rosbags`` unpack no more than the bound, in this process from now on."""
    import bz2

    import lz4.frame
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap as mcap

    two = {"bz2": Bounded(bz2).decompress, "lz4": Bounded(lz4.frame).decompress}
    getattr(ros1, "decompressors", {}).update(two)
    for module, name in ((ros1, "bz2"), (ros1, "lz4"), (mcap, "lz4")):
        setattr(module, f"{name}_decompress", two[name])
    for module, name in ((mcap, "zstd"), (ros2, "zstd"), (ros2, "zstandard")):
        library = getattr(module, name, None)
        if library is not None and not isinstance(library, Bounded):
            setattr(module, name, Bounded(library))
            if name == "zstandard":  # of the last rosbags for Python 3.9
                mcap.DECOMPRESSORS["zstd"] = Bounded(library).decompress


class Bounded:
    """A compression library, a module like ``bz2``, that reads within the bound."""

    def __init__(self, library: Any) -> None:
        self._library = library

    def __getattr__(self, name: str) -> Any:
        return getattr(self._library, name)

    def decompress(self, packed: bytes, _: int = 0) -> bytes:
        """Return the content of packed bytes, or raise TooMuchError."""
        content = BytesIO()
        self.copy_stream(BytesIO(packed), content)
        return content.getvalue()

    def ZstdDecompressor(self) -> Bounded:
        """Return what ``zstandard`` has its functions in."""
        return self

    def copy_stream(self, packed: Any, content: Any) -> None:
        """Write the content of a packed file to another, or raise TooMuchError."""
        with self.open(packed) as stream:
            while piece := stream.read(_BLOCK):
                content.write(piece)

    def open(self, file: Any, mode: str = "rb", **options: Any) -> Any:
        """Open a file as the library does; reading on beyond the bound raises TooMuchError."""
        stream = self._library.open(file, mode, **options)
        if mode != "rb" or not hasattr(file, "seek"):
            return stream
        size = file.seek(0, 2)
        file.seek(0)
        return _Stream(stream, max(ALWAYS, MOST_RATIO * size))


class _Stream:
    """What comes out of a packed stream, up to ``most`` bytes."""

    def __init__(self, stream: Any, most: int) -> None:
        self._stream, self._most, self._read = stream, most, 0

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def read(self, size: int) -> bytes:
        """Return the next bytes, at most ``size``."""
        piece: bytes = self._stream.read(size)
        self._read += len(piece)
        if self._read > self._most:
            raise TooMuchError(
                f"a piece of it unpacks to more than {self._most / 1e6:g} MB, far more than any "
                "recording would; record it again without compression"
            )
        return piece
