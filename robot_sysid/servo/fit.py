"""Servo gains, delay, friction and rotor inertia by output error, and how sure they are.

What is sought is the logarithm of each number over its usual size, softened so that zero is not
far away: gain, damping, friction and rotor inertia of a joint that grow together by the same factor
change little where links and gravity are small beside them, and in logarithms that is a straight
line.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import CLOSED, RolloutError, RolloutTest
from robot_sysid.results.rollout import HELD_OUT_SHARE, HORIZONS
from robot_sysid.servo.commands import MOST_PERIODS
from robot_sysid.signals.resampling import part_of, usual_period
from robot_sysid.simulation.rollout import playback
from robot_sysid.simulation.rollout.servo import Servos, Window, actuators_of, played_servos

STEP = 0.002
"""Time step of the rollouts [s], at most."""
LENGTH = 3.0
"""Length of a window [s]."""
SETTLED = 0.6
"""Beginning of a window that does not count: the state there is known from steps of the encoder."""
SMOOTHED = 0.12
"""Length of the parabolas that give the state at the start of a window [s]."""
SERVO_WORDS = "the log's commands through the model's servos, both late by the delay that was found"
GAINS = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Factors on the gains of the start that are tried beforehand; luck decides where a servo with a
larger one is at its limit all the time."""
FEW_WINDOWS = 6
"""Windows that are enough for that."""
MOST_ROUNDS = 8
WIDEST = 100.0
"""How many times its usual size a number may be."""
SOFT = 0.3
"""Part of its usual size below which steps are no longer shares of a number: zero can be left."""
PULL = 2.5
"""Standard deviation of a weak pull of each unknown towards the start: a factor of twelve."""
LINKS_WRONG = 0.02
"""How far masses and inertias of the links, which are trusted, may be off."""
UNEXPLAINED = 0.005
"""Part of a joint's torque that a model of servo and friction does not explain at best."""
LEAST_SHARE = 0.1
"""Share of the links in a joint's torque below which only the ratios of its numbers are seen."""
_UNKNOWN_RATE = 20.0
"""Bandwidth of a servo of which nothing is known [rad/s]."""
# A servo that is at its limit again and again makes rollouts rough over smaller steps.
_STEP = 0.04
_SETTLED = 1e-4
_LEAST_SIZE = 1e-3


@dataclass(frozen=True)
class Problem:
    """Windows of logs, and what happens in them.

    Attributes:
        windows: where rollouts start, with times after it (m,) and positions (m, n) that count.
        edges: (S + 1,) ends of the steps of each window, from its start [s].
    """

    robot: RobotModel
    windows: tuple[tuple[Window, Array, Array], ...]
    edges: Array

    def some(self, most: int) -> Problem:
        """Return the problem with at most so many of its windows, spread evenly."""
        keep = np.linspace(0, len(self.windows) - 1, min(len(self.windows), most))
        return replace(self, windows=tuple(self.windows[k] for k in keep.round().astype(int)))

    def played(self, choices: Sequence[Servos]) -> Array:
        """Return positions (C, W, S + 1, n) of each choice in every window."""
        windows = [window for window, _, _ in self.windows]
        return played_servos(self.robot, choices, windows, self.edges)

    def errors(self, choices: Sequence[Servos]) -> Array:
        """Return position errors (C, M, n) of all windows [rad]; pi where a rollout diverges."""

        def error(q: Array, time: Array, measured: Array) -> Array:
            found = np.stack([np.interp(time, self.edges, column) for column in q.T], axis=1)
            return np.nan_to_num(found - measured, nan=np.pi)

        return np.stack(
            [
                np.concatenate([error(q, *own[1:]) for q, own in zip(each, self.windows)])
                for each in self.played(choices)
            ]
        )


def problem_of(
    robot: RobotModel,
    pieces: Sequence[Measurement],
    most: int,
    length: float = LENGTH,
    settled: float = SETTLED,
) -> Problem:
    """Return the windows of some pieces, one after the other; at most so many, spread evenly.

    Raises:
        InputError: no piece is long enough.
    """
    windows = []
    for piece in pieces:
        lead = max(MOST_PERIODS * usual_period(piece.time), SMOOTHED)
        starts = np.arange(piece.time[0] + lead, piece.time[-1] - length, length)
        if not len(starts) or piece.command is None:
            continue
        q, qd = smoothed(piece)
        for k in np.searchsorted(piece.time, starts).tolist():
            start = float(piece.time[k])
            inside = (piece.time > start + settled) & (piece.time <= start + length)
            window = Window(start, q[k], qd[k], piece.time, piece.command)
            windows.append((window, piece.time[inside] - start, piece.q[inside]))
    if not windows:
        raise InputError(f"no piece of the log is as long as {length:g} s; record longer")
    edges = np.linspace(0.0, length, max(1, round(length / STEP)) + 1)
    return Problem(robot, tuple(windows), edges).some(most)


