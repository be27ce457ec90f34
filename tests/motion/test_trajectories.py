"""Fourier series, motions through poses, and sweeps: derivatives, ends, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.motion.trajectories import (
    PEAK_ACCELERATION,
    PEAK_OF_RAMP,
    PEAK_SPEED,
    FourierBasis,
    FourierTrajectory,
    LineTrajectory,
)
from robot_sysid.trajectory import smooth_step
from tests.support.arms import SEEDS

JOINTS = 3


@st.composite
def bases(draw):
    """Any faded or periodic basis."""
    duration, harmonics = draw(st.floats(1.0, 60.0)), draw(st.integers(3, 12))
    if draw(st.booleans()):
        fade = draw(st.floats(0.05, 0.5)) * duration
        return FourierBasis(duration, draw(st.floats(0.02, 1.0)), harmonics, fade)
    return FourierBasis(duration, draw(st.integers(1, 4)) / duration, harmonics, 0.0)


def trajectory(basis, seed, size=1.0):
    """A random trajectory that is at rest at both ends."""
    rng = np.random.default_rng(seed)
    directions = basis.free_directions()
    x = size * rng.normal(size=(JOINTS, directions.shape[1]))
    return FourierTrajectory(basis, rng.normal(size=JOINTS), x @ directions.T)


@given(bases(), SEEDS)
def test_starts_and_ends_at_rest_in_the_rest_configuration(basis, seed):
    plan = trajectory(basis, seed)
    ends = plan.evaluate(np.array([0.0, plan.duration]))
    fastest = 2.0 * np.pi * max(basis.top_frequency_hz, 1.0)
    assert np.max(np.abs(ends.q - plan.rest)) < 1e-9
    assert np.max(np.abs(ends.qd)) < 1e-9 * fastest
    assert np.max(np.abs(ends.qdd)) < 1e-9 * fastest**2


@given(bases(), SEEDS)
def test_velocity_and_acceleration_are_the_derivatives(basis, seed):
    plan = trajectory(basis, seed)
    step = 1e-4 / max(basis.top_frequency_hz, 1.0 / (basis.fade or basis.duration))
    time = np.linspace(2.0 * step, plan.duration - 2.0 * step, 50)
    before, here, after = (plan.evaluate(time + d) for d in (-step, 0.0, step))
    speed = np.max(np.abs(here.qd)) + 1e-3
    push = np.max(np.abs(here.qdd)) + 1e-3
    assert np.max(np.abs((after.q - before.q) / (2 * step) - here.qd)) < 1e-5 * speed
    assert np.max(np.abs((after.qd - before.qd) / (2 * step) - here.qdd)) < 1e-5 * push


def test_a_periodic_trajectory_repeats_without_a_step():
    plan = trajectory(FourierBasis(5.0, 0.2, 6, 0.0), 0)
    time = np.linspace(0.0, 5.0, 40)
    assert np.allclose(plan.evaluate(time).qdd, plan.evaluate(time + 5.0).qdd, atol=1e-9)


def test_free_directions_span_all_that_is_at_rest():
    basis = FourierBasis(5.0, 0.2, 6, 0.0)
    directions = basis.free_directions()
    assert directions.shape == (basis.size, basis.size - 3)
    assert np.allclose(directions.T @ directions, np.eye(basis.size - 3), atol=1e-12)


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ((0.0, 0.1, 5, 0.1), "positive"),
        ((10.0, float("inf"), 5, 1.0), "positive"),
        ((10.0, 0.1, 5, 6.0), "twice"),
        ((10.0, 0.1, 5, float("nan")), "twice"),
        ((10.0, 0.13, 5, 0.0), "whole number of periods"),
        ((10.0, 0.1, 2, 0.0), "--harmonics"),
        ((10.0, 0.1, 0, 1.0), "--harmonics"),
    ],
)
def test_refuses_a_basis_that_cannot_be(values, word):
    with pytest.raises(InputError, match=word):
        FourierBasis(*values)


def test_refuses_periodic_coefficients_that_do_not_start_at_rest():
    basis = FourierBasis(10.0, 0.1, 4, 0.0)
    with pytest.raises(InputError, match="do not start at rest"):
        FourierTrajectory(basis, np.zeros(2), np.ones((2, basis.size)))


def test_refuses_coefficients_of_the_wrong_shape():
    with pytest.raises(InputError, match="Fourier coefficients has shape"):
        FourierTrajectory(FourierBasis(10.0, 0.1, 4, 1.0), np.zeros(2), np.zeros((2, 8)))


def random_poses(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 7))
    moves, dwells = rng.uniform(0.3, 2.0, count - 1), rng.uniform(0.0, 1.0, count)
    return LineTrajectory(rng.normal(size=(count, 3)), moves, dwells)


@given(SEEDS)
def test_the_arm_rests_in_every_point(seed):
    plan = random_poses(seed)
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
        LineTrajectory(np.zeros((1, 2)), np.zeros(0), np.ones(1))
    with pytest.raises(InputError, match="take time"):
        LineTrajectory(np.zeros((2, 1)), np.zeros(1), np.zeros(2))


def random_sweeps(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 7))
    ramps = rng.uniform(0.1, 0.5, count - 1)
    moves = ramps * rng.uniform(2.0, 6.0, count - 1)
    return LineTrajectory(rng.normal(size=(count, 3)), moves, np.zeros(count), ramps)


@pytest.mark.parametrize(("make", "error"), [(random_poses, 2e-5), (random_sweeps, 2e-4)])
@given(seed=SEEDS)
def test_derivatives_of_lines_are_those_of_the_positions(make, error, seed):
    plan = make(seed)
    time, step = np.linspace(0.01, plan.duration - 0.01, 40), 1e-5
    ahead, behind, here = (plan.evaluate(time + s) for s in (step, -step, 0.0))
    np.testing.assert_allclose((ahead.q - behind.q) / (2 * step), here.qd, atol=error)
    np.testing.assert_allclose((ahead.qd - behind.qd) / (2 * step), here.qdd, atol=100.0 * error)


@given(SEEDS)
def test_each_point_is_reached_at_rest_and_each_speed_held(seed):
    plan = random_sweeps(seed)
    ends = np.concatenate(([0.0], np.cumsum(plan.moves)))
    at_ends = plan.evaluate(ends)
    np.testing.assert_allclose(at_ends.q, plan.points, atol=1e-12)
    np.testing.assert_allclose(at_ends.qd, 0.0, atol=1e-12)
    middle = plan.evaluate(ends[:-1] + 0.5 * plan.moves)
    np.testing.assert_allclose(middle.qd, plan.speeds, atol=1e-12)
    along = plan.evaluate(np.linspace(0.0, plan.duration, 2000))
    most = np.max(PEAK_OF_RAMP * np.abs(plan.speeds) / plan.ramps[:, None], axis=0)
    assert np.all(np.max(np.abs(along.qdd), axis=0) <= most * (1.0 + 1e-12))


@pytest.mark.parametrize("ramps", [[0.0], [0.6], [-0.1]])
def test_ramps_that_do_not_fit_are_refused(ramps):
    with pytest.raises(InputError, match="ramps fit into it twice"):
        LineTrajectory(np.array([[0.0], [1.0]]), np.array([1.0]), np.zeros(2), np.array(ramps))
