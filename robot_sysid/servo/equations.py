"""Equations of an arm's servos: position errors as a list of terms, and what has to be searched.

The servo of a joint with gain K moves rotor inertia A against damping D, dry friction f and the
links' torque tau:

    K given(command(t - delay) - q) = A qdd + D qd + f sign(qd) + tau(q, qd, qdd).

Divided by K it is a list of terms of the position error: 1/K, D/K, f/K and A/K, errors of the
links, and what is searched:

* the delay, because each has other position errors;
* the dead zone b of a joint: gears and servos with play give no torque within b of the command, so
  that given(e) = e - clip(e, -b, b);
* the position error from which a servo gives no more torque. Samples that it makes wrong are left
  out, because a real servo's limit depends on speed, supply and temperature.

The best is what leaves least. A dead zone or a limit counts only where the log is clearly better
explained with it: both bend the torque over the position error, as nothing else here does.

n is the number of joints, M that of samples of all pieces, p that of terms of a joint, four.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import COULOMB, ROTOR, TERMS, VISCOUS
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimate.equations.inverse import solve
from robot_sysid.estimate.links import EXPECTED, link_factor
from robot_sysid.estimate.terms import Prior, independent
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.records.levels import CLEAR
from robot_sysid.servo.loop import (
    DELAYS,
    GRID,
    low_pass,
    low_pass_motion,
    low_pass_pieces,
    raw_distances,
    rms,
)
from robot_sysid.simulation.playback import beyond, chain_actuators, servos_in_model

LINK_SHARE = 0.01 * usual_errors.LINK
"""Relative standard deviation of links, as ``link_factor`` takes it."""
LINK_ERROR = LINK_SHARE * EXPECTED.mass
"""Relative standard deviation of the links' masses."""
FADING = tuple(term for term in TERMS.values() if term.prior == usual_errors.FADING)
"""Terms of friction that fades with speed, of which no file knows."""
FADING_SHARE = 0.01 * usual_errors.LOAD_LOSS * usual_errors.FADING
"""Standard deviation of each, over the dry friction of its joint."""
N_VALUES = 4
"""Number of terms of a joint."""
N_SEARCHED = 2
"""Number of searched quantities that errors are stated with: the delay and the dead zone."""

# ---- which samples are rows

SLOWEST = 0.1
"""Speed below which dry friction creeps, in MuJoCo as on arms, and looks like damping [rad/s]."""
NEAREST_SHARE = 0.6
"""Share of the samples that are fitted first, those nearest to their commands: far from them a
servo reaches its torque limit."""
LEAST_SLOW_SHARE = 0.05
"""Share of slower samples in the low-pass from which a row shows no torque limit and no dead zone:
a joint that sticks gives friction of any size, which looks like play."""
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
LEAST_SIZE = 1e-12
"""Least size of a term, in its units: that of a joint without any."""
DELAY_CHANGE = 0.002
"""Change of the delay from which the equations have another derivative [s]."""
DELAY_DIGITS = 1e-5
"""Accuracy of the search for the delay [s]."""
NORMAL_MEDIAN = 1.0 / 0.6745
"""Standard deviation of normal errors over the median of their sizes."""

# ---- torque limits and dead zones

N_LIMITS = 40
"""Number of torque limits that are tried."""
LEAST_UNLIMITED = 0.3
"""Least share of the moving samples below a limit: of a servo that is nearly always at its limit,
the sign of the speed would explain all."""
NEAR_LIMIT = 0.9
"""Share of the limit from which a sample counts as limited: limits are known to the
step between those that are tried, and commands between two samples are interpolated."""
LEAST_ROWS = 10.0 * CORRELATED_SAMPLES
"""Number of rows beside those at a torque limit without which a joint is not identified."""
LEAST_SHARE = 0.01
"""Share of limited samples in the low-pass from which a row is left out."""
DEAD_ZONES = np.radians(np.arange(0.1, 3.0, 0.1))
"""Dead zones that are tried before the best is refined [rad]: a servo with more play than 3 degrees
is broken."""
DEAD_ZONE_DIGITS = 1e-5
"""Accuracy of the search for a dead zone [rad]."""


def loop_columns(
    robot: RobotModel, pieces: Sequence[Recording]
) -> tuple[Array, Array, Array]:
    """Return the columns of the equations of an arm's servos, behind the low-pass.

    They are (M, n, p) the links' torque, viscous friction, dry friction and rotor inertia; (M, n,
    L) the torque by one standard deviation of each of L link errors [N m]; and (M, n, 3) friction
    that fades with speed, over what it is at rest.
    """
    dynamics = LinkDynamics(robot)
    links = list(range(robot.n_joints))
    factor = link_factor(robot, links, LINK_SHARE)
    columns = []
    link_columns = []
    fading_columns = []
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
        fading = [term.of_state(direction, qd, qdd, torque, 1.0) for term in FADING]
        fading_columns.append(np.stack(fading, axis=-1))
    joined = np.concatenate(columns), np.concatenate(link_columns)
    return *joined, np.concatenate(fading_columns)


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


