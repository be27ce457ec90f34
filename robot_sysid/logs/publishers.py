"""Who sent a message: several programs may publish the state of one arm on one topic.

A simulator, or a publisher of a description, sends positions beside the driver's, with an effort of
zero or none. Their messages lie between each other, and taken for those of one sensor they have
torques that come and go. They are told apart by what a message says of its sender: the node (ROS
1), the frame in its header, and the joints that it names.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from robot_sysid.logs.text import is_names
from robot_sysid.records.messages import count_text

MOST_NAMES = 3
"""Joints that a sentence names to tell publishers apart."""
MOST_FRAMES = 8
"""Frames above which they tell no publishers: one that counts its messages in them."""
Rank = tuple[bool, bool, bool]
"""Whether messages have positions of the arm, torques, and torques other than zero."""


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
        why = "effort 0 in each of them" if sender.rank[1] else "without effort"
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


# Keys of a nested state that say who sent it.
_FRAMES = frozenset({"frame_id", "frame", "frameId"})
# Levels of a state in which they are looked for: a message, its header.
_DEPTH = 3
