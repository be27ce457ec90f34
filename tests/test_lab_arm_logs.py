"""Recordings of laboratory arms as their own software writes them are read without any option.

Those of arms whose model is public are skipped where it is not beside the checkout.
"""

from __future__ import annotations

import shlex

import numpy as np
import pytest

from rigs.lab_arm_logs import LAB_ARM_LOGS, OPENARM, SO101, openarm_bag, so101_data_set
from robot_sysid.cli import main
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_log
from robot_sysid.parser import load_robot_model

for library in ("rosbags", "pyarrow"):
    pytest.importorskip(library)


@pytest.mark.parametrize("log", LAB_ARM_LOGS, ids=lambda log: log.name)
def test_positions_and_torques_of_each_joint_are_those_of_the_arm(tmp_path, log):
    if log.name.startswith("OpenArm") and not OPENARM.exists():
        pytest.skip("the public models are not here")
    robot = log.robot(tmp_path)
    expected = log.motion()
    samples = open_log(robot, log.write(tmp_path), LogOptions())
    assert len(samples) == 2 * (len(expected) // 2)
    count = len(samples)
    np.testing.assert_allclose(samples.q, expected.q[:count], rtol=0, atol=log.accuracy)
    np.testing.assert_allclose(samples.tau, expected.tau[:count], rtol=0, atol=1e-4)


def remedies(message):
    """Return the commands that stand alone on a line, as words without the program's name."""
    lines = [line for line in message.splitlines() if line.startswith("  robot-sysid ")]
    return [shlex.split(line)[1:] for line in lines]


@pytest.mark.skipif(not SO101.exists(), reason="the public models are not here")
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_servo_arms_data_set_names_the_command_that_needs_no_torque(
    tmp_path, monkeypatch, capsys, version
):
    monkeypatch.chdir(tmp_path)
    path = so101_data_set(tmp_path, version)
    assert main(["identify", str(SO101), path.name]) == 2
    (command,) = remedies(capsys.readouterr().err)
    added = ["--torque-from", "position-error"]
    assert command == ["identify", str(SO101), path.name, *added]
    robot = load_robot_model(SO101)
    log = open_log(robot, path, LogOptions(commanded=True))
    assert len(log.columns.position) == len(log.columns.torque) == 5
    assert log.command.shape == log.q.shape == (900, 5)
    assert np.max(np.abs(log.q)) < np.pi


@pytest.mark.skipif(not OPENARM.exists(), reason="the public models are not here")
def test_of_two_arms_each_ones_command_is_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = openarm_bag(tmp_path)
    assert main(["identify", str(OPENARM), path.name]) == 2
    sides = [command[-1] for command in remedies(capsys.readouterr().err)]
    assert sides == ["openarm_left_joint7", "openarm_right_joint7"]
