"""Possible bodies: laws of the least-squares fit of all links at once."""

from __future__ import annotations

from typing import NamedTuple

import clarabel
import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.small_arms import SEEDS
from robot_sysid import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimate.equations.bodies import LEAST_SHARE, consistent_least_squares


class Problem(NamedTuple):
    """Links (L, 10) among parameters, and the prior (p,) of these."""

    links: np.ndarray
    prior: np.ndarray


LINKS = 2
FRICTION = 3
SIZE = 10 * LINKS + FRICTION
BODY = np.arange(10)


def random_body(rng):
    """Return theta of a link of an arm: 0.1 to 20 kg, 1 to 30 cm."""
    mass = 10.0 ** rng.uniform(-1.0, 1.3)
    return small_arms.random_theta(rng, mass, 10.0 ** rng.uniform(-2.0, -0.5))


def sizes_of(theta):
    """Return the usual size of each parameter of a link (10,)."""
    return spatial.parameter_scale(theta[0], spatial.characteristic_length(theta))


def relative_bodies(values, problem):
    """Yield each body's pseudo-inertia relative to that of its reference body."""
    for link in problem.links:
        prior = problem.prior[link]
        reference = spatial.nearest_consistent_body(prior, prior, LEAST_SHARE)
        root = np.linalg.cholesky(spatial.pseudo_inertia(reference))
        inverse = np.linalg.inv(root)
        yield inverse @ spatial.pseudo_inertia(values[link]) @ inverse.T


def is_admitted(values, problem):
    """Tell whether all bodies have their least share of the reference bodies."""
    bodies = relative_bodies(values, problem)
    return all(np.linalg.eigvalsh(body)[0] >= LEAST_SHARE for body in bodies)


@given(SEEDS)
def test_the_best_is_found_where_it_is_known(seed):
    """On the edge of the admitted bodies, at a bound, and with a gradient that points outwards.

    Beside impossible bodies, other parameters may cross their bounds and stay inside here.
    """
    rng = np.random.default_rng(seed)
    thetas = [random_body(rng) for _ in range(2 * LINKS)]
    sizes = np.concatenate((*map(sizes_of, thetas[LINKS:]), np.ones(FRICTION)))
    matrix = 100.0 * rng.normal(size=(40, SIZE)) / sizes
    links = BODY + 10 * np.arange(LINKS)[:, None]
    problem = Problem(links, np.concatenate((*thetas[:LINKS], np.zeros(FRICTION))))
    best = np.concatenate((*thetas[LINKS:], rng.normal(size=FRICTION)))
    gradient = np.zeros(SIZE)
    for link, relative in zip(problem.links, relative_bodies(best, problem)):
        root = np.linalg.cholesky(spatial.pseudo_inertia(problem.prior[link]))
        shares, axes = np.linalg.eigh(relative)
        shares[0] = LEAST_SHARE
        edge = root @ (axes * shares) @ axes.T @ root.T
        best[link] = spatial.theta_from_pseudo_inertia(edge)
        outwards = np.linalg.solve(root.T, axes[:, 0])
        for index, unit in zip(link, np.eye(10)):
            gradient[index] = outwards @ spatial.pseudo_inertia(unit) @ outwards
    lower = np.full(SIZE, -np.inf)
    upper = np.full(SIZE, np.inf)
    lower[-3:] = best[-3:] - (0.0, 0.1, 1.0)
    upper[-2:] = best[-2:] + (0.0, 1.0)
    gradient[-3:-1] = rng.uniform(0.0, 100.0, 2) * (1.0, -1.0)
    residual = np.linalg.lstsq(matrix.T, gradient, rcond=None)[0]
    residual *= 10.0 ** rng.uniform(0.0, 3.0) / np.linalg.norm(residual)
    right = matrix @ best - residual
    bounds = lower, upper
    found = consistent_least_squares(matrix, right, *problem, bounds=bounds)
    values = found.values
    assert np.all((lower <= values) & (values <= upper))
    assert np.all((values == lower) | (values == upper), where=~found.is_inside)
    excess = np.sum((matrix @ values - right) ** 2) - np.sum(residual**2)
    assert -1e-3 < excess < 3.0 + 1e-3


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
    problem = Problem(BODY[None], prior)
    return prior, consistent_least_squares(matrix, matrix @ truth, *problem).values


