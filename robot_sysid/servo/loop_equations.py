"""Equations of servos' closed loops, linear in the unknowns: servo numbers, and errors by links.

The servo of a joint with gain K moves rotor inertia A against damping D, dry friction f and the
links' torque tau:

    K (command(t - delay) - q) = A qdd + D qd + f sign(qd) + tau(q, qd, qdd).

Divided by K it is linear in A/K, D/K, f/K and 1/K. The distance on its left has an error of encoder
steps only, so that least squares determine these ratios without a start, whatever the model says of
servos. 1/K shows only where the links' torque is no small part; elsewhere only ratios are
determined. All terms pass the same smoothing, which leaves the equation valid as long as the
samples resolve the motion.

n is the number of joints, M that of samples of all pieces.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimation.algebra.priors import model_link_factor
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.servo.windows import MAX_DELAY_PERIODS, smooth_states
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.simulation.playback import (
    ServoParameters,
    ServoWindow,
    servos_in_model,
)

LINK_ERROR = 0.1
"""Relative standard deviation of the links' masses, of their centres of mass in link sizes, and
half that of their inertias: those of small arms are drawn, and seldom weighed."""
LARGEST_ERROR = 1.0 / 3.0
"""Relative standard error up to which the equations determine a number."""
LARGEST_TURN = 1.8
"""Largest angle [rad] by which the oscillation of a servo without damping may turn between two
samples: differences of faster motion are no derivatives, and its equations are wrong."""
_CORRELATED_SAMPLES = 10.0
"""Samples over which errors of the equations are correlated: those of friction near standstill and
of smoothed accelerations last about as long as a start or a stop."""
_SURE_SHARE = 0.6
"""Share of the samples, those nearest to their commands, that are fitted first: a servo reaches its
torque limit far from its command."""
_OUTLIER = 5.0
"""Residual, in root mean squares of the first fit, from which on a sample is left out."""
_LIMITED_RATIO = 1.2
"""Torque that a servo asks for over the torque that it delivers from which on it is limited."""
_LIMITED_SAMPLES = 5
"""Least number of samples at a torque limit: fewer are disturbances."""
_LINKS = 3
"""Column of the links' torque in the equations."""


@dataclass(frozen=True)
class LoopEquations:
    """The terms of the equations, smoothed.

    Attributes:
        pieces: the pieces of logs.
        position: (M, n) measured positions [rad or m].
        columns: (M, n, 4) acceleration, velocity, its sign, and the links' torque.
        is_moving: (M, n) whether a joint moves, so that its friction has the sign of its velocity;
            never in the beginning of a piece, whose commands are not known.
        regressor: (M, n, 10 n) of the links' torque by the links' inertial parameters.
    """

    pieces: tuple[Measurement, ...]
    position: Array
    columns: Array
    is_moving: NDArray[np.bool_]
    regressor: Array

    def distances(self, delay: float) -> Array:
        """Return the distance (M, n) from each position to its command of ``delay`` [s] before."""
        commands = []
        for piece in self.pieces:
            middles = 0.5 * (piece.time[1:] + piece.time[:-1])
            half = 0.5 * sampling_period(piece.time)
            edges = np.hstack((piece.time[0] - half, middles, piece.time[-1] + half))
            assert piece.command is not None
            window = ServoWindow(0.0, piece.q[0], piece.q[0], piece.time, piece.command)
            mean_command = window.controls(delay, edges)
            smooth_command, _ = smooth_states(replace(piece, q=mean_command))
            commands.append(_average(_average(smooth_command)))
        return np.asarray(np.concatenate(commands) - self.position)


