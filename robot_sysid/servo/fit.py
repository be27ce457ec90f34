"""Servos, friction and rotor inertia fitted to an arm's commands and positions.

The servo of a joint with gain K moves rotor inertia A against damping D, dry friction f and the
links' torque tau:

    K (command(t - delay) - q) = A qdd + D qd + f sign(qd) + tau(q, qd, qdd).

Divided by K it is a list of terms of the position error: 1/K, D/K, f/K and A/K, errors of the
links, and the delay. 1/K is a torque scale without a unit, and shows only where the links' torque
is no small part. Elsewhere it comes from its prior: the gains of the other joints, because servos
of one arm are alike. What is found of a joint stays together, so that the ratios of its numbers,
which set the motion, are right whatever the gain.

The terms are those of every fit, formulas of ``dynamics.friction`` with a ``Prior`` each, and their
normal equations have its solver (``estimate.fit.solve``). What is not the one fit's:

* The delay is no small error here but up to a fifth of a second, and is searched: each has other
  position errors, and the best is the one that leaves least.
* Links are not fitted, because the file keeps them; all that they may be off by is in the errors.
* All samples are rows, behind a short low-pass (``loop``), and those are left out that are far from
  what fits the others: there a servo is at its torque limit, for which no linear term stands.

The equation is valid as long as the samples resolve the motion. The numbers of a joint whose servo
is faster are those of ``played_fit``.

n is the number of joints, M that of samples of all pieces, p that of terms of a joint, four.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import COULOMB, ROTOR, VISCOUS
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimate.fit import solve
from robot_sysid.estimate.links import EXPECTED, link_factor
from robot_sysid.estimate.terms import Prior, independent
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.servo.loop import (
    DELAYS,
    GRID,
    distances,
    longest_period,
    low_pass,
    low_pass_motion,
    rms,
)
from robot_sysid.simulation.playback import ServoParameters, servos_in_model

LINK_SHARE = 0.01 * usual_errors.LINK
"""Relative standard deviation of links, as ``link_factor`` takes it."""
LINK_ERROR = LINK_SHARE * EXPECTED.mass
"""Relative standard deviation of the links' masses."""
LARGEST_ERROR = 0.4
"""Relative standard error up to which a number is identified, and up to which a joint's resistance
at 1 rad/s is known well enough for its numbers to be written."""

# ---- which samples are rows

SLOWEST = 0.1
"""Speed below which dry friction creeps, in MuJoCo as on arms, and looks like damping [rad/s]."""
NEAREST_SHARE = 0.6
"""Share of the samples that are fitted first, those nearest to their commands: far from them a
servo reaches its torque limit."""
OUTLIER = 5.0
"""Residual over the noise beyond which a sample is left out."""
TRIMMINGS = 4
"""Number of times that samples are chosen by the fit before."""
CORRELATED_SAMPLES = 10.0
"""Samples that count as one independent row: errors of friction near standstill and of smoothed
accelerations last about as long as a start or a stop."""
LEAST_NOISE = 1e-9
"""Least noise of a position error [rad or m]."""

# ---- gains and delay

UNKNOWN_GAIN = 1e3
"""Relative standard deviation of a gain that the data alone determines."""
LEAST_COMPLIANCE = 1e-9
"""Least 1/K of a joint [rad/(N m)]."""
LEAST_SIZE = 1e-12
"""Least size of a term, in its units: that of a joint without any."""
DELAY_DIGITS = 1e-5
"""Accuracy of the search for the delay [s]."""
CREEP_DELAY = 1e-4
"""Error of the delay by friction that creeps [s]."""
SAMPLING_DELAY = 0.02
"""Error of the delay by sampling, over the sampling period."""

# ---- servos that are too fast

FASTEST_TURN = 1.2
"""Angle by which the oscillation of a servo without damping may turn between two samples [rad]:
differences of faster motion are no derivatives, and its equations are wrong."""
SHORTEST_PERIOD = 0.01
"""Sampling period below which none resolves a faster motion [s]: the low-pass hides it."""


def loop_columns(robot: RobotModel, pieces: Sequence[Recording]) -> tuple[Array, Array]:
    """Return the columns of the equations of an arm's servos, behind the low-pass.

    They are (M, n, p) the links' torque, viscous friction, dry friction and rotor inertia; and (M,
    n, L) the torque by one standard deviation of each of L link errors [N m].
    """
    dynamics = LinkDynamics(robot)
    links = list(range(robot.n_joints))
    factor = link_factor(robot, links, LINK_SHARE)
    columns = []
    link_columns = []
    for piece in pieces:
        q, qd, qdd = low_pass_motion(piece)
        motion = dynamics.motion(q, qd, qdd)
        torque = motion.torque(robot.thetas)
        direction = low_pass(piece.time, np.sign(qd))
        terms = [torque]
        for term in (VISCOUS, COULOMB, ROTOR):
            terms.append(term.of_state(direction, qd, qdd, torque, 1.0))
        columns.append(np.stack(terms, axis=-1))
        link_columns.append(motion.columns(links) @ factor)
    return np.concatenate(columns), np.concatenate(link_columns)


def solve_not_negative(normal: Array, is_free: NDArray[np.bool_]) -> Array:
    """Return the solution (k,) of products (k + 1, k + 1) in which no value is negative.

    Values that are not ``is_free`` (k,) are zero. Those that cross zero are held there and not
    released, as in the one fit, but one after the other, that which crosses farthest first: held
    together, some would be that need not, because friction, damping and rotor trade.
    """
    scale = np.sqrt(np.diag(normal)[:-1])
    zero = np.zeros(len(is_free))
    while np.any(is_free):
        values, _ = solve(normal, zero, is_free)
        farthest = np.argmin(scale * values)
        if values[farthest] >= 0.0:
            return values
        is_free = is_free & (np.arange(len(values)) != farthest)
    return zero


