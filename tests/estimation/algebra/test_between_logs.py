"""The variation of parameters from log to log: as large as drawn, and zero where they agree."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.estimation.log_comparison import compare_logs

COMMON = 5
"""Number of parameters that all logs share."""
VARYING = 12
"""Number of parameters that may differ between logs: six of each of two terms."""
TERMS = np.repeat((0, 1), VARYING // 2)
SIZES = np.repeat((1.0, 3.0), VARYING // 2)


def compare_random_logs(shares, n_logs, seed, hidden_in_first=()):
    """Return (comparison, truth (logs, 12)) of logs that differ by shares (2,) of SIZES."""
    rng = np.random.default_rng(seed)
    common = rng.standard_normal(COMMON)
    mean = SIZES * (1.0 + rng.uniform(size=VARYING))
    spread = np.array(shares)[TERMS] * SIZES
    truth = mean + spread * rng.standard_normal((n_logs, VARYING))
    normals = []
    for log in range(n_logs):
        rows = rng.standard_normal((400, COMMON + VARYING))
        if log == 0:
            rows[:, COMMON + np.array(hidden_in_first, dtype=int)] = 0.0
        right = rows @ np.append(common, truth[log]) + 0.2 * rng.standard_normal(400)
        equations = np.column_stack((rows, right)) / 0.2
        normals.append(equations.T @ equations)
    prior = np.zeros_like(normals[0])
    indices = COMMON + np.arange(VARYING)
    return compare_logs(normals, prior, indices, mean, SIZES, TERMS), truth


@pytest.mark.parametrize("shares", [(0.0, 0.0), (0.3, 0.0), (0.1, 0.4)])
@pytest.mark.parametrize("n_logs", [2, 5])
def test_spread_and_values_are_those_of_the_logs(shares, n_logs):
    spreads = []
    ratios = []
    for seed in range(10):
        between, truth = compare_random_logs(shares, n_logs, seed)
        spreads.append(between.spread / SIZES)
        ratios.append((between.values - truth) / between.errors)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.12)
    for term, share in enumerate(shares):
        spread = np.sqrt(np.mean(np.square(spreads)[:, term == TERMS]))
        assert spread == pytest.approx(share, rel=0.35, abs=0.012)


def test_the_error_in_another_log_adds_the_spread_and_the_error_of_the_mean():
    between, _ = compare_random_logs((0.3, 0.3), 2, 0)
    expected = np.sqrt(0.1**2 + 1.5 * between.spread**2)
    assert_allclose(between.next_log(np.full(VARYING, 0.1)), expected)


def test_logs_differ_where_they_were_made_to_and_nowhere_else():
    for seed in range(20):
        between, _ = compare_random_logs((0.3, 0.0), 2, seed)
        assert between.differ(np.flatnonzero(TERMS == 0), 2)
        assert not between.differ(np.flatnonzero(TERMS == 1), 2)


def test_a_parameter_hidden_in_one_log_is_uncertain_in_it_alone():
    between, _ = compare_random_logs((0.0, 0.0), 2, 0, hidden_in_first=(3,))
    assert between.errors[0, 3] > 10.0 > 0.1 > between.errors[1, 3]
    assert not between.differ(np.array([3]), 1)
    assert np.max(np.delete(between.errors, 3, axis=1)) < 0.1
