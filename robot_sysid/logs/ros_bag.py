"""ROS bags: ROS 2 (folder with .db3 or .mcap, or a single .mcap) and ROS 1 (.bag).

``ros_messages`` says which messages are read. A joint is identified by its name in each message:
the order may change from message to message, several publishers may share a topic, and a message
may hold a gripper only, or a few of the arm's joints. Time is that of the message's header, or
where that is empty the time at which the message was recorded.

Drivers publish one arm more than once: ros2_control's broadcaster in /joint_states and
/dynamic_joint_states, Franka's launch file at 1 kHz and once more, with the fingers, at 30 Hz. The
topic with torques and with the most samples is read. Topics whose names are those of two arms are
not chosen from. Where no topic of joints has torques, an array that is called so, with a number per
joint, has them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.logs.halves import Half, join_pair
from robot_sysid.logs.joint_names import (
    are_opposite_sides,
    match_joint_names,
    split_name,
)
from robot_sysid.logs.ros_messages import (
    DEFINITIONS,
    READERS,
    TORQUE,
    Key,
    Readers,
    Sample,
    read_array,
    read_frame,
    read_stamp,
)
from robot_sysid.logs.states import (
    MOST_FRAMES,
    Publisher,
    Rank,
    Sender,
    choose_sender,
    without_frame,
)
from robot_sysid.logs.table import (
    LATER,
    NANOSECOND,
    ROWS,
    Chunk,
    LogTable,
    chunk_blocks,
    import_optional,
    make_table,
    select_columns,
)
from robot_sysid.logs.titles import read_title
from robot_sysid.records import Column
from robot_sysid.records.file_access import refuse_special_file
from robot_sysid.wording import option_name

FIRST_MESSAGES = 200
"""Messages of a topic that show what it holds: a second or more, in which each of its publishers
has sent one."""
MORE_MESSAGES = 2000
"""Messages that show which of several publishers has torques: an arm may be switched on late."""
Message = tuple[int, Sample, Publisher]
"""(time of the header, or else of recording [ns since 1970], sample, who sent it)."""


POSITIONS_ALONE = True, False, False
"""The rank of a topic without torques."""
TORQUES_ALONE = False, True, True
"""The rank of a topic without positions."""
# Words in the names of topics of an arm by which another one is led.
_LEADERS = frozenset({"leader", "master"})


Arrays = Mapping[str, str]
"""Description of a topic with an array of numbers to its name, "" where it cannot be read."""


@dataclass(frozen=True)
class Topic:
    """A topic that holds joints.

    Attributes:
        name: of the topic.
        message_type: of its messages.
        table: the topic as a table.
        n_messages: number of its messages.
        rank: whether it has positions of all joints of the arm, torques of all, and torques other
            than zero.
    """

    name: str
    message_type: str
    table: LogTable
    n_messages: int
    rank: tuple[bool, bool, bool]

    @property
    def has_torque_alone(self) -> bool:
        """Whether it has measured torques of the arm's joints, and no positions."""
        return self.rank == TORQUES_ALONE and not self.is_commanded

    @property
    def is_commanded(self) -> bool:
        """Whether its name marks it as commands or references, as in /desired_joint_states.

        So does the name of an arm that leads the other one, which moves almost alike.
        """
        title = read_title(self.name)
        return title.is_commanded or bool(_LEADERS & {*title.tokens})


