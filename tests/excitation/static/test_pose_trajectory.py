"""Motion from pose to pose: derivatives are exact, and the arm rests where it is said to."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from robot_sysid.errors import InputError
from robot_sysid.excitation.static.pose_trajectory import (
    PEAK_ACCELERATION,
    PEAK_SPEED,
    PoseTrajectory,
    smooth_step,
)
from tests.support.arms import SEEDS


def random_plan(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 7))
    moves, dwells = rng.uniform(0.3, 2.0, count - 1), rng.uniform(0.0, 1.0, count)
    return PoseTrajectory(rng.normal(size=(count, 3)), moves, dwells)


@given(SEEDS)
def test_derivatives_are_those_of_the_positions(seed):
    plan = random_plan(seed)
    time, step = np.linspace(0.01, plan.duration - 0.01, 40), 1e-5
    ahead, behind, here = (plan.evaluate(time + s) for s in (step, -step, 0.0))
    np.testing.assert_allclose((ahead.q - behind.q) / (2 * step), here.qd, atol=2e-5)
    np.testing.assert_allclose((ahead.qd - behind.qd) / (2 * step), here.qdd, atol=2e-3)


@given(SEEDS)
def test_the_arm_rests_in_every_point(seed):
    plan = random_plan(seed)
    for arrival, dwell, point in zip(plan.arrivals, plan.dwells, plan.points):
        motion = plan.evaluate(arrival + np.linspace(0.0, 1.0, 5) * dwell)
        np.testing.assert_allclose(motion.q, np.broadcast_to(point, (5, 3)), atol=1e-9)
        np.testing.assert_allclose(motion.qd, 0.0, atol=1e-9)


def test_peaks_of_the_step():
    _, speed, acceleration = smooth_step(np.linspace(0.0, 1.0, 100001))
    assert np.max(speed) == pytest.approx(PEAK_SPEED, rel=1e-6)
    assert np.max(np.abs(acceleration)) == pytest.approx(PEAK_ACCELERATION, rel=1e-4)


def test_a_move_takes_time():
    with pytest.raises(InputError, match="take time"):
        PoseTrajectory(np.zeros((1, 2)), np.zeros(0), np.ones(1))
    with pytest.raises(InputError, match="take time"):
        PoseTrajectory(np.zeros((2, 1)), np.zeros(1), np.zeros(2))
