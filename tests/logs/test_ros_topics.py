"""Of several topics of a bag, the one with torques and most samples is read, of one arm only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.logs.ros_messages import DYNAMIC, STATE
from robot_sysid.logs.ros_topics import Topic, choose_topic
from robot_sysid.logs.table import Block, LogTable
from tests.support.log_files import motion

DATA = motion()
BAG = Path("run.bag")


def topic(name, step=1, late=0.0, q=DATA.q, rank=(True, True, True), kind=STATE):
    """Return a topic with every ``step``-th sample of a motion, which are late [s]."""
    cells = np.column_stack((DATA.time + late, q))[::step]
    blocks = [Block(np.arange(len(cells)), cells)]
    table = LogTable(BAG, name, (), lambda columns: iter(blocks))
    return Topic(name, kind, table, 0, len(cells), (1, 2, 3), rank)


def chosen(*topics):
    picked, note = choose_topic(BAG, topics)
    return picked.name, note


def test_the_topic_with_most_samples_is_read_and_said():
    name, note = chosen(
        topic("/joint_states", 8, late=0.03), topic("/franka/joint_states")
    )
    assert name == "/franka/joint_states"
    assert note == (
        "log topic: /franka/joint_states with 400 samples is read; the same motion is in "
        "/joint_states (50)"
    )


def test_of_equal_topics_the_plain_joint_states_are_read():
    dynamic = topic("/dynamic_joint_states", kind=DYNAMIC)
    assert chosen(dynamic, topic("/joint_states"))[0] == "/joint_states"
    assert chosen(topic("/joint_states"))[1] == ""


@pytest.mark.parametrize(
    "other",
    [
        topic("/a/desired_joint_states"),
        topic("/a/leader/joint_states", q=1.001 * DATA.q),
        topic("/a/sim", rank=(True, True, False)),
        topic("/a/sim", rank=(True, False, False)),
    ],
)
def test_commands_and_efforts_of_zero_are_left_out(other):
    assert chosen(topic("/a/joint_states", step=2), other) == ("/a/joint_states", "")


@pytest.mark.parametrize(
    "other",
    [
        topic("/right/joint_states", late=0.001),
        topic("/right_arm/joint_states", q=1.001 * DATA.q),
        topic("/joint_states", q=DATA.q[::-1]),
        topic("/joint_states", late=5.0),
    ],
)
def test_topics_of_two_arms_are_refused(other):
    """By their names, by their motions, by their joints, or where no time is common."""
    fault = r"several .* /left/joint_states .*--topic"
    with pytest.raises(InputError, match=fault) as caught:
        choose_topic(BAG, [topic("/left/joint_states"), other])
    names = {"/left/joint_states", other.name}
    assert {*caught.value.options} == {("--topic", name) for name in names}


def test_topics_with_equal_numbers_are_one_arm_whatever_their_names():
    names = ["/joint_states_single", "/joint_states_feedback"]
    assert chosen(*map(topic, names))[0] == names[1]


def test_arms_that_stand_still_are_not_taken_for_one():
    rest = np.zeros_like(DATA.q)
    topics = [topic("/a/joint_states", q=rest), topic("/joint_states", q=rest)]
    with pytest.raises(InputError, match="several topics"):
        choose_topic(BAG, topics)


def test_an_arm_without_torque_is_refused():
    bare = topic("/joint_states", rank=(True, False, False))
    with pytest.raises(InputError, match="/joint_states has no effort"):
        choose_topic(BAG, [bare])