def loop_equations(robot: RobotModel, pieces: Sequence[Measurement]) -> LoopEquations:
    """Return the equations of an arm's servos in the pieces of logs that have commands."""
    commanded = tuple(piece for piece in pieces if piece.command is not None)
    dynamics = LinkDynamics(robot)
    links = list(range(robot.n_joints))
    terms_of_pieces = []
    for piece in commanded:
        q, _ = smooth_states(piece)
        # A central difference is the mean velocity over two samples: the other terms are averaged
        # over them as well, once for each difference.
        qd = _average(np.gradient(q, piece.time, axis=0))
        qdd = np.gradient(np.gradient(q, piece.time, axis=0), piece.time, axis=0)
        q = _average(_average(q))
        motion = dynamics.motion(q, qd, qdd)
        terms = (qdd, qd, np.sign(qd), motion.torque(robot.thetas))
        is_inner = np.arange(len(q)) >= MAX_DELAY_PERIODS
        columns = np.stack(terms, axis=-1)
        terms_of_pieces.append((q, columns, is_inner, motion.columns(links)))
    joined = map(np.concatenate, zip(*terms_of_pieces))
    position, all_columns, is_inner, regressor = joined
    speed = np.abs(all_columns[:, :, 1])
    is_fast = speed > 0.1 * np.sqrt(np.mean(speed**2, axis=0))
    is_moving = is_fast & is_inner[:, None]
    return LoopEquations(commanded, position, all_columns, is_moving, regressor)


def _average(values: Array) -> Array:
    """Return the mean of values (N, n) over the two sampling periods around each sample."""
    from scipy.ndimage import convolve1d

    return np.asarray(convolve1d(values, [0.25, 0.5, 0.25], axis=0, mode="nearest"))


@dataclass(frozen=True)
class LoopFit:
    """Servo numbers that solve the equations best.

    Attributes:
        equations: as given.
        servos: the numbers; NaN where a joint does not move.
        errors: (4 n + 1,) standard errors of the numbers at the given gains and delay, in the order
            of ``ServoParameters.vector``: zero of a gain that is determined, infinite of another,
            of the delay, and of joints that do not move.
        scale_error: (n,) relative standard error of the scale of a joint's numbers; 1 where the
            links' torque does not fix it.
        is_used: (M, n) the samples that solve the equations; the others are outliers or at rest.
        is_limited: (M, n) the samples in which a servo delivers less torque than its gain asks for.
        limit: (n,) the torque that it delivers then; NaN where it is never limited [N m].
    """

    equations: LoopEquations
    servos: ServoParameters
    errors: Array
    scale_error: Array
    is_used: NDArray[np.bool_]
    is_limited: NDArray[np.bool_]
    limit: Array

    def is_resolved(self, inertia: Array) -> NDArray[np.bool_]:
        """Return whether the samples resolve the motion of each servo (n,).

        ``inertia`` (n,) is that of the links at each joint [kg m^2].
        """
        servos = self.servos
        periods = [sampling_period(piece.time) for piece in self.equations.pieces]
        rate = np.sqrt(servos.stiffness / (servos.armature + inertia))
        return np.asarray(~(rate * np.median(periods) > LARGEST_TURN))

    def restrict(self, is_valid: NDArray[np.bool_]) -> LoopFit:
        """Return the fit in which the equations of the other joints (n,) determine nothing.

        Their scale is as uncertain as the links, whose errors add up to about two single ones.
        """
        errors = np.where(np.append(np.tile(is_valid, 4), True), self.errors, np.inf)
        scale_error = np.where(is_valid, self.scale_error, 2.0 * LINK_ERROR)
        return replace(
            self,
            errors=errors,
            scale_error=scale_error,
            is_limited=self.is_limited & is_valid,
            limit=np.where(is_valid, self.limit, np.nan),
        )

    @property
    def determines(self) -> NDArray[np.bool_]:
        """Whether the equations determine a number (4 n + 1,)."""
        return self.errors < LARGEST_ERROR * np.nan_to_num(self.servos.vector())

    def limited_samples(self) -> Iterator[tuple[Measurement, NDArray[np.bool_]]]:
        """Yield each piece and whether any servo is limited in each of its samples (N,)."""
        is_limited = np.any(self.is_limited, axis=1)
        ends = np.cumsum([len(piece) for piece in self.equations.pieces])
        yield from zip(self.equations.pieces, np.split(is_limited, ends[:-1]))


