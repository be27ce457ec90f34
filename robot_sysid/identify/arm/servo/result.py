"""From a fit of servos to what is told and written of each joint."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from robot_sysid.identify.arm.model_friction import PROVEN
from robot_sysid.identify.arm.servo.commands import MOST_PERIODS
from robot_sysid.identify.arm.servo.fit import ServoFit
from robot_sysid.identify.arm.servo.problem import Scale
from robot_sysid.mjcf.changes import ActuatorChange, JointChange
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.whole_arm import JointServo, ServoIdentification
from robot_sysid.simulation.rollout.servo import Actuators, actuators_of

NAMES = ("gain", "damping", "frictionloss", "armature")
"""What is found of a joint, in the order of ``Servos``."""
OFTEN = 0.2
"""Share of time at its limit from which on a servo's gain is hardly seen."""
SHORTEST_STEP = 5e-4
"""Time step down to which a written delay is kept [s]; MuJoCo shortens it below."""
UNSURE = 0.1
"""Relative error of a gain from which on only ratios are seen."""


def joint_servos(
    robot: RobotModel, actuators: Actuators, start: Scale, fit: ServoFit, limited: Array
) -> tuple[JointServo, ...]:
    """Return what was found of each joint."""
    model, dofs, n = robot.mj_model, robot.dof_index, robot.n_joints
    damping = model.dof_damping[dofs] + np.nan_to_num(actuators.damping)
    before = (actuators.stiffness, damping, model.dof_frictionloss[dofs], model.dof_armature[dofs])
    after, errors = (s.vector()[:-1].reshape(4, n) for s in (fit.servos, fit.errors))
    shares, moves = fit.share[:-1].reshape(4, n), start.free[:n]

    def named(values: Any, joint: int) -> dict[str, float]:
        return dict(zip(NAMES, np.array(values)[:, joint].tolist()))

    return tuple(
        JointServo(
            name,
            named(before, k),
            named(after, k),
            named(errors, k),
            named(shares, k),
            bool(moves[k]),
            bool(np.isfinite(actuators.stiffness[k])),
            float(limited[k]),
        )
        for k, name in enumerate(robot.joint_names)
    )


def changes(
    robot: RobotModel, joints: Sequence[JointServo], delay: float | None = None
) -> tuple[list[JointChange], list[ActuatorChange]]:
    """Return what the joints and the position actuators of the model get.

    Args:
        robot: the arm.
        joints: what was found of them.
        delay: by which the actuators are to act late [s]; None leaves the model's.
    """
    actuators, found, servos = actuators_of(robot), [], []
    late = () if delay is None else (delay, _remembered(delay, robot.mj_model.opt.timestep))
    for k, joint in enumerate(joints):
        if not joint.moves:
            continue
        after = joint.after
        kv = float(actuators.share[k]) * after["damping"]
        damping = after["damping"] - kv
        if joint.has_servo:
            gear = float(actuators.gear[k]) ** 2
            gains = after["gain"] / gear, kv / gear
            servos.append(ActuatorChange(int(actuators.index[k]), *gains, *late))
        found.append(JointChange(joint.joint, after["armature"], damping, after["frictionloss"]))
    return found, servos


def _remembered(delay: float, timestep: float) -> int:
    """Return how many commands an actuator has to remember, at shorter time steps too."""
    return math.ceil(delay / min(timestep, SHORTEST_STEP)) + 2


def delay_to_write(
    robot: RobotModel, found: ServoIdentification, wanted: bool
) -> tuple[float | None, tuple[str, ...]]:
    """Return the delay that the model gets [s], None for its own, and what there is to say."""
    if not wanted:
        return None, ()
    if not any(joint.moves and joint.has_servo for joint in found.joints):
        return None, ("the model has no position actuator that could hold the delay",)
    if found.delay < PROVEN * found.delay_error:
        return None, ("the delay is not proven: the model's actuators keep theirs",)
    return found.delay, (
        f"the actuators of the written model act {1e3 * found.delay:.3g} ms late, also after each "
        "reset, when they hold the command 0 that long unless mj_initCtrlHistory gives them "
        "another; simulators other than MuJoCo may not read it",
    )


def servo_notes(
    robot: RobotModel, actuators: Actuators, found: ServoIdentification, period: float
) -> Iterator[str]:
    """Yield a sentence on each thing that the numbers do not say."""
    yield (
        "damping is that of joint and servo together, which look alike: the servo keeps the share "
        "of it that it has in the model"
    )
    if found.delay > 0.95 * MOST_PERIODS * period:
        yield (
            f"the delay is at the end of what is sought ({MOST_PERIODS} samples): check the time "
            "stamps of the commands"
        )
    for joint, limit in zip(found.joints, actuators.limit):
        if not joint.moves:
            yield f"{joint.joint} does not move in these logs: it keeps the model's numbers"
            continue
        if joint.at_limit > OFTEN:
            yield (
                f"the servo of {joint.joint} asks for more than its limit of {limit:.3g} N·m (the "
                f"model's) in {100.0 * joint.at_limit:.0f} % of the time: its gain is then hardly "
                "seen, and its limit matters"
            )
        if joint.errors["gain"] > UNSURE * joint.after["gain"]:
            yield (
                f"these logs hardly show the absolute size of gain, friction and rotor inertia of "
                f"{joint.joint}, only their ratios (gravity and the links' inertia would); the "
                "size stays near where the search began"
            )
        if not joint.has_servo:
            yield (
                f"the model has no position actuator on {joint.joint}: its gain of "
                f"{joint.after['gain']:.4g} N·m/rad is told, not written"
            )
