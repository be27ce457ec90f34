"""Joints that a model ties to each other are refused in the arm, and nowhere else."""

from __future__ import annotations

import pytest

from rigs.arms.small_arms import X, Y, Z, robot_of, serial_arm
from rigs.files import urdf
from rigs.files.refusals import refused
from robot_sysid.errors import ModelError
from robot_sysid.parser import load_robot_model

FINGERS = """<body name="hand"><joint name="finger_1" axis="1 0 0"/><geom size=".02"/></body>
<body pos="0 .1 0"><joint name="finger_2" axis="1 0 0"/><geom size=".02"/>
<body name="pad" pos="0 0 .1"><joint name="finger_3" axis="1 0 0"/><geom size=".02"/></body>
</body>"""
ROD = """<body><joint name="rod_1" axis="0 1 0"/><geom size=".02"/>
<body name="rod" pos="0 0 .2"><joint name="rod_2" axis="0 1 0"/><geom size=".02"/></body></body>"""
TIES = {
    "joints": '<joint joint1="joint2" joint2="joint1" polycoef=".1 -1 0 0 0"/>',
    "tendons": '<tendon tendon1="t1" tendon2="t2"/>',
    "tendon": '<tendon tendon1="both"/>',
    "rods": '<connect body1="rod" body2="link2" anchor="0 0 0"/>',
}
HARMLESS = {
    "fingers": '<joint joint1="finger_1" joint2="finger_2"/>',
    "loop of fingers": '<connect body1="pad" body2="hand" anchor="0 0 0"/>',
    "one with a finger": '<joint joint1="joint1" joint2="finger_1"/>',
    "held": '<joint joint1="joint1" polycoef=".1 0 0 0 0"/>',
    "follows nothing": '<joint joint1="joint2" joint2="joint1" polycoef=".1 0 0 0 0"/>',
    "switched off": '<joint joint1="joint2" joint2="joint1" active="false"/>',
    "target": '<weld body1="target" body2="link2"/>',
}
TENDONS = """<tendon><fixed name="t1"><joint joint="joint1" coef="1"/></fixed>
<fixed name="t2"><joint joint="joint2" coef="1"/></fixed>
<fixed name="both"><joint joint="joint1" coef="1"/><joint joint="joint2" coef="2"/></fixed>
</tendon>"""


def arm(tie):
    extra = f"{TENDONS}<equality>{tie}</equality>"
    beside = f'<body name="target" mocap="true"/>{ROD}'
    xml = serial_arm((Z, Y, Y, X), tip=FINGERS, extra=extra)
    return robot_of(xml.replace("<worldbody>", f"<worldbody>{beside}", 1), "joint3")


@pytest.mark.parametrize("name", TIES)
def test_an_arm_of_tied_joints_is_refused(name):
    with refused("joints? .*joint1 and joint2|over joint0, joint1, joint2", ModelError):
        arm(TIES[name])


@pytest.mark.parametrize("name", HARMLESS)
def test_ties_beside_the_arm_and_ties_that_hold_or_rest_are_not(name):
    assert arm(HARMLESS[name]).n_joints == 4


def test_a_joint_tied_to_one_beside_the_arm_is_told():
    (note,) = arm(HARMLESS["one with a finger"]).notes
    assert "equality constraints on joint1" in note
    assert arm(HARMLESS["switched off"]).notes == ()


@pytest.mark.parametrize("follower, is_refused", [("l1_l2", True), ("base_rod", False)])
def test_a_joint_of_a_urdf_that_mimics_another_of_the_arm_is_refused(
    tmp_path, follower, is_refused
):
    links = {f"l{k}": urdf.inertial() for k in range(3)}
    rod = urdf.link("rod", urdf.inertial()), urdf.joint("base", "rod")
    path = urdf.write_arm(tmp_path, links, *rod)
    head, name, tail = path.read_text().partition(f'name="{follower}"')
    tie = '<mimic joint="l0_l1" multiplier="-1"/></joint>'
    path.write_text(head + name + tail.replace("</joint>", tie, 1))
    if not is_refused:
        assert load_robot_model(path, joint="l1_l2").n_joints == 3
        return
    with refused("l1_l2 and l0_l1 are tied", ModelError):
        load_robot_model(path, joint="l1_l2")
