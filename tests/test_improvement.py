"""Rounds of improvement: what is proven obeys everything, and never gets worse."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.design.certificate import certify
from robot_sysid.design.improvement import first_candidate, improve, obeys_everything
from robot_sysid.design.random_search import draw_trajectories
from tests import arms
from tests.excitation_arms import TUBES, TUBES_AND_POST, design


def best_draw(some, seed=0):
    return min(draw_trajectories(some, seed, range(6)), key=lambda d: d.score)


@pytest.mark.parametrize(
    ("xml", "ends"),
    [
        (arms.THREE, "faded"),
        (TUBES, "periodic"),
        (TUBES_AND_POST, "faded"),
        (arms.SLIDE_IN_CHAIN, "periodic"),
    ],
)
def test_rounds_keep_the_best_and_prove_it(xml, ends):
    some = design(xml, ends=ends, iterations=15)
    candidate = first_candidate(some, 0, best_draw(some).x)
    scores = [candidate.proven_score]
    for _ in range(3):
        candidate = improve(some, candidate)
        scores.append(candidate.proven_score)
        assert certify(some.problem, some.trajectory(candidate.proven_x)).holds
    assert all(later <= earlier for earlier, later in zip(scores, scores[1:]))
    assert scores[-1] < scores[0] - 0.1
    assert scores[-1] == some.criterion_of(candidate.proven_x)


def test_a_motion_beyond_its_limits_is_shrunk_until_it_obeys():
    some = design(TUBES_AND_POST)
    candidate = first_candidate(some, 0, 3.0 * best_draw(some).x)
    assert not obeys_everything(some, candidate.x)
    assert obeys_everything(some, candidate.proven_x)
    assert np.linalg.norm(candidate.proven_x) < np.linalg.norm(candidate.x)


def test_times_of_excess_join_the_grid():
    some = design(TUBES_AND_POST, iterations=3)
    candidate = improve(some, first_candidate(some, 0, 1.5 * best_draw(some).x))
    assert len(candidate.extra_times) > 0
    assert candidate.multipliers.shape[0] == len(some.grid) + len(candidate.extra_times)
    assert len(np.unique(candidate.extra_times)) == len(candidate.extra_times)
    again = improve(some, candidate)
    assert len(again.extra_times) >= len(candidate.extra_times)
