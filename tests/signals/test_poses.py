"""Resting poses in a log: friction cancels, slow starts and stops do not count."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.motion.trajectories import LineTrajectory
from robot_sysid.records import Measurement
from robot_sysid.signals.poses import resting_poses

NAMES = ("one", "two")
APPROACH = 0.05


def log_of(poses, dwell=1.5, friction=2.0, both_sides=True):
    """A log whose torque is 3 q plus dry friction that lasts while the arm rests."""
    points = [np.zeros(2)]
    dwells = [0.0]
    for pose in poses:
        last = pose + APPROACH if both_sides else pose - APPROACH
        points += [pose - APPROACH, pose, last, pose]
        dwells += [0.0, dwell, 0.0, dwell]
    plan = LineTrajectory(
        np.array(points), np.full(len(points) - 1, 0.8), np.array(dwells)
    )
    time = np.arange(0.0, plan.duration, 0.005)
    motion = plan.evaluate(time)
    held = np.zeros(2)
    tau = np.zeros_like(motion.q)
    for k, speed in enumerate(motion.qd):
        held = np.where(speed != 0.0, np.sign(speed), held)
        tau[k] = 3.0 * motion.q[k] + friction * held
    return Measurement(time, motion.q, None, tau)


POSES = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 2))


def test_friction_of_both_sides_cancels():
    log = log_of(POSES)
    q = log.q + 1e-4 * np.random.default_rng(1).standard_normal(log.q.shape)
    noisy = Measurement(log.time, q, None, log.tau)
    assert len(resting_poses(noisy, NAMES)[0]) == 6
    poses, used = resting_poses(log, NAMES)
    assert len(poses) == 6 and np.all(used)
    np.testing.assert_allclose(poses.q, POSES, atol=1e-6)
    np.testing.assert_allclose(poses.tau, 3.0 * POSES, atol=1e-6)
    assert not np.any(poses.qd) and not np.any(poses.qdd)


def test_poses_that_are_approached_twice_from_one_side_do_not_count():
    with pytest.raises(InputError, match="from both sides"):
        resting_poses(log_of(POSES, both_sides=False), NAMES)


def test_too_few_poses_are_refused_with_what_to_do():
    with pytest.raises(InputError, match="plan --for payload --static"):
        resting_poses(log_of(POSES[:3]), NAMES)
