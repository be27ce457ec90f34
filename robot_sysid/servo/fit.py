"""Servos, friction and rotor inertia fitted to an arm's commands and positions by output error.

The fitted numbers are those whose rollouts come nearest to the measured positions. The unknowns are
logarithms of the numbers over their typical sizes, softened so that zero is not far away. Gain,
damping, friction and rotor inertia of a joint that grow together by one factor change the motion
little where links and gravity are small beside them, so that numbers come from the equations of
the closed loop (``loop_equations``), which see the links' torque itself, as far as these determine
them. Searched for are the others, and the delay.

Arrays of all numbers of an arm of n joints have the order of ``ServoParameters.vector()``,
(4 n + 1,): stiffness, damping, dry friction and rotor inertia of all joints, then the delay. M is
the number of samples in all windows, p that of unknowns. ``ServoProblem`` plays the windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.uncertainty import (
    autocorrelation_time,
    autocovariance,
)
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.messages import Progress
from robot_sysid.servo.loop_equations import (
    LoopFit,
    link_errors,
    loop_equations,
    solve_loop_equations,
)
from robot_sysid.servo.windows import MAX_DELAY_PERIODS, ServoProblem
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.simulation.playback import (
    STEP,
    ServoParameters,
    chain_actuators,
    servos_in_model,
)

GAIN_FACTORS = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Factors on the start's gains that are tried before the search. With a larger one a servo is at
its limit all the time, and chance decides which fits best."""
_GRID_WINDOWS = 6
"""Largest number of windows that are played for the grid of start gains."""
MAX_RATIO = 100.0
"""Upper bound of a number, in typical sizes."""
LOG_OFFSET = 0.3
"""Added to a number, in typical sizes, before its logarithm: far below it, steps are absolute."""
PRIOR_DEVIATION = 2.5
"""Standard deviation of the weak prior of each unknown about its start: a factor of twelve."""
MAX_EVALUATIONS = 8
"""Largest number of evaluations in one search."""
_TOLERANCE = 1e-4
"""Relative change of the unknowns, or of the cost, at which a search ends."""
# Step of the central differences of the unknowns, in units of ``Parametrisation.unit``.
# A servo that is at its limit again and again makes the error rough on smaller scales.
_DIFFERENCE_STEP = 0.04
_LEAST_SIZE = 1e-3
"""Least typical size of a joint's dry friction [N m]; a hundredth of it is that of rotor inertia
[kg m^2]."""
UNSEEN_SPREAD = 1.0 / 3.0
"""Standard error, in units of the search (``Parametrisation.unit``), from which on a number counts
as not identified: three standard errors are then as large as the typical number."""
_AT_BOUND = 0.02
"""Number, in typical sizes, below which it is at its bound of zero: the search ended there."""
_FRICTION = 2
"""Position of friction among the four numbers of a joint."""
_POSITIONS = 200
"""Number of positions that stand for a whole log."""
_DEFAULT_RATE = 20.0
"""Bandwidth of a servo of which the model says nothing [rad/s]."""


