"""Laws of square-root information and of weighted least squares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.estimation.algebra.least_squares import (
    InformationAccumulator,
    combine,
    joint_noise,
    restrict,
    solver,
    update_triangle,
)
from tests.support.arms import SEEDS
from tests.support.estimates import identify
from tests.support.synthetic_data import noisy_samples

# ---- square-root information

COLUMNS = 5
NAMES = tuple("abcdef")


def with_positive_diagonal(triangle):
    """Return the one of equivalent triangles whose diagonal is not negative."""
    return np.where(np.diag(triangle) < 0.0, -1.0, 1.0)[:, None] * triangle


@st.composite
def tall_matrices(draw):
    """Return rows of very different sizes, with two columns that may be nearly equal."""
    rng = np.random.default_rng(draw(SEEDS))
    rows = rng.normal(size=(draw(st.integers(1, 60)), COLUMNS))
    rows *= 10.0 ** rng.uniform(-3.0, 3.0, size=(len(rows), 1))
    rows[:, 1] = rows[:, 0] + draw(st.sampled_from([1e-6, 1.0])) * rows[:, 1]
    return rows


@given(tall_matrices(), st.lists(st.integers(0, 60), max_size=6), SEEDS)
def test_rows_in_any_order_and_chunks_have_the_one_shot_triangle(rows, cuts, seed):
    triangle = empty = np.zeros((COLUMNS, COLUMNS))
    shuffled = np.random.default_rng(seed).permutation(rows)
    for chunk in np.split(shuffled, np.sort(np.minimum(cuts, len(rows)).astype(int))):
        triangle = update_triangle(triangle, chunk)
    once = update_triangle(empty, rows)
    size = np.max(np.abs(once))
    atol = 1e-13 * size**2
    assert_allclose(triangle.T @ triangle, once.T @ once, rtol=0.0, atol=atol)
    if len(rows) >= COLUMNS and np.linalg.cond(rows) < 1e6:
        expected = with_positive_diagonal(once)
        assert_allclose(with_positive_diagonal(triangle), expected, atol=1e-9 * size)


@given(SEEDS, st.integers(1, 4))
def test_triangle_gives_the_residual_of_all_rows(seed, chunks):
    rng = np.random.default_rng(seed)
    columns = rng.permutation(6)[:4]
    accumulator = InformationAccumulator(NAMES, ["j"], [columns])
    values = rng.normal(size=6)
    expected = 0.0
    for _ in range(chunks):
        rows = rng.normal(size=(20, 4))
        tau = rng.normal(size=20)
        accumulator.add(0, rows, tau)
        expected += np.sum((rows @ values[columns] - tau) ** 2)
    information = accumulator.result()
    assert information.n_samples == 20 * chunks
    assert_allclose(information.squared_residuals(values), [expected], rtol=1e-12)
    matrix, right = information.equations()
    squares = np.sum((matrix @ values - right) ** 2)
    assert squares == pytest.approx(expected, rel=1e-12)


def information_of(columns, blocks):
    """Return information of two joints from blocks (joint number, rows, tau)."""
    accumulator = InformationAccumulator(NAMES, ["i", "j"], columns)
    for block in blocks:
        accumulator.add(*block)
    return accumulator.result()


def random_blocks(rng, columns, count):
    blocks = []
    for joint, size in rng.integers(0, [2, 20], (count, 2)):
        rows = rng.normal(size=(size, len(columns[joint])))
        blocks.append((joint, rows, rng.normal(size=size)))
    return blocks


def assert_same_joints(information, expected):
    assert len(information.joints) == len(expected.joints)
    for joint, other in zip(information.joints, expected.joints):
        assert (joint.joint, joint.n_samples) == (other.joint, other.n_samples)


@given(SEEDS, st.integers(1, 4))
def test_combined_information_is_that_of_all_rows(seed, count):
    """The prior is the same in each, and counts once."""
    rng = np.random.default_rng(seed)
    columns = [rng.permutation(6)[:3], rng.permutation(6)[:4]]
    prior = rng.normal(size=(2, 7))
    logs = [random_blocks(rng, columns, 3) for _ in range(count)]
    combined = combine(
        [replace(information_of(columns, blocks), prior=prior) for blocks in logs]
    )
    expected = information_of(columns, sum(logs, []))
    assert combined.names == NAMES
    assert_array_equal(combined.prior, prior)
    assert_same_joints(combined, expected)
    for joint, other in zip(combined.joints, expected.joints):
        assert_array_equal(joint.columns, other.columns)
        gram = other.triangle.T @ other.triangle
        atol = 1e-12 * (1.0 + np.max(gram))
        assert_allclose(joint.triangle.T @ joint.triangle, gram, rtol=0.0, atol=atol)
    assert combine([expected]).prior is None


@given(SEEDS, st.permutations(range(6)), st.integers(1, 6))
def test_restricting_holds_the_other_parameters_at_zero(seed, order, count):
    rng = np.random.default_rng(seed)
    columns = [rng.permutation(6)[:3], rng.permutation(6)]
    information = information_of(columns, random_blocks(rng, columns, 5))
    free = sorted(order[:count])
    restricted = restrict(information, [NAMES[k] for k in order[:count]])
    assert restricted.names == tuple(NAMES[k] for k in free)
    values = np.zeros(6)
    values[free] = rng.normal(size=count)
    squares = restricted.squared_residuals(values[free])
    assert_allclose(squares, information.squared_residuals(values), rtol=1e-11)
    assert_same_joints(restricted, information)


# ---- weighted least squares

PRIOR = np.zeros(16)


@pytest.mark.slow
@given(SEEDS, st.floats(-3, 3))
def test_wls_does_not_depend_on_the_unit_of_one_joint(seed, power):
    samples, names, _, _ = noisy_samples(seed, (0.3, 0.1, 0.02))
    information = samples.information(names)
    estimate = identify(information, PRIOR, "wls")
    joints = list(information.joints)
    joints[1] = replace(joints[1], triangle=10.0**power * joints[1].triangle)
    rescaled = replace(information, joints=tuple(joints))
    values = identify(rescaled, PRIOR, "wls").values
    assert_allclose(values, estimate.values, rtol=0.0, atol=1e-6)


def test_wls_reports_each_joints_noise_and_beats_ols_where_joints_differ():
    noises = (1.0, 0.1, 0.01)
    ratios = []
    for seed in range(20):
        samples, names, truth, _ = noisy_samples(seed, noises)
        information = samples.information(names)
        ordinary = identify(information, PRIOR, "ols").values - truth
        weighted = identify(information, PRIOR, "wls")
        error = np.linalg.norm((weighted.values - truth)[:10])
        ratios.append(error / np.linalg.norm(ordinary[:10]))
    assert np.median(ratios) < 0.3
    assert_allclose(list(weighted.noise_per_joint.values()), noises, rtol=0.2)


@given(SEEDS)
def test_degrees_of_freedom_of_all_joints_sum_to_the_rank(seed):
    """Of those subtracted from each joint's number of samples, for any weights and values."""
    samples, names, _, rng = noisy_samples(seed)
    information = samples.information(names)
    values = rng.normal(size=16)
    _, shares = solver(information, PRIOR)(rng.uniform(0.1, 10.0, 3))
    noise = joint_noise(information, values, shares, 0.0)
    freedom = 200.0 - information.squared_residuals(values) / noise**2
    assert np.sum(freedom) == pytest.approx(16.0, rel=1e-9)


