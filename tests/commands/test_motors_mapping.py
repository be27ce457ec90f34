"""Joints whose direction gravity does not show: named, moved a little, kept in the joint map."""

from __future__ import annotations

import json

import numpy as np
import pytest

from robot_sysid.commands.motors import mapping
from robot_sysid.damiao.joints import read_joint_map
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion
from robot_sysid.simulation.plant import ArmStepper
from robot_sysid.simulator import ArmTorque
from tests.support import arms
from tests.support.command_line import fail, succeed
from tests.support.damiao_rig import only_asks, swing, trajectory_file

CAN0 = ("--channel", "can0", "--rate", "100")
START = np.array([0.4, 0.6])


@pytest.fixture
def arguments(bus, arm_file, tmp_path, monkeypatch):
    """What plays a swing on an arm with an upright first axis."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mapping, "_PACE", (1.0, 0.4))
    path = arm_file(arms.serial_arm((arms.Z, arms.Y)))
    robot = load_robot_model(path)
    bus.arm.mechanism = ArmStepper(robot, START, 4e-3)
    time, q, qd, _ = swing(2, duration=1.0, amplitude=0.05)
    standing = Motion(time, q + START, 0 * qd, 0 * qd)
    played = trajectory_file(
        tmp_path, (time, q + START, qd, ArmTorque(robot)(standing))
    )
    return ("play", played.path, *CAN0, "--model", path)


def test_nothing_is_played_before_somebody_has_seen_which_way_joints_turn(
    capsys, bus, arguments
):
    err = fail(capsys, 3, *arguments, "--yes")
    assert "nobody has verified which way motor 1 (joint joint0)" in err
    assert only_asks(bus.wire.sent)
    out = succeed(capsys, *arguments, "--yes", "--accept-directions")
    assert "mirrored or swapped, they would be played like that" in out
    # Without a model it is said.
    out = succeed(capsys, *arguments[:-2], "--yes")
    assert "nobody has verified which way motor 1" in out


def test_a_small_motion_verifies_a_set_up_once(
    capsys, bus, arguments, person, tmp_path
):
    person[0][:] = ["yes"] * 3
    out = succeed(capsys, *arguments, "--verify", "--park", "start")
    assert (
        "motor 1 (joint joint0) is to turn so that" in out
        and "parking, straight" in out
    )
    assert np.max(np.abs(bus.arm.mechanism.q - START)[0]) < 0.02
    rows = read_joint_map(tmp_path / "joint_map.csv")
    assert [row.verified for row in rows] == ["motion"] * 2
    out = succeed(capsys, *arguments, "--yes", "--joint-map", "joint_map.csv")
    out = succeed(capsys, *arguments, "--verify", "--joint-map", "joint_map.csv")
    assert "somebody has verified it" in out


def test_what_is_seen_is_never_written_into_a_file_of_lerobots(
    capsys, arguments, person, tmp_path, monkeypatch
):
    entry = {"drive_mode": 0, "homing_offset": 0}
    text = json.dumps({f"joint_{k}": {**entry, "id": k + 1} for k in range(2)})
    theirs = tmp_path / "calibration.json"
    theirs.write_text(text)
    monkeypatch.setattr(mapping, "_nudge_joints", lambda *_: ["up"] * 2)
    person[0][:] = ["yes"] * 3
    succeed(capsys, *arguments, "--verify", "--joint-map", theirs)
    assert theirs.read_text() == text
    assert "motion" in [
        row.verified for row in read_joint_map(tmp_path / "joint_map.csv")
    ]


def test_a_joint_that_went_another_way_leaves_nothing_written(
    capsys, arguments, person, tmp_path
):
    person[0][:] = ["yes", "no"]
    err = fail(capsys, 2, *arguments, "--verify")
    assert "motor 1 (joint joint0) is not verified" in err
    assert (
        "Did motor 1 (joint joint0), and no other joint, turn so that" in person[1][-1]
    )
    assert not (tmp_path / "joint_map.csv").exists()
