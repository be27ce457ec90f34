"""The topic of a bag from which an arm is read, where several hold its joints.

Drivers publish one arm more than once: ros2_control's broadcaster in /joint_states and
/dynamic_joint_states, Franka's launch file at 1 kHz and once more, with the fingers, at 30 Hz. The
topic with torques and with the most samples is read. Topics of two arms, which move differently or
lie in namespaces of their own, are not chosen from.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.ros_messages import READERS
from robot_sysid.logs.table import LogTable
from robot_sysid.logs.titles import read_title
from robot_sysid.records import Array

_MOST_DIFFERENCE = 0.2
"""Largest difference of two topics' positions over the positions' spread that counts as one motion:
a topic that is put together from others lags by a sample of its low rate."""
_LEAST_SAMPLES = 10
"""Least number of samples that are compared."""

_LEADERS = frozenset({"leader", "master"})
"""Words in the names of topics of an arm by which another one is led."""


@dataclass(frozen=True)
class Topic:
    """A topic that holds joints.

    Attributes:
        name: of the topic.
        message_type: of its messages.
        table: the topic as a table.
        start: stamp at which the table's time is zero [ns since 1970].
        n_messages: number of its messages.
        positions: the table's columns of the arm's positions; empty where one is missing.
        rank: whether it has positions of all joints of the arm, torques of all, and torques other
            than zero.
    """

    name: str
    message_type: str
    table: LogTable
    start: int
    n_messages: int
    positions: tuple[int, ...]
    rank: tuple[bool, bool, bool]

    @property
    def is_commanded(self) -> bool:
        """Whether its name marks it as commands or references, as in /desired_joint_states.

        So does the name of an arm that leads the other one, which moves almost alike.
        """
        title = read_title(self.name)
        return title.is_commanded or bool(_LEADERS & {*title.tokens})

    def motion(self) -> tuple[Array, Array]:
        """Return time stamps (K,) [s] and positions (K, n) of its first samples with all joints."""
        block = next(self.table.blocks([0, *self.positions]))
        cells = block.cells[~np.isnan(block.cells).any(axis=1)]
        return cells[:, 0] + 1e-9 * self.start, cells[:, 1:]


def choose_topic(path: Path, topics: Sequence[Topic]) -> tuple[Topic, str]:
    """Return the topic to read, and a sentence on the others with the same motion; "" for none.

    Raises:
        InputError: topics of two arms fit, or the only one lacks torques.
    """
    best = max(topic.rank for topic in topics)
    fitting = [topic for topic in topics if topic.rank == best]
    measured = [topic for topic in fitting if not topic.is_commanded]
    fitting = measured or fitting
    if best == (True, False, False) and len(fitting) == 1:
        raise InputError(
            f"{path}: topic {fitting[0].name} has no effort of the arm's joints; let the driver "
            "publish effort and record again"
        )
    types = list(READERS)
    fitting.sort(key=lambda t: (-t.n_messages, types.index(t.message_type), t.name))
    topic_read = fitting[0]
    rivals = fitting[1:]
    if not all(_is_one_arm(topic_read, rival) for rival in rivals):
        listed = ", ".join(f"{topic.name} ({topic.message_type})" for topic in fitting)
        raise InputError(
            f"{path}: several topics could be the arm: {listed}; choose with --topic",
            options=[("--topic", topic.name) for topic in fitting],
        )
    if rivals:
        listed = ", ".join(f"{topic.name} ({topic.n_messages})" for topic in rivals)
        return topic_read, (
            f"log topic: {topic_read.name} with {topic_read.n_messages} samples is read; the same "
            f"motion is in {listed}"
        )
    return topic_read, ""


def _is_one_arm(first: Topic, second: Topic) -> bool:
    """Return whether two topics hold the same motion, and their names are not those of two arms.

    Whatever the names are, two arms never read equal positions at all equal times.
    """
    if not (first.positions and second.positions):
        return False
    motion = first.motion()
    other_motion = second.motion()
    is_equal = all(map(np.array_equal, motion, other_motion))
    has_one_type = first.message_type == second.message_type
    has_other_name = has_one_type and _is_of_another_arm(first.name, second.name)
    if has_other_name and not is_equal:
        return False
    return _is_same_motion(motion, other_motion)


def _is_of_another_arm(first: str, second: str) -> bool:
    """Return whether the names of two topics of one message type are alike but for that of the arm.

    So are /left_joint_states and /right_joint_states, and topics of one name in namespaces of which
    none is in the other. /joint_states is no other arm than /franka/joint_states.
    """
    # Names with as many words on each level.
    if re.sub("[^/_]", "", first) == re.sub("[^/_]", "", second):
        return True
    namespace, _, name = first.rpartition("/")
    other_namespace, _, other_name = second.rpartition("/")
    shorter, longer = sorted((f"{namespace}/", f"{other_namespace}/"), key=len)
    return name == other_name and not longer.startswith(shorter)


def _is_same_motion(first: tuple[Array, Array], second: tuple[Array, Array]) -> bool:
    """Return whether two recordings of positions agree where both are there, and the arm moves."""
    time, positions = first
    other_time, other_positions = second
    is_common = (time >= other_time[0]) & (time <= other_time[-1])
    if np.count_nonzero(is_common) < _LEAST_SAMPLES:
        return False
    others = [np.interp(time, other_time, q) for q in other_positions.T]
    difference = (positions - np.column_stack(others))[is_common]
    spread = np.mean(np.var(positions[is_common], axis=0))
    return bool(np.mean(difference**2) < _MOST_DIFFERENCE**2 * spread)
