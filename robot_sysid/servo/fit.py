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
from robot_sysid.estimate.links import link_factor
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.records.usual_errors import EXPECTED_SCALES, LINK
from robot_sysid.servo.windows import (
    MAX_DELAY,
    ServoProblem,
    commands,
    longest_period,
    low_pass,
    low_pass_motion,
    rms,
)
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.simulation.playback import STEP, ServoParameters, servos_in_model

LINK_ERROR = 0.01 * LINK * EXPECTED_SCALES[0]
"""Relative standard deviation of the links' masses."""
LARGEST_ERROR = 0.4
"""Relative standard error up to which a number is identified, and up to which a joint's resistance
at 1 rad/s is known well enough for its numbers to be written."""
GRID = 0.005
"""Distance between ``DELAYS`` [s]."""
DELAYS = np.arange(0.0, MAX_DELAY, GRID)
"""Delays that are tried before the best of them is refined [s]."""
# Relative errors of a fast servo's numbers beside those of noise: of the links, which fix the scale
# and add up to about two single ones, and of friction that a stiff servo hides.
_LEAST_ERRORS = (2.0 * LINK_ERROR, 2.0 * LINK_ERROR, 2.0, 2.0 * LINK_ERROR)


def distances(pieces: Sequence[Recording], delay: float) -> Array:
    """Return the distance (M, n) from each position to its command of ``delay`` [s] before, behind
    the low-pass.
    """
    from scipy.interpolate import make_interp_spline

    distances = []
    for piece in pieces:
        # Commands that hold until the next one are, below half of the sampling rate, a smooth curve
        # through the middles of their periods, whose means over a period they are.
        held = commands(piece).copy()
        held[1:-1] += np.diff(held, 2, axis=0) / 24.0
        middle = 0.5 * sampling_period(piece.time)
        curve = make_interp_spline(piece.time + middle, held)
        at = np.maximum(piece.time - delay, piece.time[0] + middle)
        distances.append(low_pass(piece.time, curve(at) - piece.q))
    return np.concatenate(distances)


def goal_error(pieces: Sequence[Recording]) -> float:
    """Return the error of the commands of some time before, where that time fits best [rad or m].

    It is the root mean square of all joints.
    """
    return min(rms(distances(pieces, delay)) for delay in DELAYS)


def loop_columns(robot: RobotModel, pieces: Sequence[Recording]) -> tuple[Array, Array]:
    """Return the columns of the equations of an arm's servos, behind the low-pass.

    They are (M, n, 4) the links' torque, velocity, its sign, and acceleration; and (M, n, L) the
    torque by one standard deviation of each of L link errors [N m].
    """
    dynamics = LinkDynamics(robot)
    links = list(range(robot.n_joints))
    factor = link_factor(robot, links, 0.01 * LINK)
    columns = []
    link_columns = []
    for piece in pieces:
        q, qd, qdd = low_pass_motion(piece)
        motion = dynamics.motion(q, qd, qdd)
        sign = low_pass(piece.time, np.sign(qd))
        terms = motion.torque(robot.thetas), qd, sign, qdd
        columns.append(np.stack(terms, axis=-1))
        link_columns.append(motion.columns(links) @ factor)
    return np.concatenate(columns), np.concatenate(link_columns)


def fit_joint(
    columns: Array, mean: Array, deviation: Array, links: Array, error: Array
) -> tuple[Array, Array, float]:
    """Return the values (p,) of terms that explain a joint's position error, their covariance with
    the delay's (p + 1, p + 1), and the root mean square of what they leave [rad].

    They are solved from the samples nearest to their commands first, then from all that are no
    outliers. The first is that of torque; none is negative.

    Args:
        columns: (M, p + 1) derivative of the position error by the values and the delay.
        mean: (p,) what is known of the values.
        deviation: (p + 1,) how well they and the delay are known.
        links: (M, L) torque by one standard deviation of each link error [N m], which the model
            file keeps: none of it is fitted, all of it is in the covariance.
        error: (M,) position error [rad].
    """
    from scipy.optimize import nnls

    residual = np.abs(error)
    # The samples nearest to their commands first: far from them a servo reaches its torque limit.
    is_used = residual <= np.quantile(residual, 0.6)
    for _ in range(4):
        noise = rms(residual[is_used]) + 1e-9
        # Samples with a larger residual are left out.
        limit = 5.0 * noise
        # Errors of about ten samples are correlated: those of friction near standstill and of
        # smoothed accelerations last about as long as a start or a stop.
        weight = 1.0 / (noise * np.sqrt(10.0))
        data = weight * columns[is_used]
        rows = np.vstack((data, np.diag(1.0 / deviation)))
        known = np.append(weight * error[is_used], mean / deviation[:-1])
        # The delay is at its best: as a column it makes the others less sure.
        values, _ = nnls(rows[:-1, :-1], known)
        residual = np.abs(error - columns[:, :-1] @ values)
        by_links = weight * values[0] * links[is_used]
        is_used = residual <= limit
    covariance = np.linalg.inv(rows.T @ rows)
    spread = covariance @ data.T @ by_links
    return values, covariance + spread @ spread.T, rms(np.minimum(residual, limit))


