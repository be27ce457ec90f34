"""Covariances, autocorrelation and effective samples, against closed forms and dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import nnls
from scipy.signal import lfilter

from robot_sysid.estimation.algebra.uncertainty import (
    concentration,
    joint_residuals,
    non_negative,
    residual_correlation_time,
    uncertainty,
)
from tests.support.arms import SEEDS
from tests.support.estimates import identify
from tests.support.synthetic_data import (
    Samples,
    SmoothArm,
    arm_equations,
    autocorrelated,
    information_of,
    random_body,
    terminal_information,
)

# ---- covariances


@given(SEEDS)
def test_white_covariance_is_the_sandwich_of_the_dense_rows(seed):
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng)
    information = information_of(equations, names, rng.normal(size=16))
    noise = rng.uniform(0.1, 1.0, 3)
    weights = rng.uniform(0.5, 2.0, 3)
    normal = np.zeros((16, 16))
    score = np.zeros((16, 16))
    for joint, (rows, columns) in enumerate(equations):
        gram = weights[joint] ** 2 * rows.T @ rows
        block = np.ix_(columns, columns)
        normal[block] += gram
        score[block] += (weights[joint] * noise[joint]) ** 2 * gram
    expected = np.linalg.solve(normal, np.linalg.solve(normal, score).T)
    errors = uncertainty(information, weights, noise)
    assert_allclose(errors.covariance, expected, rtol=1e-7, atol=1e-12)
    assert_allclose(errors.standard_errors**2, np.diag(expected), rtol=1e-7)


def test_unidentifiable_parameters_have_no_error_bars_and_no_share_of_the_data():
    rng = np.random.default_rng(0)
    truth = np.append(random_body(rng), [0.4, 0.1])
    errors = uncertainty(terminal_information(rng, truth), np.ones(1), np.ones(1))
    is_hidden = np.isin(np.arange(12), [0, 3, 4, 7])
    assert np.all(np.isinf(errors.standard_errors) == is_hidden)
    assert np.all(np.isfinite(errors.covariance))
    assert_allclose(errors.data_share[[0, 3]], 0.0, atol=1e-12)
    assert_allclose(errors.data_share[[4, 7]], 0.5, atol=0.05)
    assert_allclose(errors.data_share[~is_hidden], 1.0, atol=1e-12)


@pytest.mark.parametrize("duration", [0.05, 15.0])
def test_zero_torque_gives_finite_covariances(duration):
    rng = np.random.default_rng(2)
    arm = SmoothArm(rng, rate=100.0, duration=duration)
    samples = arm.samples()
    information = samples.information(arm.names)
    estimate = identify(information, arm.truth, "wls", samples=samples)
    assert np.all(np.isfinite(estimate.covariance))
    assert not np.any(np.isnan(estimate.standard_errors))
    assert all(np.isfinite(list(estimate.effective_samples.values())))


def test_the_unit_of_torque_changes_no_standard_error():
    rng = np.random.default_rng(3)
    arm = SmoothArm(rng, rate=100.0, duration=3.0)
    samples = arm.samples(arm.noise(rng, 0.3, 0.1))
    equations = [(100.0 * rows, columns) for rows, columns in arm.equations]
    rescaled = Samples(equations, 100.0 * np.array(samples.torques))
    estimate, other = (
        identify(unit.information(arm.names), arm.truth, "wls", unit)
        for unit in (samples, rescaled)
    )
    assert_allclose(other.standard_errors, estimate.standard_errors, rtol=1e-6)
    counts = list(estimate.effective_samples.values())
    assert_allclose(list(other.effective_samples.values()), counts, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0.0, 0.1])
def test_intervals_cover_under_white_and_under_autocorrelated_noise(memory):
    """30 arms times 31 parameters: 95 % would give 883 of 930; white intervals fail at 0.1 s."""
    is_covered = []
    is_covered_if_white = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        arm = SmoothArm(rng, rate=100.0)
        noise = arm.noise(rng, rng.uniform(0.1, 0.5, 7), memory)
        samples = arm.samples(noise)
        information = samples.information(arm.names)
        estimate = identify(information, np.zeros(31), "wls", samples=samples)
        white = identify(information, np.zeros(31), "wls")
        error = np.abs(estimate.values - arm.truth)
        is_covered.append(error < 1.96 * estimate.standard_errors)
        is_covered_if_white.append(error < 1.96 * white.standard_errors)
    assert 0.91 < np.mean(is_covered) < 0.98
    assert (np.mean(is_covered_if_white) < 0.6) == (memory > 0.0)


# ---- autocorrelation


def residuals_of(rows, residual):
    """Return JointResiduals of all columns of some rows."""
    width = rows.shape[1]
    root = 0.1 * np.eye(width)
    return joint_residuals(np.arange(width), root, rows, residual)


def dense_kernels(residuals, count):
    """Return the covariance (count, count) of each kernel."""
    lag = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return [np.eye(count), *(decay**lag for decay in residuals.decay)]


@given(SEEDS)
def test_kernel_sums_are_those_of_the_dense_kernels(seed):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(80, 3))
    residuals = residuals_of(rows, rng.normal(size=80))
    expected = [rows.T @ kernel @ rows for kernel in dense_kernels(residuals, 80)]
    assert_allclose(residuals.sums, expected, rtol=0.0, atol=1e-10)


@given(
    SEEDS,
    st.integers(1, 10),
    st.sampled_from(("random", "kernels", "repeated column", "zero column")),
)
def test_non_negative_least_squares_fits_as_well_as_scipy(seed, size, columns):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(40, size))
    right = rng.normal(size=40)
    if columns == "kernels":
        decays = np.exp(-np.arange(40)[:, None] / 2.0 ** np.arange(size))
        matrix = decays + 1e-3 * matrix
        right = matrix @ np.maximum(rng.normal(size=size), 0.0) + 0.01 * right
    elif columns == "repeated column":
        matrix[:, -1] = matrix[:, 0]
    elif columns == "zero column":
        matrix[:, -1] = 0.0
    values, misfit = non_negative(matrix, right)
    assert np.all(values >= 0.0)
    assert misfit == pytest.approx(np.linalg.norm(matrix @ values - right), abs=1e-9)
    assert misfit == pytest.approx(nnls(matrix, right)[1], abs=1e-9)


def test_lagged_products_are_means_over_the_pairs_that_exist():
    residual = np.random.default_rng(0).normal(size=60)
    residual[[5, 6, 30]] = np.nan
    residuals = residuals_of(np.ones((60, 1)), residual)
    assert residuals.count == 57
    means = [np.nanmean(residual[: 60 - k] * residual[k:]) for k in residuals.lags]
    assert_allclose(residuals.products, means, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("memory", [0.0, 4.0, 20.0, 50.0])
def test_effective_samples_of_noise_with_a_known_memory(memory):
    count = 40_000
    rng = np.random.default_rng(1)
    white = rng.normal(size=(count, 1))
    noise = autocorrelated(white, memory, rng.normal(size=(1, 1)))
    residuals = residuals_of(np.zeros((count, 1)), noise[:, 0])
    kernels = residuals.fit(residuals.absorbed_share(np.zeros((1, 1))), 0.0)
    decay = np.exp(-1.0 / memory) if memory else 0.0
    expected = count * (1.0 - decay) / (1.0 + decay)
    assert np.all(kernels >= 0.0)
    assert np.sum(kernels) == pytest.approx(1.0, rel=0.1)
    assert residuals.effective_samples(kernels) == pytest.approx(expected, rel=0.2)


def test_an_absorbed_share_is_that_of_the_dense_projection():
    rng = np.random.default_rng(2)
    ramp = np.linspace(-1.0, 1.0, 70)
    rows = np.column_stack((np.ones(70), ramp, rng.normal(size=70)))
    inverse = np.linalg.inv(rows.T @ rows)
    residuals = residuals_of(rows, rng.normal(size=70))
    residual_maker = np.eye(70) - rows @ inverse @ rows.T
    kernels = np.array(dense_kernels(residuals, 70))
    remainder = residual_maker @ kernels @ residual_maker
    expected = np.clip(1.0 - np.trace(remainder, axis1=1, axis2=2) / 70.0, 0.0, 0.8)
    assert_allclose(residuals.absorbed_share(inverse), expected, atol=1e-10)


def test_a_burst_counts_as_few_rows():
    residual = np.random.default_rng(1).standard_normal(1000)
    assert concentration(residual) < 1.3
    residual[400:440] *= 20.0
    assert concentration(residual) > 10.0
    assert concentration(np.append(residual, np.nan)) > 10.0
    assert concentration(np.zeros(1000)) == 1.0


@pytest.mark.parametrize("keep", [0.0, 0.8, 0.95])
def test_the_correlation_time_of_first_order_noise(keep):
    """It is (1 + a) / (1 - a) for coefficient a; missing values change nothing."""
    drawn = np.random.default_rng(3).normal(size=20000)
    residual = lfilter([1.0], [1.0, -keep], drawn)
    residual[5000:6000] = np.nan
    assert residual_correlation_time(residual) == pytest.approx(
        (1.0 + keep) / (1.0 - keep), rel=0.15
    )
    assert residual_correlation_time(np.zeros(50)) == 1.0
