"""The maker of an arm's controller, by the names in its model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from rigs.files import results as made
from robot_sysid.records.controllers import makers_of


def arm_called(model="", path="somewhere/arm.xml", joints=("j5", "j6")):
    """An arm with these names."""
    mj_model = SimpleNamespace(names=model.encode() + b"\0world\0")
    names = {"mj_model": mj_model, "path": Path(path).absolute()}
    return replace(made.ARM, joint_names=joints, **names)


@pytest.mark.parametrize(
    ("name", "maker"),
    [
        ("panda nohand", "franka"),
        ("FrankaFR3_7DoF", "franka"),
        ("fr3v2", "franka"),
        ("ur5e scene", "ur"),
        ("UR10", "ur"),
        ("universal_robots", "ur"),
        ("iiwa14", "kuka"),
        ("kuka-lwr", "kuka"),
        ("lbr_med7_r800", "kuka"),
        ("kr210l150", "kuka"),
        ("gen3", "kinova"),
        ("xarm7 hand", "xarm"),
        ("lite6", "xarm"),
        ("irb1200_5_90", "abb"),
        ("meca500", "mecademic"),
        ("staubli_tx40", None),
        ("so101_new_calib", None),
        ("tiago", None),
        # Names that contain those of makers within a word.
        ("purple_arm", None),
        ("turtle", None),
        ("krypton", None),
    ],
)
def test_a_model_or_file_of_this_name_has_the_maker(name, maker):
    expected = () if maker is None else (maker,)
    assert makers_of(arm_called(model=name)) == expected
    assert makers_of(arm_called(path=f"somewhere/{name}.xml")) == expected
    assert makers_of(arm_called(path=f"{name}/arm.xml")) == expected


def test_names_of_joints_count_before_those_of_model_and_file():
    """An arm of one maker often carries the hand of another."""
    joints = ("fr3_joint1", "fr3_joint2")
    robot = arm_called("ur5e", "kuka.xml", joints)
    assert makers_of(robot) == ("franka",)
    assert makers_of(replace(robot, joint_names=("j5", "j6"))) == ("ur", "kuka")
    joints = (
        "left_shoulder_pan_joint",
        "left_shoulder_lift_joint",
        "left_elbow_joint",
        "left_wrist_1_joint",
        "left_wrist_2_joint",
        "left_wrist_3_joint",
    )
    assert makers_of(arm_called(joints=joints)) == ("ur",)
    so101 = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    assert makers_of(arm_called(joints=so101)) == ()


def test_a_name_that_fits_two_makers_has_both():
    assert makers_of(arm_called("panda_on_ur5e")) == ("franka", "ur")
