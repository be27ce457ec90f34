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

from robot_sysid.records import Array

_AT_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
"""MuJoCo's types of transmission by which an actuator acts on a joint directly."""
_AT_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
"""MuJoCo's type of transmission by which an actuator pulls a tendon."""
_WRAPS_JOINT = int(mujoco.mjtWrap.mjWRAP_JOINT)
"""MuJoCo's type of a joint that a tendon runs over."""
_UNLIMITED = np.array([-np.inf, np.inf])
"""Interval of a force or control without limits."""


def _type_number(name: str) -> int | None:
    """Return MuJoCo's number for a type such as "mjGAIN_PID"; None if this release has none."""
    types = {"mjGAIN": mujoco.mjtGain, "mjBIAS": mujoco.mjtBias, "mjDYN": mujoco.mjtDyn}
    value = getattr(types[name.split("_")[0]], name, None)
    return None if value is None else int(value)


_FIXED_GAIN = _type_number("mjGAIN_FIXED")
_AFFINE_GAIN = _type_number("mjGAIN_AFFINE")
_DCMOTOR_GAIN = _type_number("mjGAIN_DCMOTOR")
_PID_GAIN = _type_number("mjGAIN_PID")
_NO_BIAS = _type_number("mjBIAS_NONE")
_AFFINE_BIAS = _type_number("mjBIAS_AFFINE")
_NO_DYNAMICS = _type_number("mjDYN_NONE")
_SETTLING = (
    _NO_DYNAMICS,
    _type_number("mjDYN_FILTER"),
    _type_number("mjDYN_FILTEREXACT"),
)
"""Dynamics whose activation comes to the control."""
# MuJoCo's bits for the inputs of an actuator with several.
_POSITION = 1
_SPEED = 2
_FEEDFORWARD = 4
_VOLTAGE = 8


def control_rows(mj_model: Any, actuator: int) -> NDArray[np.int64]:
    """Return the rows of an actuator's (id) controls in ``ctrl`` and ``actuator_ctrlrange``."""
    if not hasattr(mj_model, "actuator_ctrladr"):
        return np.array([actuator])
    first = int(mj_model.actuator_ctrladr[actuator])
    return np.arange(first, first + int(mj_model.actuator_ctrlnum[actuator]))


def output_row(mj_model: Any, actuator: int) -> int:
    """Return the row of an actuator (id) in ``actuator_gear`` and other arrays of outputs."""
    if not hasattr(mj_model, "actuator_outadr"):
        return actuator
    return int(mj_model.actuator_outadr[actuator])


def gear_ratio(mj_model: Any, actuator: int) -> float:
    """Return the gear ratio of an actuator (id) on a hinge, slide or tendon."""
    return float(mj_model.actuator_gear[output_row(mj_model, actuator), 0])


def actuators_on(mj_model: Any, joint: int) -> list[int]:
    """Return the ids of the actuators that pull at a joint directly."""
    is_direct = np.isin(mj_model.actuator_trntype, _AT_JOINT)
    is_on_joint = mj_model.actuator_trnid[:, 0] == joint
    return np.flatnonzero(is_direct & is_on_joint).tolist()


def actuators_of_tendon(mj_model: Any, tendon: int) -> list[int]:
    """Return the ids of the actuators that pull at a tendon."""
    is_on_tendon = mj_model.actuator_trnid[:, 0] == tendon
    return np.flatnonzero(
        (mj_model.actuator_trntype == _AT_TENDON) & is_on_tendon
    ).tolist()


def driven_joints(mj_model: Any) -> set[int]:
    """Return the ids of joints that an actuator moves: directly, by a tendon, or by an equality
    constraint with a joint that is moved so.
    """
    joints = set[int]()
    transmissions = mj_model.actuator_trntype.tolist()
    # Ids of joints or tendons, as the type of transmission says.
    targets = mj_model.actuator_trnid[:, 0].tolist()
    for transmission, target in zip(transmissions, targets):
        if transmission in _AT_JOINT:
            joints.add(target)
        elif transmission == _AT_TENDON:
            wraps = _wraps(mj_model, target)
            is_joint = mj_model.wrap_type[wraps] == _WRAPS_JOINT
            joints.update(mj_model.wrap_objid[wraps][is_joint].tolist())
    is_coupling = mj_model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)
    pairs = np.column_stack((mj_model.eq_obj1id, mj_model.eq_obj2id))
    for pair in pairs[is_coupling].tolist():
        if joints.intersection(pair):
            joints.update(pair)
    return joints


