"""Many rollouts of an arm at a time: torques or commands in, motion out.

The model is the file's own: links, rotor inertia, springs, damping and MuJoCo's ``frictionloss`` as
written. As in ``forward_dynamics`` joints outside the chain are held, and contacts, joint stops,
equalities and gravity compensation do not act. The integrator is MuJoCo's implicit one without
derivatives of forces between bodies, which is stable under any damping.

``mujoco.rollout`` does the steps on all processors where the installed release has it with several
models at a time; older ones step in Python.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from robot_sysid.model.compilation import captured_warnings
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.options import processors
from robot_sysid.simulation.forward_dynamics import forward_copy

MOST_NUMBERS = 20_000_000
"""Numbers of state and control that are in memory at a time."""
_FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_INPUTS = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)


@dataclass(frozen=True)
class Inputs:
    """What B rollouts of S steps start from and are driven by.

    Attributes:
        q, qd: (B, n) chain state at the start [rad, rad/s].
        torque: (B, S, n) applied during each step [N m].
        control: (B, S, nu) of the model's actuators; None where they are off.
    """

    q: Array
    qd: Array
    torque: Array
    control: Array | None = None

    def part(self, rows: slice) -> Inputs:
        """Return some of the rollouts."""
        control = None if self.control is None else self.control[rows]
        return Inputs(self.q[rows], self.qd[rows], self.torque[rows], control)


def rollout_copy(robot: RobotModel, timestep: float) -> Any:
    """Return a copy of an arm's compiled model that is set up to be rolled out."""
    model = forward_copy(robot)
    model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    model.opt.timestep = timestep
    model.opt.tolerance = 1e-8
    # A rollout that diverges must not go on from the start.
    model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, "mjDSBL_AUTORESET", 0))
    return model


def roll(robot: RobotModel, models: Sequence[Any], inputs: Inputs) -> Array:
    """Return chain positions (B, S, n) after each step; NaN from where a rollout diverged.

    Args:
        robot: the arm the models are copies of.
        models: one for each rollout.
        inputs: B rollouts.
    """
    count, steps, _ = inputs.torque.shape
    size = mujoco.mj_stateSize(models[0], _FULL) + mujoco.mj_stateSize(models[0], _INPUTS)
    most = max(1, MOST_NUMBERS // max(1, size * steps))
    played = _threaded if _has_threads() else _stepped
    parts = []
    with captured_warnings():
        for first in range(0, count, most):
            rows = slice(first, first + most)
            parts.append(played(robot, models[rows], inputs.part(rows)))
    q = np.concatenate(parts)
    q[np.logical_or.accumulate(~np.all(np.isfinite(q), axis=2), axis=1)] = np.nan
    return q


def _has_threads() -> bool:
    try:
        from mujoco import rollout
    except ImportError:
        return False
    return hasattr(rollout, "Rollout")


def _threaded(robot: RobotModel, models: Sequence[Any], inputs: Inputs) -> Array:
    from mujoco import rollout

    threads = min(processors(), len(models))
    data = [mujoco.MjData(models[0]) for _ in range(threads)]
    starts = np.stack(
        [_start(robot, models[0], data[0], *pair) for pair in zip(inputs.q, inputs.qd)]
    )
    given = np.zeros((*inputs.torque.shape[:2], mujoco.mj_stateSize(models[0], _INPUTS)))
    given[:, :, models[0].nu + robot.dof_index] = inputs.torque
    if inputs.control is not None:
        given[:, :, : models[0].nu] = inputs.control
    with rollout.Rollout(nthread=threads if threads > 1 else 0) as pool:
        states, _ = pool.rollout(list(models), data, starts, given, control_spec=_INPUTS)
    q = np.array(states[:, :, 1 + robot.qpos_index])
    # A rollout that diverges stands still from there, its clock too.
    expected = models[0].opt.timestep * np.arange(1, q.shape[1] + 1)
    q[states[:, :, 0] < expected - 0.5 * models[0].opt.timestep] = np.nan
    return q


def _start(robot: RobotModel, model: Any, data: Any, q: Array, qd: Array) -> Array:
    """Return the whole state of a model whose chain is at q, qd (n,)."""
    _place(robot, model, data, q, qd)
    state = np.empty(mujoco.mj_stateSize(model, _FULL))
    mujoco.mj_getState(model, data, state, _FULL)
    return state


def _place(robot: RobotModel, model: Any, data: Any, q: Array, qd: Array) -> None:
    mujoco.mj_resetData(model, data)
    data.qpos[:] = robot.reference_qpos
    data.qpos[robot.qpos_index], data.qvel[robot.dof_index] = q, qd


def _stepped(robot: RobotModel, models: Sequence[Any], inputs: Inputs) -> Array:
    """Do what ``mujoco.rollout`` does, step by step."""
    q: Array = np.full(inputs.torque.shape, math.nan)
    for row, model in enumerate(models):
        data = mujoco.MjData(model)
        _place(robot, model, data, inputs.q[row], inputs.qd[row])
        for step in range(inputs.torque.shape[1]):
            data.qfrc_applied[robot.dof_index] = inputs.torque[row, step]
            if inputs.control is not None:
                data.ctrl[:] = inputs.control[row, step]
            mujoco.mj_step(model, data)
            if any(warning.number for warning in data.warning):
                break
            q[row, step] = data.qpos[robot.qpos_index]
    return q
