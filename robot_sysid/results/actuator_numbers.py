"""Numbers that a file states at a joint or tendon, beside those that it states at actuators.

The fit knows a joint's rotor inertia and damping as a whole. Since MuJoCo 3.7 a file may state
parts of them at the actuators that pull at the joint.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from robot_sysid.mjcf.updated_model import ActuatorChange, ModelChange
from robot_sysid.model.actuators import (
    actuators_of_tendon,
    actuators_on,
    stated_at_actuators,
)
from robot_sysid.records import RobotModel


def beside_actuators(robot: RobotModel, change: ModelChange) -> ModelChange:
    """Return a change with the numbers of joints and tendons that the file has to state.

    Rotor inertia and damping of a joint or tendon are partly its actuators', whose numbers stay.
    Only where these alone are too large do they become smaller, and the joint's or tendon's zero.
    """
    model = robot.mj_model
    actuators = list(change.actuators)
    joints = []
    for joint in change.joints:
        dof = robot.dof_index[robot.joint_names.index(joint.label)]
        on_joint = actuators_on(model, int(model.dof_jntid[dof]))
        numbers, smaller = _numbers_beside(model, on_joint, joint.numbers)
        joint = replace(joint, numbers=numbers)
        if joint.nonlinear_damping:
            own_damping = np.array(joint.nonlinear_damping)
            rounding = 1e-12 * own_damping
            own_damping -= stated_at_actuators(model, on_joint, "dampingpoly")
            own_damping[own_damping <= rounding] = 0.0
            own = tuple(own_damping) if np.any(own_damping) else ()
            joint = replace(joint, nonlinear_damping=own)
        joints.append(joint)
        actuators += smaller
    tendons = []
    for tendon in change.tendons:
        on_tendon = actuators_of_tendon(model, tendon.tendon)
        numbers, smaller = _numbers_beside(model, on_tendon, tendon.numbers)
        tendons.append(replace(tendon, numbers=numbers))
        actuators += smaller
    return replace(
        change, joints=tuple(joints), tendons=tuple(tendons), actuators=tuple(actuators)
    )


def _numbers_beside(
    mj_model: Any, actuators: Sequence[int], numbers: Mapping[str, float]
) -> tuple[dict[str, float], list[ActuatorChange]]:
    """Return a joint's or tendon's own numbers beside its actuators', and changes of the latter.

    Args:
        mj_model: the compiled model, see ``with_actuators_in_joints``.
        actuators: ids of the actuators that pull at the joint or tendon.
        numbers: "armature", "damping" and others to their values of all of them together.
    """
    own_numbers = dict(numbers)
    changes = []
    for name in ("armature", "damping"):
        if name not in numbers:
            continue
        stated = float(stated_at_actuators(mj_model, actuators, name))
        own_numbers[name] = max(numbers[name] - stated, 0.0)
        if numbers[name] < stated:
            factor = numbers[name] / stated
            for actuator in actuators:
                number = getattr(mj_model, f"actuator_{name}")[actuator]
                smaller = {name: factor * float(number)}
                changes.append(ActuatorChange(actuator, numbers=smaller))
    return own_numbers, changes
