"""Joints of a log are matched with the model's by the whole set of names, or are refused."""

from __future__ import annotations

import pytest

from rigs.files.refusals import refused
from robot_sysid.logs.joint_names import joint_note, match_joint_names


def count(name: str, last: int = 7, first: int = 1) -> list[str]:
    """Return names with a number in the place of ``#``, or at the end."""
    text = name if "#" in name else f"{name}#"
    return [text.replace("#", str(k)) for k in range(first, last + 1)]


JOINTS = count("joint")
FINGERS = ["panda_finger_joint1", "panda_finger_joint2"]
UR = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
LEFT = count("left_joint")
RIGHT = count("right_joint")


@pytest.mark.parametrize(
    ("names", "joints"),
    [
        (count("panda_joint") + FINGERS, JOINTS),
        (count("fr3_joint")[::-1], JOINTS),
        (count("lbr_A"), JOINTS),
        (count("arm_joint_"), JOINTS),
        (count("iiwa7_joint_"), JOINTS),
        (count("robot1/j#_link"), JOINTS),
        (count("joint_0"), JOINTS),
        (JOINTS, count("panda_joint")),
        (JOINTS + LEFT, JOINTS),
        (sorted(f"{name}_joint" for name in UR), UR),
        (sorted(UR), [f"ur5e_{name}_joint" for name in UR]),
        (LEFT + RIGHT, count("openarm_left_joint")),
        (count("robot1_j") + count("robot2_j"), count("robot2_joint")),
        (["panda_joint1"], ["joint1"]),
        # The link of joint5 is identified; or the model has fingers that count on.
        (JOINTS, count("joint", 5)),
        (count("panda_joint"), count("joint", 5)),
        (["joint_link_x", "joint_x"], ["joint", "joint_link"]),
        (["arm-1", "arm_1", "arm-2"], ["arm_1", "arm-2"]),
    ],
)  # fmt: skip
def test_names_match_whatever_stands_around_them_and_in_any_order(names, joints):
    matched = match_joint_names(names, joints)
    assert list(matched.values()) == list(joints)
    assert {*matched} <= {*names}
    for name, joint in matched.items():
        assert name[-1] == joint[-1] or joint in name or name in joint or "link" in name


@pytest.mark.parametrize(
    ("names", "joints", "fault"),
    [
        (LEFT + RIGHT, JOINTS, "2 sets .* left_joint1, .* and right_joint1, "),
        (count("joint_") + ["joint1"], JOINTS, "joint_1 and joint1 could both"),
        (count("a_joint") + count("b_joint"), JOINTS, "a_joint1, .* and b_joint1, "),
        (["a_joint1", "b_joint1"], ["joint1"], "a_joint1 and b_joint1"),
        (count("arm1_joint") + count("arm9_joint"), JOINTS, "arm1_joint1, .* and arm9_joint1, "),
        (LEFT, RIGHT, "left_joint1, .* are those of another arm than .* right_joint1, "),
        ([f"left_{n}" for n in UR], [f"right_{n}" for n in UR], "those of another arm"),
    ],
)  # fmt: skip
def test_names_of_two_arms_or_of_another_arm_are_refused(names, joints, fault):
    with refused(fault):
        match_joint_names(names, joints)


@pytest.mark.parametrize(
    "names",
    [
        [],
        ["x", "y"],
        count("xarm_joint", 6),
        UR,
        count("A", 6, 0),
        ["joint_²", "joint_①"],
    ],
)
def test_nothing_is_made_of_names_that_are_no_set(names):
    assert match_joint_names(names, JOINTS) == {}


def test_what_was_matched_is_one_sentence_and_nothing_where_names_are_equal():
    names = count("panda_joint") + FINGERS
    assert joint_note(match_joint_names(names, JOINTS), names) == (
        "log joints: panda_joint1, ..., panda_joint7 are joint1, ..., joint7; "
        "not used: panda_finger_joint1, panda_finger_joint2"
    )
    equal = match_joint_names(JOINTS + FINGERS, JOINTS)
    assert joint_note(equal, JOINTS + FINGERS) == ""
