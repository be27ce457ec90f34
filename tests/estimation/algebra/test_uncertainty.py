"""Covariances against closed forms, and intervals that cover; the full study is a benchmark."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose

from robot_sysid.estimation.algebra.uncertainty import uncertainty
from tests.support.arms import SEEDS
from tests.support.estimates import identify
from tests.support.smooth_arm import SmoothArm, information_of_samples, samples_of
from tests.support.synthetic_data import (
    arm_equations,
    information_of,
    random_body,
    terminal_information,
)


def dense(equations, size):
    rows = []
    for block, columns in equations:
        wide = np.zeros((len(block), size))
        wide[:, columns] = block
        rows.append(wide)
    return rows


@given(SEEDS)
def test_white_covariance_is_the_sandwich_of_the_dense_rows(seed):
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng)
    information = information_of(equations, names, rng.normal(size=16))
    noise = rng.uniform(0.1, 1.0, 3)
    weights = rng.uniform(0.5, 2.0, 3)
    rows = dense(equations, 16)
    normal = sum(w**2 * r.T @ r for w, r in zip(weights, rows))
    score = sum(w**4 * s**2 * r.T @ r for w, s, r in zip(weights, noise, rows))
    expected = np.linalg.solve(normal, np.linalg.solve(normal, score).T)
    found = uncertainty(information, weights, noise)
    assert_allclose(found.covariance, expected, rtol=1e-7, atol=1e-12)
    assert_allclose(found.standard_errors**2, np.diag(expected), rtol=1e-7)


def test_unidentifiable_parameters_have_no_error_bars_and_no_share_of_the_data():
    rng = np.random.default_rng(0)
    truth = np.append(random_body(rng), [0.4, 0.1])
    estimate = uncertainty(terminal_information(rng, truth), np.ones(1), np.ones(1))
    unseen = [0, 3, 4, 7]
    seen = [1, 2, 5, 6, 8, 9, 10, 11]
    assert np.all(np.isinf(estimate.standard_errors[unseen]))
    assert np.all(np.isfinite(estimate.standard_errors[seen]))
    assert np.all(np.isfinite(estimate.covariance))
    assert_allclose(estimate.data_share[[0, 3]], 0.0, atol=1e-12)
    assert_allclose(estimate.data_share[[4, 7]], 0.5, atol=0.05)
    assert_allclose(estimate.data_share[seen], 1.0, atol=1e-12)


@pytest.mark.parametrize("duration", [0.05, 15.0])
def test_nothing_to_explain_leaves_no_nan(duration):
    rng = np.random.default_rng(2)
    arm = SmoothArm(rng, rate=100.0, duration=duration)
    samples = samples_of(arm, arm.torques(np.zeros((arm.count, 7))))
    information = information_of_samples(arm, samples)
    estimate = identify(information, arm.truth, "wls", samples=samples)
    assert np.all(np.isfinite(estimate.covariance))
    assert not np.any(np.isnan(estimate.standard_errors))
    assert all(np.isfinite(list(estimate.effective_samples.values())))


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0.0, 0.1])
def test_intervals_cover_under_white_and_under_slow_noise(memory):
    """30 arms times 31 parameters: 95 % would give 883 of 930; white intervals fail at 0.1 s."""
    hits = []
    naive = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        arm = SmoothArm(rng, rate=100.0)
        samples = samples_of(
            arm, arm.torques(arm.noise(rng, rng.uniform(0.1, 0.5, 7), memory))
        )
        information = information_of_samples(arm, samples)
        aware = identify(information, np.zeros(31), "wls", samples=samples)
        white = identify(information, np.zeros(31), "wls")
        error = np.abs(aware.values - arm.truth)
        hits.append(error < 1.96 * aware.standard_errors)
        naive.append(error < 1.96 * white.standard_errors)
    assert 0.91 < np.mean(hits) < 0.98
    assert (np.mean(naive) < 0.6) == (memory > 0.0)
