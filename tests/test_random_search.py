"""Random trajectories: feasible on the grid, the same however they are dealt out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.design.motion_constraints import ROUNDING, MotionConstraints
from robot_sysid.design.random_search import draw_trajectories
from tests import arms
from tests.arms import SEEDS
from tests.excitation_arms import TUBES, TUBES_AND_POST, design

PERIODIC = {"ends": "periodic"}
DESIGNS = [
    design(arms.THREE),
    design(TUBES),
    design(arms.SLIDE_IN_CHAIN),
    design(arms.UNLIMITED, **PERIODIC),
]


def motion_of(some, x):
    b, db, ddb = some.functions(some.grid)
    return some.problem.rest + b @ x.T, db @ x.T, ddb @ x.T


@given(st.sampled_from(DESIGNS), SEEDS)
@settings(max_examples=100)
def test_every_feasible_draw_keeps_all_limits_on_the_grid(some, seed):
    (draw,) = draw_trajectories(some, seed, [0])
    if np.isfinite(draw.score):
        value = MotionConstraints(some.problem, 1.0, 0.0).evaluate(motion_of(some, draw.x)).value
        assert np.max(value) <= ROUNDING
        assert draw.obstacle == ""
    else:
        assert not np.any(draw.x)


def test_most_draws_of_an_arm_in_free_space_are_feasible():
    draws = draw_trajectories(design(TUBES), 0, range(30))
    assert sum(np.isfinite(draw.score) for draw in draws) > 20


def test_a_draw_depends_on_its_number_and_the_seed_alone():
    some = design(TUBES_AND_POST)
    together = draw_trajectories(some, 5, range(4))
    alone = draw_trajectories(some, 5, [2])[0]
    other_seed = draw_trajectories(some, 6, [2])[0]
    assert np.array_equal(together[2].x, alone.x)
    assert together[2].score == alone.score
    assert not np.array_equal(alone.x, other_seed.x)


def test_a_draw_that_fits_nowhere_names_what_is_in_the_way():
    some = design(TUBES)
    # Shoulders that hold less than the arm weighs, at rest and in any other posture.
    weak = np.full(4, 1e-3)
    object.__setattr__(some.problem.limits, "torque", weak)
    try:
        (draw,) = draw_trajectories(some, 0, [0])
    finally:
        object.__setattr__(some.problem.limits, "torque", np.full(4, np.inf))
    assert draw.score == np.inf
    assert "torque limit of joint joint" in draw.obstacle


@pytest.mark.parametrize("some", DESIGNS)
def test_the_score_is_the_criterion(some):
    draw = min(draw_trajectories(some, 1, range(5)), key=lambda d: d.score)
    assert draw.score == some.criterion_of(draw.x)