def _wraps(mj_model: Any, tendon: int) -> slice:
    """Return the range of a tendon's (id) entries in the model's ``wrap_`` arrays.

    An entry is a joint, site or geom that the tendon runs over; a fixed tendon has joints alone.
    """
    first = int(mj_model.tendon_adr[tendon])
    return slice(first, first + int(mj_model.tendon_num[tendon]))


def tendon_coefficients(mj_model: Any, tendon: int) -> Array | None:
    """Return a fixed tendon's (id) speed per speed of each joint (nv,), of another one None."""
    wraps = _wraps(mj_model, tendon)
    if not np.all(mj_model.wrap_type[wraps] == _WRAPS_JOINT):
        return None
    coefficients = np.zeros(mj_model.nv)
    addresses = mj_model.jnt_dofadr[mj_model.wrap_objid[wraps]]
    np.add.at(coefficients, addresses, mj_model.wrap_prm[wraps])
    return coefficients


def torque_limits(mj_model: Any, joints: tuple[int, ...]) -> Array:
    """Return the torque (n,) that each joint (id) can make either way [N m or N].

    It is infinite without limit. Where actuators pull a joint one way only, it is their torque.
    """
    # Smallest and largest torque (2,) of each joint.
    ranges = []
    for joint in joints:
        forces = [output_range(mj_model, k) for k in actuators_on(mj_model, joint)]
        ranges.append(np.sum(forces, axis=0) if forces else np.zeros(2))
    dofs = mj_model.jnt_dofadr[list(joints)]
    for tendon in range(mj_model.ntendon):
        coefficients = tendon_coefficients(mj_model, tendon)
        pulling = actuators_of_tendon(mj_model, tendon)
        if coefficients is None or not pulling:
            continue
        force = np.sum([output_range(mj_model, k) for k in pulling], axis=0)
        # The first releases have no limit of a tendon's force.
        limited = getattr(mj_model, "tendon_actfrclimited", None)
        if limited is not None and limited[tendon]:
            force = np.clip(force, *mj_model.tendon_actfrcrange[tendon])
        for index, coefficient in enumerate(coefficients[dofs].tolist()):
            ranges[index] = ranges[index] + _scaled(force, coefficient)
    limits = []
    for joint, torque in zip(joints, ranges):
        if not np.any(torque):  # nothing drives it, as far as the model says
            torque = _UNLIMITED
        if mj_model.jnt_actfrclimited[joint]:
            torque = np.clip(torque, *mj_model.jnt_actfrcrange[joint])
        limits.append(_bound(torque))
    return np.array(limits)


def _bound(torque: Array) -> float:
    """Return the largest magnitude that a range (2,) allows both ways, or else one way.

    Where it allows none at all, nothing is known: it is infinite.
    """
    magnitudes = np.array([-torque[0], torque[1]])
    both_ways = float(np.min(magnitudes))
    if both_ways > 0.0:
        return both_ways
    one_way = float(np.max(magnitudes))
    return one_way if one_way > 0.0 else np.inf


def _scaled(interval: Array, factor: float) -> Array:
    """Return an interval (2,), of which ends may be infinite, times a factor."""
    return np.sort(factor * interval) if factor else np.zeros(2)


def output_range(mj_model: Any, actuator: int) -> Array:
    """Return the smallest and largest force (2,) of an actuator (id) behind its gear [N m or N].

    It is that of the joint or tendon at rest in the model's zero position.
    """
    group = int(mj_model.actuator_group[actuator])
    # Releases before 3.1 cannot switch groups of actuators off.
    disabled_groups = int(getattr(mj_model.opt, "disableactuator", 0))
    if 0 <= group < 31 and disabled_groups >> group & 1:
        return np.zeros(2)
    force = _commanded_range(mj_model, actuator)
    if mj_model.actuator_forcelimited[actuator]:
        force = np.clip(force, *mj_model.actuator_forcerange[actuator])
    return _scaled(force, gear_ratio(mj_model, actuator))


