"""Servos, friction and rotor inertia fitted to an arm's commands and positions.

The servo of a joint with gain K moves rotor inertia A against damping D, dry friction f and the
links' torque tau:

    K (command(t - delay) - q) = A qdd + D qd + f sign(qd) + tau(q, qd, qdd).

Divided by K it is a list of terms of the position error: 1/K, D/K, f/K and A/K, errors of the
links, and the delay. Each has columns and a prior, and one linear fit with bounds has them all. 1/K
shows only where the links' torque is no small part. Elsewhere it comes from its prior: the gains of
the other joints, because servos of one arm are alike. What is found of a joint stays together, so
that the ratios of its numbers, which set the motion, are right whatever the gain.

All columns pass the same smoothing, which leaves the equation valid as long as the samples resolve
the motion. The numbers of a joint whose servo is faster are those with which the model, played with
the commands, comes nearest to the positions (``refine_played``).

n is the number of joints, M that of samples of all pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimate.fit import solve
from robot_sysid.estimate.links import model_link_factor
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.servo.windows import MAX_DELAY_PERIODS, ServoProblem, smooth_states
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.simulation.playback import (
    ServoParameters,
    mean_commands,
    servos_in_model,
)

LINK_ERROR = 0.1
"""Relative standard deviation of the links' masses, of their centres of mass in link sizes, and
half that of their inertias: those of small arms are drawn, and seldom weighed."""
OWN_GAIN = 0.3
"""Standard deviation of the logarithm of a joint's gain over the model's about that of the others:
servos of one arm are of one kind, and set alike."""
UNKNOWN_GAIN = 1.5
"""The same of all gains together, and of one about the others where the model has none."""
LARGEST_ERROR = 1.0 / 3.0
"""Relative standard error up to which a number is identified, and up to which a joint's resistance
at ``USUAL_SPEED`` is known well enough for its numbers to be written."""
USUAL_SPEED = 1.0
"""Speed of joints in the motions that a model is used for [rad/s]."""
CREEP = 0.1
"""Speed below which dry friction creeps, in MuJoCo as on arms, and looks like damping [rad/s]."""
DELAY_ERROR = 0.05
"""Standard error of the delay that sampling leaves, in sampling periods."""
FAST_PRIOR = 1.0
"""Standard deviation of the logarithm of a fast servo's numbers about the model's."""
LARGEST_TURN = 1.2
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
_CORRELATED_ROLLOUTS = 30.0
"""The same of the position errors of rollouts, which last until the servo pulls them back."""
_STEPS = (0.3, 0.3, 0.7, 0.3)
"""Steps of central differences by the logarithms of gain, damping, friction and rotor inertia. A
servo that is at its limit again and again makes rollouts rough on smaller scales."""
_LEAST_ERRORS = (2.0 * LINK_ERROR, 2.0 * LINK_ERROR, 1.0, 2.0 * LINK_ERROR)
"""Relative errors of the same numbers beside those of noise: of the links, which fix the scale and
add up to about two single ones, and of friction that a stiff servo hides."""
_EVALUATIONS = 5
"""Largest number of evaluations in each of two searches."""

_CENTRE = 5.0
"""Unknown of a number that is as in the model: far from zero, as relative steps need."""
_DELAY_STEPS = 4
"""Number of fits that lead to the delay; each is linear in it."""
_DEFAULT_RATE = 20.0
"""Bandwidth of a servo of which the model says nothing [rad/s]."""


@dataclass(frozen=True)
class LoopEquations:
    """The equations of the servos' closed loops, smoothed.

    Attributes:
        pieces: of logs, with commands.
        period: sampling period [s].
        position: (M, n) measured positions [rad or m].
        columns: (M, n, 4) the links' torque, velocity, its sign, and acceleration.
        is_moving: (M, n) whether a joint moves, so that its friction has the sign of its velocity;
            never in the beginning of a piece, whose commands are not known.
        link_columns: (M, n, L) torque by one standard deviation of each of L link errors [N m].
    """

    pieces: tuple[Measurement, ...]
    period: float
    position: Array
    columns: Array
    is_moving: NDArray[np.bool_]
    link_columns: Array

    def distances(self, delay: float) -> Array:
        """Return the distance (M, n) from each position to its command of ``delay`` [s] before."""
        commands = []
        for piece in self.pieces:
            middles = 0.5 * (piece.time[1:] + piece.time[:-1])
            half = 0.5 * self.period
            edges = np.hstack((piece.time[0] - half, middles, piece.time[-1] + half))
            assert piece.command is not None
            command = mean_commands(piece.time, piece.command, edges - delay)
            smooth_command, _ = smooth_states(replace(piece, q=command))
            commands.append(_average(_average(smooth_command)))
        return np.asarray(np.concatenate(commands) - self.position)

    def best_goal_delay(self) -> float:
        """Return the time [s] by which positions lag behind commands if they else equal them."""
        delays = self.period * np.arange(0.0, MAX_DELAY_PERIODS + 0.25, 0.25)
        return float(min(delays.tolist(), key=lambda d: np.sum(self.distances(d) ** 2)))


def loop_equations(robot: RobotModel, pieces: Sequence[Measurement]) -> LoopEquations:
    """Return the equations of an arm's servos in pieces of logs, which have commands."""
    dynamics = LinkDynamics(robot)
    links = list(range(robot.n_joints))
    factor = model_link_factor(robot, links, LINK_ERROR)
    rows = []
    for piece in pieces:
        q, _ = smooth_states(piece)
        # A central difference is the mean velocity over two samples: the other terms are averaged
        # over them as well, once for each difference.
        slope = np.gradient(q, piece.time, axis=0)
        qd = _average(slope)
        qdd = np.gradient(slope, piece.time, axis=0)
        q = _average(_average(q))
        motion = dynamics.motion(q, qd, qdd)
        torque = motion.torque(robot.thetas)
        sign, _ = smooth_states(replace(piece, q=np.sign(qd)))
        sign = _average(_average(sign))
        columns = np.stack((torque, qd, sign, qdd), axis=-1)
        is_inner = np.arange(len(q)) >= MAX_DELAY_PERIODS
        rows.append((q, columns, is_inner, motion.columns(links) @ factor))
    position, columns, is_inner, link_columns = map(np.concatenate, zip(*rows))
    speed = np.abs(columns[:, :, 1])
    least = np.maximum(0.1 * np.sqrt(np.mean(speed**2, axis=0)), CREEP)
    return LoopEquations(
        pieces=tuple(pieces),
        period=float(np.median([sampling_period(piece.time) for piece in pieces])),
        position=position,
        columns=columns,
        is_moving=(speed > least) & (is_inner[:, None] > 0),
        link_columns=link_columns,
    )


