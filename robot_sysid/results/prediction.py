"""Prediction of logs that were not fitted: the torques of a model file."""

from __future__ import annotations

from typing import Any

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.model.chain import joint_friction
from robot_sysid.records import Array, Motion, RobotModel, Validation
from robot_sysid.records.data import validation_of
from robot_sysid.signals.process import ProcessedSignals

BLOCKS = 10
"""Number of blocks of a log in which two models are compared."""


def torque_error(
    mj_model: Any, robot: RobotModel, signals: ProcessedSignals, source: str
) -> Validation:
    """Return the torque error of a model file on a log, up to one sensor offset per joint.

    ``ArmDynamics`` has no linear damping of joints; it is added as viscous friction. Dry friction
    is Coulomb's. The prediction passes the same low-pass as the measured torque, and the mean
    residual of each joint is subtracted.

    Args:
        mj_model: compiled model, whose chain joints have the addresses of the robot's model.
        robot: the arm.
        signals: the processed log.
        source: description of the log.
    """
    dynamics = ArmDynamics(robot, mj_model)
    friction = joint_friction(mj_model, robot.dof_index)

    def torque(motion: Motion) -> Array:
        """Return the torque (K, n) along a motion [N m]."""
        rigid = dynamics.torque(motion.q, motion.qd, motion.qdd)
        return rigid + friction.torque(motion.qd)

    predicted = signals.filter_columns(torque)
    tau = signals.low_pass.decimate(signals.tau)
    usable = signals.usable()
    counts = np.count_nonzero(usable, axis=0)
    residual = np.where(usable, tau - predicted, 0.0)
    offset = np.sum(residual, axis=0) / np.maximum(counts, 1)
    residual = np.where(usable, residual - offset, 0.0)
    blocks = [np.sum(b**2, axis=0) for b in np.array_split(residual, BLOCKS)]
    squared_torques = np.sum(np.where(usable, tau, 0.0) ** 2, axis=0)
    return validation_of(
        robot.joint_names, np.stack(blocks), squared_torques, counts, source
    )
