"""ROS bags: ROS 2 (folder with .db3 or .mcap, or a single .mcap) and ROS 1 (.bag).

Read are sensor_msgs/JointState, control_msgs/DynamicJointState and Franka's FrankaRobotState. A
joint is identified by its name in each message: the order may change from message to message,
several publishers may share a topic, and a message may hold a gripper only, or a few of the arm's
joints. Time is that of the message's header, or where that is empty the time at which the message
was recorded. A message that comes late is sorted in. Where no message holds all joints of an arm,
those of one stamp are put together; where stamps differ, each joint keeps its own.

``rosbags`` unpacks each chunk, message or file completely: a few kilobytes may become the
computer's whole memory, or disk. Its public interface (``AnyReader``, ``typesys``) has no limit and
no hook for one: the unpackers are names in its private modules, bound when these are imported. So
``bounded_reader`` makes private copies of these modules and replaces the names there; the
``rosbags`` that others import does not change. The alternative, a limit on the memory of the
process, would not protect the disk and would work on Linux alone.
"""

from __future__ import annotations

import bz2
import contextlib
import functools
import heapq
import importlib.util
import os
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from itertools import chain, groupby, islice, product
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.table import (
    ALWAYS_ALLOWED,
    BLOCK,
    MAX_RATIO,
    Block,
    LogSource,
    LogTable,
    as_input_errors,
    import_optional,
    model_spelling,
)
from robot_sysid.records.file_access import refuse_special_file

FORM = "a ROS bag"
"""Name of the form in messages."""
POSITION = ("position",)
"""Names of positions in messages of a bag."""
TORQUE = ("effort", "current")
"""Names, in messages of a bag, of quantities that stand for torque."""
QUANTITIES = (*POSITION, "velocity", *TORQUE)
"""Names of all quantities that are read from messages of a bag."""
_FIRST_MESSAGES = 200
"""Messages of a topic from which its joints are listed: a second or more, in which each publisher
of the topic has sent one."""
_STATE = "sensor_msgs/msg/JointState"
_DYNAMIC = "control_msgs/msg/DynamicJointState"
_FRANKA = "franka_msgs/msg/FrankaRobotState"
# control_msgs is not among the types that rosbags defines.
_DEFINITIONS = {
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    _DYNAMIC: "std_msgs/Header header\nstring[] joint_names\n"
    "control_msgs/InterfaceValue[] interface_values\n",
}

Key = tuple[str, str]
"""Names of a joint and of a quantity."""
Sample = Mapping[Key, float]
"""The numbers of a message, in the units of the message."""
Message = tuple[tuple[int, int], Sample]
"""((time of the header, time of recording) [ns since 1970], sample)."""
StampedSample = tuple[int, Sample]
"""(time stamp in use [ns since 1970], sample)."""


def bag_table(source: LogSource) -> LogTable:
    """Return the topic of a bag with the arm's joints: the one of --topic, or the only one.

    InputError where no topic or several fit, or where the only one lacks torques.
    """
    path = source.path
    joints = source.joint_names
    topic = source.options.topic
    with _open_bag(path) as bag:
        # Topic with joint states to the type of its messages.
        types = {}
        topics = set()
        for connection in bag.connections:
            topics.add(f"{connection.topic} ({connection.msgtype})")
            if connection.msgtype in _READERS:
                types[connection.topic] = connection.msgtype
        its_topics = f"its topics: {', '.join(sorted(topics)) or 'none'}"
        if topic is not None and topic not in types:
            fault = f"{path} has no joint states in topic {topic!r}"
            raise InputError(f"{fault}; {its_topics}")
        tables = {}
        for name in [topic] if topic else sorted(types):
            table = _topic_table(path, bag, name, joints)
            if table is not None:
                tables[name] = table
    if not tables:
        raise InputError(f"{path} holds no joint states; {its_topics}")
    # (whether it has all positions, whether it has all torques).
    ranks = {}
    for name, table in tables.items():
        has_position = _has_all(table, joints, POSITION)
        ranks[name] = (has_position, _has_all(table, joints, TORQUE))
    best = max(ranks.values())
    names = [name for name in tables if ranks[name] == best]
    if best == (True, False) and len(names) == 1:
        fault = f"topic {names[0]} has no effort of joint {joints[-1]}"
        raise InputError(
            f"{path}: {fault}; let the driver publish effort and record again"
        )
    if len(names) > 1:
        listed = ", ".join(f"{name} ({types[name]})" for name in names)
        raise InputError(
            f"{path}: several topics could be the arm: {listed}; choose with --topic"
        )
    return tables[names[0]]