@dataclass(frozen=True)
class Parametrisation:
    """How a vector of p unknowns (p,) stands for servo parameters.

    The unknown of a free number x with typical size s is log(x / s + ``LOG_OFFSET``), of the delay
    x / s.

    Attributes:
        start: parameters where the search starts; fixed numbers keep these.
        typical: typical size of every number.
        free: (4 n + 1,) which numbers are unknown.
    """

    start: ServoParameters
    typical: ServoParameters
    free: NDArray[np.bool_]

    def unknowns(self, servos: ServoParameters) -> Array:
        """Return the vector of unknowns (p,) that stands for parameters."""
        values = servos.vector() / self.typical.vector()
        values[:-1] = np.log(values[:-1] + LOG_OFFSET)
        return values[self.free]

    def servos(self, unknowns: Array) -> ServoParameters:
        """Return the parameters that a vector of unknowns (p,) stands for, none below zero.

        Fixed numbers are those of ``start``.
        """
        values = np.zeros(len(self.free))
        values[self.free] = unknowns
        values[:-1] = np.maximum(np.exp(values[:-1]) - LOG_OFFSET, 0.0)
        free_values = values * self.typical.vector()
        return ServoParameters.from_vector(
            np.where(self.free, free_values, self.start.vector())
        )

    def derivative(self, servos: ServoParameters) -> Array:
        """Return the derivative (4 n + 1,) of each number by its own unknown, in its own unit.

        It is x + ``LOG_OFFSET`` s for a number x with typical size s, and s for the delay.
        """
        size = self.typical.vector()
        size[:-1] = servos.vector()[:-1] + LOG_OFFSET * size[:-1]
        return size

    def unit(self, servos: ServoParameters) -> Array:
        """Return the scale (4 n + 1,) of each number, in its own unit.

        It is the derivative by the unknown, at least the typical size: the change of a number that
        counts as large as one unit of the search.
        """
        return np.maximum(self.derivative(servos), self.typical.vector())

    def bounds(self) -> tuple[Array, Array]:
        """Return the lower and the upper bound of the unknowns (p,).

        They stand for numbers of zero, and for ``MAX_RATIO`` times the typical sizes with a delay
        of ``MAX_DELAY_PERIODS`` typical ones.
        """
        size = self.typical.vector()
        zero = ServoParameters.from_vector(0.0 * size)
        largest = MAX_RATIO * size
        largest[-1] = MAX_DELAY_PERIODS * size[-1]
        return self.unknowns(zero), self.unknowns(ServoParameters.from_vector(largest))


def initial_parametrisation(
    robot: RobotModel, pieces: Sequence[Measurement], moves: NDArray[np.bool_]
) -> tuple[Parametrisation, LoopFit]:
    """Return the parametrisation of a search for servo parameters, and what its start comes from.

    The numbers of joints that move are where the equations of their closed loops put them. Numbers
    that these determine are fixed, because rollouts show little but ratios of a joint's numbers,
    and friction too small. All numbers are free of a joint whose servo is too fast for the
    equations; they start at the model's. Every free number starts at 0.1 of its typical size at
    least.

    Args:
        robot: the arm as in the model file.
        pieces: pieces of logs, some with commands.
        moves: (n,) which joints move; the numbers of the others are fixed.
    """
    in_model = servos_in_model(robot)
    gravity, inertia = _gravity_and_inertia(robot, log_positions(pieces))
    inertia += in_model.armature
    equations = loop_equations(robot, pieces)
    default_gain = inertia * _DEFAULT_RATE**2
    loop_fit = solve_loop_equations(robot, equations, moves, default_gain)
    is_resolved = loop_fit.is_resolved(inertia - in_model.armature)
    loop_fit = loop_fit.restrict(is_resolved)
    use_model = ~is_resolved & np.isfinite(in_model.stiffness)
    in_loop = loop_fit.servos.vector()
    in_loop[:-1][np.tile(use_model, 4)] = np.nan
    start = ServoParameters.from_vector(
        np.where(np.isfinite(in_loop), in_loop, in_model.vector())
    )
    stiffness = np.where(np.isfinite(start.stiffness), start.stiffness, default_gain)
    inertia += np.maximum(start.armature - in_model.armature, 0.0)
    # A tenth of critical damping at the servo's own bandwidth.
    typical_damping = 0.2 * np.sqrt(stiffness * inertia)
    # Friction is rarely less than this share of a geared motor's load or limit.
    distance = np.max(np.abs(equations.distances(start.delay)), axis=0)
    largest_torque = np.minimum(chain_actuators(robot).limit, stiffness * distance)
    typical_friction = np.maximum(0.05 * gravity, 0.02 * largest_torque)
    least_armature = np.maximum(0.2 * inertia, 1e-2 * _LEAST_SIZE)
    periods = [sampling_period(piece.time) for piece in pieces]
    typical = ServoParameters(
        stiffness=stiffness,
        damping=np.maximum(start.damping, typical_damping),
        frictionloss=np.maximum(
            start.frictionloss, np.maximum(typical_friction, _LEAST_SIZE)
        ),
        armature=np.maximum(start.armature, least_armature),
        delay=float(np.median(periods)),
    )
    free = np.append(np.tile(moves, 4), True)
    free[: len(moves)] &= ~is_resolved
    free &= ~loop_fit.determines
    start_vector = replace(start, stiffness=stiffness).vector()
    # From zero the search would hardly get away.
    start_vector = np.maximum(start_vector, 0.1 * typical.vector() * free)
    start = ServoParameters.from_vector(start_vector)
    return Parametrisation(start, typical, free), loop_fit