def choose_topic(
    path: Path, topics: Sequence[Topic], find_arrays: Callable[[], Arrays] = dict
) -> tuple[Topic, str]:
    """Return the topic to read, and a sentence on the others that hold the arm; "" for none.

    Args:
        path: of the bag.
        topics: that hold joints.
        find_arrays: returns descriptions of other topics, in which torques may be, each with the
            topic's name if it can be read; "" if not.

    Raises:
        InputError: topics of two arms fit, or the only one lacks torques.
    """
    best = max(topic.rank for topic in topics)
    fitting = [topic for topic in topics if topic.rank == best]
    measured = [topic for topic in fitting if not topic.is_commanded]
    types = list(READERS)
    topic_read, *rivals = sorted(
        measured or fitting,
        key=lambda t: (-t.n_messages, types.index(t.message_type), t.name),
    )
    with_torque = [t for t in topics if t.has_torque_alone]
    # An effort of zero says no more than none where another topic has torques.
    if (best == POSITIONS_ALONE and not rivals) or (with_torque and not best[2]):
        raise _lacking_torque(path, topic_read, with_torque, find_arrays)
    if any(_is_of_another_arm(topic_read.name, rival.name) for rival in rivals):
        fitting = [topic_read, *rivals]
        listed = ", ".join(f"{topic.name} ({topic.message_type})" for topic in fitting)
        raise InputError(
            f"{path}: several topics could be the arm: {listed}; choose with "
            f"{option_name('topic')}",
            options=[("--topic", topic.name) for topic in fitting],
        )
    note = ""
    if rivals:
        listed = ", ".join(f"{topic.name} ({topic.n_messages})" for topic in rivals)
        note = (
            f"log topic: {topic_read.name} with {topic_read.n_messages} samples is read, not "
            f"{listed}; choose with {option_name('topic')}"
        )
    return topic_read, note


def _lacking_torque(
    path: Path,
    topic: Topic,
    with_torque: Sequence[Topic],
    find_arrays: Callable[[], Arrays],
) -> InputError:
    """Return the error for a topic of positions, with the topics in which torques may be."""
    others = {
        f"{t.name} ({t.message_type}, {t.n_messages} messages)": t.name
        for t in with_torque
    }
    if topic.rank == POSITIONS_ALONE:
        others.update(find_arrays())
    fault = f"{path}: topic {topic.name} has no effort of the arm's joints"
    if topic.rank[1]:
        fault += " but zero"
    if not others:
        return InputError(f"{fault}; let the driver publish effort and record again")
    fault += f"; torques may be in {', '.join(others)}"
    names = [name for name in others.values() if name]
    if names:
        remedy = f"choose theirs with {option_name('topic')}, to be joined by time"
        return InputError(f"{fault}: {remedy}", [("--topic", name) for name in names])
    return InputError(
        f"{fault}: write times and torques of the joints into a table, those of positions into "
        "another one, and give both"
    )


def _is_of_another_arm(first: str, second: str) -> bool:
    """Return whether the names of two topics are those of two arms.

    So are those in namespaces of which none is in the other, and /left_joint_states and
    /right_joint_states. /joint_states is no other arm than /franka/joint_states.
    """
    namespaces = [f"{name.rpartition('/')[0]}/" for name in (first, second)]
    outer, inner = sorted(namespaces, key=len)
    are_sides = are_opposite_sides({*split_name(first)}, {*split_name(second)})
    return are_sides or not inner.startswith(outer)


