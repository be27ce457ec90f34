"""ROS bags: ROS 2 (folder with .db3 or .mcap, or a single .mcap) and ROS 1 (.bag).

Read are sensor_msgs/JointState, control_msgs/DynamicJointState and Franka's FrankaRobotState. A
joint is found by its name in each message: the order may change from message to message, several
publishers may share a topic, and a message may hold a gripper only, or some of the arm's joints.
Time is that of the message's header, or where that is empty the time at which the message was
recorded. A message that comes late takes its place. Where no message holds all joints of an arm,
those of one stamp are put together; where stamps differ, each joint keeps its own.

``rosbags`` unpacks each chunk, message or file whole, whatever comes out: a few kilobytes may
become the computer's whole memory, or disk. So a private copy of its readers, with a bound on what
they unpack, reads here; the ``rosbags`` that others import stays as it is.
"""

from __future__ import annotations

import bz2
import contextlib
import functools
import heapq
import importlib.util
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from itertools import chain, groupby, islice
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs import table
from robot_sysid.logs.table import (
    Asked,
    Block,
    LogTable,
    as_input_errors,
    library,
    renamed,
)
from robot_sysid.special_files import refuse_special_file

WHAT = "a ROS bag"
POSITION = ("position",)
TORQUE = ("effort", "current")
QUANTITIES = (*POSITION, "velocity", *TORQUE)
# So many messages of a topic are looked at to find out which joints it has: a second or more, in
# which each publisher of the topic has spoken.
_LOOKED_AT = 200
_STATE = "sensor_msgs/msg/JointState"
_DYNAMIC = "control_msgs/msg/DynamicJointState"
_FRANKA = "franka_msgs/msg/FrankaRobotState"
# control_msgs is not among the types that the reader knows by itself.
_DEFINED = {
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    _DYNAMIC: "std_msgs/Header header\nstring[] joint_names\n"
    "control_msgs/InterfaceValue[] interface_values\n",
}


def bag_table(asked: Asked) -> LogTable:
    """Return the topic of a bag with the arm's joints: the one asked for, or the only one."""
    path = asked.path
    joints = asked.joint_names
    topic = asked.options.topic
    with _opened(path) as bag:
        known = {c.topic: c.msgtype for c in bag.connections if c.msgtype in _READ}
        topics = sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections})
        listed = f"its topics: {', '.join(topics) or 'none'}"
        if topic is not None and topic not in known:
            raise InputError(f"{path} has no joint states in topic {topic!r}; {listed}")
        wanted = [topic] if topic else sorted(known)
        tables = {name: _topic(path, bag, name, joints) for name in wanted}
    found = {name: each for name, each in tables.items() if each is not None}
    if not found:
        raise InputError(f"{path} holds no joint states; {listed}")
    positions = [name for name in found if _has(found[name], joints, POSITION)]
    fitting = positions or list(found)
    measured = [name for name in fitting if _has(found[name], joints, TORQUE)]
    if positions and not measured and len(fitting) == 1:
        fault = f"topic {fitting[0]} has no effort of joint {joints[-1]}"
        raise InputError(
            f"{path}: {fault}; let the driver publish effort and record again"
        )
    chosen = measured or fitting
    if len(chosen) > 1:
        listed = ", ".join(f"{name} ({known[name]})" for name in chosen)
        raise InputError(
            f"{path}: several topics could be the arm: {listed}; choose with --topic"
        )
    return found[chosen[0]]


def _has(
    topic: LogTable, joint_names: Sequence[str], quantities: Sequence[str]
) -> bool:
    return any(
        {f"{joint} {q}" for joint in joint_names} <= {*topic.titles} for q in quantities
    )


