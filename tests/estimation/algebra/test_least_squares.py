"""Laws of least squares: weights follow the noise, units of a joint do not matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from robot_sysid.estimation.algebra.least_squares import (
    InformationAccumulator,
    joint_noise,
    solver,
)
from tests.support.estimates import identify
from tests.support.synthetic_data import Samples, noisy_samples

SEEDS = st.integers(0, 2**32 - 1)
PRIOR = np.zeros(16)


@pytest.mark.slow
@given(SEEDS, st.floats(-3, 3))
def test_wls_does_not_care_about_the_unit_of_one_joint(seed, power):
    samples, names, _, _ = noisy_samples(seed, (0.3, 0.1, 0.02))
    factor = 10.0**power
    rescaled = Samples(
        [
            (factor * rows if j == 1 else rows, c)
            for j, (rows, c) in enumerate(samples.equations)
        ],
        [factor * tau if j == 1 else tau for j, tau in enumerate(samples.torques)],
    )
    one = identify(samples.information(names), PRIOR, "wls")
    other = identify(rescaled.information(names), PRIOR, "wls")
    assert_allclose(other.values, one.values, rtol=0.0, atol=1e-6)


def test_wls_reports_each_joints_noise_and_beats_ols_where_joints_differ():
    noises = (1.0, 0.1, 0.01)
    ratios = []
    for seed in range(20):
        samples, names, truth, _ = noisy_samples(seed, noises)
        information = samples.information(names)
        ordinary, weighted = (
            np.linalg.norm((identify(information, PRIOR, method).values - truth)[:10])
            for method in ("ols", "wls")
        )
        ratios.append(weighted / ordinary)
    reported = identify(information, PRIOR, "wls").noise_per_joint
    assert np.median(ratios) < 0.3
    assert_allclose(list(reported.values()), noises, rtol=0.2)


@given(SEEDS)
def test_parameters_that_the_joints_pay_for_sum_to_the_rank(seed):
    """What is taken off each joint's number of samples, whatever the weights and the values."""
    samples, names, _, rng = noisy_samples(seed)
    information = samples.information(names)
    values = rng.normal(size=16)
    _, each = solver(information, PRIOR)(rng.uniform(0.1, 10.0, 3))
    noise = joint_noise(information, values, each, 0.0)
    paid = 200.0 - information.squared_residuals(values) / noise**2
    assert np.sum(paid) == pytest.approx(16.0, rel=1e-9)


@given(SEEDS)
def test_equations_with_a_prior_are_solved_to_rounding(seed):
    """Through their squares, as accurate as without them."""
    samples, names, truth, rng = noisy_samples(seed)
    known = np.column_stack((np.diag(10.0 ** rng.uniform(-3, 0, 16)), np.zeros(16)))
    information = samples.information(names)
    weights = rng.uniform(0.1, 10.0, 3)
    information = replace(information, prior=known)
    best = np.linalg.lstsq(*information.stacked(weights), rcond=None)[0]
    found, _ = solver(information, PRIOR)(weights)
    assert_allclose(found, best, rtol=0.0, atol=1e-11 * np.max(np.abs(truth)))


@given(SEEDS)
def test_what_exact_data_does_not_see_keeps_the_priors_value(seed):
    """Beside other priors; squares left it anywhere where rounding made them definite."""
    rng = np.random.default_rng(seed)
    names = noisy_samples(seed)[1]
    for _ in range(10):
        rows = rng.normal(size=(60, 16))
        truth, prior = rng.normal(size=(2, 16))
        ratios = rng.normal(size=2)
        rows[:, [2, 5]] = ratios * rows[:, [1, 4]]
        accumulator = InformationAccumulator(names, ["j"], [np.arange(16)])
        accumulator.add(0, rows, rows @ truth)
        known = np.pad(np.eye(6), ((0, 0), (10, 1)))
        found, _ = solver(replace(accumulator.result(), prior=known), prior)(
            np.array([10.0])
        )
        moved = found - prior
        assert_allclose(moved[[2, 5]], ratios * moved[[1, 4]], atol=1e-6)
