"""Laws of simulated sensors: what each option changes, by how much, and what it leaves alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.signals.resampling import join_measurements
from robot_sysid.simulation.options import SimulatedArmOptions
from robot_sysid.simulation.plant import PlantSimulation, quantised
from robot_sysid.simulator import ArmTorque
from tests.support import arms
from tests.support.arms import SEEDS
from tests.support.closed_loop_proof import excitation

RATE = 500.0
ROBOT = arms.robot_of(arms.THREE)


def read(plan, **options):
    """What the sensors of a plant report of a motion, as one measurement."""
    rng = np.random.default_rng(0)
    sensors = SimulatedArmOptions(**options)
    return join_measurements(PlantSimulation(ROBOT, plan, sensors, RATE, rng))


def test_noise_has_the_standard_deviation_asked_for_joint_by_joint():
    plan = excitation(ROBOT, duration=120.0)
    levels = np.array([0.1, 0.5, 2.0])
    exact = read(plan)
    seen = read(plan, noise_torque=tuple(levels), encoder_resolution=0.02)
    # An arm with only encoders would have to compute them from those same positions.
    assert seen.qd is None and seen.qdd is None
    # 60 000 draws: the spread of an estimated deviation is 0.3 %; 1.5 % is five times that.
    np.testing.assert_allclose(np.std(seen.tau - exact.tau, axis=0), levels, rtol=0.015)
    assert np.max(np.abs(seen.q - exact.q)) <= 0.01 * (1.0 + 1e-9)


@given(st.floats(1e-6, 0.1), SEEDS)
def test_quantised_positions_are_multiples_of_the_step_and_nearest(step, seed):
    values = np.random.default_rng(seed).normal(size=50)
    seen = quantised(values, step)
    assert np.all(np.abs(seen - values) <= 0.5 * step * (1.0 + 1e-9))
    np.testing.assert_allclose(seen / step, np.round(seen / step), rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(quantised(seen, step), seen)


@given(st.floats(0.0, 0.05))
def test_a_delayed_torque_is_the_torque_that_much_earlier(delay):
    plan = excitation(ROBOT, duration=2.0)
    seen = read(plan, torque_delay=delay)
    earlier = plan.evaluate(np.maximum(seen.time - delay, 0.0))
    np.testing.assert_allclose(seen.tau, ArmTorque(ROBOT)(earlier), rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(seen.q, plan.evaluate(seen.time).q)


@pytest.mark.parametrize(
    ("spoil", "option"),
    [
        ({"noise_torque": -0.1}, "--noise-torque"),
        ({"torque_delay": 5.0}, "--torque-delay"),
    ],
)
def test_impossible_sensors_are_refused_by_the_option_name(spoil, option):
    with pytest.raises(InputError, match=option):
        SimulatedArmOptions(**spoil)