def bag_table(path: Path, joint_names: Sequence[str], options: LogOptions) -> LogTable:
    """Return the topic of a bag with the arm's joints: the one of --topic, or the one that fits.

    Where it has positions alone, or torques alone, it is joined with the other half.

    InputError where no topic or those of two arms fit, or where the only one lacks torques.
    """
    chosen = options.topic
    with _open_bag(path) as bag:
        names, described = _joint_topics(bag)
        its_topics = f"its topics: {', '.join(sorted(described)) or 'none'}"
        topics: list[Topic] = []
        for name in sorted(names):
            topics += _read_topic(path, bag, name, joint_names)
        positions = [topic for topic in topics if topic.rank[0]]
        torques = [topic for topic in topics if topic.has_torque_alone]
        if chosen is not None:
            own = [topic for topic in topics if topic.name == chosen]
            if (
                not own
                and chosen not in names
                and _are_in_order(positions, joint_names)
            ):
                own = [*_array_topics(path, bag, joint_names, chosen)]
            if not own:
                fault = f"{path} has no joint states in topic {chosen!r}"
                raise InputError(f"{fault}; {its_topics}")
            if own[0].rank == TORQUES_ALONE and positions:
                torques = own
                topics = [_with_torques(topic, own[0]) for topic in positions]
            else:
                positions = own
                topics = [*own, *torques] if own[0].rank == POSITIONS_ALONE else own
        if not topics:
            raise InputError(f"{path} holds no joint states; {its_topics}")
        best = max(topic.rank for topic in topics)
        # An effort of zero says no more than none where another topic has torques.
        if best[0] and not best[2]:
            if not torques and _are_in_order(positions, joint_names):
                torques = [*_array_topics(path, bag, joint_names)]
            if len(torques) == 1:
                topics = [_with_torques(topic, torques[0]) for topic in positions]
        topic, note = choose_topic(
            path, topics, partial(_arrays_of, bag, joint_names, positions)
        )
    return replace(topic.table, notes=(*topic.table.notes, *filter(None, [note])))


def _with_torques(position: Topic, torque: Topic) -> Topic:
    """Return a topic of positions with the torques of another one, joined by time."""
    halves = []
    for topic, quantities in (
        (position, {"position", "velocity"}),
        (torque, {*TORQUE}),
    ):
        kinds = [title.rpartition(" ")[2] for title in topic.table.titles]
        indices = [k for k, kind in enumerate(kinds) if kind in quantities]
        table = replace(topic.table, path=topic.table.path / topic.name.strip("/"))
        # Efforts of zero beside the positions are not those of the joints.
        halves.append(select_columns(table, [0, *indices]))
    time = [Column(0, "time", 1.0)]
    q, tau = ([*range(1, len(half.titles))] for half in halves)
    joined = join_pair(Half(halves[0], time, q, []), Half(halves[1], time, [], tau))
    table = replace(joined, path=position.table.path)
    return replace(position, table=table, rank=(True, *torque.rank[1:]))


class ArrayField(NamedTuple):
    """An array of numbers in the messages of a topic that is none of joints.

    Attributes:
        topic, message_type, n_messages: of the topic.
        name: of the field.
        size: of the array in the first message.
    """

    topic: str
    message_type: str
    n_messages: int
    name: str
    size: int


def _array_fields(bag: Any) -> Iterator[ArrayField]:
    """Yield the arrays of numbers in messages that are not read, of topics without commands."""
    for connection in bag.connections:
        message_type = connection.msgtype
        is_known = message_type in bag.typestore.fielddefs
        is_commanded = read_title(connection.topic).is_commanded
        if message_type in READERS or is_commanded or not is_known:
            continue
        _, _, raw = next(bag.messages(connections=[connection]), (None, None, None))
        if raw is None:
            continue
        topic = connection.topic, message_type, connection.msgcount
        for name, value in vars(bag.deserialize(raw, message_type)).items():
            if np.asarray(value).dtype.kind == "f":
                yield ArrayField(*topic, name, int(np.size(value)))


def _arrays_of(
    bag: Any, joint_names: Sequence[str], positions: Sequence[Topic]
) -> Arrays:
    """Return the topics of other messages that hold as many numbers as the arm has joints, or more.

    Those with one array of a number per joint can be read, in the order of the joints.
    """
    sizes: dict[tuple[str, str, int], list[ArrayField]] = {}
    for field in _array_fields(bag):
        if field.size >= len(joint_names):
            sizes.setdefault(field[:3], []).append(field)
    is_in_order = _are_in_order(positions, joint_names)
    arrays = {}
    for (topic, message_type, n_messages), fields in sizes.items():
        texts = [f"{field.size} numbers in {field.name}" for field in fields]
        description = (
            f"{topic} ({message_type}: {', '.join(texts)}, {n_messages} messages)"
        )
        is_readable = [field.size for field in fields] == [len(joint_names)]
        arrays[description] = topic if is_readable and is_in_order else ""
    return arrays


