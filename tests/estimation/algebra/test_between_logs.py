"""How much numbers differ from log to log: what was drawn, and nothing where they are the same."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.estimation.log_comparison import compare_logs

COMMON = 5
OWN = 12
"""Numbers that logs have in common, and numbers of their own: six of each of two kinds."""
PLACES = COMMON + np.arange(OWN)
KINDS = np.repeat((0, 1), OWN // 2)
SIZES = np.repeat((1.0, 3.0), OWN // 2)


def compared(shares, n_logs, seed, unseen=()):
    """(comparison, truth of each log); logs differ by shares (2,) of the sizes of a kind."""
    rng = np.random.default_rng(seed)
    common = rng.standard_normal(COMMON)
    mean = SIZES * (1.0 + rng.uniform(size=OWN))
    truth = mean + np.array(shares)[KINDS] * SIZES * rng.standard_normal((n_logs, OWN))
    normals = []
    for log in range(n_logs):
        rows = rng.standard_normal((400, COMMON + OWN))
        if log == 0:
            rows[:, COMMON + np.array(unseen, dtype=int)] = 0.0
        right = rows @ np.append(common, truth[log]) + 0.2 * rng.standard_normal(400)
        equations = np.column_stack((rows, right)) / 0.2
        normals.append(equations.T @ equations)
    prior = np.zeros_like(normals[0])
    return compare_logs(normals, prior, PLACES, mean, SIZES, KINDS), truth


@pytest.mark.parametrize("shares", [(0.0, 0.0), (0.3, 0.0), (0.1, 0.4)])
@pytest.mark.parametrize("n_logs", [2, 5])
def test_spread_and_values_are_those_of_the_logs(shares, n_logs):
    found = []
    off = []
    for seed in range(10):
        between, truth = compared(shares, n_logs, seed)
        found.append(between.spread / SIZES)
        off += ((between.values - truth) / between.errors).ravel().tolist()
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.12)
    rms = np.sqrt(np.mean(np.square(found), axis=0))
    for kind, share in enumerate(shares):
        spread = np.sqrt(np.mean(rms[kind == KINDS] ** 2))
        assert spread == pytest.approx(share, rel=0.35, abs=0.012)


def test_another_log_is_off_by_the_spread_and_by_that_of_the_mean():
    between, _ = compared((0.3, 0.3), 2, 0)
    errors = np.full(OWN, 0.1)
    expected = np.sqrt(0.1**2 + 1.5 * between.spread**2)
    assert_allclose(between.next_log(errors), expected)


def test_logs_differ_where_they_were_made_to_and_nowhere_else():
    for seed in range(20):
        between, _ = compared((0.3, 0.0), 2, seed)
        assert between.differ(np.flatnonzero(KINDS == 0), 2)
        assert not between.differ(np.flatnonzero(KINDS == 1), 2)


def test_what_one_log_does_not_show_is_open_in_it_alone():
    between, _ = compared((0.0, 0.0), 2, 0, unseen=(3,))
    assert between.errors[0, 3] > 10.0 > 0.1 > between.errors[1, 3]
    assert not between.differ(np.array([3]), 1)
    assert np.max(np.delete(between.errors, 3, axis=1)) < 0.1