def _average(values: Array) -> Array:
    """Return the mean of values (N, n) over the two sampling periods around each sample."""
    from scipy.ndimage import convolve1d

    return np.asarray(convolve1d(values, [0.25, 0.5, 0.25], axis=0, mode="nearest"))


def fit_joint(
    columns: Array, mean: Array, deviation: Array, links: Array, error: Array
) -> tuple[Array, Array]:
    """Return the values (p,) of terms that explain a joint's position error, and their covariance.

    They are solved from the samples nearest to their commands first, then from all that are no
    outliers. The first is that of torque; all but the last are not negative.

    Args:
        columns: (M, p) derivative of the position error by the values [rad].
        mean, deviation: (p,) what is known of the values.
        links: (M, L) torque by one standard deviation of each link error [N m], which the model
            file keeps: none of it is fitted, all of it is in the covariance.
        error: (M,) position error [rad].
    """
    prior = np.column_stack((np.eye(len(mean)), mean)) / deviation[:, None]
    rows = np.column_stack((columns, error))
    is_used = np.abs(error) <= np.quantile(np.abs(error), _SURE_SHARE)
    noise = _rms(error[is_used])
    for _ in range(3):
        weight = 1.0 / (noise * np.sqrt(_CORRELATED_SAMPLES))
        weighted = weight * rows[is_used]
        normal = weighted.T @ weighted + prior.T @ prior
        values, inverse = solve(normal, mean)
        is_kept = np.ones(len(mean), dtype=bool)
        for _ in mean:
            is_kept[:-1] &= values[:-1] > 0.0
            values, _ = solve(normal, np.where(is_kept, mean, 0.0), is_kept)
        by_links = weight * values[0] * links[is_used]
        spread = inverse @ weighted[:, :-1].T @ by_links
        residual = np.abs(error - columns @ values)
        noise = _rms(residual[is_used])
        is_used = residual <= _OUTLIER * noise
    return values, inverse + spread @ spread.T


