"""The barrier method on problems whose answer is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import SysidError
from robot_sysid.estimation.barrier import MatrixProblem, minimise

UPPER = [(i, j) for i in range(3) for j in range(i, 3)]


def symmetric_basis():
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(UPPER):
        basis[k, i, j] = basis[k, j, i] = 1.0 if i == j else np.sqrt(0.5)
    return basis


def coordinates(matrix):
    return np.tensordot(symmetric_basis(), matrix, axes=2)


def projection_problem(target, singular=1.0):
    right = singular * coordinates(target)
    return MatrixProblem(
        singular * np.ones(6), right, np.zeros(6), np.zeros((3, 3)), symmetric_basis()
    )


@given(st.integers(0, 2**32 - 1))
def test_projection_onto_the_cone_cuts_negative_eigenvalues(seed):
    raw = np.random.default_rng(seed).normal(size=(3, 3))
    target = raw + raw.T
    values, vectors = np.linalg.eigh(target)
    w = minimise(projection_problem(target), coordinates(np.eye(3)), lambda w: 1e-12)
    expected = (vectors * np.maximum(values, 0.0)) @ vectors.T
    found = np.tensordot(w, symmetric_basis(), axes=1)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-6)
    assert np.linalg.eigvalsh(found)[0] > 0.0


def test_linear_term_and_barrier_balance():
    problem = MatrixProblem(
        np.zeros(6), np.zeros(6), coordinates(np.eye(3)), np.zeros((3, 3)), symmetric_basis()
    )
    w = minimise(problem, coordinates(np.eye(3)), lambda w: 4.0)
    np.testing.assert_allclose(w, coordinates(4.0 * np.eye(3)), rtol=1e-6, atol=1e-8)


def test_a_start_outside_is_an_error_of_ours():
    with pytest.raises(SysidError, match="did not converge"):
        minimise(projection_problem(np.eye(3)), coordinates(-np.eye(3)), lambda w: 1e-9)
