"""Laws of the physically consistent fit; the oracle comparison at scale is a benchmark."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.consistency import YIELDING, consistent_least_squares
from tests.support.synthetic_data import (
    arm_equations,
    body_divergence,
    information_of,
    random_body,
    sdp_least_squares,
    terminal_information,
)

SEEDS = st.integers(0, 2**32 - 1)


def noisy_problem(seed, noise=3.0, spread=0.1):
    """(A, b, prior) of a thin body under heavy noise: most plain estimates are impossible."""
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng, joints=3, count=40)
    truth = np.concatenate((random_body(rng, spread), rng.uniform(0.1, 1.0, 6)))
    prior = np.concatenate((random_body(rng), np.zeros(6)))
    return (*information_of(equations, names, truth, noise, rng).stacked(), prior)


def plain(matrix, right):
    return np.linalg.lstsq(matrix, right, rcond=None)[0]


def cost(matrix, right, values):
    return float(np.sum((matrix @ values - right) ** 2))


@given(SEEDS, st.floats(0.01, 30.0))
def test_the_result_is_always_a_possible_body(seed, noise):
    matrix, right, prior = noisy_problem(seed, noise)
    values = consistent_least_squares(matrix, right, prior)
    body = spatial.pseudo_inertia(values[:10])
    assert np.linalg.eigvalsh(body)[0] > 1e-14 * np.trace(body)


@given(SEEDS)
def test_a_consistent_plain_estimate_stays_unchanged(seed):
    matrix, right, prior = noisy_problem(seed, noise=1e-4, spread=1.0)
    unconstrained = plain(matrix, right)
    if not spatial.is_consistent(
        unconstrained[:10] - 1e-8 * spatial.lifted_body(prior[:10], prior[:10], 0.01)
    ):
        return
    values = consistent_least_squares(matrix, right, prior)
    np.testing.assert_allclose(values, unconstrained, rtol=0.0, atol=1e-11)


@given(SEEDS)
def test_no_possible_body_nearby_fits_better(seed):
    matrix, right, prior = noisy_problem(seed)
    values = consistent_least_squares(matrix, right, prior)
    best = cost(matrix, right, values)
    rng = np.random.default_rng(seed + 1)
    towards = np.concatenate((random_body(rng), rng.uniform(0.1, 1.0, 6)))
    for share in (1e-3, 1e-2, 0.1):
        moved = (1.0 - share) * values + share * towards
        assert cost(matrix, right, moved) >= best * (1.0 - 1e-8)


@pytest.mark.parametrize("seed", range(8))
def test_objective_is_that_of_the_semidefinite_program(seed):
    matrix, right, prior = noisy_problem(seed)
    values = consistent_least_squares(matrix, right, prior)
    reference = sdp_least_squares(matrix, right)
    assert not spatial.is_consistent(plain(matrix, right)[:10])
    assert cost(matrix, right, values) == pytest.approx(reference, rel=1e-8)


@pytest.mark.slow
@given(SEEDS, st.floats(-3, 3), st.floats(-2, 2), st.floats(-3, 3))
def test_units_do_not_matter(seed, mass_power, length_power, torque_power):
    matrix, right, prior = noisy_problem(seed)
    units = np.ones(16)
    units[:10] = spatial.parameter_scale(10.0**mass_power, 10.0**length_power)
    torque = 10.0**torque_power
    one = consistent_least_squares(matrix, right, prior)
    other = consistent_least_squares(torque * matrix / units, torque * right, units * prior)
    scale = units * np.max(np.abs(one))
    np.testing.assert_allclose(other / scale, one * units / scale, rtol=0.0, atol=1e-6)


@given(SEEDS, st.floats(0.0, 30.0))
def test_what_the_data_cannot_see_stays_at_the_prior_unless_that_is_impossible(seed, noise):
    matrix, right, prior, _ = terminal_problem(seed, noise)
    values = consistent_least_squares(matrix, right, prior)
    assert spatial.is_consistent(values[:10])
    if spatial.is_consistent(least_correction(matrix, right, prior)[:10] * (1.0 - 1e-6)):
        assert values[0] == prior[0] and values[3] == prior[3]
        assert values[4] + values[7] == pytest.approx(prior[4] + prior[7], rel=1e-12)


@given(SEEDS, st.floats(0.0, 30.0))
def test_what_the_data_does_not_see_gives_way_before_what_it_sees(seed, noise):
    """The truth is a possible body, so nothing visible may be bent more than towards it."""
    matrix, right, prior, truth = terminal_problem(seed, noise)
    values = consistent_least_squares(matrix, right, prior)
    allowed = YIELDING * body_divergence(truth[:10], prior[:10]) + 1e-6
    assert cost(matrix, right, values) <= cost(matrix, right, truth) + 1.01 * allowed


def terminal_problem(seed, noise):
    rng = np.random.default_rng(seed)
    truth = np.append(random_body(rng, 0.1), [0.4, 0.1])
    prior = np.append(random_body(rng), [0.0, 0.0])
    matrix, right = terminal_information(rng, truth).stacked()
    return matrix, right + noise * rng.normal(size=len(right)), prior, truth


def least_correction(matrix, right, prior):
    return prior + np.linalg.lstsq(matrix, right - matrix @ prior, rcond=1e-10)[0]


def test_data_at_rest_gives_the_prior_or_its_nearest_possible_body():
    rng = np.random.default_rng(0)
    body = random_body(rng)
    values = consistent_least_squares(np.zeros((11, 10)), np.zeros(11), body)
    np.testing.assert_array_equal(values, body)
    repaired = consistent_least_squares(np.zeros((11, 10)), np.zeros(11), -body)
    assert spatial.is_consistent(repaired)


def test_noise_free_data_of_a_body_on_the_boundary_is_recovered():
    rng = np.random.default_rng(1)
    plate = spatial.theta_from_com(2.0, np.array([0.1, 0.0, 0.2]), np.diag([0.01, 0.02, 0.03]))
    equations, names = arm_equations(rng)
    truth = np.concatenate((plate, np.full(6, 0.3)))
    matrix, right = information_of(equations, names, truth).stacked()
    values = consistent_least_squares(
        matrix, right, np.concatenate((random_body(rng), np.zeros(6)))
    )
    assert spatial.is_consistent(values[:10])
    np.testing.assert_allclose(values, truth, rtol=0.0, atol=1e-7)


@given(SEEDS)
def test_a_strong_prior_wins_and_a_weak_one_gives_way(seed):
    matrix, right, prior = noisy_problem(seed)
    strong = consistent_least_squares(matrix, right, prior, weight=1e9)
    weak = consistent_least_squares(matrix, right, prior, weight=1e-9)
    constrained = consistent_least_squares(matrix, right, prior)
    assert body_divergence(strong[:10], prior[:10]) < 1e-6
    best = cost(matrix, right, constrained)
    assert cost(matrix, right, weak) == pytest.approx(best, rel=1e-5)


@given(SEEDS, st.floats(-2, 3))
def test_a_newton_step_from_the_entropic_optimum_gains_nothing(seed, power):
    matrix, right, prior = noisy_problem(seed)
    weight = 10.0**power
    values = consistent_least_squares(matrix, right, prior, weight=weight)
    basis = spatial.pseudo_inertia(np.eye(10))
    inverse = np.linalg.inv(spatial.pseudo_inertia(values[:10]))
    pull = np.linalg.inv(spatial.pseudo_inertia(prior[:10])) - inverse
    slope, curve = 2.0 * matrix.T @ (matrix @ values - right), 2.0 * matrix.T @ matrix
    slope[:10] += weight * np.einsum("kij,ij->k", basis, pull)
    curve[:10, :10] += weight * np.einsum("kij,lji->kl", inverse @ basis, inverse @ basis)
    gain = 0.5 * slope @ np.linalg.solve(curve, slope)
    assert gain < 1e-6 * weight