def fit_joint(rows: Array, prior: Prior, links: Array) -> tuple[Array, Array, float]:
    """Return the values (p,) of terms that explain a joint's position error, their covariance with
    the delay's (p + 1, p + 1), and the root mean square of what they leave [rad].

    They are solved from the samples nearest to their commands first, then from all that are no
    outliers. The first is that of torque; none is negative.

    Args:
        rows: (M, p + 2) derivative of the position error by the values and the delay, and the
            position error [rad].
        prior: of the p values and the delay.
        links: (M, L) torque by one standard deviation of each link error [N m], which the model
            file keeps: none of it is fitted, all of it is in the covariance.
    """
    known = prior.rows.T @ prior.rows
    # The delay is at its best: as a column it makes the others less sure.
    is_value = np.append(np.ones(len(known) - 2, dtype=bool), False)
    error = rows[:, -1]
    residual = np.abs(error)
    is_used = residual <= np.quantile(residual, NEAREST_SHARE)
    for _ in range(TRIMMINGS):
        noise = rms(residual[is_used]) + LEAST_NOISE
        limit = OUTLIER * noise
        weight = 1.0 / (noise * np.sqrt(CORRELATED_SAMPLES))
        data = weight * rows[is_used]
        normal = known + data.T @ data
        values = solve_not_negative(normal, is_value)
        residual = np.abs(error - rows[:, :-1] @ values)
        by_links = weight * values[0] * links[is_used]
        is_used = residual <= limit
    _, covariance = solve(normal, prior.mean)
    spread = covariance @ data[:, :-1].T @ by_links
    left = rms(np.minimum(residual, limit))
    return values[:-1], covariance + spread @ spread.T, left


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
    is_moving = np.abs(columns[:, :, 1]) > SLOWEST
    moves = np.any(is_moving, axis=0)
    in_model = servos_in_model(robot).numbers
    inertia = robot.mj_model.dof_M0[robot.dof_index] - robot.armature
    has_gain = np.isfinite(in_model[0])
    usual_gain = np.median(inertia) * usual_errors.SERVO_BANDWIDTH**2
    gain = np.where(has_gain, in_model[0], usual_gain)
    # Of each joint 1/K, D/K, f/K, A/K; zero of one that does not move.
    values = np.zeros((len(moves), 4))
    covariances = np.zeros((len(moves), 5, 5))
    # Standard deviation of the logarithm of a joint's gain over the model's.
    gain_error = np.full(len(moves), UNKNOWN_GAIN)

    def fit_joints(delay: float) -> float:
        """Set values and covariances of the joints that move; return the log of what they leave."""
        errors = distances(pieces, delay)
        late = (distances(pieces, delay + GRID) - errors) / GRID
        misfit = 0.0
        for k in np.flatnonzero(moves):
            at = is_moving[:, k]
            rows = np.column_stack((columns[at, k], late[at, k], errors[at, k]))
            # Beside the gain, a term may be as large as the whole distance.
            sizes = np.std(rows, axis=0)
            deviation = sizes[-1] / (sizes[:-1] + LEAST_SIZE)
            deviation[0] = gain_error[k] / gain[k]
            mean = np.array([1.0 / gain[k], 0.0, 0.0, 0.0, 0.0])
            prior = independent(deviation, mean)
            values[k], covariances[k], residual = fit_joint(
                rows, prior, link_columns[at, k]
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
        options={"xatol": DELAY_DIGITS},
    ).x
    fit_joints(delay)
    gain_error[:] = usual_errors.SERVO_GAIN
    has_scale = np.sqrt(covariances[:, 0, 0]) < LARGEST_ERROR * values[:, 0]
    if np.any(has_scale):
        gain *= np.median(1.0 / (values[:, 0] * gain)[has_scale])
        gain_error[has_gain] = usual_errors.SERVO_GAIN_SPREAD
    fit_joints(delay)
    information = np.sum(1.0 / covariances[moves, 4, 4])
    covariances = covariances[:, :4, :4]

    found = np.where(moves, 1.0 / np.maximum(values[:, 0], LEAST_COMPLIANCE), gain)
    numbers = found * values.T
    numbers[0] = found
    # The derivative of each number by the joint's values.
    slopes = found[:, None, None] * np.eye(4)
    slopes[:, :, 0] = -(numbers * found).T
    variance = np.einsum("kij,kjl,kil->ik", slopes, covariances, slopes)
    turn = max(period, SHORTEST_PERIOD) * np.sqrt(found / (numbers[3] + inertia))
    is_fast = moves & (turn > FASTEST_TURN)
    # Over the gain, by which all numbers of the joint are off alike.
    at_speed = np.array([0.0, 1.0, 1.0, 0.0])
    doubt = np.sqrt(at_speed @ covariances @ at_speed)
    return ServoFit(
        numbers=np.where(moves | np.isnan(in_model), numbers, in_model),
        errors=np.sqrt(variance),
        delay=delay,
        is_fast=is_fast,
        is_known=is_fast | (doubt < LARGEST_ERROR * (values @ at_speed)),
        delay_error=np.hypot(CREEP_DELAY + SAMPLING_DELAY * period, information**-0.5),
    )
