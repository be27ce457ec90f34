"""A plant is accepted exactly when its chain has the robot's joints; differences are listed."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.parser import load_robot_model
from robot_sysid.simulation.closed_loop import load_plant
from tests.support.arms import FREE_OBJECT_BESIDE, SEVEN, THREE, X, Y, Z, serial_arm


@pytest.fixture
def robot(arm_file):
    """The three-joint arm from a file."""
    return load_robot_model(arm_file(THREE))


def test_a_plant_keeps_its_own_inertials_friction_and_armature(robot, arm_file):
    joint = 'range="-2 2" frictionloss=".7" damping=".3" armature=".05"'
    heavier = serial_arm((Z, Y, X), joint=joint).replace('mass=".8"', 'mass="1.9"')
    plant = load_plant(robot, arm_file(heavier, "plant.xml"))
    assert plant.joint_names == robot.joint_names
    assert plant.prior.mass == pytest.approx(1.9, rel=1e-12)
    np.testing.assert_array_equal(plant.friction.coulomb, 0.7)
    np.testing.assert_array_equal(plant.mj_model.dof_armature[plant.dof_index], 0.05)
    assert plant.notes == ()


def test_a_plant_may_have_other_things_around_the_arm(robot, arm_file):
    plant = load_plant(robot, arm_file(FREE_OBJECT_BESIDE, "plant.xml"))
    assert plant.joint_names == robot.joint_names
    assert plant.notes == ("joints only the plant has are held still: door_hinge",)


@pytest.mark.parametrize(
    ("xml", "words"),
    [
        (SEVEN.replace("joint2", "j2"), "has no joint joint2, the last joint of arm.xml.*j2"),
        (THREE.replace("joint1", "roll"), "joint0, roll, joint2 instead of joint0, joint1, joint2"),
        (
            THREE.replace('name="joint1"', 'name="joint1" type="slide"'),
            "joint1 is a slide instead of a hinge",
        ),
        (
            THREE.replace("joint0", "t").replace("joint1", "joint0").replace('"t"', '"joint1"'),
            "joint1, joint0, joint2 instead of joint0, joint1, joint2",
        ),
    ],
)
def test_a_plant_with_other_joints_is_refused_with_a_list(robot, arm_file, xml, words):
    with pytest.raises(InputError, match=words):
        load_plant(robot, arm_file(xml, "plant.xml"))


def test_another_geometry_is_allowed_and_noted(robot, arm_file):
    longer = arm_file(THREE.replace('pos="0 .02 .25"', 'pos="0 .02 .251"'), "plant.xml")
    (note,) = load_plant(robot, longer).notes
    assert "mm from where the model has it" in note