def _has_all(
    table: LogTable, joint_names: Sequence[str], quantities: Sequence[str]
) -> bool:
    """Return whether a topic's table has a column of one of the quantities for every joint."""
    for quantity in quantities:
        titles = {f"{joint} {quantity}" for joint in joint_names}
        if titles <= {*table.titles}:
            return True
    return False


def _connections(bag: Any, topic: str) -> list[Any]:
    """Return the connections of a bag through which a topic was recorded, one per publisher."""
    return [c for c in bag.connections if c.topic == topic]


def _topic_table(
    path: Path, bag: Any, topic: str, joint_names: Sequence[str]
) -> LogTable | None:
    """Return a topic as a table with time and a column per joint and quantity.

    Joints and quantities are those of its first messages; None where these hold none.
    """
    messages = list(islice(_read_messages(bag, topic), _FIRST_MESSAGES))
    # A dictionary keeps the keys in the order in which they come first.
    sent: dict[Key, float] = {}
    for _, sample in messages:
        sent.update(sample)
    if not sent:
        return None
    spelling = model_spelling([joint for joint, _ in sent], joint_names)
    arm_joints = [name for name in spelling if spelling[name] in joint_names]
    pattern = MessagePattern.of(messages, arm_joints)
    keys = (*sent, *pattern.time_keys)
    titles = ["time"]
    for joint, quantity in keys:
        titles.append(f"{spelling[joint]} {quantity}")
    message_type = _connections(bag, topic)[0].msgtype
    layout = f"ROS bag, topic {topic} ({message_type}), joints by name"
    layout += pattern.description
    if pattern.stamp_index:
        layout += ", headers without time: when it was recorded"
    blocks = partial(_blocks, path, topic, keys, pattern)
    return LogTable(path, layout, tuple(titles), blocks, row_noun="message")


def _blocks(
    path: Path,
    topic: str,
    keys: Sequence[Key],
    pattern: MessagePattern,
    columns: Sequence[int],
) -> Iterator[Block]:
    """Yield the samples of a topic in order of time, with the columns of these indices.

    Column 0 is time from the start [s], column k + 1 the number of ``keys[k]``.
    """
    with _open_bag(path) as bag:
        total = max(1, sum(c.msgcount for c in _connections(bag, topic)))
        samples = pattern.join(_read_messages(bag, topic))
        count = 0
        while batch := list(islice(samples, BLOCK)):
            cells = np.empty((len(batch), 1 + len(keys)))
            for row, (time, sample) in zip(cells, batch):
                row[0] = time
                row[1:] = [sample.get(key, np.nan) for key in keys]
            lines = np.arange(count, count + len(batch)) + 1
            count += len(batch)
            yield Block(lines, cells[:, list(columns)], share_read=count / total)


def _read_messages(bag: Any, topic: str) -> Iterator[Message]:
    """Yield the messages of a topic in the order in which they were recorded."""
    connections = _connections(bag, topic)
    for connection, received, raw in bag.messages(connections=connections):
        message = bag.deserialize(raw, connection.msgtype)
        # FrankaRobotState holds a JointState.
        message = getattr(message, "measured_joint_state", message)
        stamp = message.header.stamp
        sampled = int(stamp.sec) * 10**9 + int(stamp.nanosec)
        yield (sampled, int(received)), _READERS[connection.msgtype](message)


