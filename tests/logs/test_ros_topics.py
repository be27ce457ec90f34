"""Of several topics of a bag, the one with torques and most samples is read, of one arm only."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigs.refusals import refused
from robot_sysid.logs.ros_bag import Topic, choose_topic
from robot_sysid.logs.ros_messages import DYNAMIC, STATE
from robot_sysid.logs.table import LogTable

BAG = Path("run.bag")


def topic(name, n_messages=400, rank=(True, True, True), kind=STATE):
    """Return a topic without rows."""
    table = LogTable(BAG, name, (), lambda columns: iter([]))
    return Topic(name, kind, table, n_messages, rank)


def chosen(*topics):
    picked, note = choose_topic(BAG, topics)
    return picked.name, note


def test_the_topic_with_most_samples_is_read_and_said():
    name, note = chosen(topic("/joint_states", 50), topic("/franka/joint_states"))
    assert name == "/franka/joint_states"
    assert note == (
        "log topic: /franka/joint_states with 400 samples is read, not /joint_states (50); "
        "choose with --topic"
    )


def test_of_equal_topics_the_plain_joint_states_are_read():
    dynamic = topic("/dynamic_joint_states", kind=DYNAMIC)
    assert chosen(dynamic, topic("/joint_states"))[0] == "/joint_states"
    assert chosen(topic("/joint_states"))[1] == ""


@pytest.mark.parametrize(
    "other",
    [
        topic("/a/desired_joint_states"),
        topic("/a/leader/joint_states"),
        topic("/a/sim", rank=(True, True, False)),
        topic("/a/sim", rank=(True, False, False)),
    ],
)
def test_commands_and_efforts_of_zero_are_left_out(other):
    assert chosen(topic("/a/joint_states", 200), other) == ("/a/joint_states", "")


@pytest.mark.parametrize(
    "names", ["/left/{}", "/right_arm/{}", "/left_{}", "/a/right_{}"]
)
def test_topics_of_two_arms_are_refused(names):
    """By their namespaces, or by a word for the side."""
    other = names.replace("left", "right")
    other = other if other != names else names.replace("right", "left")
    both = [name.format("joint_states") for name in (names, other)]
    fault = r"several .*joint_states .*--topic"
    with refused(fault) as caught:
        choose_topic(BAG, list(map(topic, both)))
    assert {*caught.value.options} == {("--topic", name) for name in both}


def test_an_arm_without_torque_is_refused():
    bare = topic("/joint_states", rank=(True, False, False))
    with refused("/joint_states has no effort"):
        choose_topic(BAG, [bare])