def _are_in_order(topics: Sequence[Topic], joint_names: Sequence[str]) -> bool:
    """Return whether all topics of positions list the arm's joints from base to terminal.

    Then an array without names has the same order.
    """
    for topic in topics:
        titles = [title.rpartition(" ") for title in topic.table.titles]
        names = [name for name, _, quantity in titles if quantity == "position"]
        matched = match_joint_names(names, joint_names)
        if [matched[name] for name in names if name in matched] != [*joint_names]:
            return False
    return True


def _array_topics(
    path: Path, bag: Any, joint_names: Sequence[str], chosen: str = ""
) -> Iterator[Topic]:
    """Yield the topics whose messages have one array of torques, a number per joint: that of a
    name, or else those that are called so.
    """
    for field in _array_fields(bag):
        title = read_title(f"{field.topic.replace('/', ' ')} {field.name}")
        is_torque = title.likely_quantity == "torque"
        is_sought = field.topic == chosen if chosen else is_torque
        if not is_sought or field.size != len(joint_names):
            continue
        readers = {field.message_type: partial(read_array, field.name, joint_names)}
        for topic in _read_topic(path, bag, field.topic, joint_names, readers):
            note = (
                f"torques are the numbers of {field.name} in {field.topic}, base first"
            )
            yield replace(topic, table=replace(topic.table, notes=(note,)))


def _joint_topics(bag: Any) -> tuple[set[str], set[str]]:
    """Return the names of the topics of a bag with joints, and a description of each of all."""
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
    return names, described


def _connections(bag: Any, topic: str, readers: Readers = READERS) -> list[Any]:
    """Return the connections of a bag through which joints of a topic were recorded, one per
    publisher; messages of other types may share its name.
    """
    return [c for c in bag.connections if c.topic == topic and c.msgtype in readers]


def _read_topic(
    path: Path,
    bag: Any,
    name: str,
    joint_names: Sequence[str],
    readers: Readers = READERS,
) -> Iterator[Topic]:
    """Yield a topic with its table, which has time and a column per joint and quantity.

    Joints and quantities are those of its first messages; nothing is yielded where these hold none.
    """
    messages = list(islice(_read_messages(bag, name, readers), FIRST_MESSAGES))
    if len({publisher for *_, publisher in messages}) > 1:
        messages = list(islice(_read_messages(bag, name, readers), MORE_MESSAGES))
    # A dictionary keeps the keys in the order in which they come first.
    sent: dict[Key, None] = {}
    samples: dict[Publisher, list[Sample]] = {}
    has_frames = len({p.frame for *_, p in messages}) <= MOST_FRAMES
    for _, sample, its_publisher in messages:
        sent.update(dict.fromkeys(sample))
        key = its_publisher if has_frames else without_frame(its_publisher)
        samples.setdefault(key, []).append(sample)
    if not sent:
        return
    arm_joints: Collection[str] = ()
    with contextlib.suppress(InputError):
        arm_joints = match_joint_names([joint for joint, _ in sent], joint_names)
    connections = _connections(bag, name, readers)
    message_type = connections[0].msgtype
    n_messages = sum(connection.msgcount for connection in connections)
    ranks = {p: _rank(arm_joints, own) for p, own in samples.items()}
    # Others may publish a gripper, or a few joints of the arm, on the same topic.
    senders = [
        Sender(p, ranks[p], round(n_messages * len(own) / len(messages)))
        for p, own in samples.items()
        if ranks[p][0] or ranks[p][1]
    ]
    publisher: Publisher | None = None
    rank = (False, False, False)
    notes: list[str] = []
    if senders:
        sender, note = choose_sender(senders)
        rank = sender.rank
        if len(samples) > 1:
            publisher = sender.publisher
        if len(senders) < len(samples):
            notes.append(
                "messages without all joints of the arm, of another publisher, are left out"
            )
        notes += filter(None, [note])
    start = min(stamp for stamp, *_ in messages)

    def is_read(its_publisher: Publisher) -> bool:
        """Return whether messages of a publisher are read."""
        key = its_publisher if has_frames else without_frame(its_publisher)
        return publisher in (None, key)

    read = partial(_read_chunks, path, name, list(sent), start, is_read, readers)
    titles = ["time", *map(" ".join, sent)]
    table = make_table(
        path,
        f"ROS bag, topic {name} ({message_type}), joints by name",
        [(title, LATER) for title in titles],
        blocks=partial(chunk_blocks, read, n_messages),
        row_noun="message",
        notes=tuple(notes),
        starts={"time": start},
    )
    yield Topic(name, message_type, table, n_messages, rank)


