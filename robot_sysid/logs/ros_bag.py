"""ROS bags: ROS 2 (folder with .db3 or .mcap, or a single .mcap) and ROS 1 (.bag).

``ros_messages`` says which messages are read, ``ros_topics`` which topic where several fit. A joint
is identified by its name in each message: the order may change from message to message, several
publishers may share a topic, and a message may hold a gripper only, or a few of the arm's joints.
Time is that of the message's header, or where that is empty the time at which the message
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
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from itertools import chain, groupby, islice, product
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.joint_names import find_joint_match
from robot_sysid.logs.ros_messages import (
    DEFINITIONS,
    POSITION,
    READERS,
    TORQUE,
    Key,
    Sample,
    read_stamp,
)
from robot_sysid.logs.ros_topics import Topic, choose_topic
from robot_sysid.logs.table import (
    ALWAYS_ALLOWED,
    BLOCK,
    MAX_RATIO,
    Block,
    LogSource,
    LogTable,
    import_optional,
)
from robot_sysid.records import Array
from robot_sysid.records.file_access import refuse_special_file

_FIRST_MESSAGES = 200
"""Messages of a topic from which its joints are listed: a second or more, in which each publisher
of the topic has sent one."""
_COMPARED_MESSAGES = 20_000
"""Messages of topics that are compared: 20 s at 1 kHz."""

Message = tuple[tuple[int, int], Sample]
"""((time of the header, time of recording) [ns since 1970], sample)."""
StampedSample = tuple[int, Sample]
"""(time stamp in use [ns since 1970], sample)."""


def bag_table(source: LogSource) -> LogTable:
    """Return the topic of a bag with the arm's joints: the one of --topic, or the one that fits.

    InputError where no topic or those of two arms fit, or where the only one lacks torques.
    """
    path = source.path
    topic_option = source.options.topic
    with _open_bag(path) as bag:
        # Names of topics with joints.
        names = set()
        described = set()
        for connection in bag.connections:
            description = f"{connection.topic} ({connection.msgtype})"
            # Bags of .db3 before ROS 2 Iron do not define their messages' types.
            is_defined = connection.msgtype in bag.typestore.fielddefs
            if connection.msgtype in READERS and is_defined:
                names.add(connection.topic)
            elif connection.msgtype in READERS:
                description += (
                    " without its definition: record it with ros2 bag record -s mcap"
                )
            described.add(description)
        its_topics = f"its topics: {', '.join(sorted(described)) or 'none'}"
        if topic_option is not None and topic_option not in names:
            fault = f"{path} has no joint states in topic {topic_option!r}"
            raise InputError(f"{fault}; {its_topics}")
        read_names = [topic_option] if topic_option else sorted(names)
        read_topics = [
            _read_topic(path, bag, name, source.joint_names) for name in read_names
        ]
        topics = [topic for topic in read_topics if topic is not None]
        if not topics:
            raise InputError(f"{path} holds no joint states; {its_topics}")
        topic, note = choose_topic(path, topics)
    return replace(topic.table, notes=(note,) if note else ())


def _connections(bag: Any, topic: str) -> list[Any]:
    """Return the connections of a bag through which a topic was recorded, one per publisher."""
    return [c for c in bag.connections if c.topic == topic]


def _read_topic(
    path: Path, bag: Any, name: str, joint_names: Sequence[str]
) -> Topic | None:
    """Return a topic with its table, which has time and a column per joint and quantity.

    Joints and quantities are those of its first messages; None where these hold none.
    """
    messages = list(islice(_read_messages(bag, name), _FIRST_MESSAGES))
    # A dictionary keeps the keys in the order in which they come first.
    sent: dict[Key, float] = {}
    for _, sample in messages:
        sent.update(sample)
    if not sent:
        return None
    recorded_joints = [joint for joint, _ in sent]
    joint_match = find_joint_match(recorded_joints, joint_names)
    # Without a model, all joints count.
    arm_joints = [] if joint_names else sorted(set(recorded_joints))
    if joint_match is not None:
        arm_joints = list(joint_match.model_names)
    has_effort = False
    for _, sample in messages:
        efforts = [sample.get(key, 0.0) for key in product(arm_joints, TORQUE)]
        has_effort |= any(abs(effort) > 0.0 for effort in efforts)
    pattern = MessagePattern.of(messages, arm_joints)
    keys = (*sent, *pattern.time_keys)
    titles = ("time", *map(" ".join, keys))
    connections = _connections(bag, name)
    message_type = connections[0].msgtype
    layout = f"ROS bag, topic {name} ({message_type}), joints by name"
    layout += pattern.description
    if pattern.stamp_index:
        layout += ", headers without time: when it was recorded"
    blocks = partial(_blocks, path, name, keys, pattern)
    return Topic(
        name,
        message_type,
        LogTable(path, layout, titles, blocks, row_noun="message"),
        n_messages=sum(connection.msgcount for connection in connections),
        has_positions=_has_all(sent, arm_joints, POSITION),
        has_torques=_has_all(sent, arm_joints, TORQUE),
        is_zero=not has_effort,
        read_motion=partial(_read_motion, bag, name, arm_joints, pattern.stamp_index),
    )


def _has_all(
    keys: Container[Key], joints: Sequence[str], quantities: Sequence[str]
) -> bool:
    """Return whether one of the quantities is there for every joint, of at least one."""
    for quantity in quantities:
        if joints and all((joint, quantity) in keys for joint in joints):
            return True
    return False


def _read_motion(
    bag: Any, topic: str, joints: Sequence[str], stamp_index: int
) -> tuple[Array, Array]:
    """Return time stamps (K,) [s] and positions (K, n) of a topic's first messages with all joints.

    ``stamp_index``: of the stamp of a ``Message`` in use.
    """
    time = []
    positions = []
    for stamps, sample in islice(_read_messages(bag, topic), _COMPARED_MESSAGES):
        row = [sample.get((joint, "position"), np.nan) for joint in joints]
        if not np.isnan(row).any():
            time.append(1e-9 * stamps[stamp_index])
            positions.append(row)
    return np.array(time), np.array(positions)


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
        stamps = (read_stamp(message), int(received))
        yield stamps, READERS[connection.msgtype](message)


@contextlib.contextmanager
def _open_bag(path: Path) -> Iterator[Any]:
    """Yield a bag that is open within a block.

    ``path``: of the bag, or of a part of a ROS 2 bag, which is then opened whole.
    """
    typesys = import_optional("rosbags.typesys", "rosbag")
    import_optional("rosbags.highlevel", "rosbag")  # the reader below needs it
    is_part = path.suffix in (".db3", ".mcap")
    has_metadata = (path.parent / "metadata.yaml").is_file()
    folder = path.parent if is_part and has_metadata else path
    for file in folder.iterdir() if folder.is_dir() else ():
        refuse_special_file(file, "give a bag whose parts are files")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
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
