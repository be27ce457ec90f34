"""Possible bodies: laws of the least-squares fit of all links at once."""

from __future__ import annotations

from types import SimpleNamespace

import clarabel
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimate.bodies import (
    LEAST_SHARE,
    TOLERANCES,
    LinksProblem,
    consistent_least_squares,
)
from tests.support import arms

LINKS = 2
FRICTION = 3
SIZE = 10 * LINKS + FRICTION
BODY = np.arange(10)
SEEDS = st.integers(0, 2**31 - 1)


@st.composite
def link_bodies(draw, count=LINKS):
    """Return theta of some links of an arm: 0.1 to 20 kg, 1 to 30 cm."""
    thetas = []
    for _ in range(count):
        rng = np.random.default_rng(draw(SEEDS))
        gyration = 10.0 ** rng.uniform(-2.0, -0.5, 3)
        rotation = arms.random_rotation(rng)
        mass = 10.0 ** rng.uniform(-1.0, 1.3)
        second = mass * rotation @ np.diag(gyration**2) @ rotation.T
        inertia = np.trace(second) * np.eye(3) - second
        theta = spatial.theta_from_com(mass, 0.1 * rng.normal(size=3), inertia)
        thetas.append(theta)
    return thetas


def problem_of(thetas):
    """Return the problem of links, with a prior each, and three friction terms."""
    bodies = tuple(10 * k + BODY for k in range(len(thetas)))
    return LinksProblem(bodies, np.concatenate((*thetas, np.zeros(FRICTION))))


def unit_sizes(thetas):
    """Return the usual size of each parameter of links, and ones for friction."""
    lengths = map(spatial.characteristic_length, thetas)
    sizes = map(spatial.parameter_scale, [theta[0] for theta in thetas], lengths)
    return np.concatenate((*sizes, np.ones(FRICTION)))


def random_rows(rng, count, thetas):
    """Return a regressor whose columns all weigh about the same for such links."""
    return rng.normal(size=(count, SIZE)) / unit_sizes(thetas)


@given(thetas=link_bodies(4), seed=SEEDS)
def test_noise_free_data_gives_the_truth_whatever_the_model(thetas, seed):
    rng = np.random.default_rng(seed)
    truth = np.concatenate((*thetas[2:], [0.3, 0.5, 0.1]))
    matrix = 1e4 * random_rows(rng, 60, thetas[2:])
    problem = problem_of(thetas[:2])
    values = consistent_least_squares(matrix, matrix @ truth, problem)
    assert np.max(np.abs(values - truth) / unit_sizes(thetas[2:])) < 1e-3


@given(thetas=link_bodies(), seed=SEEDS)
def test_links_are_possible_bodies_whatever_the_data(thetas, seed):
    """Right-hand sides are nothing but noise, and half of the directions do not show."""
    rng = np.random.default_rng(seed)
    matrix = random_rows(rng, SIZE // 2, thetas)
    right = 100.0 * rng.normal(size=len(matrix))
    values = consistent_least_squares(matrix, right, problem_of(thetas))
    for theta in values[: 10 * LINKS].reshape(LINKS, 10):
        assert spatial.is_consistent(theta)


def is_admitted(values, problem):
    """Tell whether all bodies have their least share of the reference bodies."""
    for link in problem.links:
        root = np.linalg.cholesky(spatial.pseudo_inertia(problem.prior[link]))
        inverse = np.linalg.inv(root)
        relative = inverse @ spatial.pseudo_inertia(values[link]) @ inverse.T
        if np.linalg.eigvalsh(relative)[0] < LEAST_SHARE:
            return False
    return True


@given(thetas=link_bodies(), seed=SEEDS)
def test_no_admitted_bodies_nearby_are_better(thetas, seed):
    rng = np.random.default_rng(seed)
    matrix = random_rows(rng, 40, thetas)
    right = 10.0 * rng.normal(size=40)
    problem = problem_of(thetas)
    values = consistent_least_squares(matrix, right, problem)
    best = np.sum((matrix @ values - right) ** 2)
    for _ in range(10):
        step = rng.normal(size=SIZE) / np.linalg.norm(matrix, axis=0)
        for size in (1e-3, 0.1, 1.0):
            other = values + size * step
            if is_admitted(other, problem):
                assert np.sum((matrix @ other - right) ** 2) >= (1.0 - 1e-6) * best


def fit_last_joint(izz):
    """Return (prior, fit) of a body of which the last joint's torque shows a part.

    It shows hx and hy, Ixz and Iyz, Izz well and the rest of Ixx - Iyy; Ixy weakly.
    """
    com = np.array([0.0, 0.02, 0.1])
    prior = spatial.theta_from_com(1.0, com, np.diag([0.01, 0.01, 0.001]))
    matrix = np.zeros((7, 10))
    matrix[range(6), (1, 2, 5, 6, 8, 9)] = 1e4, 1e4, 100.0, 1e4, 1e4, 1e4
    matrix[6, [4, 7]] = 1e4, -1e4
    truth = prior.copy()
    truth[[2, 5, 9]] = 0.01, 0.003, izz
    problem = LinksProblem((BODY,), prior)
    return prior, consistent_least_squares(matrix, matrix @ truth, problem)


def test_hidden_parameters_keep_the_prior_where_a_possible_body_costs_hardly_anything():
    """Ixy, weakly seen, is larger than a body as slim as this can have."""
    prior, theta = fit_last_joint(0.001)
    assert spatial.is_consistent(theta) and theta[5] < 0.001
    assert_allclose(theta[[0, 3]], prior[[0, 3]], rtol=1e-5)
    assert theta[4] + theta[7] == pytest.approx(prior[4] + prior[7], rel=1e-5)


def test_hidden_parameters_give_way_to_well_seen_ones():
    """No body has an Izz above the sum of the others."""
    prior, theta = fit_last_joint(0.1)
    assert spatial.is_consistent(theta)
    assert theta[9] == pytest.approx(0.1, rel=1e-2)
    assert theta[4] + theta[7] > 2.0 * (prior[4] + prior[7])


def test_equations_that_are_no_numbers_are_our_error():
    problem = LinksProblem((BODY,), fit_last_joint(0.001)[0])
    with pytest.raises(SysidError, match="did not converge"):
        consistent_least_squares(np.full((12, 10), np.nan), np.zeros(12), problem)


def test_a_search_that_panics_is_tried_with_another_tolerance(monkeypatch):
    """What Clarabel raises where rounding leaves it without a number is no Exception."""
    tolerances = []

    class Solver:
        """A solver of Clarabel that panics in its first searches."""

        panics = 1

        def __init__(self, *problem):
            tolerances.append(problem[-1].tol_gap_rel)

        def solve(self):
            if len(tolerances) <= self.panics:
                raise type("PanicException", (BaseException,), {})("Eigval error")
            return SimpleNamespace(status="Solved", x=np.zeros(100))

    monkeypatch.setattr(clarabel, "DefaultSolver", Solver)
    fit_last_joint(0.001)
    assert tolerances[:2] == list(TOLERANCES)
    Solver.panics = 1000
    with pytest.raises(SysidError, match="did not converge"):
        fit_last_joint(0.001)
