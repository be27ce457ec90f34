"""A joint takes a term where held-out torques ask for it clearly, and not otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.identify.arm.friction_choice import (
    BASIC,
    CANDIDATES,
    CLEAR_SHARE,
    best_per_joint,
    errors_per_joint,
    is_clearly_lower,
)

COUNTS = np.full((5, 2), 100.0)
STRIBECK = "coulomb-viscous-offset-armature-stribeck"
RICHEST = CANDIDATES[-1]


def squared(**factors):
    """Squared errors: one for all candidates but those whose name's end is given."""
    base = np.tile(np.array([1.0, 2.0, 0.5, 1.0, 1.5])[:, None], (1, 2)) * COUNTS
    return {name: base * factors.get(name, 1.0) for name in CANDIDATES}


def test_the_simplest_stays_where_nothing_is_better():
    assert [model.name for model in best_per_joint(squared(), COUNTS)] == [CANDIDATES[0]] * 2


def test_each_joint_takes_its_own():
    errors = squared()
    errors[STRIBECK][:, 1] *= 0.5
    assert [m.name for m in best_per_joint(errors, COUNTS)] == [CANDIDATES[0], STRIBECK]


def test_a_term_that_helps_little_or_here_and_there_is_left_out():
    errors = squared(**{BASIC: 1.0 - 0.8 * CLEAR_SHARE})
    errors[RICHEST] *= np.array([0.2, 1.6, 1.0, 0.9, 1.3])[:, None]
    assert [model.name for model in best_per_joint(errors, COUNTS)] == [CANDIDATES[0]] * 2


def test_more_terms_are_taken_where_they_help_more():
    errors = squared(**{STRIBECK: 0.5, RICHEST: 0.2})
    assert {model.name for model in best_per_joint(errors, COUNTS)} == {RICHEST}


def test_a_stretch_that_shows_friction_far_more_than_others_does_not_hide_it():
    """Every stretch is far better; their gains differ by a factor of a hundred."""
    before = np.array([4.2, 3.9, 2.8, 3.9, 400.0])
    assert is_clearly_lower(before / 5.0, before)


def test_a_fit_that_failed_is_never_taken_and_always_left():
    good, bad = np.ones(5), np.array([1.0, 1.0, np.inf, 1.0, 1.0])
    assert is_clearly_lower(good, bad) and not is_clearly_lower(0.1 * bad, good)


@given(st.floats(1e-12, 1e12), st.lists(st.floats(0.1, 10.0), min_size=5, max_size=5))
def test_units_do_not_decide(scale, ratios):
    before = np.linspace(1.0, 3.0, 5)
    after = before * np.array(ratios)
    assert is_clearly_lower(scale * after, scale * before) == is_clearly_lower(after, before)


def test_errors_are_told_per_joint():
    told = errors_per_joint(squared(), COUNTS, ("a", "b"))
    assert told["a"][BASIC] == pytest.approx(np.sqrt(np.mean([1.0, 2.0, 0.5, 1.0, 1.5])))
