"""Laws of the solver: exact recovery, prior kept where nothing shows, scaling, order of joints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.estimation.information import InformationAccumulator, combined
from robot_sysid.records import SquareRootInformation, Status
from robot_sysid.solver import identify_parameters
from tests.support.synthetic_data import (
    arm_equations,
    information_of,
    joint_rows,
    random_body,
    terminal_information,
)

SEEDS = st.integers(0, 2**32 - 1)


def noisy_arm(seed, noise=0.1):
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng)
    truth = np.concatenate((random_body(rng), rng.uniform(0.1, 1.0, 6)))
    return information_of(equations, names, truth, noise, rng), truth, rng


@settings(max_examples=100, deadline=None)
@given(SEEDS)
def test_noise_free_data_is_recovered(seed):
    information, truth, rng = noisy_arm(seed, noise=0.0)
    estimate = identify_parameters(information, rng.normal(size=16))
    np.testing.assert_allclose(estimate.values, truth, rtol=0.0, atol=1e-10)
    assert estimate.rmse < 1e-12


@settings(max_examples=100, deadline=None)
@given(SEEDS)
def test_where_the_data_shows_nothing_the_prior_stays_exactly(seed):
    rng = np.random.default_rng(seed)
    truth = np.append(random_body(rng), [0.4, 0.1])
    prior = np.append(random_body(rng), [0.0, 0.0])
    values = identify_parameters(terminal_information(rng, truth), prior).values
    assert values[0] == prior[0]
    assert values[3] == prior[3]
    assert values[4] + values[7] == pytest.approx(prior[4] + prior[7], rel=1e-12)
    seen = [1, 2, 5, 6, 8, 9, 10, 11]
    np.testing.assert_allclose(values[seen], truth[seen], rtol=0.0, atol=1e-11)
    assert values[4] - values[7] == pytest.approx(truth[4] - truth[7], abs=1e-11)


@settings(max_examples=100, deadline=None)
@given(SEEDS, st.floats(1e-3, 1e3))
def test_scaling_all_torques_scales_the_estimate(seed, factor):
    information, _, rng = noisy_arm(seed)
    prior = rng.normal(size=16)
    accumulator = InformationAccumulator(
        information.names,
        [j.joint for j in information.joints],
        [j.columns for j in information.joints],
    )
    for k, joint in enumerate(information.joints):
        accumulator.add(k, joint.triangle[:, :-1], factor * joint.triangle[:, -1])
    plain = identify_parameters(information, prior)
    scaled = identify_parameters(accumulator.result(), factor * prior)
    np.testing.assert_allclose(scaled.values, factor * plain.values, rtol=1e-9, atol=1e-12 * factor)


@settings(max_examples=100, deadline=None)
@given(SEEDS, st.permutations(range(3)))
def test_the_order_of_joints_does_not_matter(seed, order):
    information, _, rng = noisy_arm(seed)
    shuffled = SquareRootInformation(information.names, tuple(information.joints[k] for k in order))
    prior = rng.normal(size=16)
    one = identify_parameters(information, prior)
    other = identify_parameters(shuffled, prior)
    np.testing.assert_allclose(other.values, one.values, rtol=0.0, atol=1e-11)
    assert other.rmse == pytest.approx(one.rmse, rel=1e-12)


def test_rmse_is_that_of_the_samples():
    rng = np.random.default_rng(5)
    equations, names = arm_equations(rng, joints=2)
    taus = [rng.normal(size=60), rng.normal(size=60)]
    accumulator = InformationAccumulator(names, ["joint0", "joint1"], [c for _, c in equations])
    for j, (rows, _) in enumerate(equations):
        accumulator.add(j, rows, taus[j])
    estimate = identify_parameters(accumulator.result(), np.zeros(14))
    for j, (rows, columns) in enumerate(equations):
        residual = rows @ estimate.values[columns] - taus[j]
        expected = np.sqrt(np.mean(residual**2))
        assert estimate.rmse_per_joint[f"joint{j}"] == pytest.approx(expected, rel=1e-10)
    overall = np.sqrt(np.mean(np.square(list(estimate.rmse_per_joint.values()))))
    assert estimate.rmse == pytest.approx(overall, rel=1e-10)


def test_status_tells_full_from_partial_from_impossible():
    rng = np.random.default_rng(6)
    equations, names = arm_equations(rng)
    body = random_body(rng)
    friction = np.full(6, 0.2)
    full = information_of(equations, names, np.append(body, friction))
    broken = information_of(equations, names, np.append(-body, friction))
    partial = terminal_information(rng, np.append(body, [0.4, 0.1]))
    assert identify_parameters(full, np.zeros(16)).status is Status.OK
    assert identify_parameters(broken, np.zeros(16)).status is Status.INCONSISTENT
    prior = np.append(body, [0.0, 0.0])
    assert identify_parameters(partial, prior).status is Status.PARTLY_FROM_MODEL


def test_rows_of_one_joint_in_any_order_give_the_same_estimate():
    rng = np.random.default_rng(7)
    rows, tau = joint_rows(rng, 50), rng.normal(size=50)
    names = tuple(f"p{k}" for k in range(12))
    results = []
    for order in (np.arange(50), rng.permutation(50)):
        accumulator = InformationAccumulator(names, ["joint0"], [np.arange(12)])
        accumulator.add(0, rows[order], tau[order])
        results.append(identify_parameters(accumulator.result(), np.zeros(12)).values)
    np.testing.assert_allclose(results[1], results[0], rtol=0.0, atol=1e-11)


@settings(max_examples=100, deadline=None)
@given(SEEDS, st.integers(2, 9))
def test_a_log_played_again_tells_no_more_than_once(seed, count):
    """The same numbers over and over, counted once: values and errors of a single time."""
    once, _, _ = noisy_arm(seed)
    prior = np.zeros(len(once.names))
    again = combined([once] * count)
    first = identify_parameters(once, prior, "wls")
    found = identify_parameters(again, prior, "wls", inflation=np.full(3, float(count)))
    np.testing.assert_allclose(found.standard_errors, first.standard_errors, rtol=0.2)
    scale = np.abs(first.values) + first.standard_errors
    assert np.all(np.abs(found.values - first.values) < 0.2 * scale)
    for joint, samples in first.effective_samples.items():
        assert found.effective_samples[joint] == pytest.approx(samples)
        assert found.noise_per_joint[joint] == pytest.approx(first.noise_per_joint[joint], rel=0.2)
