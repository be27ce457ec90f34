"""Where a motion starts: at the model's pose, at another one that can be held, or nowhere."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.excitation.options import LimitOptions
from robot_sysid.excitation.problem import build_problem
from robot_sysid.excitation.static.start import contact_on_the_way, startable
from robot_sysid.records import Motion
from tests.support.arms import X, Y, Z, robot_of
from tests.support.excitation_arms import TUBES, problem, tube_arm

SHELF = '<body name="shelf" pos="0 0 {}"><geom type="box" size=".3 .3 .01"/></body>'
TOP = 4 * 0.25 + 0.23
"""Height of the upright tubes' tip where their shelf begins 10 mm inside it."""
WALL = '<body name="wall" pos=".55 0 .75"><geom type="box" size=".02 .6 .9"/></body>'
LEANING = (0.0, 0.9, 0.0, 0.0)


def arm(xml=TUBES, pose=LEANING):
    """The tubes, at rest in another pose than upright."""
    some = robot_of(xml)
    qpos = some.reference_qpos.copy()
    qpos[some.qpos_index] = pose
    return replace(some, reference_qpos=qpos)


def built(some, **limits):
    return build_problem(some, LimitOptions(**limits))


def held(some, pose):
    """Share of the torque limits that holding a pose takes."""
    still = np.zeros((1, len(pose)))
    torque = some.torque(Motion(np.zeros(1), pose[None], still, still))
    return np.max(np.abs(torque[0]) / some.limits.torque)


def test_a_start_that_can_be_held_stays_as_it_is():
    some = built(arm(), max_torque=40.0)
    assert startable(some) is some


def test_a_motion_starts_where_nothing_collides():
    some = problem(tube_arm((Z, Y, X, Y), SHELF.format(TOP)))
    found = startable(some)
    (note,) = set(found.notes) - set(some.notes)
    assert "at rest the model is in a collision: link3 and shelf (10 mm deep)" in note
    assert some.obstacles.slack_at(some.rest)[0] < 0.0 <= found.obstacles.slack_at(found.rest)[0]


def test_where_every_pose_collides_the_bodies_are_named():
    room = '<body name="block"><geom type="box" size="2 2 .5" pos="0 0 .75"/></body>'
    with pytest.raises(InputError, match=r"in a collision: link0 and block.*touches nothing; ch"):
        startable(problem(tube_arm((Z, Y, X, Y), room)))


def test_a_pair_that_grazes_at_rest_is_named_and_may_start():
    some = startable(problem(tube_arm((Z, Y, X, Y), SHELF.format(TOP + 0.0095))))
    words = "touching already at rest, and never to get deeper: link3 and shelf (0.5 mm deep)"
    assert words in some.notes


def weakened(some, share):
    """The same problem with this share of the torque limit that its start needs."""
    limits = replace(some.limits, torque=np.full(some.n_joints, 1.0))
    unit = replace(some, limits=limits)
    allowed = np.full(some.n_joints, share * held(unit, some.rest))
    return replace(unit, limits=replace(limits, torque=allowed))


@cache
def leaning(lean):
    return built(arm(pose=(0.0, lean, 0.0, 0.0)))


@pytest.mark.slow
@given(st.sampled_from((0.4, 0.8, 1.2, 1.6)), st.floats(0.02, 0.99))
def test_what_cannot_be_held_starts_where_it_can_be(lean, share):
    """These tubes need no torque where they stand upright: there is always such a pose."""
    some = weakened(leaning(lean), share)
    found = startable(some)
    assert held(found, found.rest) < 1.0
    assert found.obstacles.slack_at(found.rest)[0] >= 0.0
    assert np.all((found.rest >= some.limits.lower) & (found.rest <= some.limits.upper))
    (note,) = set(found.notes) - set(some.notes)
    assert "holding still takes" in note and "at joint joint1" in note


def test_the_other_start_depends_on_no_seed():
    some = weakened(leaning(0.8), 0.5)
    assert np.array_equal(startable(some).rest, startable(some).rest)
    assert not np.array_equal(startable(some).rest, some.rest)


def test_dry_friction_counts_where_the_arm_moves_off():
    """A pose that is just held cannot be left: the motion starts where there is room to."""
    stiff = TUBES.replace('range="-2.5 2.5"', 'range="-2.5 2.5" frictionloss="0.3"')
    some = weakened(built(arm(stiff)), 1.01)
    (note,) = set(startable(some).notes) - set(some.notes)
    assert "moving off against gravity and dry friction takes" in note
    assert held(startable(some), startable(some).rest) < held(some, some.rest)


def test_where_no_pose_can_be_held_the_joint_is_named():
    """The second joint lies level and the ones after it cannot fold far: there is no way up."""
    stiff = TUBES.replace('range="-2.5 2.5"', 'range="-.2 .2"')
    flat = stiff.replace('pos="0 0 .25" quat="1 0 0 0"', 'pos="0 0 .25" quat=".7 0 .7 0"', 1)
    with pytest.raises(InputError, match="at joint joint1, more than 95 % of its torque limit of"):
        startable(built(robot_of(flat), max_torque=0.5))
    ignored = ("joint0", "joint1", "joint2", "joint3")
    free = built(robot_of(flat), max_torque=0.5, ignore_torque_limit=ignored)
    assert startable(free) is free


def test_the_way_to_another_start_is_looked_at_too():
    """The arm leans left of a wall; straight to where it leans right of it goes through."""
    some = built(arm(tube_arm((Z, Y, X, Y), WALL), (0.0, -0.9, 0.0, 0.0)))
    through = np.array([0.0, 0.9, 0.0, 0.0])
    assert contact_on_the_way(some, some.rest) is None
    assert contact_on_the_way(some, np.array([0.5, -0.5, 0.2, 0.1])) is None
    assert "wall" in contact_on_the_way(some, through)


def test_a_free_way_is_preferred():
    """Both sides are as light; a wall stands before one of them."""
    weak = arm(tube_arm((Z, Y, X, Y), WALL), (0.0, -1.5, 0.0, 0.0))
    some = built(weak, max_torque=3.0)
    assert contact_on_the_way(some, startable(some).rest) is None
