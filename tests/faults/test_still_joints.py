"""Joints that stand still are no measure of the units of those that move."""

from dataclasses import replace

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.core_fits import fit_logs
from rigs.arms.wrong_arms import draw_arm
from robot_sysid.faults.scales import odd_unit
from robot_sysid.records import Motion

SEVEN = small_arms.robot_of(small_arms.SEVEN)
UNIT = 1e-3
"""Newton metres in what a log with another unit has [N m]."""


def log_of_three(moving):
    """Return a log in which three of seven joints move."""

    def with_others_still(plan, _):
        motion = plan.evaluate(np.arange(round(250.0 * plan.duration)) / 250.0)
        moves = np.isin(range(SEVEN.n_joints), moving).astype(float)
        q = np.where(moves, motion.q, SEVEN.reference)
        return Motion(motion.time, q, moves * motion.qd, moves * motion.qdd)

    truth = draw_arm(SEVEN, "straight", False, 8.0, True, 2, with_others_still, 0.1)
    return replace(truth.log, name="log")


@pytest.mark.parametrize(
    ("moving", "pulled"), [((0, 4, 5), 4), ((0, 5, 6), 5), ((1, 3, 5), 5)]
)
def test_three_joints_that_move_are_accused_of_no_other_unit(moving, pulled):
    """A cable pulls at one of them, which leaves torque that nothing explains."""
    log = log_of_three(moving)
    pull = np.std(log.tau[:, pulled]) * np.sin(7.0 * log.time)
    tau = log.tau + pull[:, None] * (np.arange(SEVEN.n_joints) == pulled)
    assert not list(odd_unit(fit_logs(SEVEN, replace(log, tau=tau))))


def test_another_unit_is_found_where_other_joints_stand_still():
    log = log_of_three((1, 3, 5))
    scales = np.where(np.arange(SEVEN.n_joints) == 3, 1.0 / UNIT, 1.0)
    (finding,) = odd_unit(fit_logs(SEVEN, replace(log, tau=log.tau * scales)))
    assert f"torque of joint {SEVEN.joint_names[3]} alone reads" in finding.text