def smoothed(piece: Measurement) -> tuple[Array, Array]:
    """Return positions and speeds (N, n) as parabolas give them [rad, rad/s]."""
    from scipy.signal import savgol_filter

    period = usual_period(piece.time)
    length = max(5, 2 * round(0.5 * SMOOTHED / period) + 1)
    qd = savgol_filter(piece.q, length, 2, deriv=1, delta=period, axis=0)
    return savgol_filter(piece.q, length, 2, axis=0), qd


def parted(pieces: Sequence[Measurement]) -> tuple[list[Measurement], list[Measurement]]:
    """Return (what is fitted, what is held out): the last fifth of every piece."""
    cuts = [p.time[-1] - HELD_OUT_SHARE * (p.time[-1] - p.time[0]) for p in pieces]
    at = [int(np.searchsorted(p.time, cut, "right")) for p, cut in zip(pieces, cuts)]
    held = [part_of(piece, k, len(piece)) for piece, k in zip(pieces, at)]
    return [part_of(piece, 0, k) for piece, k in zip(pieces, at)], held


def play_servos(
    robot: RobotModel, pieces: Sequence[Measurement], pair: tuple[Servos, Servos], held_out: str
) -> RolloutTest:
    """Play two models (before, after) on held-out pieces, over every horizon that is there."""
    errors, notes = [], ["open loop was not played: no torque was measured"]
    for horizon in HORIZONS:
        try:
            problem = problem_of(robot, pieces, playback.MOST_WINDOWS, horizon, 0.0)
        except InputError:
            notes.append(f"no held-out piece is as long as {horizon:g} s")
            continue
        old, new = np.sqrt(np.mean(problem.errors(pair) ** 2, axis=1))
        errors.append(RolloutError(CLOSED, horizon, len(problem.windows), old, new))
    return RolloutTest(robot.joint_names, held_out, SERVO_WORDS, tuple(errors), tuple(notes))


@dataclass(frozen=True)
class Scale:
    """How a vector of unknowns stands for servos.

    Attributes:
        size: servos whose numbers are usual sizes.
        free: (4 n + 1,) which of the numbers are sought.
    """

    start: Servos
    size: Servos
    free: NDArray[np.bool_]

    def unknowns(self, servos: Servos) -> Array:
        """Return the vector (p,) of some servos."""
        values = servos.vector() / self.size.vector()
        values[:-1] = np.log(values[:-1] + SOFT)
        return values[self.free]

    def servos(self, unknowns: Array) -> Servos:
        """Return what a vector (p,) stands for."""
        whole = np.zeros(len(self.free))
        whole[self.free] = unknowns
        whole[:-1] = np.maximum(np.exp(whole[:-1]) - SOFT, 0.0)
        return Servos.of(np.where(self.free, whole * self.size.vector(), self.start.vector()))

    def derivative(self, servos: Servos) -> Array:
        """Return (p,) how much each number changes where its unknown changes by one."""
        size = self.size.vector()
        size[:-1] = servos.vector()[:-1] + SOFT * size[:-1]
        return size[self.free]


@dataclass(frozen=True)
class ServoFit:
    """What was found.

    Attributes:
        errors: their standard errors, zero for what was not sought.
        share: (4 n + 1,) how much of each comes from the data: 1 all, 0 all from the start.
        sigma: (n,) root mean square position error [rad].
    """

    servos: Servos
    errors: Servos
    share: Array
    sigma: Array


def model_servos(robot: RobotModel) -> Servos:
    """Return the model's own numbers, never late; gains are NaN where it has no position servo."""
    model, dofs, actuators = robot.mj_model, robot.dof_index, actuators_of(robot)
    damping = model.dof_damping[dofs] + np.nan_to_num(actuators.damping)
    return Servos(
        actuators.stiffness, damping, model.dof_frictionloss[dofs], model.dof_armature[dofs], 0.0
    )


