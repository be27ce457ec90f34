"""The fit of all links at once: laws of its minimiser on small random problems."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra import consistent_bodies
from robot_sysid.estimation.algebra.consistent_bodies import (
    ConsistentLinks,
    LinksProblem,
    ScaledBodies,
)
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
SEEDS = st.integers(0, 2**31 - 1)


@st.composite
def links(draw):
    """theta of a link of an arm: 0.1 to 20 kg, 1 to 30 cm."""
    rng = np.random.default_rng(draw(SEEDS))
    gyration = 10.0 ** rng.uniform(-2.0, -0.5, 3)
    rotation = arms.random_rotation(rng)
    mass = 10.0 ** rng.uniform(-1.0, 1.3)
    second = mass * rotation @ np.diag(gyration**2) @ rotation.T
    inertia = np.trace(second) * np.eye(3) - second
    return spatial.theta_from_com(mass, 0.1 * rng.normal(size=3), inertia)


def problem_of(prior):
    """Links, and three friction terms."""
    places = tuple(10 * k + np.arange(10) for k in range(len(prior)))
    values = np.concatenate((*prior, np.zeros(FRICTION)))
    return LinksProblem(places, values)


def scaled(rng, rows, prior):
    """A regressor whose columns all weigh about the same for links like these."""
    sizes = [
        spatial.parameter_scale(t[0], spatial.characteristic_length(t)) for t in prior
    ]
    units = np.concatenate((*sizes, np.ones(FRICTION)))
    return rng.normal(size=(rows, len(units))) / units


def objective(matrix, right, problem, gamma, values):
    """What is minimised."""
    total = 0.5 * float(np.sum((matrix @ values - right) ** 2))
    for link in problem.links:
        before = spatial.pseudo_inertia(problem.prior[link])
        after = spatial.pseudo_inertia(values[link])
        if not spatial.is_consistent(values[link]):
            return np.inf
        log = np.linalg.slogdet(after)[1]
        total += gamma * (np.trace(np.linalg.solve(before, after)) - log)
    return total


def minimiser(solver, gamma):
    """The solution for one weight."""
    return next(solver.path((gamma,)))


@given(bodies=st.lists(links(), min_size=4, max_size=4), seed=SEEDS)
def test_noise_free_data_gives_the_truth_whatever_the_model(bodies, seed):
    rng = np.random.default_rng(seed)
    truth = np.concatenate((*bodies[2:], [0.3, 0.5, 0.1]))
    matrix = 1e4 * scaled(rng, 60, bodies[2:])
    found = minimiser(
        ConsistentLinks(matrix, matrix @ truth, problem_of(bodies[:2])), 1e-3
    )
    lengths = [spatial.characteristic_length(theta) for theta in bodies[2:]]
    sizes = [
        spatial.parameter_scale(t[0], length) for t, length in zip(bodies[2:], lengths)
    ]
    assert np.max(np.abs(found - truth) / np.concatenate((*sizes, np.ones(3)))) < 1e-3


@given(bodies=st.lists(links(), min_size=2, max_size=2), seed=SEEDS)
def test_links_are_possible_bodies_whatever_the_data(bodies, seed):
    """Right-hand sides are nothing but noise, and half of the directions do not show."""
    rng = np.random.default_rng(seed)
    matrix = scaled(rng, SIZE // 2, bodies)
    right = 100.0 * rng.normal(size=len(matrix))
    solver = ConsistentLinks(matrix, right, problem_of(bodies))
    for found in solver.path((100.0, 1.0, 1e-3)):
        assert all(
            spatial.is_consistent(found[10 * k : 10 * k + 10]) for k in range(LINKS)
        )


def seen_by_the_last_joint(izz, error):
    """What its torque shows: hx and hy, Ixz and Iyz, Izz well and the rest of Ixx - Iyy weakly."""
    body = spatial.theta_from_com(
        1.0, np.array([0.0, 0.02, 0.1]), np.diag([0.01, 0.01, 0.001])
    )
    matrix = np.zeros((7, 10))
    matrix[range(6), (1, 2, 5, 6, 8, 9)] = 1e4, 1e4, error, 1e4, 1e4, 1e4
    matrix[6, [4, 7]] = 1e4, -1e4
    truth = body.copy()
    truth[2] = 0.01
    truth[5] = 0.003
    truth[9] = izz
    problem = LinksProblem((np.arange(10),), body)
    return body, ConsistentLinks(matrix, matrix @ truth, problem).best()


def test_what_nothing_shows_stays_where_a_possible_body_hardly_costs_anything():
    """Ixy, weakly seen, is larger than a body as slim as this can have."""
    body, found = seen_by_the_last_joint(0.001, error=100.0)
    assert spatial.is_consistent(found) and found[5] < 0.001
    assert_allclose(found[[0, 3]], body[[0, 3]], rtol=1e-5)
    assert found[4] + found[7] == pytest.approx(body[4] + body[7], rel=1e-5)


def test_what_nothing_shows_gives_way_to_what_is_well_seen():
    """No body has an Izz above the sum of the others."""
    body, found = seen_by_the_last_joint(0.1, error=100.0)
    assert spatial.is_consistent(found)
    assert found[9] == pytest.approx(0.1, rel=1e-2)
    assert found[4] + found[7] > 2.0 * (body[4] + body[7])


@given(bodies=st.lists(links(), min_size=2, max_size=2), seed=SEEDS)
def test_nothing_nearby_is_better(bodies, seed):
    rng = np.random.default_rng(seed)
    matrix = scaled(rng, 40, bodies)
    right = 10.0 * rng.normal(size=40)
    gamma = 3.0
    problem = problem_of(bodies)
    found = minimiser(ConsistentLinks(matrix, right, problem), gamma)
    best = objective(matrix, right, problem, gamma, found)
    for _ in range(10):
        step = rng.normal(size=SIZE) / np.linalg.norm(matrix, axis=0)
        for size in (1e-3, 0.1, 1.0):
            other = objective(matrix, right, problem, gamma, found + size * step)
            assert other >= best - 1e-6 * gamma


@pytest.mark.parametrize("seed", range(2))
def test_without_weight_the_objective_is_that_of_the_semidefinite_program(seed):
    """A thin body under heavy noise, whose plain estimate is impossible."""
    rng = np.random.default_rng(seed)
    equations, names = arm_equations(rng, count=40)
    truth = np.concatenate((random_body(rng, 0.1), rng.uniform(0.1, 1.0, 6)))
    matrix, right = information_of(equations, names, truth, 3.0, rng).stacked()
    plain = np.linalg.lstsq(matrix, right, rcond=None)[0]
    assert not spatial.is_consistent(plain[:10])
    problem = LinksProblem((np.arange(10),), np.append(random_body(rng), np.zeros(6)))
    gap = 1e-10 * np.sum((matrix @ plain - right) ** 2)
    found = minimiser(ConsistentLinks(matrix, right, problem), gap)
    assert spatial.is_consistent(found[:10])
    reference = sdp_least_squares(matrix, right)
    assert np.sum((matrix @ found - right) ** 2) == pytest.approx(reference, rel=1e-8)


@pytest.mark.parametrize(
    "where", [(consistent_bodies, "_Newton"), (ScaledBodies, "move_duals")]
)
def test_what_rounding_leaves_unsolved_is_an_error_of_ours(monkeypatch, where):
    def singular(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(*where, singular)
    with pytest.raises(SysidError, match="did not converge"):
        seen_by_the_last_joint(0.001, error=100.0)
