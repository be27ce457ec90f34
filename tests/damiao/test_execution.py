"""A whole run as it was asked for."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from robot_sysid.damiao import execution
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.safety.guards import BeyondBounds, Overload
from robot_sysid.errors import HardwareAbort
from tests.support.arms import THREE
from tests.support.damiao_rig import swing, trajectory_file


@pytest.mark.parametrize(
    ("error_type", "has_remedy"), [(Overload, True), (BeyondBounds, False)]
)
def test_an_arm_that_needs_more_than_its_motors_is_to_be_weighed(
    tmp_path, monkeypatch, heard, arm_file, error_type, has_remedy
):
    def raise_overload(*arguments):
        raise error_type("motor 1 stops")

    monkeypatch.setattr(execution, "run", raise_overload)
    trajectory = trajectory_file(tmp_path, swing(3, duration=1.0))
    values = {"trajectory": trajectory.path, "model": arm_file(THREE)}
    motors = execution.MotorRun(values, lambda text, last: None)
    monkeypatch.setattr(motors, "orders", lambda plan, q: ())
    plan = motors.plan()
    inspection = SimpleNamespace(motors={})
    with pytest.raises(HardwareAbort, match="motor 1 stops") as error:
        motors.play(None, plan, inspection, StopRequest(), print, print)
    assert ("robot-sysid plan" in str(error.value)) == has_remedy
    assert ("--for weight" in str(error.value)) == has_remedy
