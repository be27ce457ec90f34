"""Errors of the links' parameters."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.arm.consistent_links import LinksProblem
from robot_sysid.estimation.arm.errors import correlation_stretch, covariance, link_precision
from robot_sysid.estimation.information import InformationAccumulator

BODY = np.array([2.0, 0.05, 0.0, 0.02, 0.02, 0.0, 0.001, 0.02, 0.0, 0.015])


def test_white_residuals_are_not_stretched_and_slow_ones_are():
    rng = np.random.default_rng(0)
    white = rng.normal(size=4000)
    slow = np.zeros(4000)
    for k in range(1, 4000):
        slow[k] = 0.8 * slow[k - 1] + white[k]
    found = correlation_stretch([white, slow])
    # 1 + 2 sum of 0.8^k is 9.
    assert found == pytest.approx([1.0, 9.0], rel=0.25)


def test_gaps_do_not_stretch():
    rng = np.random.default_rng(1)
    gappy = np.where(rng.random(4000) < 0.5, np.nan, rng.normal(size=4000))
    assert correlation_stretch([gappy]) == pytest.approx([1.0], abs=0.3)


def test_covariance_is_that_of_least_squares_without_prior():
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(50, 3))
    accumulator = InformationAccumulator(("a", "b", "c"), ("j",), [np.arange(3)])
    accumulator.add(0, rows, rng.normal(size=50))
    known = (accumulator.result(), np.array([0.3]), np.array([4.0]), np.zeros((3, 3)))
    inverse, pull = 0.09 * np.linalg.inv(rows.T @ rows), rng.normal(size=3)
    assert covariance(*known, np.zeros(3)) == pytest.approx(4.0 * inverse, rel=1e-9)
    moved = inverse @ pull
    expected = 4.0 * inverse + np.outer(moved, moved)
    assert covariance(*known, pull) == pytest.approx(expected, rel=1e-9)


def test_the_model_knows_a_link_to_the_link_itself():
    """The divergence at weight one is as sure of a mass as the mass is large."""
    nothing = np.full(10, np.inf)
    problem = LinksProblem((np.arange(10),), BODY, -nothing, nothing)
    for weight in (1.0, 100.0):
        spread = np.linalg.inv(link_precision(problem, weight, nothing))
        assert np.sqrt(spread[0, 0]) == pytest.approx(BODY[0], rel=1e-9)
    weaker = np.linalg.inv(link_precision(problem, 0.01, nothing))
    assert np.sqrt(weaker[0, 0]) == pytest.approx(10.0 * BODY[0], rel=1e-9)


def test_its_curvature_is_that_of_the_divergence():
    nothing = np.full(10, np.inf)
    problem = LinksProblem((np.arange(10),), BODY, -nothing, nothing)
    precision = link_precision(problem, 1.0, nothing)
    step = 1e-4 * np.random.default_rng(3).normal(size=10) * np.abs(BODY[0]) * 0.1
    before = spatial.pseudo_inertia(BODY)

    def divergence(theta):
        after = spatial.pseudo_inertia(theta)
        return np.trace(np.linalg.solve(before, after)) - np.linalg.slogdet(after)[1]

    rise = divergence(BODY + step) + divergence(BODY - step) - 2.0 * divergence(BODY)
    assert rise == pytest.approx(step @ precision @ step, rel=1e-2)
