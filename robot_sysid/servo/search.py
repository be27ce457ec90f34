"""An arm without torque sensors: servos, friction and rotor inertia from commands and positions.

By output error: the numbers whose rollouts come nearest to the measured positions. What is sought
is the logarithm of each over its usual size, softened so that zero is not far away: gain, damping,
friction and rotor inertia of a joint that grow together by the same factor change little where
links and gravity are small beside them, and in logarithms that is a straight line.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.uncertainty import autocovariance, memory_of
from robot_sysid.records import (
    CLOSED,
    Array,
    Measurement,
    RobotModel,
    RolloutError,
    RolloutTest,
)
from robot_sysid.records.progress import Progress
from robot_sysid.results.rollout import HORIZONS, split_time
from robot_sysid.signals.resampling import sampling_period, slice_samples
from robot_sysid.simulation.playback import MOST_WINDOWS
from robot_sysid.simulation.servos import (
    ServoRollouts,
    Servos,
    Window,
    actuators_of,
    model_servos,
)

SERVO_WORDS = "the log's commands through the model's servos, both late by the delay that was found"
# Windows: time step of rollouts, at most, length, what does not count at the beginning, where the
# state is known from steps of the encoder, the parabolas that give it [s]; how many are fitted.
STEP = 0.002
LENGTH = 3.0
SETTLED = 0.6
SMOOTHED = 0.12
FITTED = 24
# Largest delay that is sought, in sampling periods.
MOST_PERIODS = 10
# Factors on the gains of the start that are tried beforehand, in so many windows: luck decides
# where a servo with a larger one is at its limit all the time.
GAINS = (0.03, 0.1, 0.3, 1.0, 3.0)
_FEW = 6
# The search: how many times its usual size a number may be, below which part of that steps are no
# longer shares of it, the weak pull towards the start (a factor of twelve), rounds of a search;
# step of differences: a servo that is at its limit again and again is rough over smaller ones.
WIDEST = 100.0
SOFT = 0.3
PULL = 2.5
MOST_ROUNDS = 8
_STEP = 0.04
_SETTLED = 1e-4
_LEAST_SIZE = 1e-3
# Standard error, in units, from which on thrice it is as large as a number usually is: not seen.
UNSEEN = 1.0 / 3.0
_FRICTION = 2  # Where friction stands in ``Servos``.
# Bandwidth of a servo of which nothing is known [rad/s].
_UNKNOWN_RATE = 20.0
# How far the links' masses, which are trusted, may be off; what of a joint's torque a model does
# not explain at best (both docs/rollout.md); the links' share below which only ratios are seen.
LINKS_WRONG = 0.02
UNEXPLAINED = 0.005
LEAST_SHARE = 0.1


@dataclass(frozen=True)
class Problem:
    """Windows of logs, and what happens in them.

    Attributes:
        windows: where rollouts start, with times after it (m,) and positions (m, n) that count.
        edges: (S + 1,) ends of the steps of each window, from its start [s].
    """

    rollouts: ServoRollouts
    windows: tuple[tuple[Window, Array, Array], ...]
    edges: Array

    def some(self, most: int) -> Problem:
        """Return the problem with at most so many of its windows, spread evenly."""
        keep = np.linspace(0, len(self.windows) - 1, min(len(self.windows), most))
        return replace(
            self, windows=tuple(self.windows[k] for k in keep.round().astype(int))
        )

    def moves(self) -> NDArray[np.bool_]:
        """Return (M, n) when each joint is not at rest: a tenth of its usual speed or faster."""
        speed = np.concatenate(
            [np.gradient(q, time, axis=0) for _, time, q in self.windows]
        )
        return np.asarray(np.abs(speed) > 0.1 * np.sqrt(np.mean(speed**2, axis=0)))

    def played(self, choices: Sequence[Servos]) -> Iterator[Array]:
        """Yield positions (W, S + 1, n) of each choice in every window."""
        return self.rollouts.played(
            choices, [own[0] for own in self.windows], self.edges
        )

    def errors(self, choices: Sequence[Servos]) -> Array:
        """Return position errors (C, M, n) of all windows [rad]; pi where a rollout diverges."""
        _, times, measured = zip(*self.windows)
        window = np.repeat(np.arange(len(times)), [len(time) for time in times])
        at = np.concatenate(times) / (self.edges[1] - self.edges[0])
        step = np.minimum(at.astype(int), len(self.edges) - 2)
        beyond = (at - step)[:, None]
        target = np.concatenate(measured)
        found = (
            (1.0 - beyond) * q[window, step] + beyond * q[window, step + 1] - target
            for q in self.played(choices)
        )
        return np.stack([np.nan_to_num(error, nan=np.pi) for error in found])


def problem_of(
    rollouts: ServoRollouts,
    pieces: Sequence[Measurement],
    most: int = FITTED,
    length: float = LENGTH,
    settled: float = SETTLED,
) -> Problem:
    """Return the windows of some pieces, one after the other; at most so many, spread evenly.

    InputError where no piece is long enough.
    """
    windows = []
    for piece in pieces:
        lead = max(MOST_PERIODS * sampling_period(piece.time), SMOOTHED)
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
        raise InputError(
            f"no piece of the log is as long as {length:g} s; record longer"
        )
    edges = np.linspace(0.0, length, max(1, round(length / STEP)) + 1)
    return Problem(rollouts, tuple(windows), edges).some(most)


def smoothed(piece: Measurement) -> tuple[Array, Array]:
    """Return positions and speeds (N, n) as parabolas give them [rad, rad/s]."""
    from scipy.signal import savgol_filter

    period = sampling_period(piece.time)
    length = max(5, 2 * round(0.5 * SMOOTHED / period) + 1)
    qd = savgol_filter(piece.q, length, 2, deriv=1, delta=period, axis=0)
    return savgol_filter(piece.q, length, 2, axis=0), qd


def parted(
    pieces: Sequence[Measurement],
) -> tuple[list[Measurement], list[Measurement]]:
    """Return (what is fitted, what is held out): the last fifth of every piece."""
    at = [int(np.searchsorted(p.time, split_time(p), "right")) for p in pieces]
    held = [slice_samples(piece, k, len(piece)) for piece, k in zip(pieces, at)]
    return [slice_samples(piece, 0, k) for piece, k in zip(pieces, at)], held


def play_servos(
    rollouts: ServoRollouts,
    pieces: Sequence[Measurement],
    pair: Sequence[Servos],
    held_out: str,
) -> RolloutTest:
    """Play two models (before, after) on held-out pieces, over every horizon that is there."""
    errors = []
    notes = ["open loop was not played: no torque was measured"]
    for horizon in HORIZONS:
        try:
            problem = problem_of(rollouts, pieces, MOST_WINDOWS, horizon, 0.0)
        except InputError:
            notes.append(f"no held-out piece is as long as {horizon:g} s")
            continue
        old, new = np.sqrt(np.mean(problem.errors(pair) ** 2, axis=1))
        errors.append(RolloutError(CLOSED, horizon, len(problem.windows), old, new))
    names = rollouts.robot.joint_names
    return RolloutTest(names, held_out, SERVO_WORDS, tuple(errors), tuple(notes))


@dataclass(frozen=True)
class Scale:
    """How a vector of unknowns (p,) stands for servos.

    Attributes:
        size: servos whose numbers are usual sizes.
        free: (4 n + 1,) which of the numbers are sought.
    """

    start: Servos
    size: Servos
    free: NDArray[np.bool_]

    def unknowns(self, servos: Servos) -> Array:
        """Return the vector of some servos."""
        values = servos.vector() / self.size.vector()
        values[:-1] = np.log(values[:-1] + SOFT)
        return values[self.free]

    def servos(self, unknowns: Array) -> Servos:
        """Return what a vector stands for."""
        whole = np.zeros(len(self.free))
        whole[self.free] = unknowns
        whole[:-1] = np.maximum(np.exp(whole[:-1]) - SOFT, 0.0)
        return Servos.of(
            np.where(self.free, whole * self.size.vector(), self.start.vector())
        )

    def derivative(self, servos: Servos) -> Array:
        """Return (4 n + 1,) how much each number changes where its unknown changes by one."""
        size = self.size.vector()
        size[:-1] = servos.vector()[:-1] + SOFT * size[:-1]
        return size

    def bounds(self) -> tuple[Array, Array]:
        """Return the least and the largest vector that is sought."""
        size = self.size.vector()
        widest = replace(Servos.of(WIDEST * size), delay=MOST_PERIODS * self.size.delay)
        return self.unknowns(Servos.of(0.0 * size)), self.unknowns(widest)


def first_servos(
    robot: RobotModel, q: Array, period: float, moves: NDArray[np.bool_]
) -> Scale:
    """Return where a search starts: the model's numbers, or usual ones where it has none.

    Positions (m, n) stand for all, the period is that of samples [s]; numbers of joints that do not
    move (n,) are left as they are.
    """
    own = model_servos(robot)
    (gravity, inertia) = _gravity_and_inertia(robot, q)
    inertia += own.armature
    stiffness = inertia * _UNKNOWN_RATE**2
    usual = 0.2 * inertia * _UNKNOWN_RATE
    stiffness = np.where(np.isnan(own.stiffness), stiffness, own.stiffness)
    damping = np.where(own.damping > 0.0, own.damping, usual)
    start = replace(own, stiffness=stiffness, damping=damping, delay=period)
    # Friction is rarely less than this of what a geared motor carries or can give.
    limit = np.nan_to_num(actuators_of(robot).limit, posinf=0.0)
    resisted = np.maximum(0.05 * gravity, 0.02 * limit)
    size = Servos(
        stiffness,
        np.maximum(damping, usual),
        np.maximum(own.frictionloss, np.maximum(resisted, _LEAST_SIZE)),
        np.maximum(own.armature, np.maximum(0.2 * inertia, 1e-2 * _LEAST_SIZE)),
        period,
    )
    free = np.append(np.tile(moves, 4), True)
    # From zero the search would hardly get away.
    return Scale(
        Servos.of(np.maximum(start.vector(), 0.1 * size.vector() * free)), size, free
    )


def _gravity_and_inertia(robot: RobotModel, q: Array) -> tuple[Array, Array]:
    """Return (n,) the largest torque of gravity and the mean inertia that each joint moves."""
    thetas = robot.thetas
    dynamics = LinkDynamics(robot)
    at_rest = dynamics.motion(q, 0.0 * q, 0.0 * q).torque(thetas)
    found = []
    for unit in np.eye(q.shape[1]):
        torque = dynamics.motion(q, 0.0 * q, np.tile(unit, (len(q), 1))).torque(thetas)
        found.append(np.mean((torque - at_rest) @ unit))
    return np.max(np.abs(at_rest), axis=0), np.maximum(found, 1e-6)


def better_start(problem: Problem, scale: Scale) -> Scale:
    """Return the scale with the gains and the delay that come nearest, of a coarse grid.

    InputError where no servo follows these commands.
    """
    start = scale.start
    delays = scale.size.delay * np.arange(0.0, MOST_PERIODS + 1.0)
    grid = [(gain, delay) for gain in GAINS for delay in delays]
    choices = [
        replace(start, stiffness=g * start.stiffness, delay=float(d)) for g, d in grid
    ]
    # Absolute: where a stiff servo comes off its limit, single windows run off and rule squares.
    error = np.mean(np.abs(problem.some(_FEW).errors(choices)), axis=1)
    if not np.all(np.isfinite(error)):
        raise InputError(
            "the model cannot be played with these commands; check their units"
        )
    by_gain = error.reshape(len(GAINS), len(delays), -1)
    best = int(np.argmin(np.sum(np.min(by_gain, axis=0), axis=1)))
    gains = np.array(GAINS)[np.argmin(by_gain[:, best], axis=0)]
    better = replace(
        start, stiffness=gains * start.stiffness, delay=float(delays[best])
    )
    return replace(scale, start=better)


@dataclass(frozen=True)
class ServoFit:
    """What was found.

    Attributes:
        errors: their standard errors, zero for what was not sought.
        seen: (4 n + 1,) which of them the data shows; the others are the model's own.
        sigma: (n,) root mean square position error [rad].
    """

    servos: Servos
    errors: Servos
    seen: NDArray[np.bool_]
    sigma: Array


def searched(slopes_of: Slopes, scale: Scale, progress: Progress) -> Servos:
    """Search for the servos whose rollouts come nearest to the measured positions.

    Twice: all joints' errors count alike at first, then each in units of its own error.
    """
    from scipy.optimize import least_squares

    problem = slopes_of.problem
    bounds = scale.bounds()
    origin = x = np.clip(scale.unknowns(scale.start), *bounds)
    done = 0.0

    def residuals(at: Array, sigma: Array, _: str) -> Array:
        error = problem.errors([scale.servos(at)])[0] / sigma
        return np.concatenate((error.ravel(), (at - origin) / PULL))

    def jacobian(at: Array, sigma: Array, stage: str) -> Array:
        nonlocal done
        done = min(done + 1.0, MOST_ROUNDS - 0.5)
        progress.advance(stage, done, MOST_ROUNDS, "")
        servos = scale.servos(at)
        slopes = slopes_of(scale, servos) * scale.derivative(servos)[scale.free]
        slopes /= sigma[:, None]
        return np.vstack((slopes.reshape(-1, len(at)), np.eye(len(at)) / PULL))

    settled = {"xtol": _SETTLED, "ftol": _SETTLED, "max_nfev": MOST_ROUNDS}
    for stage in ("First search", "Second search"):
        done = 0.0
        before = x
        sigma = _sigma(problem.errors([scale.servos(x)])[0])
        x = least_squares(
            residuals, x, jacobian, bounds, args=(sigma, stage), **settled
        ).x
        progress.advance(stage, 1.0, 1.0, "")
        if np.array_equal(x, before):  # as the same search would end again
            break
    return scale.servos(x)


def as_in_model(robot: RobotModel, found: Servos, which: Any = True) -> Servos:
    """Return the servos with some or all numbers as the model has them, where it has them.

    The delay stays as found, and so do gain and damping of a joint without servo in the model.
    """
    own = model_servos(robot)
    known = replace(
        own, damping=own.damping + 0.0 * own.stiffness, delay=np.nan
    ).vector()
    takes = np.isfinite(known) & which
    return Servos.of(np.where(takes, known, found.vector()))


def _sigma(errors: Array) -> Array:
    """Return (n,) root mean square error of each joint [rad]."""
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)) + 1e-9)


class Slopes:
    """Derivatives of a problem's errors; those for the last servos are kept, number by number."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._at = b""
        self._known: dict[int, Array] = {}

    def __call__(self, scale: Scale, servos: Servos) -> Array:
        """Return the derivative (M, n, p) of the errors in each number that is sought.

        By central differences: those to one side would hide the directions in which hardly anything
        changes. Friction changes by as much as is usual: behind a stiff servo luck makes more than
        a little friction.
        """
        x = servos.vector()
        free = np.flatnonzero(scale.free)
        if self._at != x.tobytes():
            self._at = x.tobytes()
            self._known = {}
        step = np.where(
            np.arange(len(x)) // len(servos.stiffness) == _FRICTION, 1.0, _STEP
        )
        step *= _unit(scale, servos)
        new = [k for k in free.tolist() if k not in self._known]
        for k, one in zip(new, np.eye(len(x))[new]):
            low = np.maximum(x - step * one, 0.0)
            high = x + step * one
            errors = self.problem.errors([Servos.of(low), Servos.of(high)])
            self._known[k] = (errors[1] - errors[0]) / (high - low)[k]
        return np.stack([self._known[k] for k in free.tolist()], axis=-1)


