"""Monte Carlo of the estimators: efficiency, coverage of 95 % intervals, effect of outliers.

Run: pytest benchmarks/test_bench_coverage.py -m slow -s
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.support.estimates import identify

from benchmarks.example_study import noise_study
from robot_sysid.dynamics import spatial
from robot_sysid.solver import identify_parameters
from tests.support.synthetic_data import SmoothArm

DRAWS = 200


def draw(seed, memory, rate=100.0):
    """Return (arm, samples, information) of one simulated log."""
    rng = np.random.default_rng(seed)
    arm = SmoothArm(rng, rate)
    sigma = rng.uniform(0.1, 0.5, 7)
    samples = arm.samples(arm.noise(rng, sigma, memory))
    return arm, samples, samples.information(arm.names)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ols", "wls"])
@pytest.mark.parametrize("memory", [0.0, 0.02, 0.1])
def test_intervals_cover(method, memory):
    hits = []
    naive = []
    for seed in range(DRAWS):
        arm, samples, information = draw(seed, memory)
        estimate = identify(information, np.zeros(31), method, samples=samples)
        error = np.abs(estimate.values - arm.truth)
        hits.append(error < 1.96 * estimate.standard_errors)
        white = identify(information, np.zeros(31), method).standard_errors
        naive.append(error < 1.96 * white)
    share = np.mean(hits, axis=0)
    print(
        f"\n{method}, noise memory {1e3 * memory:.0f} ms: covered {np.mean(hits):.3f}, ten inertial"
    )
    print(
        f"  {np.mean(share[:10]):.3f} (least {share[:10].min():.3f}, most {share[:10].max():.3f})"
    )
    print(f"  as if the noise were white: {np.mean(naive):.3f}")
    assert 0.92 <= np.mean(share[:10]) <= 0.97
    assert 0.92 <= np.mean(hits) <= 0.97


@pytest.mark.slow
def test_weighted_estimates_reach_the_cramer_rao_bound():
    """One arm, many noises: root mean square error over the bound's standard deviation."""
    errors = {"ols": [], "wls": []}
    base = SmoothArm(np.random.default_rng(0), 100.0)
    sigma = np.array([0.5, 0.5, 0.3, 0.3, 0.1, 0.1, 0.1])
    for seed in range(DRAWS):
        rng = np.random.default_rng(1000 + seed)
        samples = base.samples(base.noise(rng, sigma, 0.0))
        information = samples.information(base.names)
        for method, method_errors in errors.items():
            values = identify(information, np.zeros(31), method).values
            method_errors.append(values - base.truth)
    bound = np.sqrt(np.diag(noise_study.cramer_rao_bound(information, sigma)))
    for method, method_errors in errors.items():
        ratio = np.sqrt(np.mean(np.square(method_errors), axis=0)) / bound
        print(
            f"\n{method}: error / bound median {np.median(ratio):.3f}, worst {ratio.max():.3f}"
        )
        if method == "wls":
            assert np.median(ratio) <= 1.05
            assert np.max(ratio) <= 1.25


@pytest.mark.slow
def test_automatic_consistency_never_returns_an_impossible_body():
    plain_possible = 0
    for seed in range(DRAWS):
        arm, _, _, information = draw(seed, 0.1)
        prior = np.concatenate((arm.truth[:10] * 1.2, np.zeros(21)))
        plain = identify_parameters(information, prior)
        fitted = identify_parameters(information, prior, possible=True)
        plain_possible += spatial.is_consistent(plain.values[:10])
        assert spatial.is_consistent(fitted.values[:10])
        assert fitted.constrained == (not spatial.is_consistent(plain.values[:10]))
    print(f"\nplain estimates that are possible bodies: {plain_possible} of {DRAWS}")
