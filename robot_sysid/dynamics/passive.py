"""Actuators that act whatever their control is: no motor that a log has the torque of.

An actuator has a force of its control, of the length and speed of what it acts on, and of time:

    force = gain(length, speed) control + bias(length, speed).

The torque that is read at a joint is that of its motor: of a motor or servo, all of its force at
its control. Where the gain is zero the force is none that anyone commands: a weight's rope, a gas
spring or a damper that was written as an actuator. That is torque of the arm, as a spring's is. A
<damper> brakes by as much as its control says, so that at no control it does not act.

A DC motor of MuJoCo 4 makes the torque that is read by its current. Its cogging, which depends on
the position, and its friction (``with_dry_friction_in_joints``) are the arm's.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

_FIXED_GAIN = int(mujoco.mjtGain.mjGAIN_FIXED)
_AFFINE_GAIN = int(mujoco.mjtGain.mjGAIN_AFFINE)
_AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_AFFINE)
DC_BIAS = int(getattr(mujoco.mjtBias, "mjBIAS_DCMOTOR", -1))
"""MuJoCo's type of bias of a DC motor, -1 for releases before 4, which have none."""
COGGING = 0
"""Place of the size of a DC motor's cogging among the numbers of its bias."""
# Places of a DC motor's torque constant and of the mode of its controller among those of its gain.
_TORQUE_CONSTANT = 1
_CONTROLLER = 8


def acts_by_itself(mj_model: Any) -> NDArray[np.bool_]:
    """Return which actuators (k,) of a compiled model have a force whatever their control is."""
    kinds = mj_model.actuator_gaintype
    has_gain = np.any(mj_model.actuator_gainprm[:, :3], axis=1)
    is_uncontrolled = np.isin(kinds, (_FIXED_GAIN, _AFFINE_GAIN)) & ~has_gain
    has_bias = np.any(mj_model.actuator_biasprm[:, :3], axis=1)
    pushes = is_uncontrolled & has_bias & (mj_model.actuator_biastype == _AFFINE_BIAS)
    is_on = not mj_model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    return (pushes | cogs(mj_model)) & is_on


def cogs(mj_model: Any) -> NDArray[np.bool_]:
    """Return which actuators (k,) of a compiled model are DC motors with cogging."""
    is_motor = mj_model.actuator_biastype == DC_BIAS
    return np.asarray(is_motor & (mj_model.actuator_biasprm[:, COGGING] != 0.0))


def leave_passive_actuators(mj_model: Any) -> None:
    """Let no actuator of a compiled model act, in place, but those that act by themselves."""
    passive = acts_by_itself(mj_model)
    # Older releases have one output per actuator.
    outputs = getattr(mj_model, "actuator_outadr", np.arange(mj_model.nu))
    kept = np.isin(np.arange(len(mj_model.actuator_gear)), outputs[passive])
    mj_model.actuator_gear[~kept] = 0.0
    motors = cogs(mj_model)
    if np.any(motors):
        mj_model.actuator_gainprm[motors, _TORQUE_CONSTANT] = 0.0
        mj_model.actuator_gainprm[motors, _CONTROLLER] = 0.0
    # Limits of what all motors of a joint or tendon make together.
    mj_model.jnt_actfrclimited[:] = 0
    if hasattr(mj_model, "tendon_actfrclimited"):
        mj_model.tendon_actfrclimited[:] = 0
