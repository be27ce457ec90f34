"""The constrained fit against a semidefinite programming solver, on 1000 problems.

Run: pytest benchmarks/test_bench_consistency.py -m slow -s
Speed: pytest benchmarks/test_bench_consistency.py --benchmark-only
"""

from __future__ import annotations

import time

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.algebra.consistent_bodies import (
    ConsistentLinks,
    LinksProblem,
)
from tests.support.synthetic_data import arm_equations, random_body, sdp_least_squares


def random_problem(seed):
    """Return (A, b, prior); odd seeds are noisy and near the boundary of possible bodies."""
    rng = np.random.default_rng(seed)
    equations, _ = arm_equations(rng, 3, 60)
    matrix = np.vstack([rows[:, :10] for rows, _ in equations])
    boundary = seed % 2 == 1
    truth = random_body(rng, 10.0 ** rng.uniform(-3, 0) if boundary else 1.0)
    level = 10.0 ** (rng.uniform(-2.0, 0.5) if boundary else rng.uniform(-6.0, -3.0))
    sigma = level * np.linalg.norm(matrix @ truth) / np.sqrt(len(matrix))
    return (
        matrix,
        matrix @ truth + sigma * rng.normal(size=len(matrix)),
        random_body(rng),
    )


def consistent(matrix, rhs, prior):
    """Return the plain estimate, or the best possible body where the plain one is none."""
    plain = np.linalg.lstsq(matrix, rhs, rcond=None)[0]
    if spatial.is_consistent(plain):
        return plain
    gap = 1e-10 * np.sum((matrix @ plain - rhs) ** 2)
    problem = LinksProblem((np.arange(10),), prior)
    return next(ConsistentLinks(matrix, rhs, problem).path([gap]))


def is_on_boundary(matrix, rhs):
    """Return whether the plain estimate is no possible body."""
    plain = np.linalg.lstsq(matrix, rhs, rcond=None)[0]
    return not spatial.is_consistent(plain)


@pytest.mark.slow
def test_objective_equals_the_oracles_on_a_thousand_problems():
    excess = []
    times = []
    for seed in range(1000):
        matrix, rhs, prior = random_problem(seed)
        start = time.process_time()
        values = consistent(matrix, rhs, prior)
        elapsed = time.process_time() - start
        assert spatial.is_consistent(values)
        times += [elapsed] if is_on_boundary(matrix, rhs) else []
        reference = sdp_least_squares(matrix, rhs)
        excess.append(np.sum((matrix @ values - rhs) ** 2) / reference - 1.0)
    print(f"\non the boundary {len(times)} of 1000")
    print(
        f"relative objective, ours / oracle - 1: from {min(excess):.1e} to {max(excess):.1e}"
    )
    print(
        f"CPU time there: median {1e3 * np.median(times):.2f} ms, longest {1e3 * max(times):.1f} ms"
    )
    assert 400 <= len(times) <= 600
    assert np.max(np.abs(excess)) < 1e-6


def test_speed_on_the_boundary(benchmark):
    problems = [random_problem(seed) for seed in range(1, 41, 2)]
    problems = [p for p in problems if is_on_boundary(*p[:2])]
    benchmark(lambda: [consistent(*p) for p in problems])
