"""Servo gains, delay, friction and rotor inertia by output error, and how sure they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.errors import InputError
from robot_sysid.estimation.arm.errors import correlation_stretch
from robot_sysid.identify.arm.servo.commands import MOST_PERIODS, Piece
from robot_sysid.identify.arm.servo.problem import STEP, Problem, Scale
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.progress import Progress
from robot_sysid.simulation.rollout.servo import Actuators, Servos

GAINS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Factors on the gains of the start that are tried beforehand."""
FEW_WINDOWS = 6
"""Windows that are enough for that."""
MOST_ROUNDS = 8
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
class ServoFit:
    """What was found.

    Attributes:
        servos: the numbers.
        errors: their standard errors, zero for what was not sought.
        share: (4 n + 1,) how much of each comes from the data: 1 all, 0 all from the start.
        sigma: (n,) root mean square position error [rad].
    """

    servos: Servos
    errors: Servos
    share: Array
    sigma: Array


def first_servos(robot: RobotModel, actuators: Actuators, q: Array, period: float) -> Scale:
    """Return where a search starts: the model's numbers, or usual ones where it has none.

    Args:
        robot: the arm.
        actuators: what drives it.
        q: (m, n) some positions.
        period: between samples [s].
    """
    model, dofs = robot.mj_model, robot.dof_index
    inertia = _own_inertia(robot, q) + model.dof_armature[dofs]
    known = np.isfinite(actuators.stiffness)
    stiffness = np.where(known, actuators.stiffness, inertia * _UNKNOWN_RATE**2)
    damping = model.dof_damping[dofs] + np.nan_to_num(actuators.damping)
    start = Servos(
        stiffness,
        np.where(damping > 0.0, damping, 0.2 * inertia * _UNKNOWN_RATE),
        np.array(model.dof_frictionloss[dofs]),
        np.array(model.dof_armature[dofs]),
        period,
    )
    torque = np.max(np.abs(_gravity(robot, q)), axis=0)
    size = Servos(
        stiffness,
        np.maximum(start.damping, 0.2 * inertia * _UNKNOWN_RATE),
        np.maximum(start.frictionloss, np.maximum(0.05 * torque, _LEAST_SIZE)),
        np.maximum(start.armature, np.maximum(0.2 * inertia, 1e-2 * _LEAST_SIZE)),
        period,
    )
    # From zero the search would hardly get away.
    away = np.maximum(start.vector(), 0.1 * size.vector())
    return Scale(Servos.of(away), size, np.ones(4 * len(stiffness) + 1, dtype=bool))


def _gravity(robot: RobotModel, q: Array) -> Array:
    thetas = np.array([link.theta for link in robot.links])
    return LinkDynamics(robot).motion(q, 0.0 * q, 0.0 * q).torque(thetas)


def _own_inertia(robot: RobotModel, q: Array) -> Array:
    """Return (n,) the mean inertia that each joint moves, the others held [kg m^2]."""
    thetas, dynamics = np.array([link.theta for link in robot.links]), LinkDynamics(robot)
    at_rest = dynamics.motion(q, 0.0 * q, 0.0 * q).torque(thetas)
    found = []
    for joint in range(q.shape[1]):
        unit = np.zeros_like(q)
        unit[:, joint] = 1.0
        torque = dynamics.motion(q, 0.0 * q, unit).torque(thetas)
        found.append(np.mean((torque - at_rest)[:, joint]))
    return np.maximum(np.array(found), 1e-6)


def better_start(problem: Problem, scale: Scale, period: float) -> Scale:
    """Return the scale with the gains and the delay that come nearest, of a coarse grid.

    Raises:
        InputError: no servo follows these commands.
    """
    few, start = problem.some(FEW_WINDOWS), scale.start
    delays = period * np.arange(0.0, MOST_PERIODS + 1.0)
    grid = [(gain, delay) for gain in GAINS for delay in delays]
    choices = [replace(start, stiffness=g * start.stiffness, delay=float(d)) for g, d in grid]
    squared = np.array([np.mean(error**2, axis=0) for error in few.errors(choices)])
    by_gain = squared.reshape(len(GAINS), len(delays), -1)
    best = int(np.argmin(np.sum(np.min(by_gain, axis=0), axis=1)))
    gains = np.array(GAINS)[np.argmin(by_gain[:, best], axis=0)]
    if not np.all(np.isfinite(squared)):
        raise InputError("the model cannot be played with these commands; check their units")
    better = replace(start, stiffness=gains * start.stiffness, delay=float(delays[best]))
    return replace(scale, start=better)