def log_positions(pieces: Sequence[Measurement]) -> Array:
    """Return up to ``_POSITIONS`` positions (m, n) [rad or m] that stand for pieces of logs."""
    all_q = np.concatenate([piece.q for piece in pieces])
    return all_q[np.linspace(0, len(all_q) - 1, _POSITIONS).astype(int)]


def _gravity_and_inertia(robot: RobotModel, q: Array) -> tuple[Array, Array]:
    """Return each joint's largest gravity torque (n,) [N m] and mean inertia (n,) [kg m^2].

    Both are over the positions q (m, n) [rad or m]; an inertia is 1e-6 at least.
    """
    thetas = robot.thetas
    dynamics = LinkDynamics(robot)
    gravity = dynamics.motion(q, 0.0 * q, 0.0 * q).torque(thetas)
    inertia = []
    # A joint's inertia is the torque that it needs, beside gravity, for 1 rad/s^2 alone.
    for unit_vector in np.eye(q.shape[1]):
        acceleration = np.tile(unit_vector, (len(q), 1))
        torque = dynamics.motion(q, 0.0 * q, acceleration).torque(thetas)
        inertia.append(np.mean((torque - gravity) @ unit_vector))
    return np.max(np.abs(gravity), axis=0), np.maximum(inertia, 1e-6)


def improve_start(problem: ServoProblem, initial: Parametrisation) -> Parametrisation:
    """Return the parametrisation with the best start gains and delay of a coarse grid.

    All joints share the delay; each whose gain is free gets its own gain. Without such joints the
    start is kept.

    Args:
        problem: windows of which up to ``_GRID_WINDOWS`` are played.
        initial: its start gains are multiplied by ``GAIN_FACTORS``; the rest is kept.

    Raises:
        InputError: the model cannot be played with these commands.
    """
    start = initial.start
    is_free = initial.free[: len(start.stiffness)]
    factors = np.where(is_free, np.array(GAIN_FACTORS)[:, None], 1.0)
    delays = initial.typical.delay * np.arange(0.0, MAX_DELAY_PERIODS + 1.0)
    if not np.any(is_free):
        factors = factors[:1]
        delays = np.array([start.delay])
    grid = product(factors * start.stiffness, delays.tolist())
    candidates = [replace(start, stiffness=k, delay=delay) for k, delay in grid]
    # Absolute errors: where a stiff servo comes off its limit, single windows run off and would
    # dominate the squares.
    errors = problem.subset(_GRID_WINDOWS).errors(candidates)
    error = np.mean(np.abs(errors), axis=1)
    # Errors are pi where a rollout has diverged: here the best candidate's for most of the time.
    if np.min(np.mean(errors == np.pi, axis=(1, 2))) > 0.5:
        raise InputError(
            "the model cannot be played with these commands; check their units"
        )
    # Mean errors (factors, delays, n): the sum over joints of the best factors chooses the delay.
    error_grid = error.reshape(len(factors), len(delays), -1)
    best_delay = int(np.argmin(np.sum(np.min(error_grid, axis=0), axis=1)))
    best = np.argmin(error_grid[:, best_delay], axis=0)
    stiffness = factors[best, np.arange(len(best))] * start.stiffness
    best_start = replace(start, stiffness=stiffness, delay=float(delays[best_delay]))
    return replace(initial, start=best_start)


@dataclass(frozen=True)
class ServoFit:
    """The fitted numbers of an arm and how sure they are.

    Attributes:
        servos: the numbers.
        errors: their standard errors, zero for fixed numbers.
        is_identified: (4 n + 1,) whether the data shows a number; the others keep the model's value
            where the model has one.
        position_error: (n,) root mean square error of the rollouts [rad].
    """

    servos: ServoParameters
    errors: ServoParameters
    is_identified: NDArray[np.bool_]
    position_error: Array


