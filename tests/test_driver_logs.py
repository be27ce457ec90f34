"""Recordings as the makers' drivers write them are read without any option.

Skipped where the public models are not beside the checkout.
"""

from __future__ import annotations

import numpy as np
import pytest

from rigs.driver_logs import DRIVER_LOGS, UNWEIGHED_LOGS, DriverLog, model_of, motion_of
from rigs.places import MODELS
from robot_sysid.cli import main
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_log

pytestmark = pytest.mark.skipif(
    not MODELS.is_dir(), reason="the public models are not here"
)

QUICK = {"panda ROS 1 bag", "LBR state alone", "UR RTDE torque"}
"""Recordings of the fast run; the others take seconds to write."""


def marked(logs: tuple[DriverLog, ...]):
    """Return the recordings as parameters, slow but for those of the fast run."""
    parameters = []
    for log in logs:
        marks = () if log.name in QUICK else (pytest.mark.slow,)
        parameters.append(pytest.param(log, marks=marks, id=log.name))
    return parameters


@pytest.mark.parametrize("log", marked(DRIVER_LOGS))
def test_positions_and_torques_of_each_joint_are_those_of_the_arm(tmp_path, log):
    """Whatever the driver's order, names, units, turns and further topics are."""
    pytest.importorskip("rosbags")
    expected = motion_of(log.model, rate=log.rate)
    samples = open_log(model_of(log.model), log.write(tmp_path), LogOptions())
    assert len(samples) == len(expected)
    turns = (samples.q - expected.q) / (2.0 * np.pi)
    # Kinova's own message has single precision.
    np.testing.assert_allclose(turns, np.round(turns[:1]) + 0 * turns, atol=1e-6)
    np.testing.assert_allclose(samples.tau, expected.tau, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("log", UNWEIGHED_LOGS, ids=lambda log: log.name)
def test_motor_currents_are_named_and_never_fitted(tmp_path, monkeypatch, capsys, log):
    pytest.importorskip("rosbags")
    monkeypatch.chdir(tmp_path)
    model = str(MODELS / log.model)
    path = log.write(tmp_path)
    assert main(["identify", model, str(path)]) == 2
    error = capsys.readouterr().err
    assert "motor currents" in error and "--torque-constants" in error
    command = f"payload {model} --empty {path} --loaded "
    if path.suffix == ".csv":
        command = f"identify {model} {path} --torque-constants 1\n"
    assert f"\n  robot-sysid {command}" in error
    assert not (tmp_path / "sysid_output" / "updated_model.xml").exists()
