"""From a model file to the arm in it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms import small_arms
from rigs.arms.small_arms import X, Y, Z, compile_xml, robot_of, serial_arm
from rigs.files import urdf
from rigs.files.refusals import refused
from robot_sysid.dynamics.inverse_dynamics import subtree
from robot_sysid.errors import ModelError
from robot_sysid.parser import load_robot_model


def test_a_file_becomes_an_arm(arm_file):
    robot = load_robot_model(arm_file(small_arms.SEVEN))
    assert robot.terminal_joint == "joint6"
    assert robot.body_name == "link6"
    assert robot.n_joints == 7
    assert len(robot.sha256) == 64
    assert_array_equal(robot.qpos_index, np.arange(7))
    assert_allclose(robot.friction.coulomb, 0.4)
    assert_allclose(robot.friction.viscous, 0.1)
    assert not np.any(robot.is_slide)


@pytest.mark.parametrize("side", ["left", "right"])
def test_either_of_two_arms_can_be_asked_for(side):
    robot = robot_of(small_arms.TWO_ARMS, f"{side}_joint3")
    assert robot.joint_names == tuple(f"{side}_joint{k}" for k in range(4))
    assert robot.body_name == f"{side}_link3"


def test_a_joint_in_the_middle_makes_all_behind_it_the_link():
    robot = robot_of(small_arms.THREE, "joint1")
    assert robot.joint_names == ("joint0", "joint1")
    masses = robot.mj_model.body_mass[subtree(robot.mj_model, robot.body_id)]
    assert robot.prior.mass == pytest.approx(np.sum(masses), rel=1e-14)


@pytest.mark.parametrize("name", small_arms.MODELS)
def test_prior_is_the_composite_that_mujoco_sees(name):
    """Mass and centre of mass of the subtree, by MuJoCo's own sums."""
    robot = robot_of(small_arms.MODELS[name])
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.reference_qpos
    mujoco.mj_kinematics(robot.mj_model, data)
    mujoco.mj_comPos(robot.mj_model, data)
    rotation = data.xmat[robot.body_id].reshape(3, 3)
    com = rotation.T @ (data.subtree_com[robot.body_id] - data.xpos[robot.body_id])
    assert robot.prior.mass == pytest.approx(
        robot.mj_model.body_subtreemass[robot.body_id]
    )
    assert_allclose(robot.prior.com, com, atol=1e-14)
    assert robot.prior.is_consistent


ONE_KEYFRAME = small_arms.HOME_KEYFRAME.replace(
    '<key name="other" qpos="0 0 0 0 0 0"/>', ""
)
NO_HOME = small_arms.HOME_KEYFRAME.replace('name="home"', 'name="stand"').replace(
    'name="other"', ""
)


@pytest.mark.parametrize(
    "xml",
    [
        small_arms.HOME_KEYFRAME,
        ONE_KEYFRAME,
        ONE_KEYFRAME.replace("home", "neutral_pose"),
    ],
)
def test_at_rest_the_arm_is_in_the_home_keyframe_or_in_the_only_one(xml):
    model = compile_xml(xml)
    pose = [0.1, 0.2, 0.3, 0.4, 0.03, 0.01]
    assert_allclose(robot_of(model).reference_qpos, pose)


def test_of_several_keyframes_without_home_none_is_taken_unless_asked_for():
    robot = robot_of(NO_HOME)
    assert_array_equal(robot.reference, np.zeros(4))
    assert any("--keyframe chooses one of #0, stand" in note for note in robot.notes)
    assert_allclose(robot_of(NO_HOME, keyframe="stand").reference[:2], [0.1, 0.2])
    assert not any(
        "keyframe" in note for note in robot_of(NO_HOME, keyframe="#0").notes
    )


@pytest.mark.parametrize(
    ("xml", "there"), [(NO_HOME, "#0, stand"), (small_arms.THREE, "none")]
)
def test_a_keyframe_that_is_not_there_is_refused(xml, there):
    with refused(f"no such keyframe; the model has {there}"):
        robot_of(xml, keyframe="home")