def _commanded_range(mj_model: Any, actuator: int) -> Array:
    """Return the smallest and largest force (2,) that an actuator's (id) controls ask for.

    It is unlimited for a servo, a muscle, a plugin, and a law of force that a program supplies.
    """
    gain_type = int(mj_model.actuator_gaintype[actuator])
    bias_type = int(mj_model.actuator_biastype[actuator])
    gain_parameters = mj_model.actuator_gainprm[actuator]
    bias_parameters = mj_model.actuator_biasprm[actuator]
    output = output_row(mj_model, actuator)
    length = float(mj_model.actuator_length0[output])
    if mj_model.actuator_plugin[actuator] >= 0:
        return _UNLIMITED
    if gain_type == _DCMOTOR_GAIN:
        return _dcmotor_range(mj_model, actuator)
    if gain_type == _PID_GAIN:
        has_setpoint = _inputs(mj_model, actuator) != _FEEDFORWARD
        rows = control_rows(mj_model, actuator)
        return _UNLIMITED if has_setpoint else _control_range(mj_model, rows[0])
    if gain_type not in (_FIXED_GAIN, _AFFINE_GAIN):
        return _UNLIMITED
    gain = float(gain_parameters[0])
    if gain_type == _AFFINE_GAIN:
        gain += float(gain_parameters[1]) * length
    bias = 0.0
    if bias_type == _AFFINE_BIAS:
        bias, by_length, by_speed = bias_parameters[:3].tolist()
        if by_length != 0.0 or (by_speed != 0.0 and by_speed == -gain):
            return _UNLIMITED
    elif bias_type != _NO_BIAS:
        return _UNLIMITED
    return _scaled(_input_range(mj_model, actuator), gain) + bias


def _dcmotor_range(mj_model: Any, actuator: int) -> Array:
    """Return the smallest and largest torque (2,) of a DC motor (id) that stands still.

    Its controller's torque is limited by the voltage of its supply; a voltage command is added.
    """
    parameters = mj_model.actuator_gainprm[actuator]
    torque_per_volt = float(parameters[1] / parameters[0])
    supply = float(parameters[7])
    inputs = _inputs(mj_model, actuator)
    rows = control_rows(mj_model, actuator)
    torque = np.zeros(2)
    if inputs & (_POSITION | _SPEED):
        torque = _UNLIMITED
    elif inputs & _FEEDFORWARD:
        torque = _control_range(mj_model, rows[0])
    if supply > 0.0:
        largest = torque_per_volt * supply
        torque = np.clip(torque, -largest, largest)
    if inputs & _VOLTAGE:
        voltage = _control_range(mj_model, rows[-1])
        torque = torque + _scaled(voltage, torque_per_volt)
    return torque


def _inputs(mj_model: Any, actuator: int) -> int:
    """Return the sum of MuJoCo's bits for the inputs of a DC motor or PID controller (id)."""
    inputs = 0
    if hasattr(mj_model, "actuator_ctrlspec"):
        inputs = int(mj_model.actuator_ctrlspec[actuator])
    if inputs:
        return inputs
    # Before release 3.12 a number says which of three inputs a DC motor has.
    mode = int(mj_model.actuator_gainprm[actuator, 8])
    return (_VOLTAGE, _POSITION, _SPEED)[mode]


def _control_range(mj_model: Any, row: int) -> Array:
    """Return the smallest and largest value (2,) of the control in a row of ``ctrl``."""
    is_clamped = not mj_model.opt.disableflags & int(
        mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    )
    if is_clamped and mj_model.actuator_ctrllimited[row]:
        return np.array(mj_model.actuator_ctrlrange[row])
    return _UNLIMITED