def _read_joint_state(message: Any) -> Sample:
    """Return the numbers of a sensor_msgs/JointState; empty lists were not measured."""
    sample: dict[Key, float] = {}
    for quantity in ("position", "velocity", "effort"):
        numbers = getattr(message, quantity)
        if len(numbers) == len(message.name):
            keys = product(message.name, [quantity])
            sample.update(zip(keys, numbers.tolist()))
    return sample


def _read_dynamic_joint_state(message: Any) -> Sample:
    """Return the numbers of a control_msgs/DynamicJointState."""
    sample = {}
    for joint, values in zip(message.joint_names, message.interface_values):
        for quantity, value in zip(values.interface_names, values.values):
            if quantity in QUANTITIES:
                sample[joint, quantity] = float(value)
    return sample


_READERS = {
    _STATE: _read_joint_state,
    _FRANKA: _read_joint_state,
    _DYNAMIC: _read_dynamic_joint_state,
}
"""Message type to the function that returns the numbers of a message."""


@contextlib.contextmanager
def _open_bag(path: Path) -> Iterator[Any]:
    """Yield a bag that is open within a block; what goes wrong in it is an InputError.

    ``path``: of the bag, or of a part of a ROS 2 bag, which is then opened whole.
    """
    typesys = import_optional("rosbags.typesys", "rosbag", FORM)
    import_optional("rosbags.highlevel", "rosbag", FORM)  # the reader below needs it
    is_part = path.suffix in (".db3", ".mcap")
    has_metadata = (path.parent / "metadata.yaml").is_file()
    folder = path.parent if is_part and has_metadata else path
    with as_input_errors(path, FORM):
        for file in folder.iterdir() if folder.is_dir() else ():
            refuse_special_file(file, "give a bag whose parts are files")
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        for name, text in _DEFINITIONS.items():
            store.register(typesys.get_types_from_msg(text, name))
        with bounded_reader().AnyReader([folder], default_typestore=store) as bag:
            yield bag


@functools.cache
def bounded_reader() -> ModuleType:
    """Return a copy of ``rosbags.highlevel.anyreader`` that unpacks within a bound.

    The modules that it uses are copied, too; in the copies, every name of an unpacker is bound to a
    ``BoundedUnpacker``.
    The copy is made once and cached; callers must not change it.
    """
    import lz4.frame

    mcap = _copy_module("rosbags.rosbag2.storage_mcap")
    ros2 = _copy_module("rosbags.rosbag2.reader")
    ros1 = _copy_module("rosbags.rosbag1.reader")
    reader = _copy_module("rosbags.highlevel.anyreader")
    # The last rosbags for Python 3.9 unpacks with another library, called zstandard.
    zstd = BoundedUnpacker(vars(mcap).get("zstd") or vars(mcap)["zstandard"])
    unpack_bz2 = BoundedUnpacker(bz2).decompress
    unpack_lz4 = BoundedUnpacker(lz4.frame).decompress
    unpackers: dict[str, Any] = {
        "bz2_decompress": unpack_bz2,
        "lz4_decompress": unpack_lz4,
        "zstd": zstd,
        "zstandard": zstd,
    }
    for module, (name, unpacker) in product((mcap, ros2, ros1), unpackers.items()):
        if hasattr(module, name):
            setattr(module, name, unpacker)
    mcap.DECOMPRESSORS.update(lz4=unpack_lz4, zstd=zstd.decompress)
    # Not every release has these tables of unpackers and of classes.
    vars(ros1).get("decompressors", {}).update(bz2=unpack_bz2, lz4=unpack_lz4)
    for member in vars(ros2).values():
        plugins = getattr(member, "STORAGE_PLUGINS", {})
        for name, plugin in dict(plugins).items():
            plugins[name] = getattr(mcap, plugin.__name__, plugin)
    vars(reader).update(Reader1=ros1.Reader, Reader2=ros2.Reader)
    return reader


