"""The problem of a designed motion, and one round of it: minimise, update multipliers, repair.

The objective is the design criterion, the mean logarithm of the posterior standard deviations
(``information.Criterion``), plus an augmented Lagrangian of constraints.
For constraints g <= 0 with multipliers l and weight m the penalty is
sum (max(0, l + m g)^2 - l^2) / 2 m; between minimisations l becomes max(0, l + m g)
(Nocedal, Wright, "Numerical Optimization", 2006, section 17.4). It leads to a feasible optimum
without an infinite weight, so the problem stays well conditioned.

Constraints have to hold at all times, the optimiser sees finitely many. After each round the motion
is checked from begin to end; one that breaks a limit is shrunk towards rest until it keeps all.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Callable, NamedTuple

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.motion import ExcitationOptions
from robot_sysid.motion.information import (
    Gradient,
    Information,
    InformationModel,
    PriorKnowledge,
    design_criterion,
)
from robot_sysid.motion.limit_check import keeps_limits
from robot_sysid.motion.problem import OBSTACLE_LENGTH, ExcitationProblem
from robot_sysid.motion.trajectories import FourierBasis, FourierTrajectory
from robot_sysid.records import Array, Motion
from robot_sysid.trajectory import Series, TrajectoryOptions

FIRST_WEIGHT = 1.0
"""Weight of the penalty in the first rounds. It is small, so that the multipliers, and not the
weight, make the motion keep the limits."""
WEIGHT_GROWTH = 1.5
"""Growth of the weight per later round, where multipliers converge slowly."""
PLAIN_ROUNDS = 2
"""Rounds before the weight begins to grow."""
MEMORY = 20
"""Gradient pairs L-BFGS keeps: the upper end of what Nocedal, Wright, section 7.2, recommend."""
_TORQUE_STEP = 1e-6
"""Step of the finite differences of torques [rad, rad/s and rad/s^2]: torques are exact to 1e-13,
so their derivatives to 1e-7."""
REPAIRS = (
    1.0,
    0.999,
    0.998,
    0.996,
    0.992,
    0.985,
    0.97,
    0.94,
    0.9,
    0.8,
    0.6,
    0.4,
    0.2,
    0.1,
)
"""Factors by which a motion that breaks a limit is scaled down, tried in turn until it keeps all
limits."""
GRID_PER_CYCLE = 25
"""Grid points per period of the highest frequency: standard errors on the grid are within 0.04 % of
those at 1 kHz; with 10 points 0.1 %, with 5 points 0.8 % (Kinova)."""
FEWEST_GRID_POINTS = 60
"""Grid points of a motion, however short, at least."""
INFORMATION_POINTS = slice(1, None, 3)
"""Grid points at which the information is computed: 8 per period change no criterion by over
0.2 %."""
LIMIT_SHARE = 0.99
"""Share of the limits the search uses; the rest covers peaks between grid points.

A peak between two of 25 points per period is cos(pi / 25) = 0.992 of itself at the nearer one.
"""
EXTRA_SLACK = 0.003
"""Distance that the search keeps in addition to the required one [m].

A pair that approaches at 9 cm/s comes 3 mm nearer in half a step of the grid, 0.033 s.
"""
SMOOTHING_SHARE = 0.03
"""Share of the speed limit below which the search rounds off Coulomb friction's jump.

It changes no predicted standard deviation by more than 3 %
(``test_the_grid_is_fine_enough_for_the_band``).
"""
MOST_MEMORY = 2e9
"""Most memory that a search may take [bytes]."""
COPIES = 3
"""How many arrays of the size of the basis functions a search needs at a time."""
_WORST = 1e6
"""Stands for an infinite criterion: the optimiser needs a number."""

clock = time.monotonic
"""Returns the machine's time [s]."""


def is_over(deadline: float) -> bool:
    """Return whether a deadline on the ``clock`` [s] has passed."""
    return clock() > deadline


@dataclass(frozen=True)
class Candidate:
    """A trajectory on its way to the optimum.

    Attributes:
        x: (n, M) free coefficients of each joint [rad or m]; the motion may break a limit.
        multipliers: (N, 4 n + 2) Lagrange multipliers of the constraints at the N grid points.
        weight: of the penalty.
        rounds: number of rounds of improvement that have been completed.
        score: the criterion at ``x``, smaller is better; infinite if singular.
        feasible_x: (n, M) the best coefficients so far that keep all limits, or None.
        feasible_score: the criterion at ``feasible_x``; infinite where it is None.
    """

    x: Array
    multipliers: Array
    weight: float = FIRST_WEIGHT
    rounds: int = 0
    score: float = np.inf
    feasible_x: Array | None = None
    feasible_score: float = np.inf


