"""Causes of unexpected torques: weak motors, loads, and moved zeros at a standstill."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.references import HoldingCheck
from robot_sysid.damiao.safety.causes import EffortChange, explain_change

JOINTS = damiao_joints(["DM8009", "DM8009", "DM4340", "DM4310"], 4)
# Torques per angle and per kilogram, as an arm has them.
ARMS = np.array([20.0, 12.0, 4.0, 1.0])
LEVERS = np.array([7.0, 4.5, 2.0, 0.5])
Q = np.array([0.3, 0.4, -0.2, 0.1])


def gravity(q):
    """What holds four links in a plane: each joint carries all links beyond it."""
    angles = np.cumsum(q)
    return np.cumsum((ARMS - np.append(ARMS[1:], 0.0))[::-1] * np.cos(angles)[::-1])[
        ::-1
    ]


def load(q):
    """What a kilogram at the end takes."""
    angles = np.cumsum(q)
    return np.cumsum(
        (LEVERS - np.append(LEVERS[1:], 0.0))[::-1] * np.cos(angles)[::-1]
    )[::-1]


MODEL = HoldingCheck(JOINTS, gravity, 0.0, "the model needs", load)
FILE = HoldingCheck(JOINTS, lambda q: gravity(Q), 0.0, "the trajectory feeds forward")
BEFORE = np.array([1.0, -0.5, 0.2, 0.0])


def explanation(holding, torque, at_once=None):
    """What is named where this holds the arm."""
    at_once = torque - gravity(Q) if at_once is None else at_once
    change = EffortChange(1, BEFORE, at_once)
    return explain_change(change, holding, Q, torque + BEFORE, gravity(Q), JOINTS)


def weak(joint, share):
    torque = gravity(Q)
    torque[joint] /= share
    return torque


@pytest.mark.parametrize("holding", [MODEL, FILE], ids=["model", "file"])
@pytest.mark.parametrize("joint", [0, 1])
def test_a_weak_motor_shows_in_its_own_joint(holding, joint):
    message = explanation(holding, weak(joint, 0.5))
    assert (
        message.startswith(f"motor {joint + 1} makes 0.50 times") and "weak" in message
    )


def test_a_load_shows_in_all_joints():
    assert "carries about 3.0 kg more" in explanation(MODEL, gravity(Q) + 3.0 * load(Q))


@pytest.mark.parametrize("joint", [0, 1])
def test_a_zero_that_has_moved_shows_in_all_joints_beyond(joint):
    shifted = Q + 0.3 * np.eye(4)[joint]
    message = explanation(MODEL, gravity(shifted))
    # A joint that turns all links beyond it alike is told from its neighbour by those between.
    assert "has moved by 0." in message or "weak" in message
    assert f"motor {joint + 1}" in message


def test_what_is_over_was_a_push_or_a_moment_of_weakness():
    pushed = BEFORE + np.array([9.0, 8.0, 6.0, 2.0])
    assert explanation(MODEL, gravity(Q), pushed) == "something pushed it for a moment"
    alone = BEFORE + np.array([0.0, 9.0, 0.0, 0.0])
    assert "motor 2 was held back for a moment" in explanation(MODEL, gravity(Q), alone)


def test_what_nothing_explains_gets_no_name():
    strange = gravity(Q) + np.array([9.0, -9.0, 9.0, -3.0])
    assert "something pushes it or holds it back" in explanation(MODEL, strange)
