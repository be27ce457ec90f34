"""A slowed trajectory follows the same path, with exact derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.design.fourier import FourierBasis
from robot_sysid.design.slowed import SlowedTrajectory, at_speed
from robot_sysid.errors import InputError
from tests.arms import SEEDS
from tests.test_fourier import trajectory

BASIS = FourierBasis(6.0, 0.2, 4, 1.0)
SPEEDS = st.floats(0.01, 1.0)


@given(SEEDS, SPEEDS)
def test_same_path_later(seed, speed):
    plan = trajectory(BASIS, seed)
    slow = at_speed(plan, speed)
    time = np.linspace(0.0, plan.duration, 40)
    full, later = plan.evaluate(time), slow.evaluate(time / speed)
    assert slow.duration == pytest.approx(plan.duration / speed)
    assert slow.n_joints == plan.n_joints
    assert np.allclose(later.q, full.q, atol=1e-9)
    assert np.allclose(later.qd, speed * full.qd, atol=1e-8)
    assert np.allclose(later.qdd, speed**2 * full.qdd, atol=1e-7)


@given(SEEDS, SPEEDS)
def test_velocity_and_acceleration_are_the_derivatives(seed, speed):
    slow = at_speed(trajectory(BASIS, seed), speed)
    step = 1e-4 / speed
    time = np.linspace(2 * step, slow.duration - 2 * step, 30)
    before, here, after = (slow.evaluate(time + d) for d in (-step, 0.0, step))
    tolerance = 1e-4 * (1.0 + np.max(np.abs(here.qdd)))
    assert np.max(np.abs((after.q - before.q) / (2 * step) - here.qd)) < tolerance
    assert np.max(np.abs((after.qd - before.qd) / (2 * step) - here.qdd)) < tolerance


@given(SEEDS, SPEEDS)
def test_at_rest_at_both_ends(seed, speed):
    slow = at_speed(trajectory(BASIS, seed), speed)
    ends = slow.evaluate(np.array([0.0, slow.duration]))
    assert np.max(np.abs(ends.qd)) < 1e-9
    assert np.max(np.abs(ends.qdd)) < 1e-9


def test_full_speed_is_the_trajectory_itself():
    plan = trajectory(BASIS, 0)
    assert at_speed(plan, 1.0) is plan


@pytest.mark.parametrize("speed", [0.0, -0.5, 1.2, float("nan")])
def test_refuses_what_is_not_slower(speed):
    with pytest.raises(InputError, match="--speed must be above 0 and at most 1"):
        SlowedTrajectory(trajectory(BASIS, 0), speed)
