"""Torques of resting poses without friction."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from robot_sysid.errors import InputError
from robot_sysid.motion.trajectories import LineTrajectory
from robot_sysid.records import Measurement
from robot_sysid.signals.rests import resting_poses

APPROACH = 0.05


def log_of(poses, dwell=1.5, friction=2.0, both_sides=True):
    """Return a log that rests at poses (P, 2), approached from one side or from both.

    The torque is 3 q plus dry friction that lasts while the arm rests.
    """
    points = [np.zeros(2)]
    dwells = [0.0]
    for pose in poses:
        last = pose + APPROACH if both_sides else pose - APPROACH
        points += [pose - APPROACH, pose, last, pose]
        dwells += [0.0, dwell, 0.0, dwell]
    moves = np.full(len(points) - 1, 0.8)
    plan = LineTrajectory(np.array(points), moves, np.array(dwells))
    time = np.arange(0.0, plan.duration, 0.005)
    motion = plan.evaluate(time)
    held = np.zeros(2)
    tau = np.zeros_like(motion.q)
    for k, speed in enumerate(motion.qd):
        held = np.where(speed != 0.0, np.sign(speed), held)
        tau[k] = 3.0 * motion.q[k] + friction * held
    return Measurement(time, motion.q, None, tau)


POSES = default_rng(0).uniform(-1.0, 1.0, (6, 2))


def test_friction_cancels_at_poses_approached_from_both_sides():
    log = log_of(POSES)
    q = log.q + 1e-4 * default_rng(1).standard_normal(log.q.shape)
    noisy = Measurement(log.time, q, None, log.tau)
    assert len(resting_poses(noisy)[0]) == 6
    poses, used = resting_poses(log)
    assert len(poses) == 6 and np.all(used)
    assert_allclose(poses.q, POSES, atol=1e-6)
    assert_allclose(poses.tau, 3.0 * POSES, atol=1e-6)
    assert not np.any(poses.qd) and not np.any(poses.qdd)


def test_poses_approached_from_one_side_alone_are_refused():
    with pytest.raises(InputError, match="from both sides"):
        resting_poses(log_of(POSES, both_sides=False))


def test_too_few_poses_are_refused():
    with pytest.raises(InputError, match="plan --for payload --static"):
        resting_poses(log_of(POSES[:3]))
