"""Rollouts: torques or commands in, motion out; pieces of a log played by a model.

The model is the file's own: links, rotor inertia, springs, damping and MuJoCo's ``frictionloss`` as
written. As in ``forward_dynamics`` joints outside the chain are held, and contacts, joint stops,
equalities and gravity compensation do not act. The integrator is MuJoCo's implicit one without
derivatives of forces between bodies, which is stable under any damping. ``mujoco.rollout`` does the
steps on all processors where the installed release has it with several models at a time; older ones
step in Python.

Open loop: the model starts where the arm was and gets the torques that were measured. Closed loop:
it gets them too, and a servo pulls it towards the measured motion,

    tau = tau_measured + Kp (q_measured - q) + Kd (qd_measured - qd),

so that a perfect model makes no error in either, and a wrong one an error that does not run away.
The servo acts as a spring and a damper of the joint, whose rest position is where the arm was.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from robot_sysid.model.compilation import captured_warnings
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.options import processors
from robot_sysid.signals.process import ProcessedSignals
from robot_sysid.simulation.forward_dynamics import forward_copy, placed

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


def rollout_copy(robot: RobotModel, timestep: float) -> Any:
    """Return a copy of an arm's compiled model that is set up to be rolled out."""
    model = forward_copy(robot)
    model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    model.opt.timestep = timestep
    model.opt.tolerance = 1e-8
    # A rollout that diverges must not go on from the start; a chain has no islands to be found.
    for name in ("AUTORESET", "ISLAND"):
        model.opt.disableflags |= int(
            getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}", 0)
        )
    if not model.ntendon:
        # Nothing asks where a geom is: what lies at its body's origin is not worked out.
        model.geom_sameframe[:] = 1
    return model


class Roller:
    """Rolls a ``rollout_copy``, whose numbers may change from call to call, out from many starts at
    a time, on all processors where MuJoCo can.
    """

    def __init__(self, robot: RobotModel, model: Any) -> None:
        self._robot = robot
        self.model = model
        self._pool: Any = None
        threads = processors() if _has_threads() else 1
        self._data = [mujoco.MjData(model) for _ in range(threads)]
        if _has_threads():
            from mujoco import rollout

            self._pool = rollout.Rollout(nthread=threads if threads > 1 else 0)

    def __call__(self, inputs: Inputs) -> Array:
        """Return chain positions (B, S, n) after each step; NaN from where a rollout diverged."""
        with captured_warnings():
            q = self._stepped(inputs) if self._pool is None else self._threaded(inputs)
        q[np.logical_or.accumulate(~np.all(np.isfinite(q), axis=2), axis=1)] = np.nan
        return q

    def _threaded(self, inputs: Inputs) -> Array:
        robot = self._robot
        model = self.model
        data = self._data
        starts = np.empty((len(inputs.q), mujoco.mj_stateSize(model, _FULL)))
        for start, q, qd in zip(starts, inputs.q, inputs.qd):
            placed(robot, model, data[0], q, qd)
            mujoco.mj_getState(model, data[0], start, _FULL)
        given = np.zeros(
            (*inputs.torque.shape[:2], mujoco.mj_stateSize(model, _INPUTS))
        )
        given[:, :, model.nu + robot.dof_index] = inputs.torque
        if inputs.control is not None:
            given[:, :, : model.nu] = inputs.control
        models = [model] * len(starts)
        states, _ = self._pool.rollout(
            models, data, starts, given, control_spec=_INPUTS
        )
        q = np.array(states[:, :, 1 + robot.qpos_index])
        # A rollout that diverges stands still from there, its clock too.
        expected = model.opt.timestep * np.arange(1, q.shape[1] + 1)
        q[states[:, :, 0] < expected - 0.5 * model.opt.timestep] = np.nan
        return q

    def _stepped(self, inputs: Inputs) -> Array:
        """Do what ``mujoco.rollout`` does, step by step."""
        robot = self._robot
        model = self.model
        data = self._data[0]
        q: Array = np.full(inputs.torque.shape, math.nan)
        for row, steps in enumerate(inputs.torque):
            placed(robot, model, data, inputs.q[row], inputs.qd[row])
            for step, torque in enumerate(steps):
                data.qfrc_applied[robot.dof_index] = torque
                if inputs.control is not None:
                    data.ctrl[:] = inputs.control[row, step]
                mujoco.mj_step(model, data)
                if any(warning.number for warning in data.warning):
                    break
                q[row, step] = data.qpos[robot.qpos_index]
        return q


def _has_threads() -> bool:
    try:
        from mujoco import rollout
    except ImportError:
        return False
    return hasattr(rollout, "Rollout")


