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


def passes(count, phase=0.0):
    """Return ``count`` passes of the motion, each ``phase`` samples later than the last."""
    return [motion(phase * k) for k in range(count)]


def visit_inflation(motions, residual):
    """Return the variance inflation by the visits of all rows, for residuals (N,)."""
    return find_visits(motions).inflation([residual])[0]


def sample_inflation(motions, residual):
    """Return the variance inflation (1,) by samples of the rows, each motion a log of its own."""
    samples = []
    for k, errors in enumerate(np.split(residual, len(motions))):
        samples.append(sample_rows(motions[k], errors[:, None], 7 + k))
    return reduce(add, samples).inflation()


@pytest.mark.parametrize(("seed", "count"), [(0, 1), (0, 2), (1, 12)])
def test_repeated_residuals_count_once(seed, count):
    motions = passes(count)
    residual = np.tile(default_rng(seed).normal(size=COUNT), count)
    assert visit_inflation(motions, residual) == pytest.approx(count, rel=1e-9)
    assert (find_visits(motions).repeats < 1.0) == (count == 1)


@pytest.mark.parametrize(("seed", "count"), [(0, 2), (1, 12)])
def test_new_residuals_count_every_time(seed, count):
    residual = default_rng(seed).normal(size=count * COUNT)
    factor = visit_inflation(passes(count), residual)
    # The sum of count - 1 others per row, COUNT rows: six standard deviations.
    assert factor <= 1.0 + 6.0 * np.sqrt((count - 1) / COUNT)


def test_a_passage_between_the_rows_of_another_is_detected():
    """Between two rows, at twice the cut-off, the signal is band-limited."""
    factors = []
    for seed in range(20):
        fine = default_rng(seed).normal(size=COUNT)
        rows = np.arange(COUNT)
        between = np.sinc(rows[:, None] + 0.5 - rows) @ fine
        residual = np.concatenate((fine, between))
        factors.append(visit_inflation(passes(2, 0.5), residual))
    assert np.mean(factors) == pytest.approx(2.0, abs=0.3)


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
    residual = np.tile(rng.normal(size=150), count) + rng.normal(size=150 * count)
    expected = visit_inflation(passes(count), residual)
    assert sample_inflation(passes(count), residual) == pytest.approx(
        expected, rel=0.05
    )


def test_a_sample_of_many_rows_detects_repetition():
    repeated = np.tile(default_rng(0).normal(size=150), 40)
    assert 30.0 < sample_inflation(passes(40), repeated)[0] < 50.0


def test_a_sample_of_many_rows_detects_independent_residuals():
    independent = default_rng(1).normal(size=150 * 40)
    assert 1.0 <= sample_inflation(passes(40), independent)[0] < 4.0


def test_the_same_log_twice_is_refused(monkeypatch):
    monkeypatch.setattr(repetition, "MOST_ROWS", 50)
    sample = sample_rows(motion(), np.zeros((150, 1)), 3)
    with pytest.raises(InputError, match="add each log once"):
        _ = sample + sample_rows(motion(), np.zeros((150, 1)), 3)


def test_a_sampled_motion_consists_of_rows_of_the_log():
    full = motion()
    sample = sample_rows(full, np.zeros((150, 1)), 3).motion(20)
    is_row = np.all(sample.q[:, None] == full.q, axis=2)
    assert np.all(np.any(is_row, axis=1))
    rows = np.argmax(is_row, axis=1)
    assert len(np.unique(rows)) == 20
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
