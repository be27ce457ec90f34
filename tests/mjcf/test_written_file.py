"""The law of a written file: it is the model with the change, and has the torques of that."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.small_arms import SEEDS, random_theta, seeded_motion
from rigs.files.model_files import write_and_verify
from rigs.files.places import MODELS
from rigs.files.releases import IS_PRINCIPAL
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    LinkDynamics,
    data_at_pose,
    with_gravity,
)
from robot_sysid.errors import ModelError
from robot_sysid.mjcf.updated_model import BodyChange, ElementChange, ModelChange
from robot_sysid.model.bodies import body_theta, pose_in
from robot_sysid.parser import load_robot_model

PUBLIC = (
    "kuka_iiwa_14/iiwa14.xml",
    "franka_fr3/FrankaFR3_7DoF.urdf",
    "universal_robots_ur5e/ur5e.xml",
    "so101/so101_new_calib.xml",
)
NUMBERS = ("armature", "damping", "frictionloss")


@cache
def source_of(name):
    """Return the file of a small model, or of a public one by its path."""
    if name in PUBLIC:
        return MODELS / name
    FOLDERS.append(tempfile.TemporaryDirectory())
    path = Path(FOLDERS[-1].name) / "model.xml"
    path.write_text(small_arms.MODELS[name])
    return path


FOLDERS: list[tempfile.TemporaryDirectory] = []
NAMES = [*small_arms.MODELS, *(name for name in PUBLIC if (MODELS / name).exists())]


@cache
def arm_of(name):
    return load_robot_model(source_of(name))


@st.composite
def changes(draw, robot):
    """Any change that a file can hold: of bodies, of what joints have, of gravity."""
    rng = default_rng(draw(SEEDS))
    model = robot.mj_model
    ids = [body.body_id for link in robot.links for body in link.bodies]
    bodies = []
    for body in draw(st.lists(st.sampled_from(ids), unique=True)):
        theta = random_theta(rng, rng.uniform(0.1, 5.0))
        label = model.body(body).name or f"#{body}"
        bodies.append(BodyChange(label, body, theta))
    # A URDF has no rotors but those that are links.
    numbers = NUMBERS if robot.kind == "mjcf" else NUMBERS[1:]
    elements = []
    for joint in draw(st.lists(st.sampled_from(robot.joint_names), unique=True)):
        chosen = draw(st.lists(st.sampled_from(numbers), min_size=1, unique=True))
        values = {number: rng.uniform(0.0, 2.0) for number in chosen}
        elements.append(ElementChange("joint", joint, values))
    gravity = rng.normal(size=3) * 5.0 if draw(st.booleans()) else None
    return ModelChange(tuple(bodies), 0.0, tuple(elements), gravity, IS_PRINCIPAL)


def predicted_torque(robot, change, motion):
    """Return the torque of the model plus that of each change, by the columns of an estimate."""
    if change.gravity is not None:
        robot = with_gravity(robot, change.gravity)
    model = robot.mj_model
    data = data_at_pose(model, robot.reference_qpos)
    new = {body.body_id: body.theta for body in change.bodies}
    thetas = np.zeros((robot.n_joints, spatial.N_INERTIAL))
    for theta, link in zip(thetas, robot.links):
        for body in {body.body_id for body in link.bodies} & new.keys():
            pose = pose_in(data.body(body), data.body(link.body_id))
            more = new[body] - body_theta(model, body)
            theta += spatial.transform_theta(more, *pose)
    torque = ArmDynamics(robot)(motion)
    links = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd)
    torque += links.torque(thetas)
    factors = {"armature": motion.qdd, "damping": motion.qd}
    factors["frictionloss"] = np.sign(motion.qd)
    for element in change.elements:
        joint = robot.joint_names.index(element.owner)
        dof = robot.dof_index[joint]
        for number, value in element.numbers.items():
            more = value - getattr(model, f"dof_{number}")[dof]
            torque[:, joint] += more * factors[number][:, joint]
    return torque


@given(st.data(), st.sampled_from(NAMES), SEEDS)
def test_a_written_file_has_the_torques_that_were_predicted_and_no_other_change(
    data, name, seed
):
    """Export, load in MuJoCo, inverse dynamics: of any arm, with any change that it can have."""
    try:
        robot = arm_of(name)
    except ModelError as error:
        # Some public models are written for a later MuJoCo.
        assert "unrecognized attribute" in str(error)
        return
    change = data.draw(changes(robot))
    motion = seeded_motion(seed, robot.n_joints, 5)
    expected = predicted_torque(robot, change, motion)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "out" / robot.path.name
        write_and_verify(robot.path, change, target)
        written = load_robot_model(target, joint=robot.terminal_joint)
        torque = ArmDynamics(written)(motion)
    tolerance = 1e-9 * np.max(np.abs(expected))
    assert_allclose(torque, expected, rtol=0.0, atol=tolerance)