@pytest.mark.parametrize("izz", [0.001, 0.1])
def test_hidden_parameters_give_way_to_well_seen_ones_alone(izz):
    """Ixy, weakly seen, is larger than a slim body's; no body has an Izz above all others."""
    prior, theta = fit_last_joint(izz)
    assert spatial.is_consistent(theta)
    hidden_sum = (theta[4] + theta[7]) / (prior[4] + prior[7])
    if izz == 0.001:
        assert theta[5] < 0.001 and hidden_sum == pytest.approx(1.0, rel=1e-5)
        assert_allclose(theta[[0, 3]], prior[[0, 3]], rtol=1e-5)
    else:
        assert theta[9] == pytest.approx(izz, rel=1e-2) and hidden_sum > 2.0


def test_equations_that_are_no_numbers_are_our_error():
    problem = Problem(BODY[None], fit_last_joint(0.001)[0])
    with pytest.raises(SysidError, match="did not converge"):
        consistent_least_squares(np.full((12, 10), np.nan), np.zeros(12), *problem)


REFERENCES = (
    lambda rng, truth: truth,
    lambda rng, truth: random_body(rng),
    lambda rng, truth: 10.0 ** rng.uniform(-6.0, 0.0) * random_body(rng),
    lambda rng, truth: np.append(truth[0], np.zeros(9)),
    lambda rng, truth: np.zeros(10),
    lambda rng, truth: sizes_of(truth) * rng.normal(size=10),
)
"""Reference bodies: right ones, wrong ones, placeholders, points, none, and impossible ones."""


def hard_problem(rng):
    """Return (A, b, problem, truth) of 1 to 8 links with any reference bodies.

    Further parameters have units from 1e-6 to 1e6, half of all problems have directions that do not
    show, half of them a mass that is known to 1e-6, a quarter no noise, another little else.
    """
    n_links = rng.choice((1, 1, 2, 2, 3, 3, 4, 8))
    size = 10 * n_links + rng.integers(0, 21)
    links = np.array([10 * k + BODY for k in range(n_links)])
    truth = rng.normal(size=size)
    units = 10.0 ** rng.uniform(-6.0, 6.0, size)
    truth *= units
    prior = np.zeros(size)
    for link in links:
        truth[link] = random_body(rng)
        units[link] = sizes_of(truth[link])
        prior[link] = REFERENCES[rng.integers(len(REFERENCES))](rng, truth[link])
    rank = size if rng.random() < 0.5 else rng.integers(size // 3, size)
    weights = 10.0 ** (rng.uniform(0.0, 5.0) + rng.uniform(-3.0, 0.0, rank))
    mixed = weights[:, None] * rng.normal(size=(rank, size)) / units
    matrix = rng.normal(size=(rng.integers(rank, 3 * size), rank)) @ mixed
    matrix = np.vstack((matrix, np.zeros(size)))
    if rng.random() < 0.5:
        matrix[-1, 0] = 1e6 / truth[0]
    noise = rng.choice((0.0, 1.0, 10.0, 1000.0)) * rng.normal(size=len(matrix))
    return matrix, matrix @ truth + noise, Problem(links, prior), truth


class FailingSolver:
    """Clarabel where rounding ends its search."""

    status = "NumericalError"

    def __init__(self, *equations):
        pass

    def solve(self):
        return self


@given(SEEDS)
def test_every_problem_has_an_answer_near_the_best_whatever_the_reference(seed):
    """So has one whose search begins where another has ended.

    Where the search fails, bodies are possible.
    """
    matrix, right, problem, truth = hard_problem(np.random.default_rng(seed))
    found = consistent_least_squares(matrix, right, *problem)
    again = consistent_least_squares(matrix, right, *problem, like=found)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clarabel, "DefaultSolver", FailingSolver)
        failed = consistent_least_squares(matrix, right, *problem)
    for fit in (found, again, failed):
        assert all(spatial.is_consistent(fit.values[link]) for link in problem.links)
    if is_admitted(truth, problem):
        # The best is not above the truth.
        limit = np.sum((matrix @ truth - right) ** 2) + 3.0
        for fit in (found, again):
            residual = matrix @ fit.values - right
            assert np.sum(residual**2) <= (1.0 + 1e-6) * limit