def _copy_module(name: str) -> Any:
    """Return a private copy of a module, which ``import`` does not find."""
    spec = importlib.util.find_spec(name)
    if spec is None or spec.loader is None:
        raise ImportError(name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class BoundedUnpacker:
    """Substitute for a compression library, a module such as ``bz2``, that unpacks within a bound.

    Packed bytes may unpack to ``table.MAX_RATIO`` times their size, or to ALWAYS_ALLOWED bytes.
    """

    def __init__(self, library: Any) -> None:
        self._library = library

    def ZstdDecompressor(self) -> BoundedUnpacker:
        """Return this object: ``zstandard`` has its functions in a class of this name."""
        return self

    def decompress(self, packed: bytes, _: int = 0) -> bytes:
        """Return the content of packed bytes, or raise ValueError; a size stated too is ignored."""
        content = BytesIO()
        self.copy_stream(BytesIO(packed), content)
        return content.getvalue()

    def copy_stream(self, packed: Any, content: Any) -> None:
        """Write the content of a packed file to another, or raise ValueError."""
        with self.open(packed) as stream:
            shutil.copyfileobj(stream, content)

    @contextlib.contextmanager
    def open(self, file: Any, mode: str = "rb") -> Iterator[Any]:
        """Yield a packed file's content; reading on beyond the bound raises ValueError."""
        packed_size = file.seek(0, os.SEEK_END)
        bound = max(ALWAYS_ALLOWED, MAX_RATIO * packed_size)
        file.seek(0)
        unpacked = 0

        def read(size: int) -> bytes:
            """Return at most ``size`` unpacked bytes, or raise ValueError beyond the bound."""
            nonlocal unpacked
            content: bytes = stream.read(size)
            unpacked += len(content)
            if unpacked > bound:
                fault = f"a piece of it unpacks to more than {bound / 1e6:g} MB"
                raise ValueError(f"{fault}; record it again without compression")
            return content

        with self._library.open(file, mode) as stream:
            yield SimpleNamespace(read=read)


_QUEUE = 100
"""Largest number of messages recorded before an older one that are reordered: half a second of a
log at 200 Hz."""
_MAX_LATE_RUN = 3
"""Number of late messages in a row above which a clock was set back, or another recording begins:
messages are not reordered then, and the log is refused for times that run backwards."""
_MAX_AGE = 50_000_000
"""Largest age of a joint's sample in a row [ns]; half of the difference that ``checks`` refuses as
another clock."""


@dataclass(frozen=True)
class MessagePattern:
    """How an arm's joints come in the messages of a topic.

    Attributes:
        groups: joints that share a message, the rarest message last; () where all come in one.
        has_own_times: whether the groups are sampled at different times.
        stamp_index: index of the stamp of a ``Message`` in use: 0 header, 1 recording.
        start: stamp at which time is zero [ns since 1970].
    """

    groups: tuple[frozenset[str], ...]
    has_own_times: bool
    stamp_index: int
    start: int

    @classmethod
    def of(cls, messages: Sequence[Message], joints: Sequence[str]) -> MessagePattern:
        """Return the pattern of a topic's first messages, for these joints of the arm.

        There are groups only where every joint is in exactly one of several. Groups have times of
        their own where all share less than half of the stamps of the rarest group.
        """
        # Where no header has a time stamp, the time of recording stands in.
        stamp_index = 0 if any(stamps[0] for stamps, _ in messages) else 1
        # The joints in a message to the stamps of all messages with these joints.
        times: dict[frozenset[str], list[int]] = defaultdict(list)
        for stamps, sample in messages:
            group = frozenset(j for j in joints if (j, "position") in sample)
            times[group].append(stamps[stamp_index])
        start = min(chain.from_iterable(times.values()))
        times.pop(frozenset(), None)
        is_split = len(times) > 1 and sorted(chain(*times)) == sorted(joints)
        if not is_split:
            return cls(
                groups=(), has_own_times=False, stamp_index=stamp_index, start=start
            )
        groups = tuple(sorted(times, key=lambda group: -len(times[group])))
        common = set.intersection(*map(set, times.values()))
        has_own_times = 2 * len(common) < len(times[groups[-1]])
        return cls(groups, has_own_times, stamp_index, start)

    @property
    def time_keys(self) -> tuple[Key, ...]:
        """The keys (joint, "time") of the joints' own time stamps that ``join`` adds, or ()."""
        joints = sorted(chain(*self.groups)) if self.has_own_times else []
        return tuple(product(joints, ["time"]))

    @property
    def description(self) -> str:
        """The groups in words, for the log's layout; "" where all joints come in one message."""
        if not self.groups:
            return ""
        manner = "put together by their stamps"
        if self.has_own_times:
            manner = "each at its own time"
        return f", joints of {len(self.groups)} kinds of message {manner}"

    def join(self, messages: Iterator[Message]) -> Iterator[tuple[float, Sample]]:
        """Yield (time from the start [s], sample of all joints) from an arm's messages, in order of
        time.
        """
        ordered = sort_late(messages) if self.stamp_index == 0 else messages
        samples: Iterator[StampedSample]
        samples = ((stamps[self.stamp_index], sample) for stamps, sample in ordered)
        if self.has_own_times:
            samples = self._join_newest(samples)
        elif self.groups:
            samples = _join_equal_stamps(samples)
        for stamp, sample in samples:
            yield 1e-9 * (stamp - self.start), sample

    def _join_newest(self, samples: Iterator[StampedSample]) -> Iterator[StampedSample]:
        """Yield the newest samples of all groups as one, at each message of the rarest group.

        Each joint's time stamp from the start [s] is added as its quantity "time".
        """
        newest = {}
        for stamp, sample in samples:
            sent = {joint for joint, quantity in sample if quantity == "position"}
            group = next(filter(sent.issuperset, self.groups), None)
            if group is None:
                continue
            newest[group] = stamp, sample
            oldest = min(group_stamp for group_stamp, _ in newest.values())
            if len(newest) < len(self.groups):
                oldest = min(oldest, 0)  # of a group that has sent nothing
            if group == self.groups[-1] and stamp - oldest <= _MAX_AGE:
                row: dict[Key, float] = {}
                for joints, (joint_stamp, joint_sample) in newest.items():
                    time = 1e-9 * (joint_stamp - self.start)
                    row.update(joint_sample)
                    row.update(dict.fromkeys(product(joints, ["time"]), time))
                yield stamp, row


def sort_late(messages: Iterator[Message]) -> Iterator[Message]:
    """Yield messages in the order of their headers' stamps; equal stamps in the order of recording.

    From the first run of more than _MAX_LATE_RUN late messages of a publisher on, messages are
    yielded in the order of recording. Publishers are told apart by the joints in their messages.
    """
    # Heap of (stamp, number in the order of recording, message).
    queue: list[tuple[int, int, Message]] = []
    # Newest stamp of each publisher, and how many late messages in a row it has sent.
    newest: dict[frozenset[str], int] = {}
    late_run: Counter[frozenset[str]] = Counter()
    for number, message in enumerate(messages):
        (stamp, _), sample = message
        publisher = frozenset(joint for joint, _ in sample)
        newest[publisher] = max(stamp, newest.get(publisher, stamp))
        is_late = stamp < newest[publisher]
        late_run[publisher] = late_run[publisher] + 1 if is_late else 0
        if late_run[publisher] > _MAX_LATE_RUN:
            # What is queued comes first, then this message and all others unsorted.
            messages = chain([message], messages)
            break
        heapq.heappush(queue, (stamp, number, message))
        if len(queue) > _QUEUE:
            yield heapq.heappop(queue)[2]
    yield from (message for _, _, message in sorted(queue))
    yield from messages


def _join_equal_stamps(samples: Iterator[StampedSample]) -> Iterator[StampedSample]:
    """Yield one sample for all consecutive ones of an equal stamp."""
    for stamp, group in groupby(samples, key=lambda stamped: stamped[0]):
        joined: dict[Key, float] = {}
        for _, sample in group:
            joined.update(sample)
        yield stamp, joined