def first_candidate(design: Design, x: Array) -> Candidate:
    """Return a candidate at free coefficients x (n, M) with zero multipliers, its score, and the
    largest multiple of x that keeps all limits as ``feasible_x``.
    """
    multipliers = np.zeros((len(design.grid), 4 * design.problem.n_joints + 2))
    return _update_feasible(design, Candidate(x, multipliers))


def improve(
    design: Design, candidate: Candidate, deadline: float = np.inf
) -> Candidate:
    """Return the candidate after one more round: minimisation, new multipliers, repair.

    A round ends early where the deadline, a time of ``clock`` [s], passes: the coefficients are
    then those of the last iteration, and multipliers, weight and number of rounds stay.
    """
    from scipy.optimize import minimize

    # The optimiser works on the flat array of x / unit.
    unit = design.unit
    shape = candidate.x.shape
    objective = partial(penalised_objective, design, candidate)
    iterates = [candidate.x]

    def function(flat: Array) -> tuple[float, Array]:
        """Return the penalised objective and its gradient (n M,) by ``flat`` (n M,); raises
        TimeoutError after the deadline.
        """
        if is_over(deadline):
            raise TimeoutError
        value, gradient, _ = objective(unit * flat.reshape(shape))
        return value, (unit * gradient).ravel()

    def keep(flat: Array) -> None:
        """Append the iterate ``flat`` (n M,), which an interrupted minimisation does not return."""
        iterates.append(unit * flat.reshape(shape))

    options = {
        "maxiter": design.options.iterations,
        "maxfun": design.options.evaluations,
        "maxcor": MEMORY,
        "maxls": 30,
    }
    start = (candidate.x / unit).ravel()
    with contextlib.suppress(TimeoutError):
        minimize(
            function, start, jac=True, method="L-BFGS-B", callback=keep, options=options
        )
    moved = replace(candidate, x=iterates[-1])
    if not is_over(deadline):
        growth = WEIGHT_GROWTH if candidate.rounds >= PLAIN_ROUNDS else 1.0
        moved = replace(
            moved,
            multipliers=objective(moved.x)[2],
            weight=growth * candidate.weight,
            rounds=candidate.rounds + 1,
        )
    return _update_feasible(design, moved, deadline)


def _update_feasible(
    design: Design, candidate: Candidate, deadline: float = np.inf
) -> Candidate:
    """Return the candidate with the score of its x, and with the largest multiple of x that keeps
    all limits as ``feasible_x``, if that is better than the feasible coefficients it has.

    After the deadline, a time of ``clock`` [s], no further multiple is tried, unless the candidate
    has no feasible coefficients yet.
    """
    candidate = replace(candidate, score=design.criterion_of(candidate.x))
    for factor in REPAIRS:
        if is_over(deadline) and candidate.feasible_x is not None:
            break
        x = factor * candidate.x
        score = candidate.score if factor == 1.0 else design.criterion_of(x)
        if not score < candidate.feasible_score:
            break
        if keeps_limits(design.problem, design.trajectory(x)):
            return replace(candidate, feasible_x=x, feasible_score=score)
    return candidate


