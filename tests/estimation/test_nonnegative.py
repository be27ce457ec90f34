"""Bounded parameters: the same answer as non-negative least squares."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from robot_sysid.estimation.identifiability import visible_space
from robot_sysid.estimation.nonnegative import solve_nonnegative

SEEDS = st.integers(0, 2**32 - 1)


def plain(matrix, right, prior):
    return prior + visible_space(matrix).solve(right - matrix @ prior)


@settings(max_examples=200, deadline=None)
@given(SEEDS, st.integers(1, 8))
def test_all_bounded_is_non_negative_least_squares(seed, size):
    rng = np.random.default_rng(seed)
    matrix, right = rng.normal(size=(20, size)), rng.normal(size=20)
    values = solve_nonnegative(plain, matrix, right, np.zeros(size), range(size))
    expected, misfit = nnls(matrix, right)
    assert np.all(values >= 0.0)
    assert np.linalg.norm(matrix @ values - right) <= misfit * (1.0 + 1e-9)
    np.testing.assert_allclose(values, expected, rtol=0.0, atol=1e-9)


@settings(max_examples=100, deadline=None)
@given(SEEDS)
def test_free_parameters_may_be_negative_and_nothing_changes_where_no_bound_acts(seed):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(30, 4))
    truth = np.array([-3.0, 2.0, -1.0, 1.0])
    values = solve_nonnegative(plain, matrix, matrix @ truth, np.zeros(4), [1, 3])
    np.testing.assert_allclose(values, truth, rtol=0.0, atol=1e-10)


def test_no_bounds_is_the_plain_solution():
    rng = np.random.default_rng(0)
    matrix, right = rng.normal(size=(9, 3)), rng.normal(size=9)
    values = solve_nonnegative(plain, matrix, right, np.zeros(3), [])
    np.testing.assert_array_equal(values, plain(matrix, right, np.zeros(3)))