def search_servos(
    derivatives: ErrorDerivatives, parametrisation: Parametrisation, progress: Progress
) -> ServoParameters:
    """Return the parameters whose rollouts come nearest to the measured positions.

    Bounded least-squares searches, two or, where the first does not move, one; each divides a
    joint's errors by their root mean square at its start.

    Args:
        derivatives: derivatives of the position errors in the fitted windows.
        parametrisation: its start is that of the search and the centre of a weak prior.
        progress: is advanced with each evaluation.
    """
    from scipy.optimize import least_squares

    problem = derivatives.problem
    bounds = parametrisation.bounds()
    origin = np.clip(parametrisation.unknowns(parametrisation.start), *bounds)
    x = origin
    evaluations = 0.0

    # scipy calls both with the unknowns (p,) and with ``args``: each joint's scale (n,) [rad] and
    # the name of the stage.
    def residuals(unknowns: Array, scale: Array, _: str) -> Array:
        """Return the errors over their scale, then the prior's residuals (M n + p,)."""
        error = problem.errors([parametrisation.servos(unknowns)])[0] / scale
        prior = (unknowns - origin) / PRIOR_DEVIATION
        return np.concatenate((error.ravel(), prior))

    def jacobian(unknowns: Array, scale: Array, stage: str) -> Array:
        """Return the derivative (M n + p, p) of the residuals by the p unknowns; show progress.

        Errors of M samples and n joints are divided by ``scale`` (n,); ``stage`` names the search.
        """
        nonlocal evaluations
        evaluations = min(evaluations + 1.0, MAX_EVALUATIONS - 0.5)
        progress.advance(stage, done=evaluations, total=MAX_EVALUATIONS, text="")
        servos = parametrisation.servos(unknowns)
        # From the derivative by each number to that by its unknown.
        chain_rule = parametrisation.derivative(servos)[parametrisation.free]
        slopes = derivatives.at(parametrisation, servos) * chain_rule
        slopes /= scale[:, None]
        prior = np.eye(len(unknowns)) / PRIOR_DEVIATION
        return np.vstack((slopes.reshape(-1, len(unknowns)), prior))

    for stage in ("First search", "Second search"):
        evaluations = 0.0
        stage_start = x
        scale = _rms_error(problem.errors([parametrisation.servos(x)])[0])
        x = least_squares(
            residuals,
            x,
            jac=jacobian,
            bounds=bounds,
            args=(scale, stage),
            xtol=_TOLERANCE,
            ftol=_TOLERANCE,
            max_nfev=MAX_EVALUATIONS,
        ).x
        progress.advance(stage, done=1.0, total=1.0, text="")
        if np.array_equal(x, stage_start):  # another search would not move either
            break
    return parametrisation.servos(x)


def keep_model_values(
    robot: RobotModel, servos: ServoParameters, keep: Any = True
) -> ServoParameters:
    """Return fitted parameters in which chosen numbers are replaced by those of the model file.

    The delay stays as fitted, and so do gain and damping of a joint without servo in the model,
    even if they are chosen.

    Args:
        robot: the arm as in the model file.
        servos: the fitted parameters.
        keep: (4 n + 1,) whether the model's number is taken, in the order of
            ``ServoParameters.vector``; True for all.
    """
    in_model = servos_in_model(robot)
    # NaN where the model has no servo.
    damping = in_model.damping + 0.0 * in_model.stiffness
    model_values = replace(in_model, damping=damping, delay=np.nan).vector()
    is_kept = np.isfinite(model_values) & keep
    return ServoParameters.from_vector(np.where(is_kept, model_values, servos.vector()))


def _rms_error(errors: Array) -> Array:
    """Return the root mean square (n,) of errors (M, n) [rad], never zero."""
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)) + 1e-9)


