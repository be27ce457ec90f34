"""What the optimiser minimises, and one round of it: minimise, update multipliers, check or repair.

The objective is ln det of the posterior covariance plus an augmented Lagrangian of constraints.
For constraints g <= 0 with multipliers l and weight m the penalty is
sum (max(0, l + m g)^2 - l^2) / 2 m; between minimisations l becomes max(0, l + m g)
(Nocedal, Wright, "Numerical Optimization", 2006, section 17.4). It leads to a feasible optimum
without an infinite weight, so the problem stays well conditioned.

Constraints hold at all times, the optimiser knows finitely many. After each round the whole motion
is checked, and what is over a limit is taken off by shrinking the whole motion towards rest.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Callable, NamedTuple

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.motion.information import (
    Gradient,
    Information,
    Known,
    criterion,
    known_arm,
    predicted_information,
    spread_of,
)
from robot_sysid.motion.limit_check import keeps_limits
from robot_sysid.motion.plan_options import ExcitationOptions
from robot_sysid.motion.problem import OBSTACLE_LENGTH, ExcitationProblem
from robot_sysid.motion.trajectories import FourierBasis, FourierTrajectory
from robot_sysid.records import Array, Motion
from robot_sysid.trajectory import Series, TrajectoryOptions

FIRST_WEIGHT = 1.0
WEIGHT_GROWTH = 1.5
PLAIN_ROUNDS = 2
"""Weight of the penalty, its growth per round, and the rounds before it begins to grow.

The multipliers should do the work: the weight only grows where they converge slowly.
"""
MEMORY = 20
"""Gradient pairs L-BFGS keeps: the upper end of what Nocedal, Wright, section 7.2, recommend."""
_TORQUE_STEP = 1e-6
"""Step of differences [rad and its rates]: torques round to 1e-13, so slopes to 1e-7."""
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
"""Factors tried until a motion keeps all limits."""
GRID_PER_CYCLE = 25
"""Grid points per period of the highest frequency: standard errors on the grid are within 0.04 % of
those at 1 kHz; with 10 points 0.1 %, with 5 points 0.8 % (Kinova)."""
FEWEST_GRID_POINTS = 60
TOLD_BY = slice(1, None, 3)
"""Points of the grid that tell the information: 8 per period change no criterion by over 0.2 %."""
LIMIT_SHARE = 0.99
"""Share of the limits the search uses; the rest covers peaks between grid points.

A peak between two of 25 points per period is cos(pi / 25) = 0.992 of itself at the nearer one.
"""
EXTRA_SLACK = 0.003
"""Distance the search keeps beside the required one [m].

A pair that approaches at 9 cm/s comes so much nearer in half a step of the grid, 0.033 s.
"""
SMOOTHING_SHARE = 0.03
"""Share of the speed limit below which the search rounds off Coulomb friction's jump.

