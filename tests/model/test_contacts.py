"""Contacts along a motion that are not there at rest."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.errors import ModelError
from robot_sysid.model.contacts import ContactFinder, adjacent_bodies, find_new_contacts
from robot_sysid.records import Motion
from tests.support import arms
from tests.support.arms import Y, Z, hinge, link, robot_of, world

BALL = '<geom size=".08"/>'
WALL = '<body name="wall" pos="0 .5 .5"><geom type="box" size=".5 .05 .5"/></body>'


def arm_with_tip(neighbour="", extra=""):
    """Two joints; the tip is a ball 0.4 m from a vertical axis."""
    tip = link(hinge("twist", Y), BALL, "tip", pos=".4 0 0")
    return world(
        link(hinge("turn", Z), tip, "upper", pos="0 0 .5") + neighbour, extra=extra
    )


def sweep(angles):
    """Turn about the vertical axis, one step per second."""
    q = np.column_stack((angles, np.zeros(len(angles))))
    zeros = np.zeros_like(q)
    return Motion(np.arange(len(q), dtype=float), q, zeros, zeros)


def contacts(xml, angles):
    return find_new_contacts(robot_of(xml), [sweep(angles)])


def test_first_touch_of_a_pair_is_told_once_with_time_and_names():
    (contact,) = contacts(arm_with_tip(WALL), [0.0, 0.3, 1.5, 0.0, 1.5])
    assert contact == "tip and wall touch at 2.00 s"


def test_what_touches_at_rest_is_told_once_and_is_no_news_later():
    stand = '<body name="stand" pos=".4 0 .42"><geom size=".05"/></body>'
    texts = contacts(arm_with_tip(stand), [0.0, 0.05, -0.05])
    assert texts == ("tip and stand touch at rest",)


def names_of_neighbours(xml):
    model = robot_of(xml).mj_model
    label = [model.body(k).name for k in range(model.nbody)]
    return {
        (label[a], label[b]) for a, b in np.argwhere(np.triu(adjacent_bodies(model)))
    }


def test_neighbours_are_what_carries_and_what_is_carried():
    camera = '<body name="camera"><geom size=".01"/></body>'
    arm = link(
        hinge("turn", Z),
        link(hinge("bend", Y), camera, "tip", pos=".4 0 0")
        + camera[:-7].replace("camera", "lamp")
        + "</body>",
        "upper",
        pos="0 0 .5",
    )
    base = f'<body name="base"><geom size=".1"/><body name="cover"/>{arm}</body>'
    table = '<body name="table"><geom size=".1"/></body>'
    assert names_of_neighbours(world(base + table)) == {
        ("base", "upper"),
        ("base", "lamp"),
        ("cover", "upper"),
        ("cover", "lamp"),
        ("upper", "tip"),
        ("upper", "camera"),
        ("tip", "lamp"),
        ("camera", "lamp"),
    }


def test_things_that_touch_each_other_beside_the_arm_are_no_news():
    falling = '<body name="cup" pos="0 .5 1.0"><freejoint/><geom size=".05" mass=".1"/></body>'
    assert contacts(arm_with_tip(WALL + falling), np.zeros(3)) == ()


def test_links_of_the_arm_touching_each_other_are_found():
    base = '<body name="base" pos=".2 0 .3"><geom size=".1"/></body>'
    folded = world(
        base
        + link(
            hinge("bend", Y), link(hinge("end", Y), BALL, "tip"), "upper", pos="0 0 .5"
        )
    )
    (contact,) = contacts(folded, [0.0, 2.2])
    assert contact == "base and tip touch at 1.00 s"


def test_a_near_miss_inside_the_contact_margin_is_no_touch():
    wide_wall = WALL.replace("<geom ", '<geom margin=".5" ')
    finder = ContactFinder(robot_of(arm_with_tip(wide_wall)))
    assert finder.new_pairs(np.array([0.3, 0.0])) == set()
    assert len(finder.new_pairs(np.array([1.5, 0.0]))) == 1


def test_more_contacts_than_mujoco_holds_are_a_matter_of_the_model():
    crowd = '<body><geom size=".1"/></body>' * 1500
    bodies = arms.serial_bodies((arms.Y,))
    robot = arms.robot_of(arms.world(bodies + crowd, extra='<size memory="3M"/>'))
    with pytest.raises(ModelError, match="<size memory="):
        find_new_contacts(robot, [])
