"""Possible bodies: laws of the fit of all links at once, and errors of possible bodies."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra import consistent_bodies
from robot_sysid.estimation.algebra.consistent_bodies import (
    BODIES,
    GAMMAS,
    ConsistentLinks,
    LinksProblem,
    ScaledBodies,
    project_errors,
    projected_covariance,
)
from robot_sysid.estimation.algebra.uncertainty import Uncertainty
from tests.support import arms
from tests.support.synthetic_data import (
    arm_equations,
    information_of,
    random_body,
    sdp_least_squares,
)

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


def objective(matrix, right, problem, gamma, values):
    """Return the objective that the fit minimises."""
    total = 0.5 * float(np.sum((matrix @ values - right) ** 2))
    for link in problem.links:
        if not spatial.is_consistent(values[link]):
            return np.inf
        prior = spatial.pseudo_inertia(problem.prior[link])
        pseudo_inertia = spatial.pseudo_inertia(values[link])
        log_determinant = np.linalg.slogdet(pseudo_inertia)[1]
        trace = np.trace(np.linalg.solve(prior, pseudo_inertia))
        total += gamma * (trace - log_determinant)
    return total


def minimise(matrix, right, problem, gamma):
    """Return the minimiser for one weight of the prior."""
    return next(ConsistentLinks(matrix, right, problem).path((gamma,)))


@given(thetas=link_bodies(4), seed=SEEDS)
def test_noise_free_data_gives_the_truth_whatever_the_model(thetas, seed):
    rng = np.random.default_rng(seed)
    truth = np.concatenate((*thetas[2:], [0.3, 0.5, 0.1]))
    matrix = 1e4 * random_rows(rng, 60, thetas[2:])
    values = minimise(matrix, matrix @ truth, problem_of(thetas[:2]), 1e-3)
    assert np.max(np.abs(values - truth) / unit_sizes(thetas[2:])) < 1e-3


@given(thetas=link_bodies(), seed=SEEDS)
def test_links_are_possible_bodies_whatever_the_data(thetas, seed):
    """Right-hand sides are nothing but noise, and half of the directions do not show."""
    rng = np.random.default_rng(seed)
    matrix = random_rows(rng, SIZE // 2, thetas)
    right = 100.0 * rng.normal(size=len(matrix))
    solver = ConsistentLinks(matrix, right, problem_of(thetas))
    for values in solver.path((100.0, 1.0, 1e-3)):
        for theta in values[: 10 * LINKS].reshape(LINKS, 10):
            assert spatial.is_consistent(theta)


@given(thetas=link_bodies(), seed=SEEDS)
def test_nothing_nearby_is_better(thetas, seed):
    rng = np.random.default_rng(seed)
    matrix = random_rows(rng, 40, thetas)
    gamma = 3.0
    problem = (matrix, 10.0 * rng.normal(size=40), problem_of(thetas), gamma)
    values = minimise(*problem)
    best = objective(*problem, values)
    for _ in range(10):
        step = rng.normal(size=SIZE) / np.linalg.norm(matrix, axis=0)
        for size in (1e-3, 0.1, 1.0):
            assert objective(*problem, values + size * step) >= best - 1e-6 * gamma


@pytest.mark.parametrize("seed", range(2))
def test_without_weight_the_objective_is_that_of_the_semidefinite_program(seed):
    """A thin body under heavy noise, whose plain estimate is impossible."""
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng, count=40)
    truth = np.concatenate((random_body(rng, 0.1), rng.uniform(0.1, 1.0, 6)))
    matrix, right = information_of(equations, names, truth, 3.0, rng).equations()
    plain = np.linalg.lstsq(matrix, right, rcond=None)[0]
    assert not spatial.is_consistent(plain[:10])
    problem = LinksProblem((BODY,), np.append(random_body(rng), np.zeros(6)))
    gap = 1e-10 * np.sum((matrix @ plain - right) ** 2)
    values = minimise(matrix, right, problem, gap)
    assert spatial.is_consistent(values[:10])
    squares = np.sum((matrix @ values - right) ** 2)
    assert squares == pytest.approx(sdp_least_squares(matrix, right), rel=1e-8)


@pytest.mark.parametrize("seed", [72, 74, 100])
def test_one_step_that_does_not_shrink_ends_no_search(monkeypatch, seed):
    """Weights up to those of exact data, at which steps may grow before the last ones."""
    rng = np.random.default_rng(seed)
    thetas = []
    for _ in range(2 * LINKS):
        gyration = 10.0 ** rng.uniform(-2.0, -0.5, 3)
        turn = arms.random_rotation(rng)
        mass = 10.0 ** rng.uniform(-1.0, 1.3)
        second_moment = mass * turn @ np.diag(gyration**2) @ turn.T
        inertia = np.trace(second_moment) * np.eye(3) - second_moment
        center = 0.1 * rng.normal(size=3)
        thetas.append(spatial.theta_from_com(mass, center, inertia))
    truth = np.concatenate((*thetas[LINKS:], [0.3, 0.5, 0.1]))
    count = int(rng.choice([10, 14, 18, 30]))
    weight = 10.0 ** rng.uniform(1.0, 8.0)
    matrix = weight * random_rows(rng, count, thetas[LINKS:])
    noise = rng.choice([0.0, 1.0]) * rng.normal(size=count)
    if rng.random() < 0.5:
        truth[4:7] *= -0.3
    problem = problem_of(thetas[:LINKS])

    def minimisers():
        """Return the minimiser for a large gamma and for a small one."""
        solver = ConsistentLinks(matrix, matrix @ truth + noise, problem)
        return list(solver.path((GAMMAS[0], GAMMAS[-1])))

    values = minimisers()
    monkeypatch.setattr(consistent_bodies, "_STALLED", 0.0)
    assert_array_equal(values, minimisers())


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
    return prior, ConsistentLinks(matrix, matrix @ truth, problem).best()


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


@pytest.mark.parametrize(
    "step", [(consistent_bodies, "_Newton"), (ScaledBodies, "move_duals")]
)
def test_a_step_that_rounding_makes_singular_is_our_error(monkeypatch, step):
    def singular(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(*step, singular)
    with pytest.raises(SysidError, match="did not converge"):
        fit_last_joint(0.001)


# ---- errors of possible bodies

LIGHT = spatial.theta_from_com(0.2, np.array([0.02, 0.01, 0.05]), 2e-4 * np.eye(3))


def random_covariance(share, seed=0):
    """Return a covariance (10, 10) of errors of a share of a usual size, correlated."""
    mixing = np.random.default_rng(seed).normal(size=(10, 10)) / np.sqrt(10.0)
    scale = spatial.parameter_scale(0.2, 0.1)[:, None]
    root = share * scale * (mixing + np.eye(10))
    return root @ root.T


def uncertainty_of(covariance):
    errors = np.sqrt(np.diag(covariance))
    unit = np.eye(len(covariance))
    return Uncertainty(covariance, 0.0 * unit, errors, np.diag(unit), unit, (1.0,))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_the_covariance_is_the_spread_of_possible_bodies(seed):
    covariance = random_covariance(0.8, seed)
    rng = np.random.default_rng([seed, 1])
    root = np.linalg.cholesky(covariance)
    rows = np.linalg.inv(root)
    problem = LinksProblem((BODY,), LIGHT)
    squares = np.zeros(10)
    for deviation in rng.normal(size=(200, 10)) @ root.T:
        theta = LIGHT + deviation
        if not spatial.is_consistent(theta):
            theta = ConsistentLinks(rows, rows @ theta, problem).best()
        squares += (theta - LIGHT) ** 2 / 200.0
    variance = np.diag(projected_covariance(LIGHT, covariance))
    # 200 draws know a spread to 5 %, the 60 of the code to 9 %.
    ratio = np.sqrt(variance / squares)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
    assert_allclose(ratio, 1.0, atol=0.35)
    assert variance[0] < 0.8 * covariance[0, 0]


def test_where_every_body_is_possible_nothing_changes():
    covariance = random_covariance(1e-3)
    errors = uncertainty_of(covariance)
    causes = {"noise": np.linalg.cholesky(covariance).T}
    result = project_errors(errors, causes, BODY, LIGHT, LIGHT)
    assert result[0] is errors and result[1] == causes
    assert_array_equal(projected_covariance(LIGHT, covariance), covariance)


def test_causes_still_add_up_and_parameters_correlated_with_the_body_follow():
    """An eleventh parameter is the mass plus an independent error, a twelfth only has the error."""
    change = np.vstack((np.eye(10), np.eye(10)[:1], np.zeros((1, 10))))
    independent = np.diag([0.0] * 10 + [0.01**2] * 2)
    covariance = change @ random_covariance(0.8) @ change.T + independent
    root = np.linalg.cholesky(covariance).T
    causes = {"links": np.sqrt(0.7) * root, "noise": np.sqrt(0.3) * root}
    errors = uncertainty_of(covariance)
    errors, causes = project_errors(errors, causes, BODY, LIGHT, LIGHT)
    assert set(causes) == {"links", "noise", BODIES}
    rows = np.vstack([*causes.values()])
    assert_allclose(rows.T @ rows, errors.covariance, atol=1e-9 * covariance.max())
    variance = np.diag(errors.covariance)
    assert_allclose(errors.standard_errors**2, variance, rtol=1e-9)
    assert variance[10] == pytest.approx(variance[0] + 0.01**2)
    assert variance[11] == pytest.approx(0.01**2)


def test_a_body_with_a_hidden_parameter_keeps_its_errors():
    errors = uncertainty_of(random_covariance(0.8))
    errors.standard_errors[4] = np.inf
    assert project_errors(errors, {}, BODY, LIGHT, LIGHT)[0] is errors


def test_errors_stay_where_a_drawn_body_cannot_be_made_possible(monkeypatch):
    def fail(solver):
        raise SysidError("does not converge")

    monkeypatch.setattr(ConsistentLinks, "best", fail)
    covariance = random_covariance(0.8)
    assert_array_equal(projected_covariance(LIGHT, covariance), covariance)