def _topic(
    path: Path, bag: Any, topic: str, joint_names: Sequence[str]
) -> LogTable | None:
    """Return a topic with time and a column per joint and quantity in its first messages."""
    first = list(islice(_messages(bag, topic), _LOOKED_AT))
    seen = dict.fromkeys(key for _, sample in first for key in sample)
    if not seen:
        return None
    names = list(dict.fromkeys(joint for joint, _ in seen))
    spelling = dict(zip(names, renamed(names, joint_names)))
    arm = Arm.of(first, [name for name in names if spelling[name] in joint_names])
    keys = (*seen, *arm.time_keys)
    titles = ("time", *(f"{spelling[joint]} {quantity}" for joint, quantity in keys))
    late = ", headers without time: when it was recorded" if arm.clock else ""
    kind = next(c.msgtype for c in bag.connections if c.topic == topic)
    layout = f"ROS bag, topic {topic} ({kind}), joints by name{arm.said}{late}"
    return LogTable(
        path, layout, titles, partial(_blocks, path, topic, keys, arm), word="message"
    )


def _blocks(
    path: Path, topic: str, keys: Sequence[Key], arm: Arm, columns: Sequence[int]
) -> Iterator[Block]:
    """Yield the samples of a topic in their order."""
    place = {key: k + 1 for k, key in enumerate(keys)}
    with _opened(path) as bag:
        total = max(1, sum(c.msgcount for c in bag.connections if c.topic == topic))
        samples = arm.samples(_messages(bag, topic))
        done = 0
        while batch := list(islice(samples, table.BLOCK)):
            cells = np.full((len(batch), 1 + len(keys)), np.nan)
            for row, (time, sample) in zip(cells, batch):
                row[0] = time
                known = [key for key in sample if key in place]
                row[[place[key] for key in known]] = [sample[key] for key in known]
            lines = np.arange(done, done + len(batch)) + 1
            done += len(batch)
            yield Block(lines, cells[:, list(columns)], done=done / total)


def _messages(bag: Any, topic: str) -> Iterator[Stamped]:
    connections = [c for c in bag.connections if c.topic == topic]
    for connection, received, raw in bag.messages(connections=connections):
        message = bag.deserialize(raw, connection.msgtype)
        message = getattr(message, "measured_joint_state", message)
        stamp = message.header.stamp
        sampled = int(stamp.sec) * 10**9 + int(stamp.nanosec)
        yield (sampled, int(received)), _READ[connection.msgtype](message)


def _joint_state(message: Any) -> Sample:
    """Return the numbers of a sensor_msgs/JointState; lists that are empty are not sent."""
    values = {}
    for quantity in QUANTITIES[:3]:
        numbers = getattr(message, quantity)
        if len(numbers) == len(message.name):
            values.update(
                {(n, quantity): v for n, v in zip(message.name, numbers.tolist())}
            )
    return values


def _dynamic_joint_state(message: Any) -> Sample:
    return {
        (joint, interface): float(value)
        for joint, values in zip(message.joint_names, message.interface_values)
        for interface, value in zip(values.interface_names, values.values)
        if interface in QUANTITIES
    }


