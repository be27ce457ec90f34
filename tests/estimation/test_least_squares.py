"""Laws of the estimators: weights follow the noise, outliers lose theirs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.estimation.information import InformationAccumulator
from robot_sysid.estimation.least_squares import EstimatorOptions, joint_noise, leverage
from robot_sysid.estimation.registry import ESTIMATORS, estimator
from robot_sysid.estimation.robust import _StreamingMedian, huber
from robot_sysid.solver import identify_parameters
from tests.support.synthetic_data import arm_equations, information_of, random_body

SEEDS = st.integers(0, 2**32 - 1)
PRIOR = np.zeros(16)


class Samples:
    """An arm's equations with given torques, readable several times, in chunks."""

    def __init__(self, equations, torques, size=17):
        self.equations, self.torques, self.size = equations, torques, size

    def __iter__(self):
        for j, (rows, _) in enumerate(self.equations):
            for start in range(0, len(rows), self.size):
                part = slice(start, start + self.size)
                yield j, rows[part], self.torques[j][part]

    def information(self, names):
        joints = [f"joint{j}" for j in range(len(self.equations))]
        accumulator = InformationAccumulator(names, joints, [c for _, c in self.equations])
        for index, rows, tau in self:
            keep = np.isfinite(tau)
            accumulator.add(index, rows[keep], tau[keep])
        return accumulator.result()


def noisy(seed, noises=(0.1, 0.1, 0.1), count=200):
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng, joints=3, count=count)
    truth = np.concatenate((random_body(rng), rng.uniform(0.1, 1.0, 6)))
    torques = [
        rows @ truth[columns] + noise * rng.normal(size=len(rows))
        for (rows, columns), noise in zip(equations, noises)
    ]
    return Samples(equations, torques), names, truth, rng


def with_outliers(samples, rng, share=0.1, size=20.0):
    torques = []
    for tau in samples.torques:
        hit = rng.random(len(tau)) < share
        torques.append(np.where(hit, tau + size * (1.0 + rng.random(len(tau))), tau))
    return Samples(samples.equations, torques)


@pytest.mark.parametrize("method", ESTIMATORS)
def test_noise_free_data_is_recovered_by_every_method(method):
    samples, names, truth, _ = noisy(0, noises=(0.0, 0.0, 0.0))
    estimate = identify_parameters(samples.information(names), PRIOR, method, samples=samples)
    np.testing.assert_allclose(estimate.values, truth, rtol=0.0, atol=1e-9)
    assert np.all(np.isfinite(estimate.covariance))
    assert np.max(estimate.standard_errors) < 1e-6


@settings(max_examples=100, deadline=None)
@given(SEEDS, st.floats(-3, 3))
def test_wls_does_not_care_about_the_unit_of_one_joint(seed, power):
    samples, names, _, _ = noisy(seed, (0.3, 0.1, 0.02))
    factor = 10.0**power
    rescaled = Samples(
        [(factor * rows if j == 1 else rows, c) for j, (rows, c) in enumerate(samples.equations)],
        [factor * tau if j == 1 else tau for j, tau in enumerate(samples.torques)],
    )
    one = identify_parameters(samples.information(names), PRIOR, "wls")
    other = identify_parameters(rescaled.information(names), PRIOR, "wls")
    np.testing.assert_allclose(other.values, one.values, rtol=0.0, atol=1e-6)


def test_wls_reports_each_joints_noise_and_beats_ols_where_joints_differ():
    noises, ratios = (1.0, 0.1, 0.01), []
    for seed in range(20):
        samples, names, truth, _ = noisy(seed, noises)
        information = samples.information(names)
        ordinary, weighted = (
            np.linalg.norm((identify_parameters(information, PRIOR, method).values - truth)[:10])
            for method in ("ols", "wls")
        )
        ratios.append(weighted / ordinary)
    reported = identify_parameters(information, PRIOR, "wls").noise_per_joint
    assert np.median(ratios) < 0.3
    np.testing.assert_allclose(list(reported.values()), noises, rtol=0.2)


@settings(max_examples=100, deadline=None)
@given(SEEDS)
def test_leverages_sum_to_the_rank(seed):
    samples, names, _, rng = noisy(seed)
    weights = rng.uniform(0.1, 10.0, 3)
    total = np.sum(leverage(samples.information(names), weights))
    assert total == pytest.approx(16.0, rel=1e-9)


def test_noise_is_unbiased_with_few_samples():
    squares = []
    for seed in range(300):
        samples, names, _, _ = noisy(seed, (0.5, 0.5, 0.5), count=15)
        information = samples.information(names)
        values = identify_parameters(information, PRIOR).values
        squares.append(joint_noise(information, values, np.ones(3)) ** 2)
    assert np.mean(squares) == pytest.approx(0.25, rel=0.05)