def first_servos(robot: RobotModel, q: Array, period: float, moves: NDArray[np.bool_]) -> Scale:
    """Return where a search starts: the model's numbers, or usual ones where it has none.

    Args:
        q: (m, n) some positions.
        period: between samples [s].
        moves: (n,) which joints move; the others' numbers are left as they are.
    """
    own, (gravity, inertia) = model_servos(robot), _gravity_and_inertia(robot, q)
    inertia += own.armature
    stiffness, usual = inertia * _UNKNOWN_RATE**2, 0.2 * inertia * _UNKNOWN_RATE
    stiffness = np.where(np.isnan(own.stiffness), stiffness, own.stiffness)
    damping = np.where(own.damping > 0.0, own.damping, usual)
    start = replace(own, stiffness=stiffness, damping=damping, delay=period)
    size = Servos(
        stiffness,
        np.maximum(damping, usual),
        np.maximum(own.frictionloss, np.maximum(0.05 * gravity, _LEAST_SIZE)),
        np.maximum(own.armature, np.maximum(0.2 * inertia, 1e-2 * _LEAST_SIZE)),
        period,
    )
    free = np.append(np.tile(moves, 4), True)
    # From zero the search would hardly get away.
    return Scale(Servos.of(np.maximum(start.vector(), 0.1 * size.vector() * free)), size, free)


def _gravity_and_inertia(robot: RobotModel, q: Array) -> tuple[Array, Array]:
    """Return (n,) the largest torque of gravity and the mean inertia that each joint moves."""
    thetas, dynamics = np.array([link.theta for link in robot.links]), LinkDynamics(robot)
    at_rest = dynamics.motion(q, 0.0 * q, 0.0 * q).torque(thetas)
    found = []
    for unit in np.eye(q.shape[1]):
        torque = dynamics.motion(q, 0.0 * q, np.tile(unit, (len(q), 1))).torque(thetas)
        found.append(np.mean((torque - at_rest) @ unit))
    return np.max(np.abs(at_rest), axis=0), np.maximum(found, 1e-6)


def better_start(problem: Problem, scale: Scale) -> Scale:
    """Return the scale with the gains and the delay that come nearest, of a coarse grid.

    Raises:
        InputError: no servo follows these commands.
    """
    few, start = problem.some(FEW_WINDOWS), scale.start
    delays = scale.size.delay * np.arange(0.0, MOST_PERIODS + 1.0)
    grid = [(gain, delay) for gain in GAINS for delay in delays]
    choices = [replace(start, stiffness=g * start.stiffness, delay=float(d)) for g, d in grid]
    squared = np.mean(few.errors(choices) ** 2, axis=1)
    if not np.all(np.isfinite(squared)):
        raise InputError("the model cannot be played with these commands; check their units")
    by_gain = squared.reshape(len(GAINS), len(delays), -1)
    best = int(np.argmin(np.sum(np.min(by_gain, axis=0), axis=1)))
    gains = np.array(GAINS)[np.argmin(by_gain[:, best], axis=0)]
    better = replace(start, stiffness=gains * start.stiffness, delay=float(delays[best]))
    return replace(scale, start=better)


def fit_servos(problem: Problem, scale: Scale, progress: Progress) -> ServoFit:
    """Search for the servos whose rollouts come nearest to the measured positions.

    Twice: all joints' errors count alike at first, then each in units of its own error.
    """
    from scipy.optimize import least_squares

    widest = replace(Servos.of(WIDEST * scale.size.vector()), delay=MOST_PERIODS * scale.size.delay)
    bounds = scale.unknowns(Servos.of(0.0 * scale.size.vector())), scale.unknowns(widest)
    origin = x = np.clip(scale.unknowns(scale.start), *bounds)

    def residuals(at: Array, sigma: Array, *_: Any) -> Array:
        error = problem.errors([scale.servos(at)])[0] / sigma
        return np.concatenate((error.ravel(), (at - origin) / PULL))

    def jacobian(at: Array, sigma: Array, stage: str, rounds: Iterator[int]) -> Array:
        progress.advance(stage, min(next(rounds), MOST_ROUNDS - 0.5), MOST_ROUNDS, "")
        slopes = _slopes(problem, scale, at, bounds) / sigma[:, None]
        return np.vstack((slopes.reshape(-1, len(at)), np.eye(len(at)) / PULL))

    settled = {"xtol": _SETTLED, "ftol": _SETTLED, "max_nfev": MOST_ROUNDS}
    for stage in ("First search", "Second search"):
        own = _sigma(problem.errors([scale.servos(x)])[0]), stage, itertools.count(1)
        x = least_squares(residuals, x, jacobian, bounds, args=own, **settled).x
        progress.advance(stage, 1.0, 1.0, "")
    return _judged(problem, scale, x, bounds)


def _sigma(errors: Array) -> Array:
    """Return (n,) root mean square error of each joint [rad]."""
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)) + 1e-9)


