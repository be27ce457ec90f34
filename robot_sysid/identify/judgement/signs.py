"""Whether a log's torques go the way the model says."""

from __future__ import annotations

from robot_sysid.identify.simulated import CHECKPOINTS
from robot_sysid.logs.checks import sign_check
from robot_sysid.records import RobotModel
from robot_sysid.signals.process import ProcessedSignals
from robot_sysid.simulator import ArmTorque


def compared_with_model(robot: RobotModel, signals: ProcessedSignals) -> tuple[str, ...]:
    """Return a sentence per joint whose torque goes against the model's, see ``sign_check``."""
    at = signals.spread(CHECKPOINTS)
    torque = ArmTorque(robot)(signals.motion(at))
    return sign_check(signals.tau[at], torque, robot.joint_names)