def test_robust_ignores_gross_outliers():
    samples, names, truth, rng = noisy(1)
    spoiled = with_outliers(samples, rng)
    clean = identify_parameters(samples.information(names), PRIOR, "wls").values
    information = spoiled.information(names)
    robust = identify_parameters(information, PRIOR, "robust", samples=spoiled)
    plain = identify_parameters(information, PRIOR, "wls").values
    reach = np.linalg.norm(clean - truth)
    assert np.linalg.norm(robust.values - truth) < 3.0 * reach
    assert np.linalg.norm(plain - truth) > 10.0 * reach
    np.testing.assert_allclose(list(robust.noise_per_joint.values()), 0.1, rtol=0.35)


def test_robust_agrees_with_wls_where_there_are_no_outliers():
    samples, names, _, _ = noisy(2, count=2000)
    information = samples.information(names)
    robust = identify_parameters(information, PRIOR, "robust", samples=samples)
    plain = identify_parameters(information, PRIOR, "wls", samples=samples)
    assert np.max(np.abs(robust.values - plain.values) / plain.standard_errors) < 1.5
    np.testing.assert_allclose(robust.standard_errors, plain.standard_errors, rtol=0.25)
    np.testing.assert_allclose(list(robust.noise_per_joint.values()), 0.1, rtol=0.06)


@settings(max_examples=100, deadline=None)
@given(SEEDS, st.integers(10, 100))
def test_robust_does_not_depend_on_the_size_of_chunks(seed, size):
    samples, names, _, rng = noisy(seed, count=60)
    spoiled = with_outliers(samples, rng)
    other = Samples(spoiled.equations, spoiled.torques, size)
    one = huber(spoiled.information(names), PRIOR, EstimatorOptions(), spoiled)
    two = huber(spoiled.information(names), PRIOR, EstimatorOptions(), other)
    np.testing.assert_allclose(two.noise, one.noise, rtol=1e-9)
    np.testing.assert_allclose(
        two.information.squared_residuals(PRIOR),
        one.information.squared_residuals(PRIOR),
        rtol=1e-9,
    )


def test_samples_that_are_left_out_do_not_count():
    samples, names, _, rng = noisy(3)
    holes = [np.where(rng.random(len(tau)) < 0.3, np.nan, tau) for tau in samples.torques]
    partial = Samples(samples.equations, holes)
    kept = Samples(
        [(rows[np.isfinite(h)], c) for (rows, c), h in zip(samples.equations, holes)],
        [h[np.isfinite(h)] for h in holes],
    )
    information = kept.information(names)
    one = identify_parameters(information, PRIOR, "robust", samples=partial)
    two = identify_parameters(information, PRIOR, "robust", samples=kept)
    np.testing.assert_allclose(one.values, two.values, rtol=0.0, atol=1e-9)


def test_robust_without_samples_or_with_samples_that_run_dry_says_so():
    samples, names, _, _ = noisy(4)
    information = samples.information(names)
    with pytest.raises(InputError, match="needs the samples"):
        identify_parameters(information, PRIOR, "robust")
    with pytest.raises(InputError, match="readable several times"):
        identify_parameters(information, PRIOR, "robust", samples=iter(samples))


@settings(max_examples=100, deadline=None)
@given(SEEDS, st.floats(1e-3, 1e3))
def test_streaming_median_is_right_to_a_bin(seed, scale):
    numbers = np.abs(np.random.default_rng(seed).normal(size=501)) * scale
    median = _StreamingMedian(scale)
    for part in np.split(numbers, [100, 101, 300]):
        median.add(part)
    assert median.value == pytest.approx(np.median(numbers), rel=0.013)


def test_unknown_names_list_the_valid_ones():
    with pytest.raises(InputError, match="unknown method 'lasso'; valid: ols, wls, robust"):
        estimator("lasso")
    with pytest.raises(InputError, match="'maybe' is unknown; valid: auto, enforce, off"):
        EstimatorOptions(consistency="maybe")
    with pytest.raises(InputError, match="'ridge' is unknown; valid: none, entropic"):
        EstimatorOptions(prior="ridge")


@pytest.mark.parametrize("weight", [0.0, -1.0, float("nan"), float("inf")])
def test_prior_weight_must_be_positive(weight):
    with pytest.raises(InputError, match="--prior-weight must be a positive number"):
        EstimatorOptions(prior="entropic", prior_weight=weight)


def test_information_of_helpers_agree():
    rng = np.random.default_rng(5)
    equations, names = arm_equations(rng)
    truth = rng.normal(size=16)
    torques = [rows @ truth[columns] for rows, columns in equations]
    one = Samples(equations, torques).information(names)
    two = information_of(equations, names, truth)
    np.testing.assert_allclose(
        one.squared_residuals(PRIOR), two.squared_residuals(PRIOR), rtol=1e-12
    )
