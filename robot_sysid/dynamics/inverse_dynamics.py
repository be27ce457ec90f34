"""Inverse dynamics by MuJoCo: torque of an entire arm, and torque of armature, springs, tendons and
actuators alone.
"""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np

from robot_sysid.records import Array, RobotModel

MUJOCO_VERSION: str = mujoco.__version__


def analysis_copy(mj_model: Any) -> Any:
    """Return a copy of a compiled model reduced to rigid-body dynamics, armature and springs.

    Switched off: constraints (contacts, limits, equalities, and MuJoCo's own frictionloss, which is
    a ramp in acceleration and velocity and not Coulomb's law), gravity compensation (a real joint
    carries the weight), fluid drag, and linear joint damping (friction is added by the caller).
    """
    model = copy.copy(mj_model)
    disable = mujoco.mjtDisableBit
    for name in ("CONSTRAINT", "CONTACT", "SENSOR"):
        model.opt.disableflags |= int(getattr(disable, f"mjDSBL_{name}"))
    # "invdiscrete" would reinterpret qacc, "fwdinv" and "energy" only cost time.
    model.opt.enableflags = 0
    model.opt.density = model.opt.viscosity = 0.0
    model.body_gravcomp[:] = 0.0
    model.dof_damping[:] = 0.0
    return model


def data_at_pose(mj_model: Any, qpos: Array) -> Any:
    """Return new MuJoCo data of a model at ``qpos`` (nq,), with all frames computed."""
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(mj_model, data)
    return data


def subtree(mj_model: Any, body_id: int) -> list[int]:
    """Return the ids of a body and all its descendants, which MuJoCo numbers consecutively."""
    outside = np.flatnonzero(mj_model.body_parentid[body_id + 1 :] < body_id)
    end = body_id + 1 + int(outside[0]) if len(outside) else mj_model.nbody
    return list(range(body_id, end))


def has_only_armature(mj_model: Any) -> bool:
    """Return whether joint armature is the only torque beside rigid-body dynamics.

    Springs, nonlinear damping, tendons and actuator armature or damping need MuJoCo's full inverse
    dynamics; without them a cheaper formula gives the same torque.
    """
    fields = (
        "jnt_stiffness jnt_stiffnesspoly dof_dampingpoly tendon_stiffness "
        "tendon_stiffnesspoly tendon_damping tendon_dampingpoly tendon_armature "
        "actuator_armature actuator_damping actuator_dampingpoly"
    )
    # Older releases of MuJoCo lack some of these fields.
    return not any(np.any(getattr(mj_model, name, 0.0)) for name in fields.split())


def inverse_dynamics(
    model: Any, data: Any, chain: tuple[Any, Any], q: Array, qd: Array, qdd: Array
) -> Array:
    """Return MuJoCo's joint torques (N, n) for motions (N, n) of a chain of joints.

    Args:
        model: compiled MuJoCo model.
        data: its MuJoCo data, which is changed; joints outside the chain keep their positions,
            velocities and accelerations.
        chain: addresses (n,) of the chain's joints in qpos, and in qvel.
        q: positions [rad].
        qd: velocities [rad/s].
        qdd: accelerations [rad/s^2].
    """
    tau = np.empty_like(q)
    qpos_index, dof_index = chain
    # Looked up once: an attribute of ``data`` takes as long to find as the row takes to write.
    qpos = data.qpos
    qvel = data.qvel
    qacc = data.qacc
    for k in range(len(q)):
        qpos[qpos_index] = q[k]
        qvel[dof_index] = qd[k]
        qacc[dof_index] = qdd[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse[dof_index]
    return tau


class ArmDynamics:
    """Inverse dynamics of an entire arm, by MuJoCo.

    Args:
        robot: the arm.
        mj_model: another compiled model of it; None for its own.
    """

    def __init__(self, robot: RobotModel, mj_model: Any = None) -> None:
        self.model = analysis_copy(robot.mj_model if mj_model is None else mj_model)
        self.data = data_at_pose(self.model, robot.reference_qpos)
        self._chain = _as_slice(robot.qpos_index), _as_slice(robot.dof_index)

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return joint torques (N, n) without friction for motions (N, n) [N m]."""
        return inverse_dynamics(self.model, self.data, self._chain, q, qd, qdd)

    def beyond_rigid_bodies(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque (N, n) of armature, springs, tendons and actuators alone, for motions
        (N, n) [N m].
        """
        rigid = np.empty(self.model.nv)
        beyond = np.empty_like(q)
        for k in range(len(q)):
            total = self.torque(q[k : k + 1], qd[k : k + 1], qdd[k : k + 1])
            mujoco.mj_rne(self.model, self.data, 1, rigid)
            beyond[k] = total[0] - rigid[self._chain[1]]
        return beyond


class BeyondRigidBodies:
    """Torque of armature, springs, tendons and actuators, which no link's parameters make."""

    def __init__(self, robot: RobotModel) -> None:
        self._armature = robot.armature
        self._arm = None if has_only_armature(robot.mj_model) else ArmDynamics(robot)

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque (N, n) of armature, springs, tendons and actuators for motions (N, n)
        [N m].
        """
        if self._arm is None:
            return np.asarray(self._armature * qdd)
        return self._arm.beyond_rigid_bodies(q, qd, qdd)


def _as_slice(index: Any) -> Any:
    """Return addresses (n,) as a slice if they are consecutive, which is faster to write to."""
    first = int(index[0])
    count = len(index)
    is_consecutive = np.array_equal(index, np.arange(first, first + count))
    return slice(first, first + count) if is_consecutive else index