def _rms(values: Array) -> float:
    """Return the root mean square of values, a little more than zero."""
    return float(np.sqrt(np.mean(values**2))) + 1e-9


@dataclass(frozen=True)
class ServoFit:
    """The fitted numbers of an arm and how sure they are.

    Attributes:
        numbers: (4, n) stiffness, damping, dry friction and rotor inertia of the joints.
        errors: (4, n) their standard errors.
        delay, delay_error: by which all commands act late, and its standard error [s].
        gain_ratio: (n,) gain over what the other joints lead to expect.
        has_scale: (n,) whether the links' torque shows the gain.
        is_fast: (n,) whether the samples do not resolve the motion of the servo.
        is_known: (n,) whether a joint moves enough to show its numbers.
    """

    numbers: Array
    errors: Array
    delay: float
    delay_error: float
    gain_ratio: Array
    has_scale: NDArray[np.bool_]
    is_fast: NDArray[np.bool_]
    is_known: NDArray[np.bool_]

    @property
    def servos(self) -> ServoParameters:
        """The numbers and the delay, as a model is played with them."""
        stiffness, damping, frictionloss, armature = self.numbers
        return ServoParameters(stiffness, damping, frictionloss, armature, self.delay)


def fit_servos(robot: RobotModel, equations: LoopEquations) -> ServoFit:
    """Return the servo numbers that solve the equations best, with one delay for all joints.

    The delay is found first. Links then show the gains of the joints that carry them, and the
    others' are taken to be like these. Joints that do not move keep the model's numbers.
    """
    in_model = servos_in_model(robot).numbers
    inertia = robot.mj_model.dof_M0[robot.dof_index] - robot.armature
    has_gain = np.isfinite(in_model[0])
    gain = np.where(has_gain, in_model[0], np.median(inertia) * _DEFAULT_RATE**2)
    moves = np.any(equations.is_moving, axis=0)
    # Of each joint 1/K, D/K, f/K, A/K, and its own delay; zero of one that does not move.
    values = np.zeros((len(moves), 5))
    covariances = np.zeros((len(moves), 5, 5))
    period = equations.period

    def fit_joints(delay: float, own_delay: float, gain_error: Array) -> None:
        """Set values and covariances of the joints that move, by what is known of two of them."""
        distances = equations.distances(delay)
        step = 0.25 * period
        slopes = (equations.distances(delay + step) - distances) / step
        for k in np.flatnonzero(moves).tolist():
            at = equations.is_moving[:, k]
            columns = np.column_stack((equations.columns[at, k], slopes[at, k]))
            error = distances[at, k]
            mean = np.array([1.0, *in_model[1:, k], 0.0]) / gain[k]
            # Beside the gain, a term may be as large as the whole distance.
            deviation = np.std(error) / (np.std(columns, axis=0) + 1e-12) + mean
            deviation[0] = gain_error[k] / gain[k]
            deviation[-1] = own_delay
            links = equations.link_columns[at, k]
            values[k], covariances[k] = fit_joint(
                columns, mean, deviation, links, error
            )

    delay = period
    free = np.full(len(moves), np.inf)
    for _ in range(_DELAY_STEPS):
        fit_joints(delay, np.inf, free)
        weights = 1.0 / covariances[moves, 4, 4]
        shift = float(np.average(values[moves, 4], weights=weights))
        delay = min(max(delay - shift, 0.0), MAX_DELAY_PERIODS * period)
    delay_error = DELAY_ERROR * period
    fit_joints(delay, delay_error, free)
    inverse = values[:, 0]
    has_scale = np.sqrt(covariances[:, 0, 0]) < LARGEST_ERROR * inverse
    gain_error = np.full(len(moves), UNKNOWN_GAIN)
    if np.any(has_scale):
        gain *= np.median(1.0 / (inverse * gain)[has_scale])
        gain_error[has_gain] = OWN_GAIN
    fit_joints(delay, delay_error, gain_error)

    found = 1.0 / np.maximum(values[:, 0], 1e-9)
    numbers = found * values[:, :4].T
    numbers[0] = found
    # The derivative of each number by the joint's values.
    slopes = found[:, None, None] * np.eye(4, 5)
    slopes[:, :, 0] = -(numbers * found).T
    variance = np.einsum("kij,kjl,kil->ik", slopes, covariances, slopes)
    turn = period * np.sqrt(found / (numbers[3] + inertia))
    is_fast = moves & (turn > LARGEST_TURN)
    # Over the gain, by which all numbers of the joint are off alike.
    at_speed = np.array([0.0, USUAL_SPEED, 1.0, 0.0, 0.0])
    doubt = np.sqrt(at_speed @ covariances @ at_speed)
    return ServoFit(
        numbers=np.where(moves, numbers, in_model),
        errors=np.sqrt(variance),
        delay=delay,
        delay_error=delay_error,
        gain_ratio=found / gain,
        has_scale=has_scale,
        is_fast=is_fast,
        is_known=is_fast | (doubt < LARGEST_ERROR * (values @ at_speed)),
    )


