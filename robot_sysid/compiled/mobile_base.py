"""Joints that stand for a base on wheels: two free directions in a plane and a turn in it.

A model lets such a base drive with two slide joints and a hinge. They carry the arm, but no motor
torque is measured at them and no trajectory should drive them; so they stay where they are.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

N_JOINTS = 3
"""Two directions and a turn."""
LEAST_ARM = 3
"""Joints that must remain for the rest to be an arm; three can show all ten parameters."""
_PERPENDICULAR = 1e-6


def arm_without_base(mj_model: Any, chain: tuple[int, ...]) -> tuple[int, ...]:
    """Return a chain of joint ids without the joints of a mobile base at its beginning.

    Args:
        mj_model: compiled model.
        chain: joint ids from the world outwards.
    """
    if len(chain) < N_JOINTS + LEAST_ARM or not _is_planar_base(mj_model, chain[:N_JOINTS]):
        return chain
    return chain[N_JOINTS:]


def _is_planar_base(mj_model: Any, joints: tuple[int, ...]) -> bool:
    """Tell whether three joints are two slides and a hinge normal to both, all unlimited."""
    ids = list(joints)
    kinds = mj_model.jnt_type[ids]
    slides = kinds == int(mujoco.mjtJoint.mjJNT_SLIDE)
    hinges = kinds == int(mujoco.mjtJoint.mjJNT_HINGE)
    if np.any(mj_model.jnt_limited[ids]) or np.sum(slides) != 2 or np.sum(hinges) != 1:
        return False
    data = mujoco.MjData(mj_model)
    mujoco.mj_kinematics(mj_model, data)
    axes = data.xaxis[ids]
    return bool(np.max(np.abs(axes @ axes.T - np.eye(N_JOINTS))) <= _PERPENDICULAR)
