"""Huber's estimator: outliers lose weight, and nothing else does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.robust import _binned_median
from tests.support.estimates import identified
from tests.support.synthetic_data import Samples, noisy_samples

SEEDS = st.integers(0, 2**32 - 1)
PRIOR = np.zeros(16)


def with_outliers(samples, rng, share=0.1, size=20.0):
    torques = []
    for tau in samples.torques:
        hit = rng.random(len(tau)) < share
        torques.append(np.where(hit, tau + size * (1.0 + rng.random(len(tau))), tau))
    return Samples(samples.equations, torques)


def test_robust_ignores_gross_outliers():
    samples, names, truth, rng = noisy_samples(1)
    spoiled = with_outliers(samples, rng)
    clean = identified(samples.information(names), PRIOR, "wls").values
    information = spoiled.information(names)
    robust = identified(information, PRIOR, "robust", samples=spoiled)
    plain = identified(information, PRIOR, "wls").values
    reach = np.linalg.norm(clean - truth)
    assert np.linalg.norm(robust.values - truth) < 3.0 * reach
    assert np.linalg.norm(plain - truth) > 10.0 * reach
    np.testing.assert_allclose(list(robust.noise_per_joint.values()), 0.1, rtol=0.35)


def test_robust_agrees_with_wls_where_there_are_no_outliers():
    samples, names, _, _ = noisy_samples(2, count=2000)
    information = samples.information(names)
    robust = identified(information, PRIOR, "robust", samples=samples)
    plain = identified(information, PRIOR, "wls", samples=samples)
    assert np.max(np.abs(robust.values - plain.values) / plain.standard_errors) < 1.5
    np.testing.assert_allclose(robust.standard_errors, plain.standard_errors, rtol=0.25)
    np.testing.assert_allclose(list(robust.noise_per_joint.values()), 0.1, rtol=0.06)


def test_samples_that_are_left_out_do_not_count():
    samples, names, _, rng = noisy_samples(3)
    holes = [np.where(rng.random(len(tau)) < 0.3, np.nan, tau) for tau in samples.torques]
    partial = Samples(samples.equations, holes)
    kept = Samples(
        [(rows[np.isfinite(h)], c) for (rows, c), h in zip(samples.equations, holes)],
        [h[np.isfinite(h)] for h in holes],
    )
    information = kept.information(names)
    one = identified(information, PRIOR, "robust", samples=partial)
    two = identified(information, PRIOR, "robust", samples=kept)
    np.testing.assert_allclose(one.values, two.values, rtol=0.0, atol=1e-9)


def test_robust_without_samples_says_so():
    samples, names, _, _ = noisy_samples(4)
    with pytest.raises(InputError, match="needs the samples"):
        identified(samples.information(names), PRIOR, "robust")


@given(SEEDS, st.floats(1e-3, 1e3))
def test_the_median_is_right_to_a_bin(seed, scale):
    numbers = np.abs(np.random.default_rng(seed).normal(size=501)) * scale
    assert _binned_median(numbers, scale) == pytest.approx(np.median(numbers), rel=0.013)
