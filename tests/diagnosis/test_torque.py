"""Torque that the model does not explain or need not explain, without gravity, or computed."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.diagnosis.run import check_against_model
from robot_sysid.records import Measurement
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import motion_chunks
from tests.support import arms
from tests.support.closed_loop_proof import excitation

RATE = 200.0
ROBOT = arms.robot_of(
    arms.serial_arm(
        (arms.Z, arms.Y, arms.Y, arms.X), joint='range="-2.5 2.5" frictionloss=".4" damping=".2"'
    )
)


def log_that_creeps_to_rest(seed, push=0.0, robot=ROBOT):
    """A right log of a light arm with much dry friction, which acts until the very end.

    ``push``: torque of something else on every joint for half a second, while it moves [N m].
    """
    motion = next(motion_chunks(excitation(robot, seed, 12.0), RATE))
    noise = np.random.default_rng(seed).normal(0.0, 0.05, motion.q.shape)
    pushed = np.where((motion.time > 5.0) & (motion.time < 5.5), push, 0.0)[:, None]
    tau = ArmTorque(robot)(motion) + noise + pushed
    return Measurement(motion.time, np.round(motion.q, 5), None, tau)


@pytest.mark.parametrize("seed", range(3))
def test_dry_friction_at_rest_is_no_contact(seed):
    assert check_against_model(ROBOT, [log_that_creeps_to_rest(seed)]) == ()


@pytest.mark.parametrize("axes", [(arms.Y,), (arms.Z, arms.Y), (arms.Y, arms.X)])
def test_an_arm_that_is_mostly_terminal_link_is_no_odd_one(axes):
    joint = 'range="-2.5 2.5" frictionloss=".4" damping=".2"'
    short = arms.robot_of(arms.serial_arm(axes, joint=joint))
    assert check_against_model(short, [log_that_creeps_to_rest(0, robot=short)]) == ()


def test_a_push_while_it_moves_still_is():
    found = check_against_model(ROBOT, [log_that_creeps_to_rest(0, push=4.0)])
    assert [each.name for each in found] == ["contact"]