With it no deviation is off by more than 3 % (``test_the_grid_is_fine_enough_for_the_band``).
"""
MOST_MEMORY = 2e9
COPIES = 3
"""Most memory that a search may take [bytes], and how often each process holds its functions."""
_WORST = 1e6
"""Stands for an infinite criterion: the optimiser needs a number."""

clock = time.monotonic
"""Gives the time [s], of the machine, so that a deadline can be told to other processes too."""


def is_over(deadline: float) -> bool:
    """Tell whether a deadline on the ``clock`` [s] has passed."""
    return clock() > deadline


@dataclass(frozen=True)
class Candidate:
    """A trajectory on its way to the optimum.

    Attributes:
        x: (n, M) free coefficients, possibly beyond a limit.
        multipliers: (N, 4 n + 2) on the grid.
        weight: of the penalty.
        rounds: how many are done.
        score: its criterion as it is.
        feasible_x: (n, M) the best one so far that obeys everything, or None; and its criterion.
    """

    x: Array
    multipliers: Array
    weight: float = FIRST_WEIGHT
    rounds: int = 0
    score: float = np.inf
    feasible_x: Array | None = None
    feasible_score: float = np.inf


def first_candidate(design: Design, x: Array) -> Candidate:
    """Return a candidate at free coefficients x (n, M), checked against all limits."""
    none = np.zeros((len(design.grid), 4 * design.problem.n_joints + 2))
    return _checked(design, Candidate(x, none))


def improve(
    design: Design, candidate: Candidate, deadline: float = np.inf
) -> Candidate:
    """Return the candidate after one more round, or after as much of it as there was time for."""
    from scipy.optimize import minimize

    unit = design.unit
    shape = candidate.x.shape
    objective = partial(penalised, design, candidate)
    reached = [candidate.x]

    def function(flat: Array) -> tuple[float, Array]:
        if is_over(deadline):
            raise TimeoutError
        value, gradient, _ = objective(unit * flat.reshape(shape))
        return value, (unit * gradient).ravel()

    def keep(flat: Array) -> None:
        reached.append(unit * flat.reshape(shape))

    most = {"maxiter": design.options.iterations, "maxfun": design.options.evaluations}
    options = {**most, "maxcor": MEMORY, "maxls": 30}
    start = (candidate.x / unit).ravel()
    with contextlib.suppress(TimeoutError):
        minimize(
            function, start, jac=True, method="L-BFGS-B", callback=keep, options=options
        )
    moved = replace(candidate, x=reached[-1])
    if not is_over(deadline):
        grow = WEIGHT_GROWTH if candidate.rounds >= PLAIN_ROUNDS else 1.0
        multipliers = objective(moved.x)[2]
        weight = grow * candidate.weight
        moved = replace(
            moved, multipliers=multipliers, weight=weight, rounds=candidate.rounds + 1
        )
    return _checked(design, moved, deadline)


def _checked(
    design: Design, candidate: Candidate, deadline: float = np.inf
) -> Candidate:
    """Return the candidate with its feasible trajectory updated, if the present one is better."""
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
    """Everything about one problem that does not change during the search.

    Attributes:
        known: what an estimate knows beforehand; None for an arm of which all is known but the
            terminal link and friction.
        unit: (M,) of each free coefficient in the optimiser's eyes [rad].

    Raises:
        InputError: it takes more memory than any search may hold, or more samples than there are.
    """

    def __init__(
        self,
        problem: ExcitationProblem,
        options: ExcitationOptions,
        motion: TrajectoryOptions,
        known: Known | None = None,
    ) -> None:
        self.problem = problem
        self.sample_rate = motion.sample_rate
        self.options = options.for_joints(problem.n_joints)
        self.basis: FourierBasis = options.basis(motion.duration)
        top = self.basis.top_frequency_hz
        if top > 0.5 * motion.sample_rate:
            raise InputError(
                f"--sample-rate {motion.sample_rate:g} cannot show the motion's highest frequency, "
                f"{top:.4g} Hz; give at least {2.0 * top:.4g}"
            )
        points = int(np.ceil(GRID_PER_CYCLE * top * self.basis.duration))
        points = max(FEWEST_GRID_POINTS, points)
        # The basis functions, and two derivatives.
        held = options.n_workers * COPIES * 3.0 * 8.0 * points * self.basis.size
        if held > MOST_MEMORY:
            raise InputError(
                f"designing {motion.duration:g} s would take about {held / 1e9:.2g} GB of memory, "
                f"the most is {MOST_MEMORY / 1e9:g} GB; make the motion shorter and repeat it"
            )
        # All harmonics are alike as speeds, so L-BFGS needs fewer steps.
        self.harmonic = np.tile(np.arange(1.0, self.basis.harmonics + 1.0), 2)
        self.unit = np.concatenate(([1.0], 1.0 / self.harmonic))
        self.grid = (np.arange(points) + 0.5) * self.basis.duration / points
        known = known or known_arm(problem)
        told = len(self.grid[TOLD_BY])
        sigma = problem.sigma / np.sqrt(motion.duration * motion.sample_rate / told)
        self.criterion = criterion(problem, known)
        self.information = predicted_information(problem, sigma, known, SMOOTHING_SHARE)

    def trajectory(self, x: Array) -> FourierTrajectory:
        """Return the trajectory of the free coefficients x (n, M)."""
        return FourierTrajectory(self.basis, self.problem.rest, x)

    @cached_property
    def on_grid(self) -> Series:
        """The functions on the grid: most of what a search holds in memory."""
        return self.basis.evaluate(self.grid)

    def motion(self, x: Array) -> Series:
        """Return q, qd and qdd (N, n) of the free coefficients x (n, M) on the grid."""
        b, db, ddb = self.on_grid
        return self.problem.rest + b @ x.T, db @ x.T, ddb @ x.T

    def told(self, motion: Series) -> Information:
        """Return the information of a motion (q, qd, qdd) on the grid."""
        return self.information.evaluate(*(part[TOLD_BY] for part in motion))

    def promise(self, x: Array | None) -> str:
        """Return in words about how well free coefficients x (n, M) tell the terminal link."""
        if x is None or not np.any(x):
            return ""
        covariance = self.criterion.covariance(self.told(self.motion(x)).information)
        mass, centre = spread_of(self.problem.robot.prior.theta, covariance)
        return f"mass ± {mass:.2g} kg, centre of mass ± {1e3 * centre:.2g} mm"

    def criterion_of(self, x: Array) -> float:
        """Return the criterion of free coefficients x (n, M) alone."""
        return self.criterion.evaluate(self.told(self.motion(x)).information)[0]


class Constraints(NamedTuple):
    """Constraint values of a motion, and their gradient.

    Six families in the columns of one array: position, velocity, acceleration and torque of each
    joint and the speed of the tool as share of the limit minus one, and the slack towards obstacles
    over a length.

    Attributes:
        value: (N, 4 n + 2) g; fulfilled where <= 0.
        vjp: gives the gradient (N, n) of sum(weight * g) with respect to q, qd and qdd.
    """

    value: Array
    vjp: Callable[[Array], Gradient]


def constraints_of(
    problem: ExcitationProblem,
    motion: Series,
    share: float = 1.0,
    extra_slack: float = 0.0,
) -> Constraints:
    """Return all constraints of a motion (q, qd, qdd), each (N, n).

    Args:
        share: of the limits to use; less than 1 leaves room for peaks between grid points.
        extra_slack: distance to keep beside the obstacles' own requirement [m].
    """
    moved = Motion(np.arange(float(len(motion[0]))), *motion)
    signals = problem.signals(moved)
    slack = problem.obstacles.slack(moved.q)
    allowed = share * problem.limits.columns
    towards = (extra_slack - slack.value) / OBSTACLE_LENGTH
    value = np.column_stack((np.abs(signals) / allowed - 1.0, towards))
    return Constraints(
        value, partial(_vjp, problem, motion, signals, allowed, slack.gradient)
    )


def _vjp(
    problem: ExcitationProblem,
    motion: Series,
    signals: Array,
    allowed: Array,
    slack_gradient: Array,
    weight: Array,
) -> Gradient:
    ends = np.arange(1, 5) * problem.n_joints
    adjoint = weight[:, :-1] * np.sign(signals) / allowed
    q, qd, qdd, torque, fastest = np.split(adjoint, ends, axis=1)
    q -= weight[:, -1:] * slack_gradient / OBSTACLE_LENGTH
    _add_torque(
        problem, motion, np.split(signals, ends, axis=1)[3], torque, (q, qd, qdd)
    )
    used = np.flatnonzero(fastest)
    if len(used):
        q_used, *rates = (part[used] for part in motion)
        links = problem.dynamics.motion(q_used, *rates)
        none, along = np.zeros((2, 6, problem.n_joints, len(used)))
        along[:, -1] = problem.tool.speed_vjp(links.velocity[-1], fastest[used, 0])
        for total, part in zip(
            (q, qd, qdd), links.gradient(rates, none, (along, none), none)
        ):
            total[used] += part
    return q, qd, qdd


def _add_torque(
    problem: ExcitationProblem,
    motion: Series,
    torque: Array,
    adjoint: Array,
    totals: Gradient,
) -> None:
    """Add the gradient through the torque by one-sided differences, at active samples only."""
    active = np.flatnonzero(np.any(adjoint != 0.0, axis=1))
    if len(active) == 0:
        return
    at = [part[active] for part in motion]
    count = len(active)
    n = problem.n_joints
    for which, part in enumerate(at):
        # The friction torque jumps where a joint reverses; a step across the jump would be noise.
        step = np.where(part < 0.0, -_TORQUE_STEP, _TORQUE_STEP).T
        # All joints' steps at a time: (joint that is moved, sample, joint).
        moved = [np.repeat(signal[None], n, axis=0) for signal in at]
        moved[which][range(n), :, range(n)] += step
        stepped = problem.torque_at(*(signal.reshape(-1, n) for signal in moved))
        change = (stepped.reshape(n, count, n) - torque[active]) / step[:, :, None]
        totals[which][active] += np.sum(change * adjoint[active], axis=2).T


def penalised(
    design: Design, candidate: Candidate, x: Array
) -> tuple[float, Array, Array]:
    """Return the objective of a round at free coefficients x (n, M), gradient and new multipliers.

    Multipliers and weight are those of the candidate; the new ones (N, 4 n + 2) are those after a
    minimisation that ends at x.
    """
    multipliers = candidate.multipliers
    weight = candidate.weight
    motion = design.motion(x)
    told = design.told(motion)
    value, slope = design.criterion.evaluate(told.information)
    constraints = constraints_of(design.problem, motion, LIMIT_SHARE, EXTRA_SLACK)
    active = np.maximum(0.0, multipliers + weight * constraints.value)
    penalty = float(np.sum(active**2 - multipliers**2)) / (2.0 * weight)
    adjoints = constraints.vjp(active)
    for adjoint, part in zip(adjoints, told.vjp(slope)):
        adjoint[TOLD_BY] += part
    gradient = sum(a.T @ f for a, f in zip(adjoints, design.on_grid))
    return min(value, _WORST) + penalty, np.asarray(gradient), active
