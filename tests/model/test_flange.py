"""The flange: whatever names it, it is where MuJoCo puts it, and never something that moves."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given

from robot_sysid.errors import ModelError
from robot_sysid.model.flange import find_flange
from tests.support.arms import SEEDS, X, Y, Z, robot_of, serial_arm

TIP = (
    '<site name="attachment_site" pos=".01 -.02 .1" quat="1 .2 -.3 .4"/>'
    '<site name="pinch" pos="0 0 .2"/>'
    '<body name="hand" pos="0 .01 .12" euler=".1 .2 .3"><geom size=".02" mass=".1"/>'
    '<site name="palm" pos=".03 0 0" euler="0 .5 0"/>'
    '<body name="jaw"><joint name="grip" type="slide"/><geom size=".01" mass=".02"/>'
    '<site name="nail"/></body></body>'
)
# Turned, so that axes of the world and of the terminal body differ at rest.
ARM = serial_arm((Z, Y, X), tip=TIP).replace('quat="1 0 0 0"', 'quat="1 .3 -.2 .5"')
ROBOT = robot_of(ARM, joint="joint2")


def world_pose(robot, object_type, name):
    """(rotation, origin) of a site or body relative to the terminal body, in some configuration."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = np.random.default_rng(0).uniform(-1.0, 1.0, robot.mj_model.nq)
    mujoco.mj_kinematics(robot.mj_model, data)
    frame = getattr(data, object_type)(name)
    axes = data.xmat[robot.body_id].reshape(3, 3)
    return axes.T @ frame.xmat.reshape(3, 3), axes.T @ (
        frame.xpos - data.xpos[robot.body_id]
    )


@pytest.mark.parametrize(
    ("object_type", "name"),
    [("site", "attachment_site"), ("site", "palm"), ("body", "hand")],
)
def test_a_named_flange_is_where_mujoco_puts_it_whatever_the_joints_do(
    object_type, name
):
    flange = find_flange(ROBOT, name)
    rotation, translation = world_pose(ROBOT, object_type, name)
    np.testing.assert_allclose(flange.rotation, rotation, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(flange.translation, translation, rtol=0.0, atol=1e-14)
    assert (flange.name, flange.terminal, flange.note) == (
        f"{object_type} '{name}'",
        "link2",
        None,
    )
    carrier = "link2" if name == "attachment_site" else "hand"
    assert flange.carrier == ROBOT.mj_model.body(carrier).id


@given(SEEDS)
def test_numbers_are_metres_and_degrees_about_fixed_axes(seed):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-1.0, 1.0, 3)
    angles = rng.uniform(-180.0, 180.0, 3)
    flange = find_flange(ROBOT, ", ".join(str(value) for value in (*position, *angles)))
    (sr, sp, sy) = np.sin(np.radians(angles))
    (cr, cp, cy) = np.cos(np.radians(angles))
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    np.testing.assert_allclose(
        flange.rotation, about_z @ about_y @ about_x, rtol=0.0, atol=1e-14
    )
    np.testing.assert_array_equal(flange.translation, position)
    assert flange.carrier == ROBOT.body_id


@pytest.mark.parametrize(
    ("site", "flange_name"),
    [
        ("attachment_site", "site 'attachment_site'"),
        ("tool_flange", "site 'tool_flange'"),
        ("tool0", "site 'tool0'"),
        ("ee", "site 'ee'"),
        ("pinch_site", "body 'link2'"),
        ("tcp", "body 'link2'"),
        ("flangeless", "body 'link2'"),
    ],
)
def test_what_is_called_like_a_flange_is_taken_and_said(site, flange_name):
    flange = find_flange(robot_of(serial_arm((Z, Y, X), tip=f'<site name="{site}"/>')))
    assert flange.name == flange_name
    reason = (
        "because of its name"
        if flange_name.startswith("site")
        else "others that can be named"
    )
    assert reason in flange.note


def test_a_site_and_a_body_of_one_place_are_one_flange():
    twice = '<body name="flange" pos="0 0 .1"><site name="flange_site"/></body>'
    flange = find_flange(robot_of(serial_arm((Z, Y, X), tip=twice)))
    assert flange.name == "site 'flange_site'"
    np.testing.assert_allclose(
        flange.translation, [0.0, 0.0, 0.1], rtol=0.0, atol=1e-15
    )


def test_two_places_that_could_be_the_flange_are_asked_for():
    tip = '<site name="a_flange"/><site name="b_flange" pos="0 0 .1"/>'
    with pytest.raises(
        ModelError, match="site 'a_flange', site 'b_flange' could each be"
    ) as error:
        find_flange(robot_of(serial_arm((Z, Y, X), tip=tip)))
    assert "by its name" in str(error.value)


@pytest.mark.parametrize("name", ["jaw", "nail", "link1", "world"])
def test_what_moves_against_the_terminal_body_is_refused(name):
    with pytest.raises(
        ModelError, match=f"'{name}' moves against the terminal body"
    ) as error:
        find_flange(ROBOT, name)
    assert "site 'palm'" in str(error.value) and "nail'," not in str(error.value)


def test_an_unknown_name_lists_the_valid_ones():
    with pytest.raises(ModelError, match="flange tool7: no such site or body") as error:
        find_flange(ROBOT, "tool7")
    listed = (
        "site 'attachment_site', site 'pinch', site 'palm', body 'link2', body 'hand'"
    )
    assert listed in str(error.value)


@pytest.mark.parametrize(
    "text", ["1,2", "0,0,0,0", "a,b,c", "0,0,nan", "0,0,inf", "0,,0", ","]
)
def test_numbers_that_are_none_say_what_is_wanted(text):
    with pytest.raises(ModelError, match="x,y,z in metres or x,y,z,roll,pitch,yaw"):
        find_flange(ROBOT, text)


def test_millimetres_are_noticed():
    with pytest.raises(ModelError, match="metres, not millimetres"):
        find_flange(ROBOT, "0,0,107")