class Design:
    """Everything about one design that does not change during the search.

    Args:
        problem: the arm and its limits.
        options: of the search.
        motion: duration and sample rate.
        knowledge: of the parameters before the recording.

    Attributes:
        problem: the arm and its limits.
        sample_rate: of the recording [Hz].
        options: of the search.
        basis: functions whose M free coefficients per joint are searched.
        unit: (M,) scale of each free coefficient for the optimiser [rad].
        grid: (N,) times at which constraints are computed [s].
        harmonic: (M - 1,) number of the harmonic of each free coefficient but the offset.
        criterion: returns the number that is minimised from the information of a motion.
        information: returns the information about the arm's parameters from a motion.

    Raises:
        InputError: the search takes too much memory, or the sample rate is too low.
    """

    def __init__(
        self,
        problem: ExcitationProblem,
        options: ExcitationOptions,
        motion: TrajectoryOptions,
        knowledge: PriorKnowledge,
    ) -> None:
        self.problem = problem
        self.sample_rate = motion.sample_rate
        self.options = options
        self.basis: FourierBasis = options.basis(motion.duration)
        top = self.basis.top_frequency_hz
        if top > 0.5 * motion.sample_rate:
            raise InputError(
                f"--sample-rate {motion.sample_rate:g} cannot show the motion's highest frequency, "
                f"{top:.4g} Hz; give at least {2.0 * top:.4g}"
            )
        points = int(np.ceil(GRID_PER_CYCLE * top * self.basis.duration))
        points = max(FEWEST_GRID_POINTS, points)
        # The basis functions, and two derivatives, of 8 bytes per number.
        memory = COPIES * 3.0 * 8.0 * points * self.basis.size
        if memory > MOST_MEMORY:
            raise InputError(
                f"designing {motion.duration:g} s would take about {memory / 1e9:.2g} GB of "
                f"memory, the most is {MOST_MEMORY / 1e9:g} GB; make the motion shorter and "
                "repeat it"
            )
        # In these units a step changes the speed equally in all harmonics: L-BFGS needs fewer.
        self.harmonic = np.tile(np.arange(1.0, self.basis.harmonics + 1.0), 2)
        self.unit = np.concatenate(([1.0], 1.0 / self.harmonic))
        self.grid = (np.arange(points) + 0.5) * self.basis.duration / points
        # Each point of the coarse grid stands for several samples of the recording: it has as much
        # information as all of them.
        n_samples = motion.duration * motion.sample_rate
        n_points = len(self.grid[INFORMATION_POINTS])
        sigma = problem.sigma / np.sqrt(n_samples / n_points)
        self.criterion = design_criterion(problem, knowledge)
        self.information = InformationModel(problem, sigma, knowledge, SMOOTHING_SHARE)

    def trajectory(self, x: Array) -> FourierTrajectory:
        """Return the trajectory of the free coefficients x (n, M)."""
        return FourierTrajectory(self.basis, self.problem.rest, x)

    @cached_property
    def on_grid(self) -> Series:
        """The basis functions and their first two derivatives at the grid points, (N, M) each.

        They take most of the memory of a design.
        """
        return self.basis.evaluate(self.grid)

    def motion(self, x: Array) -> Series:
        """Return q, qd and qdd (N, n) of the free coefficients x (n, M) on the grid."""
        b, db, ddb = self.on_grid
        return self.problem.rest + b @ x.T, db @ x.T, ddb @ x.T

    def information_of(self, motion: Series) -> Information:
        """Return a motion's information about the parameters of all links, priors not included.

        ``motion`` has q, qd and qdd, (N, n) each, at the design's grid of instants; every third one
        is evaluated (``INFORMATION_POINTS``).
        """
        return self.information.evaluate(
            *(signal[INFORMATION_POINTS] for signal in motion)
        )

    def criterion_of(self, x: Array) -> float:
        """Return the criterion of free coefficients x (n, M), without its gradient."""
        information = self.information_of(self.motion(x)).information
        return self.criterion.evaluate(information)[0]


class Constraints(NamedTuple):
    """Constraint values of a motion at N samples, and their gradient.

    The columns are, n each, the distances of the positions from the middle of their ranges, the
    velocities, accelerations and torques, then the speed of the tool, all of them absolute values
    over their limits minus one; the last column is the missing distance from obstacles over
    ``OBSTACLE_LENGTH``.

    Attributes:
        value: (N, 4 n + 2) g; fulfilled where <= 0.
        vjp: vector-Jacobian product: takes weights (N, 4 n + 2) and returns the gradient of
            sum(weight * g) by q, qd and qdd, (N, n) each.
    """

    value: Array
    vjp: Callable[[Array], Gradient]


def constraints_of(
    problem: ExcitationProblem,
    motion: Series,
    share: float = 1.0,
    extra_slack: float = 0.0,
) -> Constraints:
    """Return all constraints at the samples of a motion.

    Args:
        problem: the arm and its limits.
        motion: q, qd and qdd, (N, n) each.
        share: of the limits to use; less than 1 leaves room for peaks between grid points.
        extra_slack: distance to keep in addition to the required one [m].
    """
    # The constraints do not depend on the time of a sample, so any times will do.
    time = np.arange(float(len(motion[0])))
    samples = Motion(time, *motion)
    # Positions count from the middle of each joint's range, so that limits are symmetric.
    signals = problem.signals(samples)
    slack = problem.obstacles.slack(samples.q)
    limits = share * problem.limits.columns
    missing = (extra_slack - slack.value) / OBSTACLE_LENGTH
    value = np.column_stack((np.abs(signals) / limits - 1.0, missing))
    vjp = partial(_vjp, problem, motion, signals, limits, slack.gradient)
    return Constraints(value, vjp)


