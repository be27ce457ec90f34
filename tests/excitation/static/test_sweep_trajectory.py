"""Motion at constant speeds: derivatives are exact, speeds are those that are stated."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from robot_sysid.errors import InputError
from robot_sysid.excitation.static.sweep_trajectory import PEAK_ACCELERATION, SweepTrajectory
from tests.support.arms import SEEDS


def random_plan(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 7))
    ramps = rng.uniform(0.1, 0.5, count - 1)
    moves = ramps * rng.uniform(2.0, 6.0, count - 1)
    return SweepTrajectory(rng.normal(size=(count, 3)), moves, ramps)


@given(SEEDS)
def test_derivatives_are_those_of_the_positions(seed):
    plan = random_plan(seed)
    time, step = np.linspace(0.01, plan.duration - 0.01, 40), 1e-5
    ahead, behind, here = (plan.evaluate(time + s) for s in (step, -step, 0.0))
    np.testing.assert_allclose((ahead.q - behind.q) / (2 * step), here.qd, atol=2e-4)
    np.testing.assert_allclose((ahead.qd - behind.qd) / (2 * step), here.qdd, atol=2e-2)


@given(SEEDS)
def test_each_point_is_reached_at_rest_and_each_speed_held(seed):
    plan = random_plan(seed)
    ends = np.concatenate(([0.0], np.cumsum(plan.moves)))
    at_ends = plan.evaluate(ends)
    np.testing.assert_allclose(at_ends.q, plan.points, atol=1e-12)
    np.testing.assert_allclose(at_ends.qd, 0.0, atol=1e-12)
    middle = plan.evaluate(ends[:-1] + 0.5 * plan.moves)
    np.testing.assert_allclose(middle.qd, plan.speeds, atol=1e-12)
    along = plan.evaluate(np.linspace(0.0, plan.duration, 2000))
    most = np.max(PEAK_ACCELERATION * np.abs(plan.speeds) / plan.ramps[:, None], axis=0)
    assert np.all(np.max(np.abs(along.qdd), axis=0) <= most * (1.0 + 1e-12))


@pytest.mark.parametrize("ramps", [[0.0], [0.6], [-0.1]])
def test_ramps_that_do_not_fit_are_refused(ramps):
    with pytest.raises(InputError, match="ramps fit into it twice"):
        SweepTrajectory(np.array([[0.0], [1.0]]), np.array([1.0]), np.array(ramps))