@dataclass(frozen=True)
class ServoFit(ServoParameters):
    """The fitted numbers of an arm and how sure they are.

    Attributes:
        errors: (4, n) standard errors of the numbers.
        is_fast: (n,) whether the samples do not resolve the motion of the servo.
        is_known: (n,) whether a joint moves enough to show its numbers.
        delay_error: standard error of the delay [s].
    """

    errors: Array
    is_fast: NDArray[np.bool_]
    is_known: NDArray[np.bool_]
    delay_error: float

    @property
    def is_shown(self) -> NDArray[np.bool_]:
        """Which numbers (4, n) the data shows, and not only in proportion to the gain."""
        return self.errors < LARGEST_ERROR * self.numbers


def fit_servos(robot: RobotModel, pieces: Sequence[Recording]) -> ServoFit:
    """Return the servo numbers that solve the equations best, with one delay for all joints.

    The delay is found first. Links then show the gains of the joints that carry them, and the
    others' are taken to be like these. Joints that do not move keep the model's numbers.
    """
    from scipy.optimize import minimize_scalar

    columns, link_columns = loop_columns(robot, pieces)
    # Slower, dry friction creeps, in MuJoCo as on arms, and looks like damping [rad/s].
    is_moving = np.abs(columns[:, :, 1]) > 0.1
    moves = np.any(is_moving, axis=0)
    in_model = servos_in_model(robot).numbers
    inertia = robot.mj_model.dof_M0[robot.dof_index] - robot.armature
    has_gain = np.isfinite(in_model[0])
    # A bandwidth of 20 rad/s where the model says nothing.
    gain = np.where(has_gain, in_model[0], np.median(inertia) * 20.0**2)
    # Of each joint 1/K, D/K, f/K, A/K; zero of one that does not move.
    values = np.zeros((len(moves), 4))
    covariances = np.zeros((len(moves), 5, 5))

    # Standard deviation of the logarithm of a joint's gain over the model's: at first the data
    # alone determines it.
    gain_error = np.full(len(moves), 1e3)

    def fit_joints(delay: float) -> float:
        """Set values and covariances of the joints that move; return the log of what they leave."""
        errors = distances(pieces, delay)
        late = (distances(pieces, delay + GRID) - errors) / GRID
        misfit = 0.0
        for k in np.flatnonzero(moves):
            at = is_moving[:, k]
            mean = np.array([1.0 / gain[k], 0.0, 0.0, 0.0])
            # Beside the gain, a term may be as large as the whole distance.
            terms = np.column_stack((columns[at, k], late[at, k]))
            size = np.std(terms, axis=0) + 1e-12
            deviation = np.std(errors[at, k]) / size
            deviation[0] = gain_error[k] / gain[k]
            values[k], covariances[k], residual = fit_joint(
                terms, mean, deviation, link_columns[at, k], errors[at, k]
            )
            misfit += np.sum(at) * np.log(residual)
        return misfit

    period = longest_period(pieces)
    # A wrong delay with other numbers may be a local minimum.
    nearest = min(DELAYS, key=fit_joints)
    delay = minimize_scalar(
        fit_joints,
        bounds=(max(nearest - GRID, 0.0), nearest + GRID),
        method="bounded",
        options={"xatol": 1e-5},
    ).x
    fit_joints(delay)
    # That of all gains together, and of one about the others where the model has none.
    gain_error[:] = 1.5
    has_scale = np.sqrt(covariances[:, 0, 0]) < LARGEST_ERROR * values[:, 0]
    if np.any(has_scale):
        gain *= np.median(1.0 / (values[:, 0] * gain)[has_scale])
        # Servos of one arm are of one kind, and set alike.
        gain_error[has_gain] = 0.5
    fit_joints(delay)
    information = np.sum(1.0 / covariances[moves, 4, 4])
    covariances = covariances[:, :4, :4]

    found = np.where(moves, 1.0 / np.maximum(values[:, 0], 1e-9), gain)
    numbers = found * values.T
    numbers[0] = found
    # The derivative of each number by the joint's values.
    slopes = found[:, None, None] * np.eye(4)
    slopes[:, :, 0] = -(numbers * found).T
    variance = np.einsum("kij,kjl,kil->ik", slopes, covariances, slopes)
    # Angle [rad] by which the oscillation of a servo without damping turns between two samples:
    # differences of faster motion are no derivatives, and its equations are wrong. Periods below
    # 10 ms resolve no faster motion, which the low-pass hides.
    turn = max(period, 0.01) * np.sqrt(found / (numbers[3] + inertia))
    is_fast = moves & (turn > 1.2)
    # Over the gain, by which all numbers of the joint are off alike.
    at_speed = np.array([0.0, 1.0, 1.0, 0.0])
    doubt = np.sqrt(at_speed @ covariances @ at_speed)
    return ServoFit(
        numbers=np.where(moves | np.isnan(in_model), numbers, in_model),
        errors=np.sqrt(variance),
        delay=delay,
        is_fast=is_fast,
        is_known=is_fast | (doubt < LARGEST_ERROR * (values @ at_speed)),
        # Beside that of noise, those of friction that creeps [s] and of sampling.
        delay_error=np.hypot(1e-4 + 0.02 * period, information**-0.5),
    )