def fit_servos(problem: Problem, scale: Scale, longest: float, progress: Progress) -> ServoFit:
    """Search for the servos whose rollouts come nearest to the measured positions.

    Twice: all joints' errors count alike at first, then each in units of its own error.

    Args:
        problem: what was measured.
        scale: the start, and what is sought.
        longest: largest delay [s].
        progress: where to tell how far it is.
    """
    bounds = scale.bounds(longest)
    x = np.clip(scale.unknowns(scale.start), *bounds)
    origin, pull = x.copy(), scale.pull
    for stage in ("First search", "Second search"):
        problem = replace(problem, sigma=_sigma(problem, scale.servos(x)))
        tell = partial(_tell, progress, stage)
        x = _nearest(problem, scale, (origin, pull), bounds, x, tell)
        progress.advance(stage, 1.0, 1.0, "")
    problem = replace(problem, sigma=_sigma(problem, scale.servos(x)))
    return _judged(problem, scale, x, bounds)


def _tell(progress: Progress, stage: str, rounds: int) -> None:
    progress.advance(stage, min(rounds, MOST_ROUNDS - 0.5), MOST_ROUNDS, "")


def _nearest(
    problem: Problem,
    scale: Scale,
    start: tuple[Array, Array],
    bounds: tuple[Array, Array],
    x: Array,
    tell: Callable[[int], None],
) -> Array:
    """Return the unknowns (p,) of the least squared error, from x on.

    Args:
        problem, scale: as in ``fit_servos``.
        start: (p,) where the unknowns are pulled to, and the standard deviation of the pull.
        bounds: (p,) least and largest unknowns.
        x: (p,) where to begin.
        tell: gets the number of rounds.
    """
    from scipy.optimize import least_squares

    (origin, pull), rounds = start, iter(range(1, 100))

    def residuals(at: Array) -> Array:
        return np.concatenate((problem.residuals(scale.servos(at)), (at - origin) / pull))

    def jacobian(at: Array) -> Array:
        tell(next(rounds))
        return np.vstack((slopes(problem, scale, at, bounds), np.diag(1.0 / pull)))

    settled = {"xtol": _SETTLED, "ftol": _SETTLED, "max_nfev": MOST_ROUNDS}
    return np.asarray(least_squares(residuals, x, jacobian, bounds, **settled).x)


def _sigma(problem: Problem, servos: Servos) -> Array:
    """Return (n,) root mean square error of each joint [rad]."""
    return np.sqrt(np.mean(problem.errors([servos])[0] ** 2, axis=0)) + 1e-9


def slopes(problem: Problem, scale: Scale, x: Array, bounds: tuple[Array, Array]) -> Array:
    """Return the derivative (M, p) of the residuals, by central differences, all at once.

    Differences to one side would hide the directions in which hardly anything changes.
    """
    low, high = np.maximum(x - _STEP, bounds[0]), np.minimum(x + _STEP, bounds[1])
    rows = np.arange(len(x))
    moved = np.tile(x, (2 * len(x), 1))
    moved[rows, rows], moved[len(x) + rows, rows] = low, high
    errors = np.stack(problem.errors([scale.servos(each) for each in moved]))
    change = (errors[len(x) :] - errors[: len(x)]) / (high - low)[:, None, None]
    return np.asarray((change / problem.sigma).reshape(len(x), -1).T)


