"""Variance inflation by residuals that repeat with the motion; resting poses without friction."""

from __future__ import annotations

from functools import reduce
from operator import add

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter

from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.uncertainty import residual_correlation_time
from robot_sysid.motion.trajectories import LineTrajectory
from robot_sysid.records import Measurement, Motion
from robot_sysid.signals import repetition
from robot_sysid.signals.repetition import find_visits, resting_poses, sample_rows

COUNT = 150


def motion(phase: float = 0.0, rate: float = 15.0) -> Motion:
    """Return the motion of two joints that passes each state once, ``phase`` samples late."""
    time = phase / rate + np.arange(COUNT) / rate
    frequency = np.array([1.3, 2.9])
    angle = frequency * time[:, None] + np.array([0.0, 1.0])
    return Motion(
        time, np.sin(angle), frequency * np.cos(angle), -(frequency**2) * np.sin(angle)
    )


class Samples:
    """One joint's regressor rows (N, 3) and torque (N,)."""

    def __init__(self, rows, tau):
        self.rows = rows
        self.tau = tau


def repeat_motion(count, noise, phase=0.0):
    """Return ``count`` passes of the motion, each ``phase`` samples later, and their Samples."""
    motions = [motion(phase * k) for k in range(count)]
    rows = np.concatenate([np.column_stack((m.q, m.qd[:, 0])) for m in motions])
    return motions, Samples(rows, rows @ np.array([1.0, 2.0, 3.0]) + noise)


def inflation(motions, samples):
    """Return the variance inflation of the residuals that TRUTH leaves."""
    return find_visits(motions).inflation(
        [samples.tau - samples.rows @ [1.0, 2.0, 3.0]]
    )[0]


@pytest.mark.parametrize(("seed", "count"), [(0, 1), (0, 2), (1, 12)])
def test_repeated_residuals_count_once(seed, count):
    rng = default_rng(seed)
    motions, samples = repeat_motion(count, np.tile(rng.normal(size=COUNT), count))
    assert inflation(motions, samples) == pytest.approx(count, rel=1e-9)
    assert (find_visits(motions).repeats < 1.0) == (count == 1)


@pytest.mark.parametrize(("seed", "count"), [(0, 2), (1, 12)])
def test_new_residuals_count_every_time(seed, count):
    rng = default_rng(seed)
    factor = inflation(*repeat_motion(count, rng.normal(size=count * COUNT)))
    # The sum of count - 1 others per row, COUNT rows: six standard deviations.
    assert factor <= 1.0 + 6.0 * np.sqrt((count - 1) / COUNT)


def test_a_passage_between_the_rows_of_another_is_detected():
    """Rows follow each other at twice the cut-off, so that the signal between two rows is band-
    limited.
    """
    factors = []
    for seed in range(20):
        fine = default_rng(seed).normal(size=COUNT)
        between = np.sinc(np.arange(COUNT)[:, None] + 0.5 - np.arange(COUNT)) @ fine
        motions, samples = repeat_motion(2, np.concatenate((fine, between)), phase=0.5)
        factors.append(inflation(motions, samples))
    assert np.mean(factors) == pytest.approx(2.0, abs=0.3)


TRUTH = np.array([1.0, 2.0, 3.0])


def samples_of(motions, samples):
    """Return a sample of the rows of each motion, as of different logs."""
    left = np.split(samples.tau - samples.rows @ TRUTH, len(motions))
    return [
        sample_rows(m, e[:, None], 7 + k) for k, (m, e) in enumerate(zip(motions, left))
    ]


@pytest.mark.parametrize("keep", [0.0, 0.8, 0.95])
def test_the_correlation_time_of_first_order_noise(keep):
    """It is (1 + a) / (1 - a) for coefficient a; missing values change nothing."""
    drawn = default_rng(3).normal(size=20000)
    residual = lfilter([1.0], [1.0, -keep], drawn)
    residual[5000:6000] = np.nan
    assert residual_correlation_time(residual) == pytest.approx(
        (1.0 + keep) / (1.0 - keep), rel=0.15
    )
    assert residual_correlation_time(np.zeros(50)) == 1.0


@pytest.mark.parametrize(("seed", "count"), [(0, 3), (1, 12)])
def test_the_inflation_of_samples_equals_that_of_visits(seed, count):
    rng = default_rng(seed)
    shared = np.tile(rng.normal(size=150), count) + rng.normal(size=150 * count)
    motions, samples = repeat_motion(count, shared)
    factors = reduce(add, samples_of(motions, samples)).inflation()
    assert factors == pytest.approx(inflation(motions, samples), rel=0.05)


@pytest.mark.parametrize(("seed", "comes_again"), [(0, True), (1, False)])
def test_a_sample_of_many_rows_detects_repetition(seed, comes_again):
    rng = default_rng(seed)
    count = 40
    passage = rng.normal(size=150)
    noise = np.tile(passage, count) if comes_again else rng.normal(size=150 * count)
    factor = reduce(add, samples_of(*repeat_motion(count, noise))).inflation()[0]
    assert (
        0.75 * count < factor < 1.25 * count
        if comes_again
        else 1.0 <= factor < 0.1 * count
    )


def test_the_same_log_twice_is_refused(monkeypatch):
    monkeypatch.setattr(repetition, "MOST_ROWS", 50)
    one, same = (sample_rows(motion(), np.zeros((150, 1)), 3) for _ in range(2))
    with pytest.raises(InputError, match="add each log once"):
        _ = one + same


def test_a_sampled_motion_consists_of_rows_of_the_log():
    full = motion()
    sample = sample_rows(full, np.zeros((150, 1)), 3).motion(20)
    rows = [int(np.flatnonzero((full.q == q).all(axis=1))[0]) for q in sample.q]
    assert len(set(rows)) == 20
    assert_array_equal(sample.qdd, full.qdd[rows])


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