def refine_played(problem: ServoProblem, fit: ServoFit, in_model: Array) -> ServoFit:
    """Return a fit with a delay, and numbers of fast servos, with which a model plays the windows.

    Unknown are logarithms of the numbers over the model's, or over those of the equations where it
    has none.

    Args:
        problem: windows of the log.
        fit: numbers of the equations.
        in_model: (4, n) numbers of the model, the means of wide priors.
    """
    from scipy.optimize import least_squares

    fast = np.flatnonzero(fit.is_fast)
    start = np.where(in_model > 0.0, in_model, np.maximum(fit.numbers, 1e-4))[:, fast]
    # Friction changes by as much as is typical: small changes move the rollouts less than chance.
    steps = np.append(np.repeat(_STEPS, len(fast)), _STEPS[0])
    x = np.full(len(steps), _CENTRE)

    def fit_at(x: Array) -> ServoFit:
        """Return the fit with the numbers and the delay that unknowns stand for."""
        factors = np.exp(x - _CENTRE)
        numbers = fit.numbers.copy()
        numbers[:, fast] = start * factors[:-1].reshape(4, -1)
        return replace(fit, numbers=numbers, delay=fit.delay * factors[-1])

    def residuals(x: Array, scale: Array | float) -> Array:
        """Return the position errors over their scale, then the prior's residuals."""
        errors = problem.errors([fit_at(x).servos])[0] / scale
        return np.append(errors, (x - _CENTRE) / FAST_PRIOR)

    for _ in range(2):
        errors = problem.errors([fit_at(x).servos])[0]
        scale = np.sqrt(_CORRELATED_ROLLOUTS * np.mean(errors**2, axis=0)) + 1e-9
        fitted = least_squares(
            residuals,
            x,
            jac="3-point",
            bounds=(0.0, 2.0 * _CENTRE),
            diff_step=steps / _CENTRE,
            loss="soft_l1",
            max_nfev=_EVALUATIONS,
            args=(scale,),
        )
        x = fitted.x
    refined = fit_at(x)
    variance = np.diag(np.linalg.inv(fitted.jac.T @ fitted.jac))
    least = np.array(_LEAST_ERRORS)[:, None]
    relative = np.sqrt(variance[:-1].reshape(4, -1) + least**2)
    errors = fit.errors.copy()
    errors[:, fast] = relative * refined.numbers[:, fast]
    return replace(
        refined,
        errors=errors,
        delay_error=float(refined.delay * np.sqrt(variance[-1])),
        has_scale=fit.has_scale | fit.is_fast,
    )