def refine_played(problem: ServoProblem, fit: ServoFit) -> ServoFit:
    """Return a fit with a delay, and numbers of fast servos, with which a model plays the windows.

    Unknown are factors on the model's numbers, the means of wide priors, or on those of the
    equations where it has none, and on the delay.

    Args:
        problem: windows of the log.
        fit: numbers of the equations.
    """
    from scipy.optimize import least_squares

    fast = fit.is_fast
    if not np.any(fast):
        return fit
    in_model = servos_in_model(problem.rollouts.robot).numbers
    start = np.where(in_model > 0.0, in_model, np.maximum(fit.numbers, 1e-4))[:, fast]
    # Of the delay [s].
    unit = 0.004

    def fit_at(factors: Array) -> ServoFit:
        """Return the fit with the numbers and the delay that factors stand for."""
        numbers = fit.numbers.copy()
        numbers[:, fast] = start * factors[:-1].reshape(4, -1)
        return replace(fit, numbers=numbers, delay=unit * (factors[-1] - 1.0))

    def residuals(factors: Array, scale: Array) -> Array:
        """Return the position errors over their scale, then the prior's residuals.

        The logarithms of a fast servo's numbers about the model's have a standard deviation of one.
        """
        errors = problem.errors(fit_at(factors)) / scale
        return np.append(errors, np.log(factors[:-1]))

    factors = np.append(np.ones(start.size), 1.0 + fit.delay / unit)
    least = np.append(np.full(start.size, 0.01), 1.0)
    for _ in range(2):
        squares = problem.errors(fit_at(factors)) ** 2
        # Errors of about thirty samples are correlated: they last until the servo brings them back.
        scale = np.sqrt(30.0 * np.mean(squares, axis=(0, 1)))
        fitted = least_squares(
            residuals,
            factors,
            jac="3-point",
            bounds=(least, 100.0),
            # A servo that is at its limit again and again makes rollouts rough on smaller scales.
            diff_step=0.3,
            loss="soft_l1",
            max_nfev=5,
            args=(scale + 1e-9,),
        )
        factors = fitted.x
    refined = fit_at(factors)
    deviation = np.sqrt(np.diag(np.linalg.inv(fitted.jac.T @ fitted.jac)))
    by_noise = (deviation / factors)[:-1].reshape(4, -1)
    relative = np.hypot(by_noise, np.vstack(_LEAST_ERRORS))
    errors = fit.errors.copy()
    errors[:, fast] = relative * refined.numbers[:, fast]
    # A servo at its limit is not damped exactly in the middle of a step.
    delay_error = np.hypot(0.5 * STEP, unit * deviation[-1])
    return replace(refined, errors=errors, delay_error=float(delay_error))
