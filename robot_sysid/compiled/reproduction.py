"""Does a written model move as the identification predicts? Compared torque by torque."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import ExportError
from robot_sysid.kinematics import ArmDynamics, ChainKinematics
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.regressor import joint_regressor

TORQUE_TOLERANCE = 1e-9
"""Largest deviation of a written model's torque, relative to the joint's largest torque."""


def predicted_torque(robot: RobotModel, theta: Array, motion: Motion) -> Array:
    """Return tau_rest + Y theta (N, n) [N m], without friction."""
    body = ChainKinematics(robot).evaluate(motion.q, motion.qd, motion.qdd)
    rows = joint_regressor(body, range(robot.n_joints))
    return body.tau_rest + (rows @ theta).T


def torque_deviation(
    robot: RobotModel, theta: Array, written_model: Any, motion: Motion
) -> tuple[float, str]:
    """Return the largest relative torque deviation of a written model, and at which joint."""
    predicted = predicted_torque(robot, theta, motion)
    actual = ArmDynamics(robot, written_model).torque(motion.q, motion.qd, motion.qdd)
    peak = np.max(np.abs(predicted), axis=0)
    # A joint that carries next to nothing is judged by what its neighbours carry.
    scale = np.maximum(peak, 1e-3 * np.max(peak, initial=0.0))
    relative = np.max(np.abs(actual - predicted), axis=0) / np.where(scale > 0.0, scale, 1.0)
    worst = int(np.argmax(relative))
    return float(relative[worst]), robot.joint_names[worst]


def require_reproduction(
    robot: RobotModel, theta: Array, written_model: Any, motion: Motion, path: Path
) -> float:
    """Return the deviation, or raise ExportError where the written model moves differently.

    Args:
        robot: the arm as it was loaded.
        theta: (10,) composite terminal link that was identified.
        written_model: compiled model of the written file.
        motion: where to compare.
        path: the written file, for the message.
    """
    deviation, joint = torque_deviation(robot, theta, written_model, motion)
    if not deviation <= TORQUE_TOLERANCE:
        raise ExportError(
            f"{path.name} does not reproduce the identified torques: joint {joint} is off by "
            f"{deviation:.1e} relative (allowed {TORQUE_TOLERANCE:.0e}); no model was written"
        )
    return deviation