class ErrorDerivatives:
    """Derivatives of position errors by servo parameters; those at the last ones are cached.

    Attributes:
        problem: windows in which the errors arise.
    """

    def __init__(self, problem: ServoProblem) -> None:
        self.problem = problem
        self._cached_at = b""
        self._cache: dict[int, Array] = {}

    def at(self, parametrisation: Parametrisation, servos: ServoParameters) -> Array:
        """Return the derivative (M, n, p) of the position errors by each free number.

        It is by the number itself, in the number's own unit, not by the unknown that stands for it
        in the search. Central differences are used: one-sided ones would hide the directions in
        which hardly anything changes. Friction changes by as much as is typical: behind a stiff
        servo a small change moves the rollouts less than chance does.

        Args:
            parametrisation: says which p numbers are free, and the scale of each.
            servos: parameters at which the derivative is taken.
        """
        x = servos.vector()
        free = np.flatnonzero(parametrisation.free).tolist()
        if self._cached_at != x.tobytes():
            self._cached_at = x.tobytes()
            self._cache = {}
        n_joints = len(servos.stiffness)
        # Entries k n to (k + 1) n - 1 of a vector are number k of the n joints.
        is_friction = np.arange(len(x)) // n_joints == _FRICTION
        step = np.where(is_friction, 1.0, _DIFFERENCE_STEP)
        step *= parametrisation.unit(servos)
        for k in free:
            if k in self._cache:
                continue
            change = step * np.eye(len(x))[k]
            low = np.maximum(x - change, 0.0)
            high = x + change
            ends = map(ServoParameters.from_vector, (low, high))
            low_errors, high_errors = self.problem.errors(list(ends))
            self._cache[k] = (high_errors - low_errors) / (high - low)[k]
        return np.stack([self._cache[k] for k in free], axis=-1)


