"""Sums over lags and kernels, against their definitions written out as dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import nnls

from robot_sysid.estimation.algebra.uncertainty import (
    concentration,
    joint_residuals,
    non_negative,
)
from tests.support.smooth_arm import remembering_noise

SEEDS = st.integers(0, 2**32 - 1)


def collected(rows, residual):
    width = rows.shape[1]
    return joint_residuals(np.arange(width), 0.1 * np.eye(width), rows, residual)


@given(SEEDS)
def test_kernel_sums_are_those_of_the_dense_kernels(seed):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(80, 3))
    found = collected(rows, rng.normal(size=80))
    lag = np.abs(np.subtract.outer(np.arange(80), np.arange(80)))
    assert_allclose(found.sums[0], rows.T @ rows, rtol=0.0, atol=1e-11)
    for decay, total in zip(found.decay, found.sums[1:]):
        assert_allclose(total, rows.T @ decay**lag @ rows, rtol=0.0, atol=1e-10)


@given(SEEDS)
def test_sums_of_few_rows_tell_the_same_in_the_rows_themselves(seed):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(30, 40))
    own = rng.normal(size=(40, 40))
    residual = rng.normal(size=30)
    own = 1e-3 * own @ own.T
    residual[7] = np.nan
    few = collected(rows, residual)
    all_of_them = joint_residuals(
        np.arange(40), 0.1 * np.eye(40), rows, residual, True
    ).shorten()
    kernels = rng.uniform(size=len(few.sums))
    assert_allclose(few.score(kernels), all_of_them.score(kernels), atol=1e-10)
    shares = [each.absorbed_share(each.inside(own)) for each in (few, all_of_them)]
    assert_allclose(*shares, atol=1e-12)


@given(
    SEEDS,
    st.integers(1, 10),
    st.sampled_from(("any", "like kernels", "twice", "nothing")),
)
def test_what_is_not_negative_fits_as_well_as_by_scipy(seed, size, kind):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(40, size))
    right = rng.normal(size=40)
    if kind == "like kernels":
        matrix = (
            np.exp(-np.arange(40)[:, None] / 2.0 ** np.arange(size)) + 1e-3 * matrix
        )
        right = matrix @ np.maximum(rng.normal(size=size), 0.0) + 0.01 * right
    elif kind != "any":
        matrix[:, -1] = matrix[:, 0] if kind == "twice" else 0.0
    found, misfit = non_negative(matrix, right)
    assert np.all(found >= 0.0)
    assert misfit == pytest.approx(np.linalg.norm(matrix @ found - right), abs=1e-9)
    assert misfit == pytest.approx(nnls(matrix, right)[1], abs=1e-9)


def test_lagged_products_are_means_over_the_pairs_that_exist():
    rng = np.random.default_rng(0)
    residual = rng.normal(size=60)
    residual[[5, 6, 30]] = np.nan
    found = collected(np.ones((60, 1)), residual)
    assert found.count == 57
    for lag, product in zip(found.lags, found.products):
        pairs = residual[: 60 - lag] * residual[lag:]
        assert product == pytest.approx(np.nanmean(pairs), abs=1e-12)


@pytest.mark.parametrize("memory", [0.0, 4.0, 20.0, 50.0])
def test_effective_samples_of_noise_with_a_known_memory(memory):
    rng = np.random.default_rng(1)
    count = 40_000
    residual = remembering_noise(rng, count, 1, memory)[:, 0]
    found = collected(np.zeros((count, 1)), residual)
    kernels = found.fit(found.absorbed_share(np.zeros((1, 1))), 0.0)
    decay = np.exp(-1.0 / memory) if memory else 0.0
    expected = count * (1.0 - decay) / (1.0 + decay)
    assert np.all(kernels >= 0.0)
    assert np.sum(kernels) == pytest.approx(1.0, rel=0.1)
    assert found.effective_samples(kernels) == pytest.approx(expected, rel=0.2)


def test_an_absorbed_share_is_that_of_the_dense_projection():
    rng = np.random.default_rng(2)
    rows = np.column_stack(
        (np.ones(70), np.linspace(-1.0, 1.0, 70), rng.normal(size=70))
    )
    own = np.linalg.inv(rows.T @ rows)
    found = collected(rows, rng.normal(size=70))
    hat = rows @ own @ rows.T
    lag = np.abs(np.subtract.outer(np.arange(70), np.arange(70)))
    kernels = [np.eye(70), *(decay**lag for decay in found.decay)]
    rest = np.eye(70) - hat
    expected = [1.0 - np.trace(rest @ kernel @ rest) / 70.0 for kernel in kernels]
    assert_allclose(found.absorbed_share(own), np.clip(expected, 0.0, 0.8), atol=1e-10)


SUMS = ("count", "sums", "products", "hats", "pairs")


def one_log(rng, count):
    root = 0.1 * np.eye(2)
    rows = rng.normal(size=(count, 2))
    residual = rng.normal(size=count)
    residual[:: int(rng.integers(5, 50))] = np.nan
    return joint_residuals(np.arange(2), root, rows, residual, True)


@given(SEEDS)
def test_sums_of_logs_are_means_over_the_pairs_of_all(seed):
    rng = np.random.default_rng(seed)
    one, two, three = (one_log(rng, int(rng.integers(30, 400))) for _ in range(3))
    whole = (one + two) + three
    again = one + (two + three)
    for name in SUMS:
        assert_allclose(getattr(whole, name), getattr(again, name), atol=1e-11)
    total = sum(log.products * log.pairs for log in (one, two, three))
    assert_allclose(whole.products * whole.pairs, total, atol=1e-10)


def test_a_burst_counts_as_few_rows():
    residual = np.random.default_rng(1).standard_normal(1000)
    even = concentration(residual)
    residual[400:440] *= 20.0
    assert even < 1.3
    assert concentration(residual) > 10.0
    assert concentration(np.append(residual, np.nan)) > 10.0
    assert concentration(np.zeros(1000)) == 1.0