@pytest.mark.parametrize("direction", [(1, 0, 0), (0.0, -3.0, 4.0)])
def test_gravity_acts_along_the_direction_that_is_stated(arm_file, direction):
    """It is as large as in the file, whatever the length of the direction."""
    path = arm_file(small_arms.THREE)
    size = np.linalg.norm(load_robot_model(path).mj_model.opt.gravity)
    robot = load_robot_model(path, gravity=direction)
    expected = size * np.array(direction) / np.linalg.norm(direction)
    assert_allclose(robot.mj_model.opt.gravity, expected, atol=1e-12)
    assert any("gravity is taken to act along" in note for note in robot.notes)


@pytest.mark.parametrize("direction", [(0, 0, 0), (1, 0), (np.nan, 0, 1)])
def test_what_is_no_direction_of_gravity_is_refused(arm_file, direction):
    path = arm_file(small_arms.THREE)
    with refused("--gravity X Y Z takes a direction"):
        load_robot_model(path, gravity=direction)


def test_a_model_without_gravity_says_so_and_gets_that_of_earth(arm_file):
    text = small_arms.THREE.replace(
        "<worldbody>", '<option gravity="0 0 0"/><worldbody>', 1
    )
    path = arm_file(text)
    assert any("the model has no gravity" in n for n in load_robot_model(path).notes)
    robot = load_robot_model(path, gravity=(2, 0, 0))
    assert_array_equal(robot.mj_model.opt.gravity, [9.81, 0.0, 0.0])
    assert not any("has no gravity" in note for note in robot.notes)


def test_a_weightless_link_is_refused():
    model = compile_xml(small_arms.THREE)
    model.body_mass[3] = 0.0
    model.body_inertia[3] = 0.0
    with refused("body link2 and all below it weigh nothing", ModelError):
        robot_of(model)


def test_a_tie_between_bodies_is_told():
    tie = '<equality><weld body1="link0" body2="link2"/></equality>'
    (note,) = robot_of(serial_arm(extra=tie)).notes
    assert "weld constraints are ignored" in note


def test_a_jaw_that_is_held_is_named_with_the_option_that_adds_it():
    jaw = '<body><joint name="gripper"/><geom size=".02"/></body>'
    xml = serial_arm((Z, Y, X, Z), tip=jaw)
    robot = robot_of(xml)
    assert robot.joint_names == ("joint0", "joint1", "joint2", "joint3")
    assert "to add the jaw: --joint gripper" in " ".join(robot.notes)
    assert robot_of(xml, "joint3").notes == ()
    assert robot_of(xml, "gripper").terminal_joint == "gripper"


NO_BODY = urdf.inertial(inertia="0.01 0.02 0.035", rpy="0.3 0.2 0.1")


ANTENNA = urdf.link("antenna", NO_BODY), urdf.joint("base", "antenna", "fixed")
"""An antenna on an arm's base that has an inertia of no body."""


def test_an_impossible_inertia_is_mended_with_a_note(tmp_path):
    links = {f"l{k}": urdf.inertial() for k in range(3)}
    expected = load_robot_model(urdf.write_arm(tmp_path, links))
    robot = load_robot_model(urdf.write_arm(tmp_path, links, *ANTENNA))
    assert_array_equal(robot.links[0].theta, expected.links[0].theta)
    (note,) = robot.notes
    assert "'antenna'" in note and "in a written model too" in note
    links["l1"] = NO_BODY
    robot = load_robot_model(urdf.write_arm(tmp_path, links, *ANTENNA))
    assert "link 'l1', 'antenna', and MuJoCo refuses" in robot.notes[0]
    assert robot.links[0].theta[0] == expected.links[0].theta[0]


@pytest.mark.parametrize(
    ("inertia", "is_silent"),
    [("0.01 0.02 0.0300001", True), ("0.01 0.02 0.031", False), ("0 1 1", True)],
)
def test_moments_of_a_link_are_mended_in_silence_where_rounding_explains_them(
    tmp_path, inertia, is_silent
):
    """Six digits of a flat link, and a line that has no moment about itself."""
    links = {"l1": urdf.inertial(), "l2": urdf.inertial(inertia=inertia)}
    robot = load_robot_model(urdf.write_arm(tmp_path, links))
    assert (robot.notes == ()) == is_silent
    if not is_silent:
        return
    moments = np.sort(np.array(inertia.split(), dtype=float))
    assert_allclose(np.sort(robot.mj_model.body("l2").inertia), moments, atol=1e-5)
