"""What each joint may do, as the model says: positions, speeds, torques."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from robot_sysid.records import Array, JointLimits
from robot_sysid.records.options import PerJoint, per_joint

DEFAULT_SLIDE_VELOCITY = 0.25
"""Speed limit of slide joints [m/s]."""


def joint_limits(
    mj_model: Any, joints: tuple[int, ...], max_velocity: PerJoint, stated: Sequence[float | None]
) -> JointLimits:
    """Return the limits of some joints.

    Args:
        mj_model: compiled model.
        joints: joint ids.
        max_velocity: speed limit of hinge joints, one number or one per joint [rad/s]; slide
            joints use their own default.
        stated: speed limit of each joint that its model file states; None where it has none.
    """
    index = np.array(joints)
    limited = mj_model.jnt_limited[index].astype(bool)
    slide = mj_model.jnt_type[index] == int(mujoco.mjtJoint.mjJNT_SLIDE)
    asked = per_joint(max_velocity, len(joints), "--max-velocity")
    usual = np.where(slide, np.minimum(DEFAULT_SLIDE_VELOCITY, asked), asked)
    return JointLimits(
        lower=np.where(limited, mj_model.jnt_range[index, 0], -np.inf),
        upper=np.where(limited, mj_model.jnt_range[index, 1], np.inf),
        velocity=np.fmin(usual, np.array(stated, dtype=float)),
        torque=np.array([_torque_limit(mj_model, joint) for joint in joints]),
    )


def _torque_limit(mj_model: Any, joint: int) -> float:
    """Return the symmetric torque limit of a joint; infinite where the model names none."""
    limited = mj_model.jnt_actfrclimited[joint]
    own = _symmetric(mj_model.jnt_actfrcrange[joint]) if limited else np.inf
    return min(own, _actuator_limit(mj_model, joint))


def _actuator_limit(mj_model: Any, joint: int) -> float:
    """Return what all actuators on a joint can give together."""
    kinds = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    limits = [
        abs(float(mj_model.actuator_gear[a, 0])) * _force_limit(mj_model, a)
        for a in range(mj_model.nu)
        if int(mj_model.actuator_trntype[a]) in kinds
        and int(mj_model.actuator_trnid[a, 0]) == joint
    ]
    return sum(limits) if limits else np.inf


def _force_limit(mj_model: Any, actuator: int) -> float:
    """Return the largest force of one actuator: its forcerange, or a motor's gain x ctrlrange."""
    if mj_model.actuator_forcelimited[actuator]:
        return _symmetric(mj_model.actuator_forcerange[actuator])
    fixed = int(mj_model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    pure = int(mj_model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_NONE)
    if mj_model.actuator_ctrllimited[actuator] and fixed and pure:
        gain = abs(float(mj_model.actuator_gainprm[actuator, 0]))
        return gain * _symmetric(mj_model.actuator_ctrlrange[actuator])
    return np.inf


def _symmetric(bounds: Array) -> float:
    """Return the largest magnitude allowed in both directions; a 0 bound means no limit."""
    value = float(min(-bounds[0], bounds[1]))
    return value if value > 0.0 else np.inf