def solve_loop_equations(
    robot: RobotModel,
    equations: LoopEquations,
    moves: NDArray[np.bool_],
    default_gain: Array,
) -> LoopFit:
    """Return the servo numbers that solve the equations best, with one delay for all joints.

    A joint whose links do not fix the scale gets the model's gain or, without one, the median of
    the other joints: the servos of one arm are alike.

    Args:
        robot: the arm as in the model file.
        equations: the equations of all joints.
        moves: (n,) which joints move.
        default_gain: (n,) gains where neither data nor model gives one [N m/rad].
    """
    joints = np.flatnonzero(moves).tolist()
    delay = _best_delay(equations, joints)
    distances = equations.distances(delay)

    gain = np.full(len(moves), np.nan)
    scale_error = np.ones(len(moves))
    for joint in joints:
        solution = _solve_joint(equations, distances, joint)
        inverse_gain = solution.ratios[_LINKS]
        if solution.errors[_LINKS] < LARGEST_ERROR * inverse_gain:
            scale_error[joint] = solution.errors[_LINKS] / inverse_gain
            gain[joint] = 1.0 / inverse_gain
    has_scale = np.isfinite(gain)
    usual_gain = np.median(gain[has_scale]) if np.any(has_scale) else default_gain
    model_gain = servos_in_model(robot).stiffness
    fallback = np.where(np.isfinite(model_gain), model_gain, usual_gain)
    gain = np.where(has_scale, gain, fallback)

    numbers = np.full((3, len(moves)), np.nan)
    errors = np.full((3, len(moves)), np.inf)
    is_used = np.zeros_like(equations.is_moving)
    is_limited = np.zeros_like(equations.is_moving)
    limit = np.full(len(moves), np.nan)
    for joint in joints:
        solution = _solve_joint(equations, distances, joint, float(gain[joint]))
        numbers[:, joint] = gain[joint] * solution.ratios
        errors[:, joint] = gain[joint] * solution.errors
        is_used[:, joint] = solution.is_used
        terms = equations.columns[:, joint] * np.append(numbers[:, joint], 1.0)
        is_limited[:, joint], limit[joint] = _torque_limit(
            gain[joint] * distances[:, joint],
            np.sum(terms, axis=1),
            equations.is_moving[:, joint],
            solution.is_used,
        )
    armature, damping, friction = numbers
    gain = np.where(moves, gain, np.nan)
    gain_error = np.where(has_scale, 0.0, np.inf)
    return LoopFit(
        equations=equations,
        servos=ServoParameters(gain, damping, friction, armature, delay),
        errors=np.hstack((gain_error, errors[1], errors[2], errors[0], np.inf)),
        scale_error=scale_error,
        is_used=is_used,
        is_limited=is_limited,
        limit=limit,
    )


def _best_delay(equations: LoopEquations, joints: Sequence[int]) -> float:
    """Return the delay [s] with which joints of these indices solve the equations best."""
    from scipy.optimize import minimize_scalar

    def cost(delay: float) -> float:
        """Return the sum of the logarithms of the joints' residuals."""
        distances = equations.distances(delay)
        residuals = [
            _solve_joint(equations, distances, joint).residual for joint in joints
        ]
        return float(np.sum(np.log(residuals)))

    period = float(np.median([sampling_period(p.time) for p in equations.pieces]))
    delays = period * np.arange(0.0, MAX_DELAY_PERIODS + 0.5, 0.5)
    best = float(delays[int(np.argmin([cost(delay) for delay in delays.tolist()]))])
    bounds = (max(best - 0.5 * period, 0.0), best + 0.5 * period)
    refined = minimize_scalar(
        cost, bounds=bounds, method="bounded", options={"xatol": 0.01 * period}
    )
    return float(refined.x)


