"""States as rows: nested values, each of one instant, whose numbers become the columns of a table.

``{"t": 0.1, "state": {"q": [1, 2]}}`` has the columns t, state/q[0] and state/q[1]. Lists beside a
list of as many names, as in ROS's JointState, have a column per name: elbow/position.

Several programs may publish the state of one arm on one topic: a simulator, or a publisher of a
description, sends positions beside the driver's, with an effort of zero or none. Taken for states
of one sensor they have torques that come and go. They are told apart by what a message says of its
sender: the node (ROS 1), the frame in its header, and the joints that it names.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.table import ROWS, LogTable, make_table, nested_name, part_titles
from robot_sysid.logs.text import is_names, list_in_cell, parse_cell
from robot_sysid.logs.titles import read_title
from robot_sysid.records.messages import count_text

MOST_NAMES = 3
"""Joints that a sentence names to tell publishers apart."""
MOST_FRAMES = 8
"""Frames above which they tell no publishers: one that counts its messages in them."""
Rank = tuple[bool, bool, bool]
"""Whether messages have positions of the arm, torques, and torques other than zero."""
# Keys of a nested state that say who sent it.
_FRAMES = frozenset({"frame_id", "frame", "frameId"})
# Levels of a state in which they are looked for: a message, its header.
_DEPTH = 3
_SECONDS = frozenset({"sec", "secs", "seconds"})
_NANOSECONDS = frozenset({"nanosec", "nsec", "nsecs", "nanos"})


class Publisher(NamedTuple):
    """What tells the messages of one sender from those of others.

    Attributes:
        node: name of the program; "" where messages do not say it.
        frame: of the header.
        parts: what the messages hold, such as the names of joints.
    """

    node: str
    frame: str
    parts: frozenset[Any]


def without_frame(publisher: Publisher) -> Publisher:
    """Return a publisher whose frame says nothing."""
    return publisher._replace(frame="")


class Sender(NamedTuple):
    """A publisher with what is known of its messages."""

    publisher: Publisher
    rank: Rank
    n_messages: int


def choose_sender(senders: Sequence[Sender]) -> tuple[Sender, str]:
    """Return the sender of an arm to read, and a sentence on the others; "" for none.

    The one with torques is read, and of several the one that sent most.
    """
    first, *others = sorted(senders, key=lambda s: (s.rank, s.n_messages), reverse=True)
    if not others:
        return first, ""
    listed = ", ".join(_describe(sender, first) for sender in others)
    read = _name(first.publisher, others[0].publisher)
    return first, (
        f"messages of {listed}, of another publisher, are left out; those of {read} are read"
    )


def _describe(sender: Sender, other: Sender) -> str:
    """Return a sender that is not read, with why another one is."""
    why = count_text(sender.n_messages, "message")
    if sender.rank < other.rank:
        why = "no effort but 0 in any of them" if sender.rank[1] else "without effort"
        why = why if sender.rank[0] else "without positions"
    return f"{_name(sender.publisher, other.publisher)} ({why})"


def _name(publisher: Publisher, other: Publisher) -> str:
    """Return the name of a publisher by what tells it from another one."""
    if publisher.node != other.node:
        return f"node {publisher.node!r}"
    if publisher.frame != other.frame:
        return f"frame {publisher.frame!r}"
    further = publisher.parts - other.parts
    names = sorted(
        {
            p if isinstance(p, str) else p[0]
            for p in further or other.parts - publisher.parts
        }
    )
    return f"joints {'with' if further else 'without'} {', '.join(names[:MOST_NAMES])}"


def publisher_of(state: Any) -> Publisher:
    """Return who sent a nested state, by the frame in it and its lists of names."""
    frames: list[str] = []
    names: set[str] = set()
    level = [state]
    for _ in range(_DEPTH):
        items = [
            item for value in level if isinstance(value, dict) for item in value.items()
        ]
        level = [content for _, content in items]
        for key, content in items:
            if key in _FRAMES and isinstance(content, str):
                frames.append(content)
            elif isinstance(content, list) and is_names(content):
                names.update(content)
    return Publisher("", "/".join(frames), frozenset(names))


def numbers_in(value: Any, title: str = "") -> Iterator[tuple[str, float]]:
    """Yield (title, number) of all numbers in a nested value, also of dates and texts of numbers.

    Args:
        value: a number, a text, or lists and mappings of such values.
        title: of the value within the state; "" for the state itself.
    """
    if hasattr(value, "isoformat"):
        value = value.isoformat()
    if isinstance(value, Mapping):
        yield from _numbers_in_mapping(value, title)
        return
    if isinstance(value, (list, tuple)):
        for item, item_title in zip(value, part_titles(title, len(value))):
            has_name = isinstance(item, Mapping) and isinstance(item.get("name"), str)
            own_title = f"{title}/{item['name']}" if has_name else item_title
            yield from numbers_in(item, own_title)
    elif isinstance(value, str):
        with contextlib.suppress(ValueError):
            yield title, parse_cell(value)
    else:
        yield title, np.nan if value is None else float(value)


def _numbers_in_mapping(
    value: Mapping[str, Any], title: str
) -> Iterator[tuple[str, float]]:
    """Yield (title, number) of the numbers in a mapping; a time stamp of ROS is one number."""
    seconds = _SECONDS & value.keys()
    nanoseconds = _NANOSECONDS & value.keys()
    if seconds and nanoseconds:
        fraction = 1e-9 * float(value[min(nanoseconds)])
        yield title or "time", float(value[min(seconds)]) + fraction
        stamp = seconds | nanoseconds
        value = {key: value[key] for key in value if key not in stamp}
    lengths = [len(content) for content in value.values() if isinstance(content, list)]
    lists = filter(is_names, value.values())
    # The names of what other lists hold.
    names: list[str] = next((n for n in lists if lengths.count(len(n)) > 1), [])
    named: list[tuple[str, Any]] = []
    for key, content in value.items():
        if not (names and isinstance(content, list)):
            named.append((key, content))
        elif len(content) == len(names):
            # A list of another length was not measured of every joint.
            named += zip(part_titles(key, len(names), names), content)
    for name, content in named:
        yield from numbers_in(content, nested_name(title, name))


def named_rows(
    path: Path, titles: Sequence[Any], rows: Iterable[Sequence[Any]]
) -> Iterator[Any]:
    """Yield rows as states, title to cell, with lists in texts as lists; None for a short row.

    InputError where two columns have one title.
    """
    names = []
    for title in titles:
        name = str(title)
        # Some headers have "[positions]" above lists.
        names.append(name.strip("[]") if name.startswith("[") else name)
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{path} has two columns {name!r}; rename one of them")
    for cells in rows:
        is_whole = len(cells) == len(names)
        yield dict(zip(names, map(list_in_cell, cells))) if is_whole else None


def _other_publishers(states: Sequence[Any]) -> tuple[frozenset[Publisher], str]:
    """Return those who sent the arm's states beside the one whose states are read, and a note.

    They send positions of joints whose positions the one that is read sends, too.
    """
    sent: dict[Publisher, list[Any]] = {}
    for state in filter(None, states):
        sent.setdefault(publisher_of(state), []).append(state)
    if len(sent) < 2 or len({p.frame for p in sent}) > MOST_FRAMES:
        return frozenset(), ""
    senders = []
    positions = {}
    for publisher, its_states in sent.items():
        rows = [dict(numbers_in(state)) for state in its_states]
        quantities = {t: read_title(t).quantity_beside_name for t in rows[0]}
        of_torque = [t for t, quantity in quantities.items() if quantity == "torque"]
        efforts = (row.get(title, 0.0) for row in rows for title in of_torque)
        is_powered = any(abs(effort) > 0.0 for effort in efforts)
        positions[publisher] = {t for t, q in quantities.items() if q == "position"}
        if positions[publisher]:
            rank = (True, bool(of_torque), is_powered)
            senders.append(Sender(publisher, rank, len(rows)))
    if not senders:
        return frozenset(), ""
    first, _ = choose_sender(senders)
    its_positions = positions[first.publisher]
    rivals = [s for s in senders if positions[s.publisher] & its_positions]
    _, note = choose_sender(rivals)
    return frozenset(s.publisher for s in rivals) - {first.publisher}, note


def states_table(
    path: Path,
    layout: str,
    states: Iterable[Any],
    row_noun: str = "row",
    notes: tuple[str, ...] = (),
) -> LogTable:
    """Return states as a table with a row per state and a column per title.

    Args:
        path: of the file.
        layout: see ``LogTable``.
        states: nested values; None in place of one that cannot be read.
        row_noun, notes: see ``LogTable``.

    Raises:
        InputError: no state has numbers.
    """
    # A dictionary keeps the titles in the order in which they come first.
    columns: dict[str, None] = {}
    chunks = []
    remaining = iter(states)
    others: frozenset[Publisher] | None = None
    while chunk := list(islice(remaining, ROWS)):
        if others is None:
            others, note = _other_publishers(chunk)
            notes += (note,) * bool(note)
        if others:
            # An empty row keeps the number of the next one.
            chunk = [{} if publisher_of(s) in others else s for s in chunk]
        rows = [None if s is None else dict(numbers_in(s)) for s in chunk]
        for row in filter(None, rows):
            columns.update(dict.fromkeys(row))
        unread = dict.fromkeys(columns, np.inf)
        read = [unread if row is None else row for row in rows]
        chunks.append(
            np.array([[row.get(title, np.nan) for title in columns] for row in read])
        )
    if not columns:
        raise InputError(f"{path} holds no numbers in states")
    # Columns that came up later are empty in earlier states.
    padded = []
    for cells in chunks:
        later = np.full((len(cells), len(columns) - cells.shape[1]), np.nan)
        padded.append(np.hstack((cells, later)))
    numbers = zip(columns, np.concatenate(padded).T)
    return make_table(path, layout, numbers, row_noun=row_noun, notes=notes)