@given(SEEDS)
def test_equations_with_a_prior_are_solved_to_rounding(seed):
    """Through normal equations, as accurately as without a prior."""
    samples, names, truth, rng = noisy_samples(seed)
    prior = np.column_stack((np.diag(10.0 ** rng.uniform(-3, 0, 16)), np.zeros(16)))
    weights = rng.uniform(0.1, 10.0, 3)
    information = replace(samples.information(names), prior=prior)
    expected = np.linalg.lstsq(*information.equations(weights), rcond=None)[0]
    values, _ = solver(information, PRIOR)(weights)
    assert_allclose(values, expected, rtol=0.0, atol=1e-11 * np.max(np.abs(truth)))


@given(SEEDS)
def test_directions_that_exact_data_does_not_show_keep_the_models_values(seed):
    """Beside priors of other parameters, and where rounding makes the Gram matrix definite."""
    rng = np.random.default_rng(seed)
    names = noisy_samples(seed)[1]
    for _ in range(10):
        rows = rng.normal(size=(60, 16))
        truth, model = rng.normal(size=(2, 16))
        ratios = rng.normal(size=2)
        rows[:, [2, 5]] = ratios * rows[:, [1, 4]]
        accumulator = InformationAccumulator(names, ["j"], [np.arange(16)])
        accumulator.add(0, rows, rows @ truth)
        prior = np.pad(np.eye(6), ((0, 0), (10, 1)))
        solve = solver(replace(accumulator.result(), prior=prior), model)
        values, _ = solve(np.array([10.0]))
        change = values - model
        assert_allclose(change[[2, 5]], ratios * change[[1, 4]], atol=1e-6)
