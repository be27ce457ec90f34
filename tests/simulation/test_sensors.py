"""Laws of simulated sensors: what each option changes, by how much, and what it leaves alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.logs.reader import join_measurements
from robot_sysid.records import Measurement
from robot_sysid.simulation.options import SimulatedArmOptions
from robot_sysid.simulation.plant import Sensors, quantised
from tests.support.arms import SEEDS

RATE = 1000.0
SAMPLES = 400


def smooth(samples=SAMPLES, joints=3, frequency=2.0):
    """Exact measurements of a sine motion with a sine torque of 10 N m."""
    time = np.arange(samples) / RATE
    angle = 2.0 * np.pi * frequency * time[:, None] + np.arange(joints)
    return Measurement(time, np.sin(angle), np.cos(angle), 10.0 * np.sin(angle), -np.sin(angle))


def cut(measurement, lengths):
    """The same measurements in chunks."""
    edges = np.unique(np.clip(np.cumsum([0, *lengths, SAMPLES]), 0, SAMPLES))
    for a, b in zip(edges[:-1], edges[1:]):
        parts = (getattr(measurement, name)[a:b] for name in ("time", "q", "qd", "tau", "qdd"))
        yield Measurement(*parts)


def read(measurements, seed=0, **options):
    """All readings as one measurement."""
    sensors = Sensors(SimulatedArmOptions(**options), RATE, np.random.default_rng(seed))
    return join_measurements(sensors.read(measurements))


def same(first, second):
    """Whether two measurements are equal bit by bit."""
    return all(
        np.array_equal(getattr(first, name), getattr(second, name)) for name in ("q", "qd", "tau")
    )


@given(st.lists(st.integers(1, 150), max_size=8), SEEDS)
def test_readings_do_not_depend_on_how_the_stream_is_cut(lengths, seed):
    spoil = {"noise_torque": (0.1, 0.2, 0.3), "encoder_resolution": 1e-4, "torque_delay": 0.0034}
    exact = smooth()
    assert same(read([exact], seed, **spoil), read(cut(exact, lengths), seed, **spoil))


def test_noise_has_the_standard_deviation_asked_for_joint_by_joint():
    exact = smooth(60_000)
    levels = np.array([0.1, 0.5, 2.0])
    seen = read([exact], noise_torque=tuple(levels), encoder_resolution=0.02)
    # An arm with only encoders would have to compute them from those same positions.
    assert seen.qd is None and seen.qdd is None
    # 60 000 draws: the spread of an estimated deviation is 0.3 %; 1.5 % is five times that.
    np.testing.assert_allclose(np.std(seen.tau - exact.tau, axis=0), levels, rtol=0.015)


@given(st.floats(1e-6, 0.1), SEEDS)
def test_quantised_positions_are_multiples_of_the_step_and_nearest(step, seed):
    values = np.random.default_rng(seed).normal(size=50)
    seen = quantised(values, step)
    assert np.all(np.abs(seen - values) <= 0.5 * step * (1.0 + 1e-9))
    np.testing.assert_allclose(seen / step, np.round(seen / step), rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(quantised(seen, step), seen)


@given(st.floats(0.0, 0.05))
def test_a_delayed_torque_is_the_torque_that_much_earlier(delay):
    frequency = 2.0
    exact = smooth(frequency=frequency)
    seen = read([exact], torque_delay=delay)
    settled = exact.time > delay + 4.0 / RATE
    angle = 2.0 * np.pi * frequency * (exact.time[settled] - delay)[:, None] + np.arange(3)
    # The stated bound: h^4 / 24 times the fourth derivative, 10 N m (2 pi f)^4.
    bound = 10.0 * (2.0 * np.pi * frequency) ** 4 / (24.0 * RATE**4)
    np.testing.assert_allclose(seen.tau[settled], 10.0 * np.sin(angle), rtol=0.0, atol=1.01 * bound)


@pytest.mark.parametrize(
    ("spoil", "option"),
    [({"noise_torque": -0.1}, "--noise-torque"), ({"torque_delay": 5.0}, "--torque-delay")],
)
def test_impossible_sensors_are_refused_by_the_option_name(spoil, option):
    with pytest.raises(InputError, match=option):
        SimulatedArmOptions(**spoil)