def _judged(problem: Problem, scale: Scale, x: Array, bounds: tuple[Array, Array]) -> ServoFit:
    """Return the result with its errors: noise as long-lived as the residuals' own.

    A number that is next to nothing may still be as large as is usual: what is known beforehand of
    each is its usual size, or the pull of the search where that is wider.
    """
    servos = scale.servos(x)
    usual = scale.size.vector()[scale.free] / scale.derivative(servos)
    reach = np.maximum(usual, 1.0) * scale.pull
    joints = problem.robot.n_joints
    rows = slopes(problem, scale, x, bounds).reshape(-1, joints, len(x))
    residuals = problem.residuals(servos).reshape(-1, joints)
    stretch = correlation_stretch([residuals[:, joint] for joint in range(joints)])
    normal = np.diag(reach**-2.0)
    score = normal.copy()
    for joint in range(joints):
        own = rows[:, joint].T @ rows[:, joint]
        normal += own
        score += stretch[joint] * own
    inverse = np.linalg.inv(normal)
    covariance = inverse @ score @ inverse
    spread = np.sqrt(np.minimum(np.diag(covariance), reach**2))
    errors, share = np.zeros(len(scale.free)), np.zeros(len(scale.free))
    errors[scale.free] = spread * scale.derivative(servos)
    share[scale.free] = 1.0 - (spread / reach) ** 2
    return ServoFit(servos, Servos.of(errors), share, problem.sigma)


def with_links_error(fit: ServoFit, share: Array) -> ServoFit:
    """Return the fit with errors that hold what the links' masses, which are trusted, add.

    All numbers of a joint grow together with the links' torque, so links that are off by
    ``LINKS_WRONG`` move them by as much; and where that torque is a small share of the whole, what
    no model explains (``UNEXPLAINED`` of the whole) passes for a part of it; below ``LEAST_SHARE``
    it may be anything, and the errors are as large as the numbers. A step h of the
    implicit integrator adds an apparent rotor inertia of h times the damping, which no arm has.

    Args:
        fit: with errors of noise.
        share: (n,) root mean square torque of the links over that of all.
    """
    size = np.hypot(LINKS_WRONG, UNEXPLAINED / np.maximum(share, LEAST_SHARE))
    size = np.where(share > LEAST_SHARE, size, 1.0)
    own, added = fit.errors.vector(), np.append(np.tile(size, 4), 0.0) * fit.servos.vector()
    added[3 * len(share) : -1] += STEP * fit.servos.damping
    return replace(fit, errors=Servos.of(np.where(own > 0.0, np.hypot(own, added), 0.0)))


def links_share(robot: RobotModel, pieces: Sequence[Piece], servos: Servos) -> Array:
    """Return (n,) the links' torque, gravity and inertia, over that of all, root mean squares."""
    thetas, parts = np.array([link.theta for link in robot.links]), []
    for piece in pieces:
        qdd = np.gradient(piece.qd, piece.time, axis=0)
        links = LinkDynamics(robot).motion(piece.smooth, piece.qd, qdd).torque(thetas)
        rest = servos.armature * qdd + servos.damping * piece.qd
        parts.append((links, rest + servos.frictionloss * np.sign(piece.qd)))
    links, rest = (np.concatenate(side) for side in zip(*parts))
    size = [np.sqrt(np.mean(torque**2, axis=0)) for torque in (links, rest)]
    return np.asarray(size[0] / np.maximum(size[0] + size[1], 1e-12))


def held_still(scale: Scale, moves: NDArray[np.bool_]) -> Scale:
    """Return the scale with the numbers of joints that do not move left as they are."""
    return replace(scale, free=np.append(np.tile(moves, 4), True))


def at_limit(
    problem: Problem, actuators: Actuators, servos: Servos, positions: Sequence[Array]
) -> Array:
    """Return (n,) the share of time in which each servo asks for more than its limit."""
    over = []
    for window, q in zip(problem.windows, positions):
        asked = window.controls(servos.delay, problem.edges) - q[:-1]
        over.append(np.abs(servos.stiffness * asked) > actuators.limit)
    return np.mean(np.concatenate(over), axis=0)
