"""The actuators of a compiled model: what they move, how strong they are, their servo gains.

An actuator has a force F, and its transmission a gear ratio g: a joint gets the torque g F; a fixed
tendon gets g F too, and each of its joints that times the joint's coefficient. Rotor inertia and
damping that a file states at an actuator act at the joint or tendon times g^2.

Since release 3.11 MuJoCo has arrays with one row per control (``actuator_ctrlrange``) and with one
row per force output (``actuator_gear``): an actuator may have none or several of the former.

The strength of a joint is that of MuJoCo's own forward dynamics at rest, all controls at the ends
of their ranges. A servo's force is its gain times an error: the range of its setpoint bounds
positions or speeds but no force, so that only its forcerange counts.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.passive import acts_by_itself, cogs
from robot_sysid.records import Array

AT_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
"""MuJoCo's types of transmission by which an actuator acts on a joint directly."""
AT_TENDON = (int(mujoco.mjtTrn.mjTRN_TENDON),)
"""MuJoCo's type of transmission by which an actuator acts on a tendon."""
# MuJoCo's type of a joint that a tendon runs over.
_WRAPS_JOINT = int(mujoco.mjtWrap.mjWRAP_JOINT)
_AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_AFFINE)
_FIXED_GAIN = int(mujoco.mjtGain.mjGAIN_FIXED)
_AFFINE_GAIN = int(mujoco.mjtGain.mjGAIN_AFFINE)
# MuJoCo's type of gain of a PID controller, which releases before 4 do not have.
_PID_GAIN = getattr(mujoco.mjtGain, "mjGAIN_PID", None)
_NO_DYNAMICS = int(mujoco.mjtDyn.mjDYN_NONE)
# Control, length and speed in place of infinite ones.
_ENDLESS = 1e9
# Least force, per unit of such a control, that grows with it: a force with an end has less.
_LEAST_GAIN = 1e-4


def control_rows(mj_model: Any, actuator: int) -> NDArray[np.int64]:
    """Return the rows of an actuator's (id) controls in ``ctrl`` and ``actuator_ctrlrange``."""
    if not hasattr(mj_model, "actuator_ctrladr"):
        return np.array([actuator])
    first = mj_model.actuator_ctrladr[actuator]
    return first + np.arange(mj_model.actuator_ctrlnum[actuator])


def output_rows(mj_model: Any) -> NDArray[np.int64]:
    """Return the row of each actuator (k,) in ``actuator_gear`` and other arrays of outputs."""
    # Older releases have one output, and one control, per actuator.
    return getattr(mj_model, "actuator_outadr", np.arange(mj_model.nu))


def gear_ratio(mj_model: Any, actuator: int) -> float:
    """Return the gear ratio of an actuator (id) on a hinge, slide or tendon."""
    return mj_model.actuator_gear[output_rows(mj_model)[actuator], 0]


def actuators_on(
    mj_model: Any, target: int, kinds: Sequence[int] = AT_JOINT
) -> list[int]:
    """Return the ids of the actuators that act on a joint (id) directly.

    ``kinds``: other types of transmission; ``AT_TENDON`` where the id is a tendon's.
    """
    is_of_kind = np.isin(mj_model.actuator_trntype, kinds)
    is_on_target = mj_model.actuator_trnid[:, 0] == target
    return np.flatnonzero(is_of_kind & is_on_target).tolist()


def driven_joints(mj_model: Any) -> set[int]:
    """Return the ids of joints that an actuator moves, directly or by a fixed tendon."""
    is_driven = np.any(_transmissions(mj_model), axis=0)
    return set(mj_model.dof_jntid[is_driven].tolist())


def _transmissions(mj_model: Any) -> Array:
    """Return each actuator's speed before its gear per speed of each joint (k, nv).

    It is zero for all joints where an actuator acts neither on a joint nor on a fixed tendon, or
    is none that anyone commands.
    """
    kinds = mj_model.actuator_trntype.tolist()
    transmissions = np.zeros((len(kinds), mj_model.nv))
    targets = mj_model.actuator_trnid[:, 0].tolist()
    for ratios, kind, target in zip(transmissions, kinds, targets):
        if kind in AT_JOINT:
            ratios[mj_model.jnt_dofadr[target]] = 1.0
        elif kind in AT_TENDON:
            ratios[:] = tendon_coefficients(mj_model, target)
    # A motor that cogs is driven, too.
    transmissions[acts_by_itself(mj_model) & ~cogs(mj_model)] = 0.0
    return transmissions


def tendon_coefficients(mj_model: Any, tendon: int) -> Array:
    """Return a fixed tendon's (id) speed per speed of each joint (nv,); zeros of another one."""
    first = mj_model.tendon_adr[tendon]
    # The joints, sites or geoms that the tendon runs over; a fixed one has joints alone.
    wraps = slice(first, first + mj_model.tendon_num[tendon])
    coefficients = np.zeros(mj_model.nv)
    if np.all(mj_model.wrap_type[wraps] == _WRAPS_JOINT):
        addresses = mj_model.jnt_dofadr[mj_model.wrap_objid[wraps]]
        np.add.at(coefficients, addresses, mj_model.wrap_prm[wraps])
    return coefficients


def torque_limits(mj_model: Any, joints: tuple[int, ...]) -> Array:
    """Return the torque (n,) that each joint (id) can make either way [N m or N].

    It is infinite without limit. Where actuators drive a joint one way only, it is their torque.
    """
    # Smallest and largest torque of each degree of freedom.
    torques = np.zeros((mj_model.nv, 2))
    for ratios, forces in zip(_transmissions(mj_model), output_ranges(mj_model)):
        for dof in np.flatnonzero(ratios):
            torques[dof] += np.sort(ratios[dof] * forces)
    limits = []
    for joint in joints:
        torque = torques[mj_model.jnt_dofadr[joint]]
        if not np.any(torque):  # nothing drives it, as far as the model says
            torque = np.array([-np.inf, np.inf])
        if mj_model.jnt_actfrclimited[joint]:
            torque = np.clip(torque, *mj_model.jnt_actfrcrange[joint])
        one_way, other_way = np.sort([-torque[0], torque[1]])
        limit = one_way if one_way > 0.0 else other_way
        limits.append(limit if limit > 0.0 else np.inf)
    return np.array(limits)