def _unit(scale: Scale, servos: Servos) -> Array:
    """Return (4 n + 1,) how far each number goes with its unknown, at least its usual size."""
    return np.maximum(scale.derivative(servos), scale.size.vector())


def judged(slopes_of: Slopes, scale: Scale, servos: Servos) -> ServoFit:
    """Return the result with its errors.

    They hold noise as long-lived as the residuals' own, and what rollouts of steps without length
    would change, which is twice what half a step changes. What is known beforehand of each number
    is its unit, as far as the search pulls.
    """
    problem = slopes_of.problem
    free = np.flatnonzero(scale.free)
    joints = len(servos.stiffness)
    unit = _unit(scale, servos)[free]
    residuals = problem.errors([servos])[0]
    halves = np.linspace(0.0, problem.edges[-1], 2 * len(problem.edges) - 1)
    drift = 2.0 * (residuals - replace(problem, edges=halves).errors([servos])[0])
    sigma = _sigma(residuals)
    normal = np.eye(len(free)) / PULL**2
    bias = np.zeros(len(free))
    score = normal.copy()
    slopes = slopes_of(scale, servos) * unit
    moves = problem.moves()
    for joint in range(joints):
        rows = slopes[:, joint] / sigma[joint]
        own = (free % joints == joint) & (free < 4 * joints)
        weight = usual_share(rows[:, own], moves[:, joint])
        rows *= weight[:, None]
        normal += rows.T @ rows
        alike, _ = autocovariance(
            weight * residuals[:, joint], max(len(rows) // 4, 1) - 1
        )
        score += memory_of(alike, np.inf) * rows.T @ rows
        bias += rows.T @ (weight * drift[:, joint]) / sigma[joint]
    inverse = np.linalg.inv(normal)
    variance = np.diag(inverse @ score @ inverse) + (inverse @ bias) ** 2
    spread = np.sqrt(np.minimum(variance, PULL**2))
    errors = np.zeros(len(scale.free))
    seen = np.zeros(len(scale.free), dtype=bool)
    seen[free] = spread < UNSEEN
    errors[free] = np.where(seen[free], spread, np.maximum(spread, 1.0)) * unit
    return ServoFit(servos, Servos.of(errors), seen, sigma)


def usual_share(rows: Array, moves: NDArray[np.bool_]) -> Array:
    """Return (M,) what part of each row (M, k) counts: no more than its columns have in motion.

    Where a servo comes off its limit, or a joint begins to slip, rollouts part by luck, and tiny
    changes of a number look like large ones. (Bounded influence: Hampel, Ronchetti, Rousseeuw,
    Stahel, "Robust Statistics", 1986, ch. 6; 1.48 medians are a standard deviation.)
    """
    if not np.any(moves):
        return np.ones(len(rows))
    usual = np.maximum(1.48 * np.median(np.abs(rows[moves]), axis=0), 1e-300)
    return np.asarray(1.0 / np.max(np.abs(rows) / usual, axis=1, initial=1.0))


def links_share(
    robot: RobotModel, pieces: Sequence[Measurement], servos: Servos
) -> Array:
    """Return (n,) the links' torque, gravity and inertia, over that of all, root mean squares."""
    thetas = robot.thetas
    parts = []
    for piece in pieces:
        q, qd = smoothed(piece)
        qdd = np.gradient(qd, piece.time, axis=0)
        rest = (
            servos.armature * qdd
            + servos.damping * qd
            + servos.frictionloss * np.sign(qd)
        )
        parts.append((LinkDynamics(robot).motion(q, qd, qdd).torque(thetas), rest))
    links, others = (
        np.sqrt(np.mean(np.concatenate(side) ** 2, axis=0)) for side in zip(*parts)
    )
    return np.asarray(links / np.maximum(links + others, 1e-12))


def with_links_error(fit: ServoFit, share: Array) -> ServoFit:
    """Return the fit with errors that hold what the links' masses, which are trusted, add.

    ``share`` (n,) is the links' root mean square torque over that of all.
    All numbers of a joint grow together with the links' torque, so links that are off by
    ``LINKS_WRONG`` move them by as much; and where that torque is a small share of the whole, what
    no model explains passes for a part of it; below ``LEAST_SHARE`` it may be anything, and the
    errors are as large as the numbers. A step h of the implicit integrator adds an apparent rotor
    inertia of h times the damping, which no arm has, and in time leaves half a step open.
    """
    known = np.hypot(LINKS_WRONG, UNEXPLAINED / np.maximum(share, LEAST_SHARE))
    size = np.where(share > LEAST_SHARE, known, 1.0)
    own = fit.errors.vector()
    added = np.append(np.tile(size, 4) * fit.servos.vector()[:-1], 0.5 * STEP)
    added[3 * len(share) : -1] += STEP * fit.servos.damping
    return replace(
        fit, errors=Servos.of(np.where(own > 0.0, np.hypot(own, added), 0.0))
    )


def at_limit(problem: Problem, servos: Servos) -> Array:
    """Return (n,) the share of time in which each servo asks for more than its limit."""
    over = []
    limit = actuators_of(problem.rollouts.robot).limit
    for (window, _, _), q in zip(problem.windows, next(problem.played([servos]))):
        asked = window.controls(servos.delay, problem.edges) - q[:-1]
        over.append(np.abs(servos.stiffness * asked) > limit)
    return np.mean(np.concatenate(over), axis=0)
