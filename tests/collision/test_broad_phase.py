"""Dropping pairs that cannot matter changes no distance that does."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.collision.broad_phase import MOST_GROUPS, drop_pairs
from tests.support.arms import SEEDS, compile_xml

BODIES = 6


def crowd(filters):
    """Balls in a heap, each body with two of them, and a floor; filters: (contype, conaffinity)."""
    balls = "".join(
        f'<body><freejoint/><geom size=".1" contype="{a}" conaffinity="{b}"/>'
        f'<geom size=".1" pos=".05 0 0" contype="{b}" conaffinity="{a}"/></body>'
        for a, b in filters
    )
    floor = '<geom type="plane" size="1 1 .1"/>'
    return compile_xml(f"<mujoco><worldbody>{floor}{balls}</worldbody></mujoco>")


def contacts(model, seed):
    """Pairs of geoms that touch when the balls lie at random places."""
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    for k in range(BODIES):
        data.qpos[7 * k : 7 * k + 3] = rng.uniform(-0.15, 0.15, size=3)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    return {tuple(sorted((int(a), int(b)))) for a, b in zip(data.contact.geom1, data.contact.geom2)}


@given(
    st.lists(st.tuples(*[st.integers(0, 3)] * 2), min_size=BODIES, max_size=BODIES),
    st.lists(st.integers(0, 2), min_size=BODIES, max_size=BODIES),
    SEEDS,
)
def test_keeps_exactly_the_pairs_that_matter(filters, parts, seed):
    model = crowd(filters)
    part = np.array([0, *parts])
    rng = np.random.default_rng(seed)
    ignored = rng.uniform(size=(BODIES + 1, BODIES + 1)) < 0.3
    ignored |= ignored.T
    decimated = copy.copy(model)
    drop_pairs(decimated, part, ignored)
    before, after = contacts(model, seed), contacts(decimated, seed)
    body = model.geom_bodyid
    matter = {
        (a, b)
        for a, b in before
        if part[body[a]] != part[body[b]] and not ignored[body[a], body[b]]
    }
    assert matter <= after <= before
    assert not any(part[body[a]] == part[body[b]] for a, b in after)


def test_drops_groups_of_which_no_pair_matters():
    model = crowd([(1, 1)] * BODIES)
    drop_pairs(model, np.arange(BODIES + 1), np.ones((BODIES + 1, BODIES + 1), dtype=bool))
    assert contacts(model, 0) == set()


def test_a_model_with_too_many_groups_stays_as_it_is():
    geoms = "".join(f'<geom size=".1" contype="{k}" conaffinity="1"/>' for k in range(1, 40))
    model = compile_xml(f"<mujoco><worldbody><body>{geoms}</body></worldbody></mujoco>")
    before = model.geom_contype.copy()
    assert len(before) > MOST_GROUPS
    drop_pairs(model, np.zeros(2, dtype=int), np.zeros((2, 2), dtype=bool))
    assert np.array_equal(model.geom_contype, before)


@pytest.mark.parametrize("name", ["geom_contype", "geom_conaffinity"])
def test_bits_fit_into_mujocos_integers(name):
    geoms = "".join(f'<geom size=".1" contype="{k}" conaffinity="1"/>' for k in range(1, 32))
    model = compile_xml(f"<mujoco><worldbody><body>{geoms}</body></worldbody></mujoco>")
    drop_pairs(model, np.zeros(2, dtype=int), np.zeros((2, 2), dtype=bool))
    assert np.all(getattr(model, name) >= 0)