def output_ranges(mj_model: Any) -> Array:
    """Return the smallest and largest force of each actuator behind its gear (k, 2) [N m or N].

    MuJoCo computes it, at rest, with all controls at their ends; errors of servos have none. It is
    infinite where a control without end moves it without end.
    """
    outputs = output_rows(mj_model)
    gears = mj_model.actuator_gear[outputs, 0]
    by_speed = -mj_model.actuator_biasprm[:, 2]
    gain = mj_model.actuator_gainprm[:, 0]
    kinds = mj_model.actuator_gaintype
    is_speed_servo = (by_speed == gain) & (gain != 0.0) | (kinds == _PID_GAIN)
    # A gain that changes with the length makes no servo.
    is_position_servo = kinds != _AFFINE_GAIN
    data = mujoco.MjData(mj_model)
    forces = []
    for end in (-_ENDLESS, _ENDLESS):
        data.ctrl[:] = end
        data.actuator_length[outputs] = -end * is_position_servo
        data.actuator_velocity[outputs] = -end * is_speed_servo
        _settle(mj_model, data)
        mujoco.mj_fwdActuation(mj_model, data)
        forces.append(gears * data.actuator_force[outputs])
    ranges = np.sort(np.transpose(forces), axis=1)
    is_endless = np.abs(ranges) > _LEAST_GAIN * _ENDLESS
    return np.where(is_endless, np.copysign(np.inf, ranges), ranges)


def _settle(mj_model: Any, data: Any) -> None:
    """Set the activations of actuators to what they come to under the controls in ``data``.

    A filter's rate falls in proportion to its activation; that of an integrator never does.
    """
    rates = []
    for activation in (0.0, 1.0):
        data.act[:] = activation
        mujoco.mj_fwdActuation(mj_model, data)
        rates.append(data.act_dot.copy())
    fall = rates[0] - rates[1]
    falls = fall > 0.0
    settled = rates[0] / np.where(falls, fall, 1.0)
    data.act[:] = np.where(falls, settled, _ENDLESS * np.sign(rates[0]))
    limited = np.flatnonzero(mj_model.actuator_actlimited)
    addresses = mj_model.actuator_actadr[limited]
    ranges = mj_model.actuator_actrange[limited]
    data.act[addresses] = np.clip(data.act[addresses], *ranges.T)


def servo_gains(mj_model: Any, actuator: int) -> tuple[float, float] | None:
    """Return (kp, kv) of a position servo (id), None for another actuator.

    Its force is kp (control - length) - kv speed, without any state of its own.
    """
    bias, kp, kv = (-mj_model.actuator_biasprm[actuator, :3]).tolist()
    gain_type = int(mj_model.actuator_gaintype[actuator])
    if gain_type == _PID_GAIN:
        # MuJoCo's bit of an actuator one of whose controls is a position.
        takes_position = mj_model.actuator_ctrlspec[actuator] & 1
    else:
        gain = mj_model.actuator_gainprm[actuator, 0]
        takes_position = gain_type == _FIXED_GAIN and gain == kp
    is_servo = (
        takes_position
        and is_static(mj_model, actuator)
        and mj_model.actuator_biastype[actuator] == _AFFINE_BIAS
        and kp > 0.0
        and bias == 0.0
    )
    return (kp, kv) if is_servo else None


def is_static(mj_model: Any, actuator: int) -> bool:
    """Return whether an actuator (id) has no state of its own."""
    return mj_model.actuator_dyntype[actuator] == _NO_DYNAMICS


# Numbers of a joint or tendon that a file may state at its actuators, since MuJoCo 3.7.
_STATED = ("armature", "damping", "dampingpoly")


def with_actuators_in_joints(mj_model: Any) -> Any:
    """Return a model whose joints and tendons have the rotors and damping of their actuators.

    It takes the same torques. Numbers of its actuators stay, but act no more: all else reads rotor
    inertia and damping in one place. Without any, it is the model itself.
    """
    if not any(np.any(getattr(mj_model, f"actuator_{n}", 0.0)) for n in _STATED):
        return mj_model
    folded = copy.copy(mj_model)
    kinds = mj_model.actuator_trntype.tolist()
    targets = mj_model.actuator_trnid[:, 0].tolist()
    for actuator, (kind, target) in enumerate(zip(kinds, targets)):
        if kind in AT_JOINT:
            owner, row = "dof", mj_model.jnt_dofadr[target]
        elif kind in AT_TENDON:
            owner, row = "tendon", target
        else:
            continue
        scale = gear_ratio(mj_model, actuator) ** 2
        for name in _STATED:
            stated = getattr(mj_model, f"actuator_{name}")[actuator]
            getattr(folded, f"{owner}_{name}")[row] += scale * stated
    folded.jnt_actuatorid[:] = -1
    folded.tendon_actuatorid[:] = -1
    return folded


def names_at_actuator(mj_model: Any, actuator: int) -> set[str]:
    """Return which of "armature" and "damping" a file states at an actuator (id)."""
    names = set()
    for name in _STATED:
        numbers = getattr(mj_model, f"actuator_{name}", None)
        if numbers is not None and np.any(numbers[actuator]):
            names.add(name.replace("poly", ""))
    return names