def fit_joint(
    rows: Array, prior: Prior, links: Array, fading: Array
) -> tuple[Array, Array, float]:
    """Return the values (p,) of terms that explain a joint's position error, their covariance with
    what is searched (p + 2, p + 2), and the root mean square of what they leave [rad].

    They are solved from the samples nearest to their commands first, then from all that are no
    outliers. The first is that of torque; none is negative.

    Args:
        rows: (M, p + 3) derivative of the position error by the values, the delay and the dead
            zone, and the position error [rad].
        prior: of the p values, the delay and the dead zone.
        links: (M, L) torque by one standard deviation of each link error [N m], which the model
            file keeps: none of it is fitted, all of it is in the covariance.
        fading: (M, 3) friction that fades, over what it is at rest: the same holds of it.
    """
    known = prior.rows.T @ prior.rows
    # What is searched is at its best: as columns it makes the others less sure.
    is_value = np.append(
        np.ones(N_VALUES, dtype=bool), np.zeros(N_SEARCHED, dtype=bool)
    )
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
        by_links = values[0] * links[is_used]
        by_fading = FADING_SHARE * values[2] * fading[is_used]
        by_others = weight * np.hstack((by_links, by_fading))
        is_used = residual <= limit
    _, covariance = solve(normal, prior.mean)
    spread = covariance @ data[:, :-1].T @ by_others
    left = rms(np.minimum(residual, limit))
    return values[:N_VALUES], covariance + spread @ spread.T, left


