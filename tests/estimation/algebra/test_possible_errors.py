"""What a body's being possible leaves of errors, by many plain estimates made possible."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.dynamics import spatial
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra.consistent_bodies import (
    BODIES,
    ConsistentLinks,
    LinksProblem,
    once_possible,
    possible_covariance,
)
from robot_sysid.estimation.algebra.uncertainty import Uncertainty

LIGHT = spatial.theta_from_com(0.2, np.array([0.02, 0.01, 0.05]), 2e-4 * np.eye(3))
PLACES = np.arange(10)


def covariance(share, seed=0):
    """Of all ten, off by a share of a usual size, correlated."""
    mixed = np.random.default_rng(seed).normal(size=(10, 10)) / np.sqrt(10.0) + np.eye(
        10
    )
    root = share * spatial.parameter_scale(0.2, 0.1)[:, None] * mixed
    return root @ root.T


def whole_of(spread, causes):
    size = len(spread)
    given = (
        np.zeros((size, size)),
        np.sqrt(np.diag(spread)),
        np.ones(size),
        np.eye(size),
        (1.0,),
    )
    return Uncertainty(spread, *given), causes


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_what_is_left_is_the_spread_of_possible_bodies(seed):
    spread = covariance(0.8, seed)
    rng = np.random.default_rng([seed, 1])
    root = np.linalg.cholesky(spread)
    rows = np.linalg.inv(root)
    problem = LinksProblem((PLACES,), LIGHT)
    squares = np.zeros(10)
    for off in rng.normal(size=(200, 10)) @ root.T:
        found = LIGHT + off
        if not spatial.is_consistent(found):
            found = ConsistentLinks(rows, rows @ found, problem).best()
        squares += (found - LIGHT) ** 2 / 200.0
    told = np.diag(possible_covariance(LIGHT, spread))
    # 200 draws know a spread to 5 %, the 60 of the code to 9 %.
    assert np.median(np.sqrt(told / squares)) == pytest.approx(1.0, abs=0.1)
    assert_allclose(np.sqrt(told / squares), 1.0, atol=0.35)
    assert told[0] < 0.8 * spread[0, 0]


def test_where_every_body_is_possible_nothing_changes():
    spread = covariance(1e-3)
    whole, causes = whole_of(spread, {"noise": np.linalg.cholesky(spread).T})
    again, parts = once_possible(whole, causes, PLACES, LIGHT, LIGHT)
    assert again is whole and parts == causes
    assert_array_equal(possible_covariance(LIGHT, spread), spread)


def test_causes_still_add_up_and_what_hangs_on_the_body_follows_it():
    """An eleventh parameter is the mass and something of its own, a twelfth has nothing of it."""
    body = covariance(0.8)
    own = 0.01
    change = np.vstack((np.eye(10), np.eye(10)[:1], np.zeros((1, 10))))
    spread = change @ body @ change.T + np.diag([0.0] * 10 + [own**2] * 2)
    root = np.linalg.cholesky(spread).T
    parts = {"links": np.sqrt(0.7) * root, "noise": np.sqrt(0.3) * root}
    whole, parts = once_possible(*whole_of(spread, parts), PLACES, LIGHT, LIGHT)
    assert set(parts) == {"links", "noise", BODIES}
    rows = np.vstack([*parts.values()])
    assert_allclose(rows.T @ rows, whole.covariance, atol=1e-9 * spread.max())
    assert_allclose(whole.standard_errors**2, np.diag(whole.covariance), rtol=1e-9)
    assert whole.covariance[10, 10] == pytest.approx(whole.covariance[0, 0] + own**2)
    assert whole.covariance[11, 11] == pytest.approx(own**2)


def test_a_body_of_which_something_stays_hidden_keeps_its_errors():
    whole, causes = whole_of(covariance(0.8), {})
    whole.standard_errors[4] = np.inf
    assert once_possible(whole, causes, PLACES, LIGHT, LIGHT)[0] is whole


def test_where_a_drawn_body_cannot_be_made_possible_errors_stay(monkeypatch):
    def fails(solver):
        raise SysidError("does not converge")

    monkeypatch.setattr(ConsistentLinks, "best", fails)
    spread = covariance(0.8)
    assert_array_equal(possible_covariance(LIGHT, spread), spread)