def estimate_errors(
    derivatives: ErrorDerivatives,
    parametrisation: Parametrisation,
    servos: ServoParameters,
) -> ServoFit:
    """Return fitted parameters with their standard errors.

    The errors are those of weighted least squares with residuals that are correlated in time (a
    sandwich estimate), plus the bias from the rollouts' step length, which is twice the change that
    half a step makes. They are at most the prior's ``PRIOR_DEVIATION`` units of the search; of a
    number that the data does not show, one unit at least.

    Args:
        derivatives: derivatives of the position errors in the fitted windows.
        parametrisation: says which numbers are free, and the unit of each in the search.
        servos: the fitted parameters.
    """
    problem = derivatives.problem
    free = np.flatnonzero(parametrisation.free)
    n_joints = len(servos.stiffness)
    unit = parametrisation.unit(servos)[free]
    residuals = problem.errors([servos])[0]
    half_steps = np.linspace(0.0, problem.edges[-1], 2 * len(problem.edges) - 1)
    finer_residuals = replace(problem, edges=half_steps).errors([servos])[0]
    step_error = 2.0 * (residuals - finer_residuals)
    scale = _rms_error(residuals)
    # Normal matrix, covariance of the score and bias, all in units of the search.
    normal = np.eye(len(free)) / PRIOR_DEVIATION**2
    score = normal.copy()
    bias = np.zeros(len(free))
    slopes = derivatives.at(parametrisation, servos) * unit
    is_moving = problem.is_moving()
    for joint in range(n_joints):
        # One row per sample: slopes of this joint's error over its scale.
        rows = slopes[:, joint] / scale[joint]
        # Entry k of a vector is a number of joint k % n, but the last entry is the delay.
        is_of_joint = (free % n_joints == joint) & (free < 4 * n_joints)
        weight = row_weights(rows[:, is_of_joint], is_moving[:, joint])
        rows *= weight[:, None]
        normal += rows.T @ rows
        weighted = weight * residuals[:, joint]
        # Lags of up to a quarter of the samples.
        covariance, _ = autocovariance(weighted, lags=max(len(rows) // 4, 1) - 1)
        score += autocorrelation_time(covariance, count=np.inf) * rows.T @ rows
        bias += rows.T @ (weight * step_error[:, joint]) / scale[joint]
    inverse = np.linalg.inv(normal)
    # The sandwich estimate, and the square of the bias that the step length makes.
    variance = np.diag(inverse @ score @ inverse) + (inverse @ bias) ** 2
    spread = np.sqrt(np.minimum(variance, PRIOR_DEVIATION**2))
    errors = np.zeros(len(parametrisation.free))
    is_identified = np.zeros(len(parametrisation.free), dtype=bool)
    is_seen = spread < UNSEEN_SPREAD
    is_identified[free] = is_seen
    errors[free] = np.where(is_seen, spread, np.maximum(spread, 1.0)) * unit
    return ServoFit(servos, ServoParameters.from_vector(errors), is_identified, scale)


def row_weights(rows: Array, is_moving: NDArray[np.bool_]) -> Array:
    """Return the weight (M,) of each row of slopes (M, k), which bounds its influence.

    A row counts fully up to the typical size of every column, 1.48 times the median of the rows in
    motion: where a servo comes off its limit, or a joint begins to slip, rollouts diverge by
    chance, and tiny changes of a number look like large ones. (Bounded influence: Hampel,
    Ronchetti, Rousseeuw, Stahel, "Robust Statistics", 1986, ch. 6; 1.48 medians are a standard
    deviation.)

    Args:
        rows: (M, k) slopes of one joint's errors by its own k free numbers.
        is_moving: (M,) whether the joint moves; all weights are one where it never does.
    """
    if not np.any(is_moving):
        return np.ones(len(rows))
    medians = np.median(np.abs(rows[is_moving]), axis=0)
    typical = np.maximum(1.48 * medians, 1e-300)
    return np.asarray(1.0 / np.max(np.abs(rows) / typical, axis=1, initial=1.0))


def add_link_errors(
    robot: RobotModel, fit: ServoFit, loop_fit: LoopFit, moves: NDArray[np.bool_]
) -> ServoFit:
    """Return the fit with standard errors that include those of the trusted links.

    All numbers of a joint scale with its gain, which the equations of the loop determine, and take
    over a part of the links' errors; where the links do not fix the scale, the errors are as large
    as the numbers. A step h of the implicit integrator adds an apparent rotor inertia of h times
    the damping and leaves half a step open in the delay. A delay t too long looks like a damping
    that is t times the gain too small.

    Args:
        robot: the arm as in the model file.
        fit: the fit without these errors.
        loop_fit: the equations of the servos' loops.
        moves: (n,) which joints move; the numbers of the others keep an error of zero.
    """
    numbers = fit.servos.vector()[:-1]
    by_links = link_errors(robot, loop_fit, fit.servos)
    by_links = np.minimum(by_links, numbers)
    rotor_inertia_error = np.append(np.zeros(3 * len(moves)), STEP * fit.servos.damping)
    has_scale = fit.is_identified[: len(moves)]
    scale_error = np.where(has_scale, loop_fit.scale_error, 1.0)
    added = np.hypot(by_links, np.tile(scale_error, 4) * numbers)
    added = np.append(np.hypot(added, rotor_inertia_error), 0.5 * STEP)
    is_moving = np.append(np.tile(moves, 4), True)
    errors = np.where(is_moving, np.hypot(fit.errors.vector(), added), 0.0)
    return replace(fit, errors=ServoParameters.from_vector(errors))


def search_shown_numbers(
    derivatives: ErrorDerivatives,
    every_number: Parametrisation,
    loop_fit: LoopFit,
    progress: Progress,
) -> Parametrisation:
    """Return the parametrisation of the numbers that the rollouts show, its start the best ones.

    All free numbers are searched for first, then those that the rollouts show. Those that neither
    rollouts nor equations show are fixed at the model's values. A number at its bound of zero is
    not shown, nor one that may be zero and may be the model's.

    Args:
        derivatives: derivatives of the position errors in the fitted windows.
        every_number: the first search.
        loop_fit: the solution of the loop's equations.
        progress: is advanced with each evaluation.

    Raises:
        InputError: the model cannot be played with these commands.
    """
    robot = derivatives.problem.rollouts.robot
    best_start = improve_start(derivatives.problem, every_number)
    servos = search_servos(derivatives, best_start, progress)
    fit = estimate_errors(derivatives, every_number, servos)
    value = servos.vector()
    error = fit.errors.vector()
    may_be_zero = value <= 2.0 * error
    may_be_models = np.abs(servos_in_model(robot).vector() - value) <= 3.0 * error
    is_at_bound = value <= _AT_BOUND * every_number.typical.vector()
    is_doubtful = is_at_bound | (may_be_zero & may_be_models)
    is_shown = fit.is_identified & ~is_doubtful
    shown_numbers = replace(every_number, free=every_number.free & is_shown)
    if not np.array_equal(shown_numbers.free, every_number.free):
        is_unknown = ~is_shown & ~loop_fit.determines
        start = keep_model_values(robot, servos, is_unknown)
        shown_numbers = replace(shown_numbers, start=start)
        servos = search_servos(derivatives, shown_numbers, progress)
    return replace(shown_numbers, start=servos)
