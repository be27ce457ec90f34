"""A judge of model files: the torques of a compiled model, by its own inverse dynamics."""

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.model.chain import joint_friction


def torque_error(mj_model, robot, signals):
    """Return the error of a compiled model on a processed log, as a share of its torque.

    The prediction passes the same low-pass as the measured torque, and the mean residual of each
    joint, the offset of its sensor, is subtracted.
    """
    dynamics = ArmDynamics(robot, mj_model)
    friction = joint_friction(mj_model, robot.dof_index)

    def torque(motion):
        """Linear damping and dry friction are none of ``ArmDynamics``."""
        rigid = dynamics.torque(motion.q, motion.qd, motion.qdd)
        return rigid + friction.torque(motion.qd)

    tau = signals.low_pass.decimate(signals.tau)
    usable = signals.is_used
    residual = np.where(usable, tau - signals.filter_columns(torque), 0.0)
    offset = np.sum(residual, axis=0) / np.count_nonzero(usable, axis=0)
    residual = np.where(usable, residual - offset, 0.0)
    return np.linalg.norm(residual) / np.linalg.norm(np.where(usable, tau, 0.0))
