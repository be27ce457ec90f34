"""The topic of a bag from which an arm is read, where several hold its joints.

Drivers publish one arm more than once: ros2_control's broadcaster in /joint_states and
/dynamic_joint_states, Franka's launch file at 1 kHz and once more, with the fingers, at 30 Hz. The
topic with torques and with the most samples is read. Topics whose names are those of two arms are
not chosen from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from robot_sysid.errors import InputError
from robot_sysid.logs.joint_names import are_opposite_sides, split_name
from robot_sysid.logs.ros_messages import READERS
from robot_sysid.logs.table import LogTable
from robot_sysid.logs.titles import read_title

_LEADERS = frozenset({"leader", "master"})
"""Words in the names of topics of an arm by which another one is led."""


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
    def is_commanded(self) -> bool:
        """Whether its name marks it as commands or references, as in /desired_joint_states.

        So does the name of an arm that leads the other one, which moves almost alike.
        """
        title = read_title(self.name)
        return title.is_commanded or bool(_LEADERS & {*title.tokens})


def choose_topic(path: Path, topics: Sequence[Topic]) -> tuple[Topic, str]:
    """Return the topic to read, and a sentence on the others that hold the arm; "" for none.

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
    if any(_is_of_another_arm(topic_read.name, rival.name) for rival in rivals):
        listed = ", ".join(f"{topic.name} ({topic.message_type})" for topic in fitting)
        raise InputError(
            f"{path}: several topics could be the arm: {listed}; choose with --topic",
            options=[("--topic", topic.name) for topic in fitting],
        )
    if rivals:
        listed = ", ".join(f"{topic.name} ({topic.n_messages})" for topic in rivals)
        return topic_read, (
            f"log topic: {topic_read.name} with {topic_read.n_messages} samples is read, not "
            f"{listed}; choose with --topic"
        )
    return topic_read, ""


def _is_of_another_arm(first: str, second: str) -> bool:
    """Return whether the names of two topics are those of two arms.

    So are those in namespaces of which none is in the other, and /left_joint_states and
    /right_joint_states. /joint_states is no other arm than /franka/joint_states.
    """
    namespaces = [f"{name.rpartition('/')[0]}/" for name in (first, second)]
    outer, inner = sorted(namespaces, key=len)
    are_sides = are_opposite_sides({*split_name(first)}, {*split_name(second)})
    return are_sides or not inner.startswith(outer)
