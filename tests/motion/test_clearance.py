"""Distances between the bodies of an arm and its scene: gradients, bounds, tested pairs."""

from __future__ import annotations

import copy
from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.random import default_rng

from robot_sysid.dynamics.inverse_dynamics import subtree
from robot_sysid.motion import LimitOptions
from robot_sysid.motion.clearance import KEPT_SHARE, Clearance, drop_pairs
from tests.support import witness
from tests.support.arms import SEEDS, X, Y, Z, compile_xml, hinge, link, world
from tests.support.excitation_arms import TUBES_AND_POST, robot

KEEP = 0.01
# Two balls: one turns about z at radius 0.3, one stands at the same radius.
BALLS = world(
    link(
        hinge("spin", Z),
        '<geom size=".02" pos=".3 0 0"/>'
        + link(hinge("tip", X), '<geom size=".01" pos="0 0 .5"/>', pos="0 0 .2"),
        pos="0 0 0",
    )
    + '<body name="ball"><geom name="ball" size=".05" pos="0 .3 0"/></body>'
)


@cache
def clearance_of(xml, planes=(), keep=KEEP):
    """Return the Clearance of an arm at its reference pose.

    Args:
        xml: the MuJoCo model.
        planes: forbidden half-spaces (nx, ny, nz, offset).
        keep: clearance that every pair of bodies has to keep [m].
    """
    arm = robot(xml)
    moving = subtree(arm.mj_model, int(arm.mj_model.jnt_bodyid[0]))
    limits = LimitOptions(clearance=keep, keep_out=planes)
    return Clearance(arm, arm.reference, keep, limits.half_spaces(moving))


@pytest.mark.parametrize("gap", [0.001, 0.02, 0.05])
def test_bodies_of_several_geoms_are_detected_within_the_margin(gap):
    """Bodies with several geoms pass a coarser test first, which has to include the margin."""
    row = "".join(f'<geom size=".05" pos="0 {0.1 * k:g} 0"/>' for k in range(3))
    xml = world(
        link(
            '<joint name="push" type="slide" axis="1 0 0" range="-1 1"/>'
            + hinge("spin", Z, 'range="-1 1"'),
            row,
            "0 0 0",
            pos="0 0 0",
        )
        + f'<body name="rack" pos=".6 0 0">{row}</body>'
    )
    closest = clearance_of(xml).closest(np.array([0.5 - gap, 0.0]))
    assert closest.distance == pytest.approx(gap, abs=1e-6)


@given(SEEDS)
def test_gradient_equals_differences(seed):
    """The gradient of the slack equals one of its two one-sided difference quotients."""
    clearance = clearance_of(TUBES_AND_POST, ((0.1, 0.2, 1.0, -0.2),))
    rng = default_rng(seed)
    q, direction = rng.uniform(-1.0, 1.0, size=(2, 4))
    step = 1e-6
    three = clearance.slack(q + step * np.outer([-1.0, 0.0, 1.0], direction))
    # Deep inside each other, MuJoCo's nearest points are approximate.
    assume(three.value[1] > -KEEP)
    one_sided = np.diff(three.value) / step
    exact = three.gradient[1] @ direction
    # Where another pair becomes the nearest one the slack has a kink and two slopes.
    assert min(abs(one_sided - exact)) < 1e-3 * (1.0 + abs(exact))


def assert_slack_is_bounded(clearance, start, end):
    """Check the slack at joint positions ``end`` (n,) against its lower bound from ``start``."""
    before, after = clearance.slacks(np.vstack((start, end)))
    assert np.all(after >= before - clearance.rates @ np.abs(end - start) - 1e-6)
    least = clearance.slack(np.vstack((start, end))).value
    assert least.tolist() == [np.min(before), np.min(after)]


@given(SEEDS)
def test_no_move_uses_up_more_slack_than_its_bound(seed):
    """A move reduces the slack by at most the rates times the joint displacements."""
    clearance = clearance_of(TUBES_AND_POST, ((0.0, 0.0, 1.0, -0.2),))
    rng = default_rng(seed)
    start = rng.uniform(-2.0, 2.0, size=4)
    end = start + rng.uniform(0.01, 0.3) * rng.normal(size=4)
    assert_slack_is_bounded(clearance, start, end)


@pytest.mark.parametrize("offset, is_by_design", [(0.05, True), (0.18, False)])
def test_links_that_overlap_in_every_pose_are_ignored(offset, is_by_design):
    """A ball wrist: the third link turns inside the first one, or swings out of it."""
    ball = f'<geom size=".1" pos="{offset} 0 0"/>'
    tip = link(hinge("roll", X, 'range="-3 3"'), ball, "tip", pos="0 0 0")
    cross = link(hinge("bend", Y, 'range="-3 3"'), tip, "cross", pos="0 0 0")
    socket = '<geom size=".1" pos=".05 0 0"/>' + cross
    clearance = clearance_of(
        world(link(hinge("turn", Z), socket, "socket", pos="0 0 0"))
    )
    assert len(clearance.collisions) == (not is_by_design)
    assert (clearance.closest(np.zeros(3)).slack < 0.0) == (not is_by_design)