STEP = 0.002
"""Time step of the rollouts [s]."""
SERVO_RATE = 2.0
"""Bandwidth of the servo of the closed loop [Hz], critically damped."""
MOST_WINDOWS = 60
"""Windows of one horizon that are played, spread evenly over the pieces."""
RAN_AWAY = {False: np.pi, True: 1.0}
"""Largest position error that counts: hinge [rad], slide [m]."""


@dataclass(frozen=True)
class Servo:
    """Gains (n,) of what holds the model near the measured motion [N m/rad, N m s/rad]."""

    stiffness: Array
    damping: Array


def pieces_of_signals(
    signals: ProcessedSignals, first: float = -np.inf
) -> list[Measurement]:
    """Return what can be played, low-passed, of a log from a time [s] on, cut at its long holes."""
    half = signals.low_pass.half_width
    inner = slice(half, len(signals) - half)
    time = signals.time[inner]
    bridged = signals.bridged[inner]
    tau = signals.low_pass.filter(signals.tau)
    usable = np.flatnonzero((time >= first) & ~bridged)
    runs = np.split(usable, np.flatnonzero(np.diff(usable) > 1) + 1)
    q = signals.q[inner]
    qd = signals.qd[inner]
    return [
        Measurement(time[run], q[run], qd[run], tau[run])
        for run in runs
        if len(run) > 1
    ]


def stated_servo(robots: Sequence[RobotModel], pieces: Sequence[Measurement]) -> Servo:
    """Return the servo for some models of one arm: for the largest inertia that one of them has."""
    q = np.concatenate([piece.q[:: max(1, len(piece.q) // 10)] for piece in pieces])
    largest = np.zeros(q.shape[1])
    for robot in robots:
        model = forward_copy(robot)
        data = mujoco.MjData(model)
        mass_column = np.empty(model.nv)
        for positions in q:
            placed(robot, model, data, positions, np.zeros_like(positions))
            mujoco.mj_forward(model, data)
            for joint, dof in enumerate(robot.dof_index):
                mujoco.mj_mulM(model, data, mass_column, np.eye(model.nv)[dof])
                largest[joint] = max(largest[joint], mass_column[dof])
    rate = 2.0 * np.pi * SERVO_RATE
    return Servo(largest * rate**2, 2.0 * largest * rate)


Start = tuple[Measurement, float]
"""A piece, and when a window of it begins [s]."""


def starts(pieces: Sequence[Measurement], horizon: float) -> list[Start]:
    """Return where windows of a length [s] begin, one after the other in each piece."""
    found = [
        (piece, float(piece.time[0] + number * horizon))
        for piece in pieces
        for number in range(int((piece.time[-1] - piece.time[0]) / horizon + 1e-9))
    ]
    keep = (
        np.linspace(0, len(found) - 1, min(len(found), MOST_WINDOWS))
        .round()
        .astype(int)
    )
    return [found[k] for k in keep]


def interpolated(
    at: Array | float, time: Array, values: Array, outside: float | None = None
) -> Array:
    """Return values (N, n) at other times (K,) or one, ``outside`` or those at the ends beyond."""
    return np.stack(
        [np.interp(at, time, column, outside, outside) for column in values.T], axis=-1
    )


def played(
    robot: RobotModel, windows: Sequence[Start], horizon: float, servo: Servo | None
) -> tuple[Array, int]:
    """Return the position error of a model in windows of a log that are ``horizon`` [s] long: root
    mean square over all windows (n,) [rad or m], and how many ran away; open loop without a servo.
    """
    steps = max(1, round(horizon / STEP))
    model = rollout_copy(robot, horizon / steps)
    grid = np.arange(steps + 1) * model.opt.timestep
    middle = 0.5 * (grid[1:] + grid[:-1])
    q, qd, torque = (
        np.stack(
            [interpolated(at + start, p.time, getattr(p, name)) for p, start in windows]
        )
        for name, at in (("q", grid), ("qd", grid), ("tau", middle))
    )
    if servo is not None:
        model.jnt_stiffness[model.dof_jntid[robot.dof_index]] += servo.stiffness
        model.dof_damping[robot.dof_index] += servo.damping
        rest = np.array(model.qpos_spring[robot.qpos_index])
        torque = (
            torque + servo.stiffness * (q[:, :-1] - rest) + servo.damping * qd[:, 1:]
        )
    found = Roller(robot, model)(Inputs(q[:, 0], qd[:, 0], torque))
    most = np.array([RAN_AWAY[bool(slide)] for slide in robot.is_slide])
    error = np.abs(found - q[:, 1:])
    away = ~np.all(error < most, axis=(1, 2))
    error = np.where(error < most, error, most)
    return np.sqrt(np.mean(error**2, axis=(0, 1))), int(np.count_nonzero(away))
