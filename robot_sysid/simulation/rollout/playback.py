"""Pieces of a log played by a model: under the measured torques, and with a servo beside them.

Open loop: the model starts where the arm was and gets the torques that were measured. Closed loop:
it gets them too, and a servo pulls it towards the measured motion,

    tau = tau_measured + Kp (q_measured - q) + Kd (qd_measured - qd),

so that a perfect model makes no error in either, and a wrong one an error that does not run away.
The servo acts as a spring and a damper of the joint, whose rest position is where the arm was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_sysid.records import Array, RobotModel
from robot_sysid.signals.process import ProcessedSignals
from robot_sysid.simulation.rollout.batch import Inputs, roll, rollout_copy

STEP = 0.002
"""Time step of the rollouts [s]."""
SERVO_RATE = 2.0
"""Bandwidth of the servo of the closed loop [Hz], critically damped."""
MOST_WINDOWS = 60
"""Windows of one horizon that are played, spread evenly over the pieces."""
RAN_AWAY = {False: np.pi, True: 1.0}
"""Largest position error that counts: hinge [rad], slide [m]."""


@dataclass(frozen=True)
class Piece:
    """A stretch of a log, all of it low-passed.

    Attributes:
        time: (N,) [s].
        q, qd, tau: (N, n) [rad, rad/s, N m].
    """

    time: Array
    q: Array
    qd: Array
    tau: Array

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Return (q, qd, tau) (..., n) at some times (...)."""
        return tuple(  # type: ignore[return-value]
            np.stack([np.interp(time, self.time, column) for column in values.T], axis=-1)
            for values in (self.q, self.qd, self.tau)
        )


@dataclass(frozen=True)
class Servo:
    """Gains (n,) of what holds the model near the measured motion [N m/rad, N m s/rad]."""

    stiffness: Array
    damping: Array


def pieces_of_signals(signals: ProcessedSignals, first: float = -np.inf) -> list[Piece]:
    """Return what can be played of a processed log from a time [s] on, cut at its long holes."""
    half = signals.low_pass.half_width
    inner = slice(half, len(signals) - half)
    time, bridged = signals.time[inner], signals.bridged[inner]
    tau = signals.low_pass.filtered(signals.tau)
    usable = np.flatnonzero((time >= first) & ~bridged)
    runs = np.split(usable, np.flatnonzero(np.diff(usable) > 1) + 1)
    q, qd = signals.q[inner], signals.qd[inner]
    return [Piece(time[run], q[run], qd[run], tau[run]) for run in runs if len(run) > 1]


def stated_servo(robots: Sequence[RobotModel], pieces: Sequence[Piece]) -> Servo:
    """Return the servo for some models of one arm: for the largest inertia that one of them has."""
    from robot_sysid.simulation.forward_dynamics import ForwardPlant

    q = np.concatenate([piece.q[:: max(1, len(piece.q) // 10)] for piece in pieces])
    largest = np.zeros(q.shape[1])
    for robot in robots:
        plant = ForwardPlant(robot, STEP, q[:1])
        for each in q:
            plant.reset(each, np.zeros_like(each))
            units = np.eye(len(each))
            mass = np.array([plant.times_mass(unit) @ unit for unit in units])
            largest = np.maximum(largest, mass)
    rate = 2.0 * np.pi * SERVO_RATE
    return Servo(largest * rate**2, 2.0 * largest * rate)


def starts(pieces: Sequence[Piece], horizon: float) -> list[tuple[Piece, float]]:
    """Return where windows of a length [s] begin, one after the other in each piece."""
    found = [
        (piece, float(piece.time[0] + number * horizon))
        for piece in pieces
        for number in range(int((piece.time[-1] - piece.time[0]) / horizon + 1e-9))
    ]
    keep = np.linspace(0, len(found) - 1, min(len(found), MOST_WINDOWS)).round().astype(int)
    return [found[k] for k in keep]


def played(
    robot: RobotModel, windows: Sequence[tuple[Piece, float]], horizon: float, servo: Servo | None
) -> tuple[Array, int]:
    """Return the position error of a model in windows of a log.

    Args:
        robot: the model.
        windows: pieces, and where in them the windows begin [s].
        horizon: length of the windows [s].
        servo: of the closed loop; None for the open one.

    Returns:
        (root mean square error over all windows (n,) [rad or m], how many windows ran away).
    """
    steps = max(1, round(horizon / STEP))
    model = rollout_copy(robot, horizon / steps)
    grid = np.arange(steps + 1) * model.opt.timestep
    reference = np.stack([piece.at(start + grid)[:2] for piece, start in windows])
    middle = 0.5 * (grid[1:] + grid[:-1])
    torque = np.stack([piece.at(start + middle)[2] for piece, start in windows])
    q, qd = reference[:, 0], reference[:, 1]
    if servo is not None:
        rest = _install(robot, model, servo)
        torque = torque + servo.stiffness * (q[:, :-1] - rest) + servo.damping * qd[:, 1:]
    found = roll(robot, [model] * len(windows), Inputs(q[:, 0], qd[:, 0], torque))
    most = np.array([RAN_AWAY[bool(slide)] for slide in robot.is_slide])
    error = np.abs(found - q[:, 1:])
    away = ~np.all(error < most, axis=(1, 2))
    error = np.where(error < most, error, most)
    return np.sqrt(np.mean(error**2, axis=(0, 1))), int(np.count_nonzero(away))


def _install(robot: RobotModel, model: Any, servo: Servo) -> Array:
    """Give the chain's joints the servo's gains; returns (n,) where their springs rest."""
    model.jnt_stiffness[model.dof_jntid[robot.dof_index]] += servo.stiffness
    model.dof_damping[robot.dof_index] += servo.damping
    return np.array(model.qpos_spring[robot.qpos_index])
