"""An arm behind position servos: commanded positions in, motion out.

    tau = clip(Kp (command(t - delay) - q) - kv qd, +-limit) - (D - kv) qd - friction

D is the whole damping of a joint. How much of it the servo gives (kv) shows only where it is at
its limit, so kv/D stays the model's: with kv itself kept, an arm of less damping would have none
left at the limit, and swing. A command holds
until the next one comes. A joint whose actuator the model does not have, or that has dynamics of
its own, is pulled by a spring, and has no limit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.model.chain import actuators_on
from robot_sysid.records import Array, RobotModel
from robot_sysid.simulation.playback import Inputs, Roller, interpolated, rollout_copy

NONE = -1


@dataclass(frozen=True)
class Servos:
    """What drives each chain joint, and what the joint itself is like.

    Attributes:
        stiffness: (n,) Kp [N m/rad].
        damping: (n,) D [N m s/rad].
        frictionloss: (n,) [N m].
        armature: (n,) rotor inertia [kg m^2].
        delay: by which commands act late [s].
    """

    stiffness: Array
    damping: Array
    frictionloss: Array
    armature: Array
    delay: float

    def vector(self) -> Array:
        """Return all of it as one vector (4 n + 1,), the delay last."""
        return np.concatenate(
            [np.atleast_1d(getattr(self, each.name)) for each in fields(self)]
        )

    @staticmethod
    def of(vector: Array) -> Servos:
        """Return what a vector stands for."""
        stiffness, damping, frictionloss, armature = np.split(vector[:-1], 4)
        return Servos(stiffness, damping, frictionloss, armature, float(vector[-1]))


@dataclass(frozen=True)
class Actuators:
    """The actuators of the chain joints, as the model has them, seen at the joint.

    Attributes:
        index: (n,) MuJoCo ids, ``NONE`` for none that a rollout can use.
        gear: (n,) gear ratios.
        stiffness, damping: (n,) Kp and kv of position actuators; NaN for other kinds.
        limit: (n,) largest torque, infinite where the model names none [N m].
        share: (n,) part of the joint's whole damping that the servo gives, between 0 and 1.
    """

    index: NDArray[np.int64]
    gear: Array
    stiffness: Array
    damping: Array
    limit: Array
    share: Array


def actuators_of(robot: RobotModel) -> Actuators:
    """Return what drives the chain; of several on a joint, the first that is a position servo."""
    found = [_of_joint(robot.mj_model, int(joint)) for joint in _joints(robot)]
    index, gear, stiffness, damping, limit = map(np.array, zip(*found))
    limit = np.minimum(limit, robot.limits.torque)
    kv = np.nan_to_num(damping)
    share = kv / np.maximum(kv + robot.mj_model.dof_damping[robot.dof_index], 1e-300)
    return Actuators(index.astype(np.int64), gear, stiffness, damping, limit, share)


def _joints(robot: RobotModel) -> NDArray[np.int64]:
    return np.asarray(robot.mj_model.dof_jntid[robot.dof_index])


def _of_joint(model: Any, joint: int) -> tuple[int, float, float, float, float]:
    """Return (id, gear, Kp, kv, limit) of what drives a joint."""
    own = [
        a
        for a in actuators_on(model, joint)
        if int(model.actuator_dyntype[a]) == int(mujoco.mjtDyn.mjDYN_NONE)
        and model.actuator_gear[a, 0] != 0.0
    ]
    own.sort(key=lambda a: not _is_position(model, a))
    if not own:
        return NONE, 1.0, np.nan, np.nan, np.inf
    first = own[0]
    gear = float(model.actuator_gear[first, 0])
    limit = np.inf
    if model.actuator_forcelimited[first]:
        limit = abs(gear) * float(np.max(np.abs(model.actuator_forcerange[first])))
    if not _is_position(model, first):
        return first, gear, np.nan, np.nan, limit
    kp = model.actuator_gainprm[first, 0]
    kv = -model.actuator_biasprm[first, 2]
    return first, gear, float(gear**2 * kp), float(gear**2 * kv), limit


def _is_position(model: Any, actuator: int) -> bool:
    """Tell whether an actuator's force is Kp (control - length) - kv speed."""
    kp = model.actuator_gainprm[actuator, 0]
    bias = model.actuator_biasprm[actuator, :2]
    fixed = int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    affine = int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    return bool(fixed and affine and kp > 0.0 and bias[0] == 0.0 and bias[1] == -kp)