def _torque_limit(
    asked: Array,
    delivered: Array,
    is_moving: NDArray[np.bool_],
    is_used: NDArray[np.bool_],
) -> tuple[NDArray[np.bool_], float]:
    """Return in which samples (M,) a servo is at its torque limit, and the limit [N m].

    It delivers much less there than it asks for, and no less than anywhere else; never and NaN of
    a servo that does not reach a limit.

    Args:
        asked: (M,) gain times distance from the command [N m].
        delivered: (M,) torque that moves joint and links [N m].
        is_moving: (M,) whether the joint moves.
        is_used: (M,) the samples that follow the equations.
    """
    is_limited = is_moving & ~is_used & (asked * delivered > 0.0)
    is_limited &= np.abs(asked) > _LIMITED_RATIO * np.abs(delivered)
    if np.count_nonzero(is_limited) >= _LIMITED_SAMPLES and np.any(is_used):
        limit = float(np.median(np.abs(delivered[is_limited])))
        largest_unlimited = np.quantile(np.abs(asked[is_used]), 0.99)
        if limit >= largest_unlimited / _LIMITED_RATIO:
            return is_limited, limit
    return np.zeros_like(is_limited), np.nan


@dataclass(frozen=True)
class _JointSolution:
    """Solution of one joint's equations.

    Attributes:
        ratios: (4,) A/K, D/K, f/K and 1/K, none below zero; (3,) without 1/K of a known gain K.
        residual: root mean square [rad].
        errors: their standard errors.
        is_used: (M,) the samples that were used.
    """

    ratios: Array
    residual: float
    errors: Array
    is_used: NDArray[np.bool_]


def _solve_joint(
    equations: LoopEquations, distances: Array, joint: int, gain: float | None = None
) -> _JointSolution:
    """Return the solution of a joint's equations.

    Args:
        equations: the equations.
        distances: (M, n) from ``LoopEquations.distances``.
        joint: index of the joint.
        gain: the known gain K; None to determine it.
    """
    from scipy.optimize import nnls

    is_moving = equations.is_moving[:, joint]
    columns = equations.columns[:, joint]
    distance = distances[:, joint]
    sure_distance = np.quantile(np.abs(distance[is_moving]), _SURE_SHARE)
    is_used = is_moving & (np.abs(distance) <= sure_distance)
    if gain is not None:
        distance = distance - columns[:, _LINKS] / gain
        columns = columns[:, :_LINKS]
    size = np.sqrt(np.mean(columns[is_moving] ** 2, axis=0)) + 1e-12
    columns = columns / size
    for _ in range(3):
        scaled_ratios, norm = nnls(columns[is_used], distance[is_used])
        residual = norm / np.sqrt(np.count_nonzero(is_used)) + 1e-9
        deviation = np.abs(distance - columns @ scaled_ratios)
        is_used = is_moving & (deviation <= _OUTLIER * residual)
    sensitivity = np.linalg.norm(np.linalg.pinv(columns[is_used]), axis=1)
    errors = residual * np.sqrt(_CORRELATED_SAMPLES) * sensitivity
    return _JointSolution(scaled_ratios / size, residual, errors / size, is_used)


def link_errors(robot: RobotModel, fit: LoopFit, servos: ServoParameters) -> Array:
    """Return the standard errors (4 n,) of servo numbers by those of the trusted links.

    Torque that wrong links add to the equations looks in part like torque of the servo; its least
    squares by the servo's numbers are their errors. The links' errors are ``link_factor``'s with a
    share of ``LINK_ERROR``. The order is that of ``ServoParameters.vector``.

    Args:
        robot: the arm as in the model file.
        fit: the equations, and which samples of them are no outliers.
        servos: numbers and delay that were fitted to the positions.
    """
    equations = fit.equations
    factor = model_link_factor(robot, range(robot.n_joints), LINK_ERROR)
    distances = equations.distances(servos.delay)
    errors = np.zeros((4, robot.n_joints))
    for joint in np.flatnonzero(np.any(fit.is_used, axis=0)).tolist():
        used = fit.is_used[:, joint]
        acceleration, velocity, direction, _ = equations.columns[used, joint].T
        distance = distances[used, joint]
        # tau = K distance - D qd - f sign(qd) - A qdd
        columns = np.stack((distance, -velocity, -direction, -acceleration), axis=1)
        size = np.sqrt(np.mean(columns**2, axis=0)) + 1e-12
        torque_errors = equations.regressor[used, joint] @ factor
        effects = np.linalg.pinv(columns / size) @ torque_errors
        errors[:, joint] = np.linalg.norm(effects, axis=1) / size
    return errors.ravel()
