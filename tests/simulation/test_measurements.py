"""The plant's measurements: both simulations, sensors on top, readable as often as wanted."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.records import Measurement
from robot_sysid.simulation.measurements import PlantSimulation
from robot_sysid.simulation.sensors import SimulatedArmOptions
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks
from tests.support import arms
from tests.support.arms import robot_of
from tests.support.closed_loop_proof import excitation

RATE = 200.0


@pytest.fixture(scope="module")
def plant():
    """A small arm with armature and dry friction."""
    joint = 'range="-2 2" frictionloss=".3" damping=".2" armature=".1"'
    return robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X), joint=joint))


@pytest.fixture(scope="module")
def plan(plant):
    """Five seconds of motion."""
    return excitation(plant, duration=5.0)


def joined(chunks):
    """All chunks as one measurement."""
    parts = list(chunks)
    values = [
        None if getattr(parts[0], n) is None else np.concatenate([getattr(p, n) for p in parts])
        for n in ("time", "q", "qd", "tau", "qdd")
    ]
    return Measurement(*values)


def run(plant, plan, simulation, **sensors):
    """One simulation with these sensors."""
    options = SimulatedArmOptions(simulation=simulation, **sensors)
    return PlantSimulation(plant, plan, options, RATE, np.random.default_rng(5))


def test_inverse_with_perfect_sensors_is_the_models_own_simulation(plant, plan):
    own = joined(simulate_inverse(plant, motion_chunks(plan, RATE)))
    np.testing.assert_array_equal(joined(run(plant, plan, "inverse")).tau, own.tau)


def test_forward_and_inverse_agree_where_friction_is_complete(plant, plan):
    simulation = run(plant, plan, "forward")
    forward, inverse = joined(simulation), joined(run(plant, plan, "inverse"))
    np.testing.assert_array_equal(forward.time, inverse.time)
    fast = np.abs(inverse.qd) > 0.1
    # The loop follows within 1e-4 rad and 1e-2 rad/s^2 of its trajectory away from reversals.
    difference = np.abs(forward.tau - inverse.tau)[fast]
    assert np.median(difference) < 1e-3 and np.max(difference) < 0.1


@pytest.mark.parametrize("simulation", ["inverse", "forward"])
def test_reading_twice_gives_the_same_measurements(plant, plan, simulation):
    measurements = run(plant, plan, simulation, noise_torque=0.1, encoder_resolution=1e-4)
    first, second = joined(measurements), joined(measurements)
    np.testing.assert_array_equal(first.tau, second.tau)
    np.testing.assert_array_equal(first.q, second.q)


@pytest.mark.parametrize("simulation", ["inverse", "forward"])
def test_sensors_act_on_what_perfect_ones_would_see(plant, plan, simulation):
    measurements = run(plant, plan, simulation, encoder_resolution=1e-3, noise_torque=0.05)
    exact, seen = joined(measurements.exact()), joined(measurements)
    assert seen.qd is None and seen.qdd is None
    assert np.max(np.abs(seen.q - exact.q)) <= 0.5e-3 * (1.0 + 1e-9)
    assert np.std(seen.tau - exact.tau) == pytest.approx(0.05, rel=0.1)


def test_notes_of_the_inverse_simulation_are_empty(plant, plan):
    measurements = run(plant, plan, "inverse")
    joined(measurements)
    assert measurements.notes() == ()


def test_what_was_asked_for_is_checked_by_name():
    with pytest.raises(InputError, match="--simulation 'both': choose one of inverse, forward"):
        SimulatedArmOptions(simulation="both")


def test_noise_levels_and_trajectory_must_fit_the_plant(plant, plan):
    with pytest.raises(
        InputError, match="--noise-torque takes one number, or one for each of the 3 joints"
    ):
        run(plant, plan, "inverse", noise_torque=(0.1, 0.2))
    with pytest.raises(InputError, match="--noise-position takes one number, or one for each"):
        run(plant, plan, "inverse", noise_position=(0.1, 0.2))
    other = robot_of(arms.SEVEN)
    with pytest.raises(InputError, match="moves 3 joints, the plant has 7"):
        run(other, plan, "inverse")