def _rank(arm_joints: Collection[str], samples: Sequence[Sample]) -> Rank:
    """Return whether all samples have positions of the arm's joints, torques, and these not 0."""
    # Those of one publisher have the same keys.
    complete = [
        quantity
        for quantity in ("position", *TORQUE)
        if arm_joints and samples[0].keys() >= {*product(arm_joints, [quantity])}
    ]
    torques = [*product(arm_joints, {*complete} & {*TORQUE})]
    # An effort that a driver does not know is NaN.
    is_powered = any(abs(sample[key]) > 0.0 for sample in samples for key in torques)
    return "position" in complete, bool(torques), is_powered


def _read_chunks(
    path: Path,
    topic: str,
    keys: Sequence[Key],
    start: int,
    is_read: Callable[[Publisher], bool],
    readers: Readers,
) -> Iterator[Chunk]:
    """Yield the samples of a topic in chunks: time from the start [s], and the numbers of ``keys``.

    Args:
        path: of the bag.
        topic: its name.
        keys: of the numbers of a sample.
        start: stamp at which time is zero [ns since 1970].
        is_read: returns whether messages of a publisher are read; others are left empty.
        readers: of its messages.
    """
    with _open_bag(path) as bag:
        messages = _read_messages(bag, topic, readers)
        while chunk := list(islice(messages, ROWS)):
            rows = []
            for stamp, sample, publisher in chunk:
                used = sample if is_read(publisher) else {}
                numbers = [used.get(key, np.nan) for key in keys]
                rows.append([NANOSECOND * (stamp - start), *numbers])
            yield [np.array(rows)]


def _read_messages(bag: Any, topic: str, readers: Readers) -> Iterator[Message]:
    """Yield the messages of a topic in the order in which they were recorded."""
    connections = _connections(bag, topic, readers)
    for connection, received, raw in bag.messages(connections=connections):
        message = bag.deserialize(raw, connection.msgtype)
        stamp = read_stamp(message) or int(received)
        sample = readers[connection.msgtype](message)
        # Velocities that are missing now and then make no other publisher.
        parts = frozenset(key for key in sample if key[1] != "velocity")
        node = getattr(connection.ext, "callerid", None) or ""
        yield stamp, sample, Publisher(node, read_frame(message), parts)


@contextlib.contextmanager
def _open_bag(path: Path) -> Iterator[Any]:
    """Yield a bag that is open within a block.

    ``path``: of the bag, or of a part of a ROS 2 bag, which is then opened whole.
    """
    typesys = import_optional("rosbags.typesys", "rosbag")
    highlevel = import_optional("rosbags.highlevel", "rosbag")
    is_part = path.suffix in (".db3", ".mcap")
    has_metadata = (path.parent / "metadata.yaml").is_file()
    folder = path.parent if is_part and has_metadata else path
    for file in folder.iterdir() if folder.is_dir() else ():
        refuse_special_file(file, "give a bag whose parts are files")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(typesys.get_types_from_msg(text, name))
    with highlevel.AnyReader([folder], default_typestore=store) as bag:
        yield bag