def model_servos(robot: RobotModel) -> Servos:
    """Return the model's own numbers, never late; gains are NaN where it has no position servo."""
    model = robot.mj_model
    dofs = robot.dof_index
    actuators = actuators_of(robot)
    damping = model.dof_damping[dofs] + np.nan_to_num(actuators.damping)
    rest = model.dof_frictionloss[dofs], model.dof_armature[dofs]
    return Servos(actuators.stiffness, damping, *rest, 0.0)


def servo_copy(robot: RobotModel, timestep: float) -> Any:
    """Return a copy of an arm's model whose actuators do nothing yet, to be rolled out."""
    model = rollout_copy(robot, timestep)
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    model.actuator_gaintype[:] = int(mujoco.mjtGain.mjGAIN_FIXED)
    model.actuator_biastype[:] = int(mujoco.mjtBias.mjBIAS_AFFINE)
    model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0.0
    model.actuator_ctrllimited[:] = 0
    if hasattr(model, "actuator_delay"):
        # Releases whose actuators can act late; the delay is in the commands of a window already.
        model.actuator_delay[:] = 0.0
    return model


def set_servos(model: Any, robot: RobotModel, servos: Servos) -> None:
    """Give a ``servo_copy`` these servos and joints; whatever it had before is gone."""
    dofs = robot.dof_index
    actuators = actuators_of(robot)
    model.dof_armature[dofs] = servos.armature
    model.dof_frictionloss[dofs] = servos.frictionloss
    kv = actuators.share * servos.damping
    driven = actuators.index != NONE
    model.dof_damping[dofs] = servos.damping - kv
    at = actuators.index[driven]
    model.actuator_gear[at] = 0.0
    model.actuator_gear[at, 0] = 1.0
    model.actuator_gainprm[at, 0] = servos.stiffness[driven]
    model.actuator_biasprm[at, 1] = -servos.stiffness[driven]
    model.actuator_biasprm[at, 2] = -kv[driven]
    limit = actuators.limit[driven]
    model.actuator_forcelimited[at] = np.isfinite(limit)
    model.actuator_forcerange[at] = np.column_stack((-limit, limit))
    sprung = _joints(robot)[~driven]
    model.jnt_stiffness[sprung] = (
        robot.mj_model.jnt_stiffness[sprung] + servos.stiffness[~driven]
    )


@dataclass(frozen=True)
class Window:
    """Where a rollout starts [s], in which state (n,), and the commands that drive it: when each
    was given (N,) [s], and what was asked (N, n) [rad].
    """

    start: float
    q: Array
    qd: Array
    time: Array
    command: Array

    def controls(self, delay: float, edges: Array) -> Array:
        """Return (S, n) the mean commanded position of each step between S + 1 edges [s]."""
        times = self.start + edges - delay
        step = np.diff(self.time, append=self.time[-1] + 1.0)[:, None]
        summed = np.vstack(
            (np.zeros_like(self.q), np.cumsum(self.command * step, axis=0))
        )
        knots = np.append(self.time, self.time[-1] + 1.0)
        values = (
            interpolated(times, knots, summed)
            + np.minimum(times - self.time[0], 0.0)[:, None] * self.command[0]
        )
        return np.asarray(np.diff(values, axis=0) / np.diff(edges)[:, None])


class ServoRollouts:
    """Rollouts of an arm behind servos; one copy of its model, which meshes make large, for all."""

    def __init__(self, robot: RobotModel, timestep: float = 0.002) -> None:
        self.robot = robot
        self._roller = Roller(robot, servo_copy(robot, timestep))

    def played(
        self, choices: Sequence[Servos], windows: Sequence[Window], edges: Array
    ) -> Iterator[Array]:
        """Yield positions (W, S + 1, n) of each choice of servos in W windows of one length, whose
        steps have these edges (S + 1,) from the start of a window [s].
        """
        robot = self.robot
        model = self._roller.model
        model.opt.timestep = edges[1] - edges[0]
        q, qd = (np.stack([getattr(w, name) for w in windows]) for name in ("q", "qd"))
        delays = {servos.delay for servos in choices}
        commanded = {
            d: np.stack([w.controls(d, edges) for w in windows]) for d in delays
        }
        index = actuators_of(robot).index
        driven = index != NONE
        rest = np.array(robot.mj_model.qpos_spring[robot.qpos_index])
        for servos in choices:
            set_servos(model, robot, servos)
            control = commanded[servos.delay]
            given = np.zeros((*control.shape[:2], model.nu))
            given[:, :, index[driven]] = control[:, :, driven]
            torque = servos.stiffness * ~driven * (control - rest)
            yield np.concatenate(
                (q[:, None], self._roller(Inputs(q, qd, torque, given))), axis=1
            )