_READ = {_STATE: _joint_state, _FRANKA: _joint_state, _DYNAMIC: _dynamic_joint_state}


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yield a bag that is open within a block; what goes wrong in it is an InputError."""
    typesys = library("rosbags.typesys", "rosbag", WHAT)
    library("rosbags.highlevel", "rosbag", WHAT)
    single = (
        path.suffix in (".db3", ".mcap") and (path.parent / "metadata.yaml").is_file()
    )
    for part in path.iterdir() if path.is_dir() else ():
        refuse_special_file(part, "give a bag whose parts are files")
    with as_input_errors(path, WHAT):
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        for name, text in _DEFINED.items():
            store.register(typesys.get_types_from_msg(text, name))
        reader = bounded_reader().AnyReader
        with reader([path.parent if single else path], default_typestore=store) as bag:
            yield bag


@functools.cache
def bounded_reader() -> ModuleType:
    """Return a copy of ``rosbags.highlevel.anyreader`` that unpacks no more than the bound."""
    import lz4.frame

    mcap = _copy("rosbags.rosbag2.storage_mcap")
    two = _copy("rosbags.rosbag2.reader")
    one = _copy("rosbags.rosbag1.reader")
    reader = _copy("rosbags.highlevel.anyreader")
    # The last rosbags for Python 3.9 unpacks with another library, called zstandard.
    zstd = Bounded(vars(mcap).get("zstd") or vars(mcap)["zstandard"])
    unpackers = {"bz2": Bounded(bz2).decompress, "lz4": Bounded(lz4.frame).decompress}
    for module in (mcap, two, one):
        names: dict[str, Any] = {
            f"{name}_decompress": unpackers[name] for name in unpackers
        }
        names.update(zstd=zstd, zstandard=zstd)
        vars(module).update(
            {n: bounded for n, bounded in names.items() if n in vars(module)}
        )
    mcap.DECOMPRESSORS.update(lz4=unpackers["lz4"], zstd=zstd.decompress)
    vars(one).get("decompressors", {}).update(unpackers)
    for each in vars(two).values():
        plugins = getattr(each, "STORAGE_PLUGINS", {})
        for name, kind in dict(plugins).items():
            plugins[name] = getattr(mcap, kind.__name__, kind)
    vars(reader).update(Reader1=one.Reader, Reader2=two.Reader)
    return reader


def _copy(name: str) -> Any:
    """Return a module once more, beside the one that everybody imports."""
    spec = importlib.util.find_spec(name)
    if spec is None or spec.loader is None:
        raise ImportError(name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Bounded:
    """A compression library, a module like ``bz2``, that unpacks within the bound."""

    def __init__(self, library: Any) -> None:
        self._library = library

    def ZstdDecompressor(self) -> Bounded:
        """Return what ``zstandard`` has its functions in."""
        return self

    def decompress(self, packed: bytes, _: int = 0) -> bytes:
        """Return the content of packed bytes, or raise ValueError."""
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
        most = max(table.ALWAYS, table.MOST_RATIO * file.seek(0, 2))
        file.seek(0)
        seen = 0

        def read(size: int) -> bytes:
            nonlocal seen
            piece: bytes = stream.read(size)
            seen += len(piece)
            if seen > most:
                fault = f"a piece of it unpacks to more than {most / 1e6:g} MB"
                raise ValueError(f"{fault}; record it again without compression")
            return piece

        with self._library.open(file, mode) as stream:
            yield SimpleNamespace(read=read)


Key = tuple[str, str]
"""Joint and quantity."""
Sample = Mapping[Key, float]
Stamped = tuple[tuple[int, int], Sample]
"""When a message was sampled and when it was recorded [ns], and what it says."""
_WAITING = 100
"""So many messages may overtake a late one: half a second of a log at 200 Hz."""
_LATE_IN_A_ROW = 3
"""More messages in a row from before the newest are a clock that was set back, or another
recording: they stay where they are, and the log is refused for them."""
_STALE = 50_000_000
"""A joint's sample is put into a row up to so long after it was taken [ns]; half of what is
refused as another clock (``logs.checks``)."""


@dataclass(frozen=True)
class Arm:
    """How an arm's joints come in messages.

    Attributes:
        parts: joints that share a message, the rarest last; nothing where all come in one.
        own_time: whether the parts are sampled at times of their own.
        clock: which of a message's two stamps counts.
        start: stamp from which time counts [ns].
    """

    parts: tuple[frozenset[str], ...]
    own_time: bool
    clock: int
    start: int

    @classmethod
    def of(cls, first: Sequence[Stamped], joints: Sequence[str]) -> Arm:
        """Return it of a recording's first messages."""
        # Where no header has a time stamp, the time of recording stands in.
        clock = 0 if any(stamps[0] for stamps, _ in first) else 1
        stamps: dict[frozenset[str], list[int]] = {}
        for each, sample in first:
            part = frozenset(joint for joint in joints if (joint, "position") in sample)
            stamps.setdefault(part, []).append(each[clock])
        stamps.pop(frozenset(), None)
        is_split = len(stamps) > 1 and sorted(
            j for part in stamps for j in part
        ) == sorted(joints)
        parts = tuple(sorted(stamps, key=lambda p: -len(stamps[p]))) if is_split else ()
        common = (
            set.intersection(*(set(stamps[part]) for part in parts)) if parts else set()
        )
        own_time = is_split and 2 * len(common) < len(stamps[parts[-1]])
        return cls(parts, own_time, clock, min(each[clock] for each, _ in first))

    @property
    def time_keys(self) -> tuple[Key, ...]:
        """The joints' own time stamps that ``samples`` adds."""
        joints = sorted(joint for part in self.parts for joint in part)
        return tuple((joint, "time") for joint in joints if self.own_time)

    @property
    def said(self) -> str:
        """How its joints come, in words; "" for all in one message."""
        how = (
            "each at its own time" if self.own_time else "put together by their stamps"
        )
        return (
            f", joints of {len(self.parts)} kinds of message {how}"
            if self.parts
            else ""
        )

    def samples(self, messages: Iterator[Stamped]) -> Iterator[tuple[float, Sample]]:
        """Yield time from the start [s] and sample of an arm's messages, in order."""
        ordered = in_order(messages) if self.clock == 0 else messages
        stamped: Iterator[tuple[int, Sample]]
        stamped = ((stamps[self.clock], sample) for stamps, sample in ordered)
        if self.parts:
            stamped = self._latest(stamped) if self.own_time else _of_one_stamp(stamped)
        for stamp, sample in stamped:
            yield 1e-9 * (stamp - self.start), sample

    def _latest(
        self, stamped: Iterator[tuple[int, Sample]]
    ) -> Iterator[tuple[int, Sample]]:
        """Yield the newest of all joints at each message of the rarest part."""
        newest: dict[frozenset[str], tuple[int, Sample]] = {}
        for stamp, sample in stamped:
            part = next(
                (p for p in self.parts if all((j, "position") in sample for j in p)),
                None,
            )
            if part is None:
                continue
            newest[part] = stamp, sample
            fresh = all(
                stamp - newest.get(each, (0, {}))[0] <= _STALE for each in self.parts
            )
            if part == self.parts[-1] and fresh:
                row = {
                    key: value
                    for _, each in newest.values()
                    for key, value in each.items()
                }
                for each, (taken, _) in newest.items():
                    row.update(
                        {(joint, "time"): 1e-9 * (taken - self.start) for joint in each}
                    )
                yield stamp, row


def in_order(messages: Iterator[Stamped]) -> Iterator[Stamped]:
    """Yield messages by the stamps of their headers, those of an equal one as recorded."""
    waiting: list[tuple[int, int, Stamped]] = []
    newest: dict[frozenset[str], int] = {}
    late: Counter[frozenset[str]] = Counter()
    for number, each in enumerate(messages):
        (stamp, _), sample = each
        publisher = frozenset(joint for joint, _ in sample)
        is_late = stamp < newest.get(publisher, stamp)
        late[publisher] = (late[publisher] + 1) * is_late
        newest[publisher] = max(stamp, newest.get(publisher, stamp))
        if late[publisher] > _LATE_IN_A_ROW:
            messages = chain([each], messages)
            break
        heapq.heappush(waiting, (stamp, number, each))
        if len(waiting) > _WAITING:
            yield heapq.heappop(waiting)[2]
    yield from (old for _, _, old in sorted(waiting))
    yield from messages


def _of_one_stamp(
    stamped: Iterator[tuple[int, Sample]],
) -> Iterator[tuple[int, Sample]]:
    for stamp, group in groupby(stamped, key=lambda each: each[0]):
        yield (
            stamp,
            {key: value for _, sample in group for key, value in sample.items()},
        )
