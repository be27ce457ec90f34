"""Of several topics of a bag, the one with torques and most samples is read, of one arm only."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigs.files.refusals import refused
from rigs.logs.log_files import titles_alone
from robot_sysid.logs.ros_bag import Topic, choose_topic
from robot_sysid.logs.ros_messages import DYNAMIC, STATE

BAG = Path("run.bag")


def topic(name, n_messages=400, rank=(True, True, True), kind=STATE):
    """Return a topic without rows."""
    return Topic(name, kind, titles_alone(()), n_messages, rank)


def chosen(*topics):
    picked, note = choose_topic(BAG, topics)
    return picked.name, note


def test_the_topic_with_most_samples_is_read_and_said():
    """Of equal ones, the plain joint states."""
    name, note = chosen(topic("/joint_states", 50), topic("/franka/joint_states"))
    assert name == "/franka/joint_states"
    assert note == (
        "log topic: /franka/joint_states with 400 samples is read, not /joint_states (50); "
        "choose with --topic"
    )
    dynamic = topic("/dynamic_joint_states", kind=DYNAMIC)
    assert chosen(dynamic, topic("/joint_states"))[0] == "/joint_states"


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
    "name", ["/{}/joint_states", "/{}_arm/joint_states", "/{}_joint_states"]
)
def test_topics_of_two_arms_are_refused(name):
    """By their namespaces, or by a word for the side."""
    both = [name.format(side) for side in ("left", "right")]
    with refused(r"several .*joint_states .*--topic") as caught:
        choose_topic(BAG, list(map(topic, both)))
    assert {*caught.value.options} == {("--topic", name) for name in both}


def test_an_arm_without_torque_is_refused():
    with refused("/joint_states has no effort"):
        chosen(topic("/joint_states", rank=(True, False, False)))