class LoopEquations:
    """The equations of an arm's servos on pieces of a log, solved for what was searched last.

    Args:
        robot: the arm as in the model file.
        pieces: of logs, which have commands.

    Attributes:
        inertia: (n,) of the links about each joint [kg m^2].
        moves: (n,) whether a joint moves fast enough to show anything.
        speeds: (M, n) of the joints behind the low-pass [rad/s].
        gain: (n,) likely gains before the data [N m/rad].
        gain_error: (n,) their relative standard deviations.
        delay: of the commands [s].
        limits: (n,) position error beyond which a servo gives no more torque [rad].
        dead_zones: (n,) position error below which a servo gives none [rad].
        limited_share: (n,) share of the moving samples that a servo's torque limit makes wrong.
        is_mostly_limited: (n,) whether too few others are left to fit anything to.
        values: (n, p) of each joint 1/K, D/K, f/K, A/K; zero of one that does not move.
        covariances: (n, p + 2, p + 2) of the values, the delay and the dead zone.
    """

    def __init__(self, robot: RobotModel, pieces: Sequence[Recording]) -> None:
        n = robot.n_joints
        self._pieces = pieces
        self._columns, self._links, self._fading = loop_columns(robot, pieces)
        self.speeds = self._columns[:, :, 1]
        is_slow = np.abs(self.speeds) <= SLOWEST
        self._is_moving = ~is_slow
        slow_share = low_pass_pieces(pieces, is_slow.astype(float))
        self._shows_shape = self._is_moving & (slow_share < LEAST_SLOW_SHARE)
        self._is_limited = np.zeros_like(self._is_moving)
        self._servo_damping = np.zeros(n)
        self._damping_share = chain_actuators(robot).damping_share
        self.moves = np.any(self._is_moving, axis=0)
        self.inertia = robot.mj_model.dof_M0[robot.dof_index] - robot.armature
        gain = servos_in_model(robot).numbers[0]
        usual_gain = np.median(self.inertia) * usual_errors.SERVO_BANDWIDTH**2
        self.gain = np.where(np.isfinite(gain), gain, usual_gain)
        self.gain_error = np.full(n, UNKNOWN_GAIN)
        self.delay = 0.0
        self.limits = np.full(n, np.inf)
        self.dead_zones = np.zeros(n)
        self.limited_share = np.zeros(n)
        self.is_mostly_limited = np.zeros(n, dtype=bool)
        self.values = np.zeros((n, N_VALUES))
        size = N_VALUES + N_SEARCHED
        self.covariances = np.zeros((n, size, size))

    @property
    def shows_delay(self) -> NDArray[np.bool_]:
        """Which joints (n,) the delay is found by: those not nearly always at a torque limit."""
        others = self.moves & ~self.is_mostly_limited
        return others if np.any(others) else self.moves

    def solve_at(self, delay: float) -> float:
        """Solve the equations of all joints with a delay; return how badly they fit [nats]."""
        self.delay = delay
        joints = np.flatnonzero(self.moves)
        misfits = self._solve_joints(joints, delay)
        return float(np.sum(misfits[self.shows_delay[joints]]))

    def _solve_joints(self, joints: NDArray[np.int64], delay: float) -> Array:
        """Solve the equations of some joints (K,); return how badly each fits (K,) [nats]."""
        distances = raw_distances(self._pieces, delay)
        later = raw_distances(self._pieces, delay + DELAY_CHANGE)
        misfits = []
        for k in joints.tolist():
            rows = self._rows(k, distances[:, k], later[:, k])
            at = self._is_moving[:, k] & ~self._is_limited[:, k]
            prior = self._prior(k, rows[at])
            fit = fit_joint(rows[at], prior, self._links[at, k], self._fading[at, k])
            self.values[k], self.covariances[k], left = fit
            misfits.append(np.sum(at) / CORRELATED_SAMPLES * np.log(left))
        return np.array(misfits)

    def delay_error(self, shown: NDArray[np.bool_]) -> float:
        """Return the standard error of the delay by the equations; infinite where none shows it.

        What the terms miss of a joint, such as a dead zone that friction hides, moves the delay
        that fits it alone. Where these delays differ by more than their errors, so does the error.

        Args:
            shown: (n,) the joints that the delay is found by.
        """
        joints = np.flatnonzero(shown)
        if not len(joints):
            return np.inf
        delay = self.delay
        variances = self.covariances[joints, N_VALUES, N_VALUES]
        errors = np.maximum(np.sqrt(variances), DELAY_DIGITS)
        least = max(delay - GRID, 0.0)
        own = []
        for joint in joints[:, None]:

            def misfit(delay: float, joint: NDArray[np.int64] = joint) -> float:
                """Return how badly the joint's equations fit with a delay."""
                return float(self._solve_joints(joint, delay)[0])

            own.append(minimum(misfit, least, delay + GRID, DELAY_DIGITS))
        self.solve_at(delay)
        spread = NORMAL_MEDIAN * np.median(np.abs(np.array(own) - delay) / errors)
        return float(np.maximum(spread, 1.0) * np.sum(errors**-2.0) ** -0.5)

    def search_delay(self, candidates: Iterable[float] = DELAYS) -> None:
        """Find the delay that fits best, near the best of some candidates."""
        # A wrong delay with other numbers may be a local minimum.
        nearest = min(candidates, key=self.solve_at)
        least = max(nearest - GRID, 0.0)
        delay = minimum(self.solve_at, least, nearest + GRID, DELAY_DIGITS)
        self.solve_at(delay)

    def search_shapes(self) -> None:
        """Find the torque limit or the dead zone of each joint whose equations clearly have one.

        Each looks like the other where only one is sought: the one that explains more comes first,
        the other beside it in the next search.
        """
        distances = raw_distances(self._pieces, self.delay)
        self._servo_damping = self._damping_share * self.values[:, 1]
        for k in np.flatnonzero(self.moves).tolist():
            self._search_shape(k, distances[:, k])

    def _search_shape(self, k: int, distance: Array) -> None:
        """Set the torque limit and the dead zone of joint k, see ``search_shapes``.

        Args:
            k: number of the joint.
            distance: (M,) from its positions to the commands.
        """
        last_limit = self.limits[k]
        last_dead_zone = self.dead_zones[k]
        is_moving = self._is_moving[:, k]
        asked = np.abs(self._asked(k, distance)[is_moving])

        def misfit_of_limit(limit: float) -> float:
            """Return the misfit of the joint's equations if its servo has a limit."""
            return self._misfit(k, distance, limit, last_dead_zone)

        def misfit_of_dead_zone(dead_zone: float) -> float:
            """Return the misfit of the joint's equations if its servo has a dead zone."""
            return self._misfit(k, distance, last_limit, dead_zone)

        least = np.quantile(asked, LEAST_UNLIMITED) + LEAST_NOISE
        limits = np.geomspace(least, np.max(asked) + LEAST_NOISE, N_LIMITS)
        limit = min(limits[:-1], key=misfit_of_limit)
        limit_gain = misfit_of_limit(np.inf) - misfit_of_limit(limit)
        limit_step = misfit_of_limit(last_limit) - misfit_of_limit(limit)
        step = DEAD_ZONES[0]
        nearest = min(DEAD_ZONES, key=misfit_of_dead_zone)
        dead_zone = minimum(
            misfit_of_dead_zone, nearest - step, nearest + step, DEAD_ZONE_DIGITS
        )
        dead_zone_gain = misfit_of_dead_zone(0.0) - misfit_of_dead_zone(dead_zone)
        last_misfit = misfit_of_dead_zone(last_dead_zone)
        dead_zone_step = last_misfit - misfit_of_dead_zone(dead_zone)
        if limit_gain < CLEAR:
            self.limits[k] = np.inf
        elif limit_step >= dead_zone_step:
            self.limits[k] = limit
        if dead_zone_gain < CLEAR:
            self.dead_zones[k] = 0.0
        elif dead_zone_step > limit_step:
            self.dead_zones[k] = dead_zone

    def leave_out_limited(self) -> None:
        """Leave out the samples that a torque limit makes wrong.

        Up to here they count as given by the limit, which finds it; but the limit of a real servo
        depends on speed, supply and temperature. A joint that has too few others keeps them.
        """
        distances = raw_distances(self._pieces, self.delay)
        for k in np.flatnonzero(self.moves).tolist():
            asked = self._asked(k, distances[:, k])
            is_near = np.abs(asked) > NEAR_LIMIT * self.limits[k]
            near_share = low_pass_pieces(self._pieces, is_near.astype(float))
            is_limited = near_share > LEAST_SHARE
            is_moving = self._is_moving[:, k]
            self.limited_share[k] = np.mean(is_limited[is_moving])
            if np.sum(is_moving & ~is_limited) >= LEAST_ROWS:
                self._is_limited[:, k] = is_limited
            else:
                self.is_mostly_limited[k] = True

    def _asked(self, k: int, distance: Array) -> Array:
        """Return the torque (M,) that joint k asks its servo for, over the gain.

        The damping that the servo gives counts against its limit.
        """
        return distance - self._servo_damping[k] * self.speeds[:, k]

    def _given(self, k: int, distance: Array, limit: float, dead_zone: float) -> Array:
        """Return the torque (M,) that the servo of joint k gives, over the gain."""
        asked = self._asked(k, distance)
        excess = asked - np.clip(asked, -limit, limit)
        return beyond(distance, dead_zone) - excess

    def _rows(self, k: int, distance: Array, later: Array) -> Array:
        """Return the equations (M, p + 3) of joint k, see ``fit_joint``.

        Args:
            k: number of the joint.
            distance: (M,) from positions to commands.
            later: (M,) the same with a delay ``DELAY_CHANGE`` longer.
        """
        dead_zone = self.dead_zones[k]
        given = self._given(k, distance, self.limits[k], dead_zone)
        late = (beyond(later, dead_zone) - beyond(distance, dead_zone)) / DELAY_CHANGE
        # Also where none is found: a small one that friction hides makes friction less sure.
        by_dead_zone = np.sign(beyond(distance, dead_zone))
        signals = np.column_stack((late, by_dead_zone, given))
        smooth = low_pass_pieces(self._pieces, signals)
        return np.column_stack((self._columns[:, k], smooth))

    def _prior(self, k: int, rows: Array) -> Prior:
        """Return what is known of joint k before its equations (M, p + 3)."""
        # Beside the gain, a term may be as large as the whole distance.
        sizes = np.std(rows, axis=0)
        deviation = sizes[-1] / (sizes[:-1] + LEAST_SIZE)
        deviation[0] = self.gain_error[k] / self.gain[k]
        deviation[-1] = usual_errors.SERVO_PLAY
        mean = np.zeros_like(deviation)
        mean[0] = 1.0 / self.gain[k]
        return independent(deviation, mean)

    def _misfit(self, k: int, distance: Array, limit: float, dead_zone: float) -> float:
        """Return how badly the terms explain the equations of joint k [nats].

        No equation is left out, and what is not explained counts over what there is to explain: a
        limit and a dead zone change both, and would otherwise win by leaving nothing.

        Args:
            k: number of the joint.
            distance: (M,) from its positions to the commands.
            limit, dead_zone: of the joint's servo.
        """
        at = self._shows_shape[:, k]
        signal = self._given(k, distance, limit, dead_zone)
        given = low_pass_pieces(self._pieces, signal)[at]
        terms = self._columns[at, k]
        table = np.column_stack((terms, given))
        values = solve_not_negative(table.T @ table, np.ones(N_VALUES, dtype=bool))
        unexplained = rms(given - terms @ values) / (rms(given) + LEAST_NOISE)
        rows = len(given) / CORRELATED_SAMPLES
        return rows * float(np.log(unexplained + LEAST_NOISE))


def minimum(
    function: Callable[[float], float], least: float, largest: float, digits: float
) -> float:
    """Return where a function is least between two values."""
    from scipy.optimize import minimize_scalar

    options = {"xatol": digits}
    bounds = (least, largest)
    return float(
        minimize_scalar(function, bounds=bounds, method="bounded", options=options).x
    )
