"""What residuals look like, on residuals whose looks are known."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.report.statistics import autocorrelation, by_speed, histogram
from tests.support.arms import SEEDS


@given(seed=SEEDS, count=st.integers(1, 300), missing=st.floats(0.0, 1.0))
def test_every_sample_in_use_is_counted_once(seed, count, missing):
    rng = np.random.default_rng(seed)
    residual = rng.standard_t(2.0, (count, 2))
    residual[rng.random((count, 2)) < missing] = np.nan
    edges, counts = histogram(residual)
    np.testing.assert_array_equal(np.sum(counts, axis=1), np.sum(np.isfinite(residual), axis=0))
    assert np.all(np.diff(edges, axis=1) > 0.0)


@given(seed=SEEDS)
def test_noise_without_memory_stays_in_its_band(seed):
    noise = np.random.default_rng(seed).normal(size=(2000, 2))
    noise[100:140, 0] = np.nan
    lags, found, band = autocorrelation(np.arange(2000) * 0.01, noise)
    np.testing.assert_allclose(found[:, 0], 1.0)
    assert np.mean(np.abs(found[:, 1:]) > band[:, None]) < 0.2
    assert lags[0] == 0.0 and lags[-1] <= 2.0


def test_slow_residuals_have_the_memory_that_they_have():
    rng, slow = np.random.default_rng(0), np.zeros((20000, 1))
    for k in range(1, len(slow)):
        slow[k] = 0.9 * slow[k - 1] + rng.normal()
    lags, found, _ = autocorrelation(np.arange(20000) * 0.1, slow)
    np.testing.assert_allclose(found[0], 0.9 ** (lags / 0.1), atol=0.05)


def test_means_by_speed_are_those_of_the_samples_in_use():
    qd = np.linspace(-2.0, 2.0, 4001)[:, None]
    torque = 3.0 * qd + 1.0
    torque[qd > 1.0] = np.nan
    speed, (mean,), spread = by_speed(qd, (torque,))
    known = np.isfinite(speed)
    np.testing.assert_allclose(mean[known], 3.0 * speed[known] + 1.0, atol=1e-9)
    assert np.nanmax(speed) <= 1.0 and np.all(spread[known] < 0.3)


def test_nothing_at_all_is_no_reason_to_fail():
    nothing = np.full((3, 1), np.nan)
    histogram(nothing)
    autocorrelation(np.zeros(3), nothing)
    assert np.all(np.isnan(by_speed(nothing, (nothing,))[0]))
