"""Laws of Fourier series trajectories: rest at both ends, exact derivatives, linearity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.excitation.fourier import FourierBasis, FourierTrajectory
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


@given(bases(), SEEDS, st.floats(0.0, 1.0))
def test_departures_from_rest_scale(basis, seed, factor):
    plan = trajectory(basis, seed)
    time = np.linspace(0.0, plan.duration, 30)
    full, part = plan.evaluate(time), plan.scaled(factor).evaluate(time)
    assert np.allclose(part.q - plan.rest, factor * (full.q - plan.rest), atol=1e-10)
    assert np.allclose(part.qdd, factor * full.qdd, rtol=1e-10, atol=1e-8)


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