def _vjp(
    problem: ExcitationProblem,
    motion: Series,
    signals: Array,
    limits: Array,
    slack_gradient: Array,
    weight: Array,
) -> Gradient:
    """Return the gradient (N, n) of sum(weight * g), g the constraints, by each of q, qd and qdd.

    Args:
        problem: the arm and its limits.
        motion: q, qd and qdd (N, n).
        signals: (N, 4 n + 1) of the problem.
        limits: (4 n + 1,) of the signals.
        slack_gradient: (N, n) derivative by q of the slack, the distance left to obstacles.
        weight: (N, 4 n + 2) of the constraints.
    """
    # Ends of the columns of positions, velocities, accelerations and torques, n each.
    ends = np.arange(1, 5) * problem.n_joints
    adjoint = weight[:, :-1] * np.sign(signals) / limits
    # Gradients by the signals; those by q, qd and qdd are views to which the others are added.
    q, qd, qdd, by_torque, by_speed = np.split(adjoint, ends, axis=1)
    q -= weight[:, -1:] * slack_gradient / OBSTACLE_LENGTH
    torque = np.split(signals, ends, axis=1)[3]
    _add_torque_gradient(problem, motion, torque, by_torque, (q, qd, qdd))
    used = np.flatnonzero(by_speed)
    if len(used):
        used_q, *rates = (signal[used] for signal in motion)
        links = problem.dynamics.motion(used_q, *rates)
        zero, by_twist = np.zeros((2, 6, problem.n_joints, len(used)))
        by_twist[:, -1] = problem.tool.speed_vjp(links.velocity[-1], by_speed[used, 0])
        gradients = links.gradient(
            rates, by_screws=zero, by_motion=(by_twist, zero), by_turns=zero
        )
        for total, gradient in zip((q, qd, qdd), gradients):
            total[used] += gradient
    return q, qd, qdd


def _add_torque_gradient(
    problem: ExcitationProblem,
    motion: Series,
    torque: Array,
    adjoint: Array,
    totals: Gradient,
) -> None:
    """Add to ``totals``, in place, the gradient of sum(adjoint * torque), by one-sided differences.

    Args:
        problem: the arm.
        motion: q, qd and qdd, (N, n) each.
        torque: (N, n) along the motion [N m].
        adjoint: (N, n) weight of each torque; samples whose weights are all zero cost nothing.
        totals: gradients by q, qd and qdd, (N, n) each; changed.
    """
    active = np.flatnonzero(np.any(adjoint != 0.0, axis=1))
    if len(active) == 0:
        return
    signals = [signal[active] for signal in motion]
    count = len(active)
    n = problem.n_joints
    for number, signal in enumerate(signals):
        # The friction torque jumps where a joint reverses; a step across the jump would be noise.
        step = np.where(signal < 0.0, -_TORQUE_STEP, _TORQUE_STEP).T
        # All joints' steps (n, count) at a time: (joint that is moved, sample, joint).
        moved = [np.repeat(values[None], n, axis=0) for values in signals]
        for joint in range(n):
            moved[number][joint, :, joint] += step[joint]
        stepped = problem.torque_at(*(values.reshape(-1, n) for values in moved))
        change = (stepped.reshape(n, count, n) - torque[active]) / step[:, :, None]
        totals[number][active] += np.sum(change * adjoint[active], axis=2).T


def penalised_objective(
    design: Design, candidate: Candidate, x: Array
) -> tuple[float, Array, Array]:
    """Return (objective, gradient (n, M), new multipliers (N, 4 n + 2)) at coefficients x (n, M).

    The objective is the criterion plus the augmented Lagrangian's penalty, with the multipliers and
    the weight of the candidate. The new multipliers max(0, l + m g) are for the next round, if the
    minimisation ends at x.
    """
    multipliers = candidate.multipliers
    weight = candidate.weight
    motion = design.motion(x)
    information = design.information_of(motion)
    value, factor = design.criterion.evaluate(information.information)
    constraints = constraints_of(design.problem, motion, LIMIT_SHARE, EXTRA_SLACK)
    active = np.maximum(0.0, multipliers + weight * constraints.value)
    penalty = float(np.sum(active**2 - multipliers**2)) / (2.0 * weight)
    # Gradients (N, n) by q, qd and qdd on the grid: of the penalty, then of the criterion too.
    adjoints = constraints.vjp(active)
    for adjoint, gradient in zip(adjoints, information.vjp(factor)):
        adjoint[INFORMATION_POINTS] += gradient
    # q, qd and qdd are linear in x, by the basis functions and their derivatives.
    gradient = np.sum([a.T @ f for a, f in zip(adjoints, design.on_grid)], axis=0)
    return min(value, _WORST) + penalty, gradient, active
