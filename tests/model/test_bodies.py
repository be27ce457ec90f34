"""Bodies of an arm: each is in one link; the flange is where MuJoCo puts it; which bodies touch."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms import small_arms
from rigs.arms.small_arms import Y, Z, hinge, link, robot_of, serial_arm, world
from rigs.files.refusals import refused
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import subtree
from robot_sysid.errors import ModelError
from robot_sysid.model.bodies import (
    body_theta,
    find_flange,
    link_reach,
    touching_by_design,
    update_contacts,
    write_body,
)


@pytest.mark.parametrize("name", sorted(small_arms.MODELS))
def test_links_weigh_what_the_first_joint_moves_and_reach_to_their_centre_of_mass(name):
    robot = small_arms.robot_of(small_arms.MODELS[name])
    model = robot.mj_model
    first = robot.links[0].body_id
    masses = [link.theta[0] for link in robot.links]
    moved = model.body_mass[list(subtree(model, first))]
    assert sum(masses) == pytest.approx(np.sum(moved), rel=1e-12)
    assert_array_equal(robot.links[-1].theta, robot.prior.theta)
    com = spatial.com_from_theta(robot.prior.theta)[1]
    assert link_reach(robot) >= np.linalg.norm(com)


@pytest.mark.parametrize("name", ["coupled fingers", "home keyframe"])
def test_a_body_has_what_was_written_into_it(name):
    model = small_arms.robot_of(small_arms.MODELS[name]).mj_model
    for body in range(1, model.nbody):
        theta = small_arms.random_theta(np.random.default_rng(body))
        write_body(model, body, theta)
        assert_allclose(body_theta(model, body), theta, rtol=1e-12, atol=1e-14)


TIP = (
    '<site name="attachment_site" pos=".01 -.02 .1" quat="1 .2 -.3 .4"/>'
    '<site name="pinch" pos="0 0 .2"/>'
    '<body name="hand" pos="0 .01 .12" euler=".1 .2 .3"><geom size=".02" mass=".1"/>'
    '<site name="palm" pos=".03 0 0" euler="0 .5 0"/>'
    '<body name="jaw"><joint name="grip" type="slide"/><geom size=".01" mass=".02"/>'
    '<site name="nail"/></body></body>'
)
# Turned, so that axes of the world and of the terminal body differ at rest.
ARM = serial_arm(tip=TIP).replace('quat="1 0 0 0"', 'quat="1 .3 -.2 .5"')
ROBOT = robot_of(ARM, joint="joint2")


def flange_of(tip):
    """The flange of an arm that carries this."""
    return find_flange(robot_of(serial_arm(tip=tip)))


def world_pose(robot, object_type, name):
    """(rotation, origin) of a site or body relative to the terminal body, in some configuration."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = np.random.default_rng(0).uniform(-1.0, 1.0, robot.mj_model.nq)
    mujoco.mj_kinematics(robot.mj_model, data)
    frame = getattr(data, object_type)(name)
    axes = data.xmat[robot.body_id].reshape(3, 3)
    translation = axes.T @ (frame.xpos - data.xpos[robot.body_id])
    return axes.T @ frame.xmat.reshape(3, 3), translation


@pytest.mark.parametrize(
    ("object_type", "name"),
    [("site", "attachment_site"), ("site", "palm"), ("body", "hand")],
)
def test_a_named_flange_is_where_mujoco_puts_it_whatever_the_joints_do(
    object_type, name
):
    flange = find_flange(ROBOT, name)
    rotation, translation = world_pose(ROBOT, object_type, name)
    assert_allclose(flange.rotation, rotation, rtol=0.0, atol=1e-14)
    assert_allclose(flange.translation, translation, rtol=0.0, atol=1e-14)
    assert flange.name == f"{object_type} '{name}'"
    assert flange.terminal == "link2" and flange.note is None


