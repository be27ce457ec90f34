"""Two arms with correct logs, which the tests of all checks spoil."""

from __future__ import annotations

import pytest

from tests.support import arms
from tests.support.wrong_logs import truth_of

FOUR_AXES = (arms.Z, arms.Y, arms.Y, arms.X)
JOINT = 'range="-2.5 2.5" frictionloss=".4" damping=".2"'


@pytest.fixture(scope="session")
def truth():
    """Return a correct log of an arm of five joints and its truth."""
    joint = 'range="-2.5 2.5" armature=".02"'
    robot = arms.robot_of(arms.serial_arm(arms.SEVEN_AXES[:5], joint=joint))
    return truth_of(robot, seed=3)


@pytest.fixture(scope="session")
def four_joints():
    """Return a correct log of an arm of four joints with friction and its truth."""
    return truth_of(arms.robot_of(arms.serial_arm(FOUR_AXES, joint=JOINT)), seed=4)