def test_the_slack_is_negative_wherever_mujoco_sees_a_contact():
    model = robot(TUBES_AND_POST).mj_model
    clearance = clearance_of(TUBES_AND_POST)
    data = mujoco.MjData(model)
    n_touching = 0
    for q in default_rng(5).uniform(-2.5, 2.5, size=(300, 4)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        if witness.touching(model, data):
            n_touching += 1
            assert clearance.closest(q).slack <= -KEEP + 1e-9
    assert n_touching > 10


def balls_with_gap(gap):
    """Return BALLS with the two balls ``gap`` metres apart in the rest pose."""
    return BALLS.replace('pos="0 .3 0"/></body>', f'pos="0.3 {0.07 + gap} 0"/></body>')


@pytest.mark.parametrize(
    ("gap", "collisions", "slack"),
    [
        (0.004, [], KEPT_SHARE * 0.004),
        (-0.0005, [], 1e-4),
        (-0.005, ["#1 and ball (5 mm deep)"], -KEEP - 0.005),
    ],
)
def test_the_slack_of_a_pair_depends_on_its_gap_at_rest(gap, collisions, slack):
    """A near pair keeps half its gap, a grazing one its depth; a deep contact is a collision."""
    clearance = clearance_of(balls_with_gap(gap))
    assert clearance.collisions == collisions
    closest = clearance.closest(np.zeros(2))
    assert closest.distance == pytest.approx(gap, abs=1e-6)
    assert closest.slack == pytest.approx(slack, abs=1e-6)
    assert clearance.slack(np.zeros((1, 2))).value[0] == pytest.approx(slack, abs=1e-6)


def test_only_the_start_pose_reduces_the_clearance_of_a_pair():
    """A pair that is close in another pose than the start keeps the full clearance."""
    arm = robot(balls_with_gap(0.004))
    started = Clearance(arm, np.array([-0.3, 0.0]), KEEP, ())
    assert started.closest(np.zeros(2)).slack == pytest.approx(0.004 - KEEP, abs=1e-6)


BODIES = 6


def crowd(filters):
    """Return a model of balls in a heap and a floor.

    Each body has two balls; ``filters`` holds (contype, conaffinity) per body.
    """
    balls = "".join(
        f'<body><freejoint/><geom size=".1" contype="{a}" conaffinity="{b}"/>'
        f'<geom size=".1" pos=".05 0 0" contype="{b}" conaffinity="{a}"/></body>'
        for a, b in filters
    )
    floor = '<geom type="plane" size="1 1 .1"/>'
    return compile_xml(f"<mujoco><worldbody>{floor}{balls}</worldbody></mujoco>")


def contacts(model, seed):
    """Return the pairs of geoms that touch when the bodies lie at random positions."""
    data = mujoco.MjData(model)
    rng = default_rng(seed)
    for k in range(BODIES):
        data.qpos[7 * k : 7 * k + 3] = rng.uniform(-0.15, 0.15, size=3)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    return set(map(tuple, np.sort(data.contact.geom).tolist()))


@given(
    st.lists(st.tuples(*[st.integers(0, 3)] * 2), min_size=BODIES, max_size=BODIES),
    st.lists(st.integers(0, 2), min_size=BODIES, max_size=BODIES),
    SEEDS,
)
def test_drop_pairs_keeps_the_pairs_of_different_groups(filters, groups, seed):
    """No pair inside a group remains, and no relevant pair is lost."""
    model = crowd(filters)
    body_groups = np.array([0, *groups])
    rng = default_rng(seed)
    ignored = rng.uniform(size=(BODIES + 1, BODIES + 1)) < 0.3
    ignored |= ignored.T
    decimated = copy.copy(model)
    drop_pairs(decimated, body_groups, ignored)
    all_contacts = contacts(model, seed)
    decimated_contacts = contacts(decimated, seed)
    assert decimated_contacts <= all_contacts
    for pair in all_contacts:
        bodies = model.geom_bodyid[list(pair)]
        is_within_group = np.ptp(body_groups[bodies]) == 0
        assert not (is_within_group and pair in decimated_contacts)
        assert is_within_group or ignored[tuple(bodies)] or pair in decimated_contacts


def test_slack_bounds_hold_for_a_slide_joint():
    xml = world(
        link(
            '<joint name="lift" type="slide" axis="0 0 1" range="-1 1"/>',
            '<geom size=".05"/>'
            + link(hinge("turn", Y), '<geom size=".05" pos="0 0 .3"/>'),
            pos="0 0 .5",
        )
        + '<geom type="plane" size="1 1 .1"/>'
    )
    clearance = clearance_of(xml)
    rng = default_rng(0)
    for _ in range(100):
        start = rng.uniform(-0.6, 0.6, size=2)
        assert_slack_is_bounded(clearance, start, start + 0.1 * rng.normal(size=2))