def _input_range(mj_model: Any, actuator: int) -> Array:
    """Return the smallest and largest value (2,) that an actuator's (id) gain multiplies.

    That is its control, or what its activation comes to under a constant control.
    """
    dynamics = int(mj_model.actuator_dyntype[actuator])
    rows = control_rows(mj_model, actuator)
    values = _UNLIMITED
    if dynamics in _SETTLING and len(rows):
        values = _control_range(mj_model, rows[0])
    if dynamics != _NO_DYNAMICS and mj_model.actuator_actlimited[actuator]:
        values = np.clip(values, *mj_model.actuator_actrange[actuator])
    return values


def has_own_friction(mj_model: Any, joint: int) -> bool:
    """Return whether an actuator on a joint (id) has friction, which MuJoCo's DC motors may."""
    on_joint = np.array(actuators_on(mj_model, joint), dtype=int)
    motors = on_joint[mj_model.actuator_gaintype[on_joint] == _DCMOTOR_GAIN]
    # The stiffness of the bristles of LuGre's friction; without it there is none.
    return bool(np.any(mj_model.actuator_dynprm[motors, 5]))


def servo_gains(mj_model: Any, actuator: int) -> tuple[float, float] | None:
    """Return (kp, kv) of a position servo (id), None for another actuator.

    Its force is kp (control - length) - kv speed, without any state of its own.
    """
    kp, kv = (-mj_model.actuator_biasprm[actuator, 1:3]).tolist()
    gain_type = int(mj_model.actuator_gaintype[actuator])
    if gain_type == _PID_GAIN:
        takes_position = bool(_inputs(mj_model, actuator) & _POSITION)
    else:
        gain = float(mj_model.actuator_gainprm[actuator, 0])
        takes_position = gain_type == _FIXED_GAIN and gain == kp
    is_servo = (
        takes_position
        and is_static(mj_model, actuator)
        and int(mj_model.actuator_biastype[actuator]) == _AFFINE_BIAS
        and kp > 0.0
        and mj_model.actuator_biasprm[actuator, 0] == 0.0
    )
    return (kp, kv) if is_servo else None


def is_static(mj_model: Any, actuator: int) -> bool:
    """Return whether an actuator (id) has no state of its own."""
    return int(mj_model.actuator_dyntype[actuator]) == _NO_DYNAMICS


def with_actuators_in_joints(mj_model: Any) -> Any:
    """Return a model whose joints and tendons have the rotors and damping of their actuators.

    It takes the same torques. Numbers of its actuators stay, but act no more: all else reads rotor
    inertia and damping in one place. Without any, it is the model itself; releases before 3.7 have
    none.
    """
    if not hasattr(mj_model, "actuator_armature"):
        return mj_model
    fields = ("armature", "damping", "dampingpoly")
    numbers = {name: getattr(mj_model, f"actuator_{name}") for name in fields}
    if not any(map(np.any, numbers.values())):
        return mj_model
    folded = copy.copy(mj_model)
    for actuator, transmission in enumerate(mj_model.actuator_trntype.tolist()):
        target = int(mj_model.actuator_trnid[actuator, 0])
        field_group = "tendon"
        if transmission in _AT_JOINT:
            target = int(mj_model.jnt_dofadr[target])
            field_group = "dof"
        elif transmission != _AT_TENDON:
            continue
        squared_gear = gear_ratio(mj_model, actuator) ** 2
        for name, values in numbers.items():
            getattr(folded, f"{field_group}_{name}")[target] += (
                squared_gear * values[actuator]
            )
    folded.jnt_actuatorid[:] = -1
    folded.tendon_actuatorid[:] = -1
    return folded


def stated_at_actuators(mj_model: Any, actuators: Sequence[int], name: str) -> Array:
    """Return what a file states at actuators (ids) of a number of their joint or tendon.

    ``name``: "armature", "damping", or "dampingpoly" with two numbers.
    """
    total = np.zeros(2 if name == "dampingpoly" else ())
    if not hasattr(mj_model, f"actuator_{name}"):
        return total  # releases before 3.7 have none
    stated = getattr(mj_model, f"actuator_{name}")
    for actuator in actuators:
        total = total + gear_ratio(mj_model, actuator) ** 2 * stated[actuator]
    return total
