"""Distances between the bodies of an arm and its scene: gradients, bounds, tested pairs."""

from functools import cache
from itertools import combinations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from numpy.random import default_rng

from rigs.arms import witness
from rigs.arms.excitation_arms import TUBES_AND_POST, robot
from rigs.arms.small_arms import SEEDS, X, Y, Z, hinge, link, world
from robot_sysid.dynamics.inverse_dynamics import subtree
from robot_sysid.model.bodies import update_contacts
from robot_sysid.motion import LimitOptions
from robot_sysid.motion.clearance import (
    KEPT_SHARE,
    SEARCH_HORIZON,
    Clearance,
    let_pairs_meet,
    unguarded_links,
)
from robot_sysid.records import Limits

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
    return Clearance(arm, arm.reference, limits.limits(arm.is_slide, moving))


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
    closest = clearance_of(xml).closest_pair(np.array([0.5 - gap, 0.0]))
    assert closest.distance == pytest.approx(gap, abs=1e-6)


@given(SEEDS)
def test_gradient_equals_differences(seed):
    """The slope of each pair's slack equals one of its two one-sided difference quotients."""
    clearance = clearance_of(TUBES_AND_POST, ((0.1, 0.2, 1.0, -0.2),))
    rng = default_rng(seed)
    q, direction = rng.uniform(-1.0, 1.0, size=(2, 4))
    step = 1e-6
    postures = q + step * np.outer([-1.0, 0.0, 1.0], direction)
    pairs = clearance.tight_pairs(postures)
    slacks = np.full((3, clearance.n_pairs), np.nan)
    slacks[pairs.posture, pairs.number] = pairs.slack
    steps = np.diff(slacks, axis=0) / step
    for posture, number, slack, slope in zip(*pairs):
        # Deep inside each other, MuJoCo's nearest points are approximate.
        if posture != 1 or slack <= -KEEP:
            continue
        exact = slope @ direction
        # Where another geom of the two links becomes the nearest one the slack has a kink and two
        # slopes; at the horizon it has one.
        off = np.nanmin(np.abs(steps[:, number] - exact), initial=np.inf)
        assert off < 1e-3 * (1.0 + abs(exact)) or np.all(np.isnan(steps[:, number]))


LIFT = world(
    link(
        '<joint name="lift" type="slide" axis="0 0 1" range="-1 1"/>',
        '<geom size=".05"/>'
        + link(hinge("turn", Y), '<geom size=".05" pos="0 0 .3"/>'),
        pos="0 0 .5",
    )
    + '<geom type="plane" size="1 1 .1"/>'
)


@pytest.mark.parametrize(
    ("clearance", "reach"),
    [
        (clearance_of(TUBES_AND_POST, ((0.0, 0.0, 1.0, -0.2),)), np.full(4, 2.0)),
        (clearance_of(LIFT), np.full(2, 0.6)),
    ],
)
@given(SEEDS)
def test_no_move_uses_up_more_slack_than_its_bound(clearance, reach, seed):
    """A move reduces the slack by at most the rates times the joint displacements."""
    rng = default_rng(seed)
    start = rng.uniform(-reach, reach)
    end = start + rng.uniform(0.01, 0.3) * rng.normal(size=len(reach))
    before, after = clearance.slacks(np.vstack((start, end)))
    assert np.all(after >= before - clearance.rates @ np.abs(end - start) - 1e-6)
    least = clearance.slack(np.vstack((start, end)))
    nearest = np.min((before, after), axis=1)
    assert least.tolist() == np.minimum(nearest, SEARCH_HORIZON).tolist()


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
    assert (clearance.closest_pair(np.zeros(3)).slack < 0.0) == (not is_by_design)


def test_the_slack_is_negative_wherever_mujoco_sees_a_contact():
    model = robot(TUBES_AND_POST).mj_model
    clearance = clearance_of(TUBES_AND_POST)
    data = mujoco.MjData(model)
    n_touching = 0
    for q in default_rng(5).uniform(-2.5, 2.5, size=(300, 4)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        if witness.touching_pairs(model, data):
            n_touching += 1
            assert clearance.closest_pair(q).slack <= -KEEP + 1e-9
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
    """A near pair keeps half its gap, a grazing one its depth; a deep contact is a collision.

    A pair that is close in another pose than the start keeps the full clearance.
    """
    clearance = clearance_of(balls_with_gap(gap))
    assert clearance.collisions == collisions
    closest = clearance.closest_pair(np.zeros(2))
    assert closest.distance == pytest.approx(gap, abs=1e-6)
    assert closest.slack == pytest.approx(slack, abs=1e-6)
    assert clearance.slack(np.zeros((1, 2))) == pytest.approx(slack, abs=1e-6)
    arm = robot(balls_with_gap(gap))
    started = Clearance(arm, np.array([-0.3, 0.0]), Limits(clearance=KEEP))
    assert started.closest_pair(np.zeros(2)).slack == pytest.approx(
        gap - KEEP, abs=1e-6
    )


SHELL = '<geom size=".03" pos="0 0 .1"/>'
PART = '<body><geom size=".03" mass=".1"/></body>'
ONE_SIDED = '<geom size=".03" pos="0 0 .1" contype="1" conaffinity="0"/>'
DRAWN = '<geom size=".03" contype="0" conaffinity="0"/>'


@pytest.mark.parametrize(
    ("shells", "names"),
    [
        ((SHELL, "", SHELL), ("link1",)),
        ((DRAWN, PART, SHELL), ("link0",)),
        ((SHELL, "", ""), ("link0", "link1", "link2")),
        ((ONE_SIDED, ONE_SIDED, ""), ("link0", "link1", "link2")),
    ],
)
def test_links_that_nothing_keeps_from_a_contact_are_named(shells, names):
    """Geometry that is only drawn, or can meet nothing, is none."""
    content = ""
    for index, shell in reversed(list(enumerate(shells))):
        joint = hinge(f"joint{index}", (Z, X, Z)[index])
        content = link(joint, shell + content, f"link{index}")
    assert unguarded_links(robot(world(content))) == names


@pytest.mark.parametrize("count", [4, 40])
def test_pairs_that_do_not_count_meet_no_more(count):
    """By masks of geoms; with more sets of geoms than bits all meet as in the file."""
    ball = '<body pos="0 0 {}"><freejoint/><geom size=".1"/></body>'
    balls = "".join(ball.format(0.004 * k) for k in range(count))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><size memory="8M"/><worldbody>{balls}</worldbody></mujoco>'
    )
    masks = model.geom_contype.copy(), model.geom_conaffinity.copy()
    # The first and the third ball meet, and those after the fourth all that are two before them.
    first, second = np.indices((count + 1, count + 1))
    counts = (second >= 5) & (first <= second - 2) & (first > 0)
    counts[1, 3] = True
    let_pairs_meet(model, masks, counts | counts.T)
    data = mujoco.MjData(model)
    update_contacts(model, data)
    pairs = {
        tuple(sorted(pair)) for pair in model.geom_bodyid[data.contact.geom].tolist()
    }
    every_pair = set(combinations(range(1, count + 1), 2))
    assert pairs == ({(1, 3)} if count == 4 else every_pair)
