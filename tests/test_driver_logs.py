"""Recordings as the makers' drivers and programs write them are read without any option.

Those of arms whose model is public are skipped where it is not beside the checkout.
"""

from __future__ import annotations

import shlex

import numpy as np
import pytest

from rigs.files.places import MODELS
from rigs.logs.driver_logs import (
    DRIVER_LOGS,
    OPENARM,
    OPENARM_LOG,
    SO101,
    UNWEIGHED_LOGS,
    so101_data_set,
)
from rigs.logs.log_files import open_log
from robot_sysid.cli import main
from robot_sysid.logs import LogOptions
from robot_sysid.parser import load_robot_model

for library in ("rosbags", "pyarrow"):
    pytest.importorskip(library)

NEEDS_MODELS = pytest.mark.skipif(
    not MODELS.is_dir(), reason="the public models are not here"
)
QUICK = {
    "panda ROS 1 bag",
    "LBR state alone",
    "UR RTDE torque",
    "Piper bag",
    "OpenArm bag",
    "i2rt arrays",
}
"""Recordings of the fast run; the others take seconds to write."""


def parameters_of(logs):
    """Return the recordings as parameters, slow but for those of the fast run."""
    parameters = []
    for log in logs:
        marks = [NEEDS_MODELS] if log.model else []
        if log.name not in QUICK:
            marks.append(pytest.mark.slow)
        parameters.append(pytest.param(log, marks=marks, id=log.name))
    return parameters


@pytest.mark.slow
@pytest.mark.parametrize("log", parameters_of(DRIVER_LOGS))
def test_positions_and_torques_of_each_joint_are_those_of_the_arm(tmp_path, log):
    """Whatever the driver's order, names, units, turns and further topics are."""
    expected = log.motion()
    recording = open_log(log.robot(tmp_path), log.write(tmp_path))
    assert len(recording) == len(expected)
    error = recording.q - expected.q
    turns = 2.0 * np.pi * np.round(error[:1] / (2.0 * np.pi))
    np.testing.assert_allclose(error, turns + 0 * error, rtol=0, atol=log.accuracy)
    np.testing.assert_allclose(recording.tau, expected.tau, rtol=0, atol=1e-5)


@pytest.mark.parametrize("log", parameters_of(UNWEIGHED_LOGS))
def test_motor_currents_are_named_and_never_fitted(tmp_path, monkeypatch, capsys, log):
    monkeypatch.chdir(tmp_path)
    model = str(log.robot(tmp_path).path)
    path = log.write(tmp_path)
    assert main(["identify", model, str(path)]) == 2
    error = capsys.readouterr().err
    assert "motor currents" in error and "--torque-constants" in error
    command = f"payload {model} --empty {path} --loaded "
    if path.suffix == ".csv":
        command = f"identify {model} {path} --torque-constants 1\n"
    assert f"\n  robot-sysid {command}" in error
    assert not (tmp_path / "sysid_output" / "updated_model.xml").exists()


def remedies(message):
    """Return the commands that stand alone on a line, as words without the program's name."""
    lines = [line for line in message.splitlines() if line.startswith("  robot-sysid ")]
    return [shlex.split(line)[1:] for line in lines]


@pytest.mark.slow
@NEEDS_MODELS
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


@pytest.mark.slow
@NEEDS_MODELS
def test_of_two_arms_each_ones_command_is_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = OPENARM_LOG.write(tmp_path)
    assert main(["identify", str(OPENARM), path.name]) == 2
    sides = [command[-1] for command in remedies(capsys.readouterr().err)]
    assert sides == ["openarm_left_joint7", "openarm_right_joint7"]