def _slopes(problem: Problem, scale: Scale, x: Array, bounds: tuple[Array, Array]) -> Array:
    """Return the derivative (M, n, p) of the errors, by central differences.

    Differences to one side would hide the directions in which hardly anything changes.
    """
    low, high = np.maximum(x - _STEP, bounds[0]), np.minimum(x + _STEP, bounds[1])
    moved = np.vstack([np.where(np.eye(len(x), dtype=bool), end, x) for end in (low, high)])
    low_errors, high_errors = np.split(problem.errors([scale.servos(each) for each in moved]), 2)
    return np.moveaxis(high_errors - low_errors, 0, -1) / (high - low)


def _judged(problem: Problem, scale: Scale, x: Array, bounds: tuple[Array, Array]) -> ServoFit:
    """Return the result with its errors: noise as long-lived as the residuals' own.

    A number that is next to nothing may still be as large as is usual: what is known beforehand of
    each is its usual size, or the pull of the search where that is wider.
    """
    servos = scale.servos(x)
    derivative, free = scale.derivative(servos), scale.free
    reach = np.maximum(scale.size.vector()[free] / derivative, 1.0) * PULL
    residuals = problem.errors([servos])[0]
    sigma = _sigma(residuals)
    normal = np.diag(reach**-2.0)
    score = normal.copy()
    slopes = _slopes(problem, scale, x, bounds) / sigma[:, None]
    for rows, own in zip(np.moveaxis(slopes, 1, 0), residuals.T):
        normal += rows.T @ rows
        score += correlation_stretch(own) * rows.T @ rows
    inverse = np.linalg.inv(normal)
    spread = np.sqrt(np.minimum(np.diag(inverse @ score @ inverse), reach**2))
    errors, share = np.zeros(len(free)), np.zeros(len(free))
    errors[free], share[free] = spread * derivative, 1.0 - (spread / reach) ** 2
    return ServoFit(servos, Servos.of(errors), share, sigma)


def correlation_stretch(residual: Array) -> float:
    """Return 1 + 2 sum of the autocorrelation of (K,) up to where it first falls below zero."""
    energy, total = float(np.mean(residual**2)), 1.0
    for lag in range(1, len(residual) // 4):
        alike = float(np.mean(residual[lag:] * residual[:-lag]))
        if alike <= 0.0 or energy == 0.0:
            break
        total += 2.0 * alike / energy
    return total


def links_share(robot: RobotModel, pieces: Sequence[Measurement], servos: Servos) -> Array:
    """Return (n,) the links' torque, gravity and inertia, over that of all, root mean squares."""
    thetas, parts = np.array([link.theta for link in robot.links]), []
    for piece in pieces:
        q, qd = smoothed(piece)
        qdd = np.gradient(qd, piece.time, axis=0)
        rest = servos.armature * qdd + servos.damping * qd + servos.frictionloss * np.sign(qd)
        parts.append((LinkDynamics(robot).motion(q, qd, qdd).torque(thetas), rest))
    links, others = (np.sqrt(np.mean(np.concatenate(side) ** 2, axis=0)) for side in zip(*parts))
    return np.asarray(links / np.maximum(links + others, 1e-12))


def with_links_error(fit: ServoFit, share: Array) -> ServoFit:
    """Return the fit with errors that hold what the links' masses, which are trusted, add.

    All numbers of a joint grow together with the links' torque, so links that are off by
    ``LINKS_WRONG`` move them by as much; and where that torque is a small share of the whole, what
    no model explains (``UNEXPLAINED`` of the whole) passes for a part of it; below ``LEAST_SHARE``
    it may be anything, and the errors are as large as the numbers. A step h of the
    implicit integrator adds an apparent rotor inertia of h times the damping, which no arm has.

    Args:
        share: (n,) root mean square torque of the links over that of all.
    """
    size = np.hypot(LINKS_WRONG, UNEXPLAINED / np.maximum(share, LEAST_SHARE))
    size = np.where(share > LEAST_SHARE, size, 1.0)
    own, added = fit.errors.vector(), np.append(np.tile(size, 4), 0.0) * fit.servos.vector()
    added[3 * len(share) : -1] += STEP * fit.servos.damping
    return replace(fit, errors=Servos.of(np.where(own > 0.0, np.hypot(own, added), 0.0)))


def at_limit(problem: Problem, servos: Servos) -> Array:
    """Return (n,) the share of time in which each servo asks for more than its limit."""
    over, limit = [], actuators_of(problem.robot).limit
    for (window, _, _), q in zip(problem.windows, problem.played([servos])[0]):
        asked = window.controls(servos.delay, problem.edges) - q[:-1]
        over.append(np.abs(servos.stiffness * asked) > limit)
    return np.mean(np.concatenate(over), axis=0)
