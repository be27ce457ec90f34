"""LeRobot's files as joint maps."""

from __future__ import annotations

import json

import pytest

from robot_sysid.damiao.protocol.joints import DamiaoJoint, read_joint_map
from robot_sysid.errors import InputError

# As LeRobot's OpenArm follower writes it, typed from its source.
CALIBRATION = {
    name: {"id": k, "drive_mode": 0, "homing_offset": 0, "range_min": -90, "range_max": 90}
    for k, name in enumerate(("joint_1", "joint_2", "gripper"), start=1)
}
ARM = {"port": "can0", "side": None, "motor_config": {"joint_1": [1, 17, "dm8009"]}}
LEFT = ["openarm_left_joint1", "openarm_left_joint2"]


@pytest.fixture
def read(tmp_path):
    def reads(content, names=()):
        path = tmp_path / "lerobot.json"
        path.write_text(json.dumps(content))
        return read_joint_map(path, names)

    return reads


def test_a_calibration_names_motors_that_turn_as_their_joints_do(read):
    first, second, gripper = read(CALIBRATION, LEFT)
    assert first == DamiaoJoint("", 1, 0x11, "openarm_left_joint1")
    assert (second.name, second.can_id) == ("openarm_left_joint2", 2)
    assert gripper == DamiaoJoint("", 3, 0x13, "gripper")
    assert [row.name for row in read(CALIBRATION)] == ["joint_1", "joint_2", "gripper"]


def test_a_configuration_tells_ids_and_buses_of_one_arm_or_two(read):
    assert read({"robot": ARM}) == read(ARM) == (DamiaoJoint("", 1, 17, "joint_1", 0, "can0"),)
    right = {"port": "can1", "motor_config": {"joint_1": [1, 33, "dm8009"]}}
    rows = read({"left_arm_config": ARM, "right_arm_config": right}, [*LEFT, "right_joint1"])
    assert [(row.name, row.master_id, row.channel) for row in rows] == [
        ("openarm_left_joint1", 17, "can0"),
        ("right_joint1", 33, "can1"),
    ]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"joint_1": {**CALIBRATION["joint_1"], "homing_offset": 512}}, "homing_offset of joint_1"),
        ({"joint_1": {**CALIBRATION["joint_1"], "drive_mode": 1}}, "drive_mode of joint_1 is 1"),
        ({"joint_1": {"id": 1}}, "is no calibration or configuration of LeRobot"),
        ([1, 2], "is no calibration or configuration of LeRobot"),
        ({"motor_config": {"a": [1, 2, "x"], "b": [2, 18, "x"]}}, "would be taken as commands"),
        ({}, "has no lines"),
    ],
)
def test_what_is_no_file_of_damiao_motors_is_refused(read, content, words):
    with pytest.raises(InputError, match=words):
        read(content)