def test_numbers_are_metres_and_degrees_about_fixed_axes():
    """Roll, then yaw: x goes to y, y to z, z to x."""
    flange = find_flange(ROBOT, "0.1, 0.2,-0.3,90,0,90")
    turned = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    assert_allclose(flange.rotation, turned, rtol=0.0, atol=1e-15)
    assert_array_equal(flange.translation, [0.1, 0.2, -0.3])


@pytest.mark.parametrize(
    ("site", "flange_name"),
    [
        ("attachment_site", "site 'attachment_site'"),
        ("tool_flange", "site 'tool_flange'"),
        ("tool0", "site 'tool0'"),
        ("left_fr3_link8", "site 'left_fr3_link8'"),
        ("link8", "body 'link2'"),
        ("ee", "site 'ee'"),
        ("pinch_site", "body 'link2'"),
        ("tcp", "body 'link2'"),
        ("flangeless", "body 'link2'"),
    ],
)
def test_what_is_called_like_a_flange_is_taken_and_said(site, flange_name):
    flange = flange_of(f'<site name="{site}"/>')
    assert flange.name == flange_name
    is_site = flange_name.startswith("site")
    assert ("because of its name" in flange.note) == is_site
    assert ("those that can be named" in flange.note) != is_site


def test_a_site_and_a_body_of_one_place_are_one_flange():
    twice = '<body name="flange" pos="0 0 .1"><site name="flange_site"/></body>'
    flange = flange_of(twice)
    assert flange.name == "site 'flange_site'"
    assert_allclose(flange.translation, [0.0, 0.0, 0.1], rtol=0.0, atol=1e-15)


def test_two_places_that_could_be_the_flange_are_asked_for():
    tip = '<site name="a_flange"/><site name="b_flange" pos="0 0 .1"/>'
    with refused("site 'a_flange', site 'b_flange' could each be", ModelError) as error:
        flange_of(tip)
    assert "by its name" in str(error.value)


FIXED = "site 'attachment_site', site 'pinch', site 'palm', body 'link2', body 'hand'"
NO_NUMBERS = ("1,2", "0,0,0,0", "a,b,c", "0,0,nan", "0,0,inf", "0,,0", ",")
REFUSED = {
    **dict.fromkeys(NO_NUMBERS, "x,y,z in metres or x,y,z,roll,pitch,yaw"),
    **dict.fromkeys(("jaw", "link1", "world", "tool7"), f"no site or body.*{FIXED}"),
    "0,0,107": "metres, not millimetres",
}


@pytest.mark.parametrize("text", REFUSED)
def test_what_is_no_flange_is_refused_with_what_is_wanted(text):
    with refused(REFUSED[text], ModelError) as error:
        find_flange(ROBOT, text)
    assert "nail'," not in str(error.value)


def test_neighbours_touch_by_design_but_no_table_and_no_other_links():
    ball = '<geom size=".3"/>'
    arm = link(
        ball + hinge("turn", Z), link(ball + hinge("bend", Y), "", "tip"), "upper"
    )
    base = f'<body name="base">{ball}<body name="cover">{ball}</body>{arm}</body>'
    robot = robot_of(world(base + f'<body name="table">{ball}</body>'))
    name = {k: robot.mj_model.body(k).name for k in range(robot.mj_model.nbody)}
    pairs = [(a, b) for a in name for b in name if 0 < a < b]
    by_design = {(name[a], name[b]) for a, b in touching_by_design(robot, pairs)}
    neighbours = {("base", "upper"), ("cover", "upper"), ("upper", "tip")}
    # Balls at one place never part.
    assert by_design >= neighbours and not any("table" in pair for pair in by_design)


def test_more_contacts_than_mujoco_holds_are_a_matter_of_the_model():
    crowd = '<body><geom size=".1"/></body>' * 1500
    bodies = small_arms.serial_bodies((small_arms.Y,))
    robot = small_arms.robot_of(
        small_arms.world(bodies + crowd, extra='<size memory="3M"/>')
    )
    with refused("<size memory=", ModelError):
        update_contacts(robot.mj_model, mujoco.MjData(robot.mj_model))
