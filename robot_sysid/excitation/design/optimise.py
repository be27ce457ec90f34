"""What the optimiser minimises, and one round of it: minimise, update multipliers, check or repair.

The objective is a criterion of the information plus an augmented Lagrangian of the constraints.
For constraints g <= 0 with multipliers l and weight m the penalty is
sum (max(0, l + m g)^2 - l^2) / 2 m; between minimisations l becomes max(0, l + m g)
(Nocedal, Wright, "Numerical Optimization", 2006, section 17.4). It leads to a feasible optimum
without an infinite weight, so the problem stays well conditioned.

Constraints hold at all times, the optimiser knows finitely many. After each round the whole motion
is checked and times at which a limit was exceeded join the optimiser's (exchange method for
semi-infinite programs, Hettich, Kortanek, SIAM Review 35(3), 1993, section 7). What little is still
over a limit is taken off by shrinking the whole motion towards rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.excitation.design.budget import UNLIMITED, Budget, OutOfTime
from robot_sysid.excitation.design.constraints import (
    ConstraintCache,
    MotionConstraints,
    constraint_count,
)
from robot_sysid.excitation.fourier import FourierBasis, FourierTrajectory
from robot_sysid.excitation.information import (
    CRITERIA,
    Criterion,
    PredictedInformation,
    RowSettings,
)
from robot_sysid.excitation.limit_check import excess_times, keeps_limits, tight_times
from robot_sysid.excitation.options import ExcitationOptions
from robot_sysid.excitation.problem import LIMIT_NAMES, ExcitationProblem
from robot_sysid.records import Array
from robot_sysid.trajectory import TrajectoryOptions

FIRST_WEIGHT = 1.0
WEIGHT_GROWTH = 1.5
PLAIN_ROUNDS = 2
"""Rounds before the weight begins to grow: the multipliers should do the work."""
MEMORY = 20
"""Gradient pairs L-BFGS keeps."""
MOST_EXTRA_TIMES = 60


@dataclass(frozen=True)
class Candidate:
    """A trajectory on its way to the optimum.

    Attributes:
        number: which start it came from.
        x: (n, M) free coefficients, possibly beyond a limit.
        multipliers: (N + E, 4 n + 2).
        extra_times: (E,) [s].
        weight: of the penalty.
        rounds: how many are done.
        feasible_x: (n, M) the best one so far that obeys everything, or None.
        feasible_score: its criterion.
    """

    number: int
    x: Array
    multipliers: Array
    extra_times: Array
    weight: float
    rounds: int
    feasible_x: Array | None
    feasible_score: float

    @property
    def prices(self) -> dict[str, float]:
        """By how much the criterion falls per share that a family of limits is raised by.

        The sum of a family's multipliers (Nocedal, Wright, section 12.8); of clearances per
        ``OBSTACLE_LENGTH`` that they are smaller.
        """
        *joints, tool, clearance = np.sum(self.multipliers, axis=0)
        families = np.sum(np.reshape(joints, (len(LIMIT_NAMES), -1)), axis=1)
        found = zip((*LIMIT_NAMES, "tool speed", "clearance"), (*families, tool, clearance))
        return {name: float(value) for name, value in found}


def first_candidate(design: Design, number: int, x: Array) -> Candidate:
    """Return a candidate at free coefficients x (n, M), checked against all limits."""
    return _checked(design, unchecked_candidate(design, number, x))


def unchecked_candidate(design: Design, number: int, x: Array) -> Candidate:
    """Return a candidate at free coefficients x (n, M) of which nothing is known yet."""
    none = np.zeros((len(design.grid), constraint_count(design.problem.n_joints)))
    return Candidate(number, x, none, np.zeros(0), FIRST_WEIGHT, 0, None, np.inf)


def improve(design: Design, candidate: Candidate, budget: Budget = UNLIMITED) -> Candidate:
    """Return the candidate after one more round, or after as much of it as there was time for."""
    objective = PenalisedDesign(
        design, candidate.extra_times, candidate.multipliers, candidate.weight
    )
    x, is_whole = _minimise(objective, candidate.x, design, budget)
    if not is_whole:
        return _checked(design, replace(candidate, x=x), budget)
    multipliers = objective.updated_multipliers(objective.evaluate(x).constraints.value)
    grow = WEIGHT_GROWTH if candidate.rounds >= PLAIN_ROUNDS else 1.0
    moved = replace(
        candidate,
        x=x,
        multipliers=multipliers,
        weight=grow * candidate.weight,
        rounds=candidate.rounds + 1,
    )
    return _checked(design, _with_extra_times(design, moved), budget)


def _minimise(
    objective: PenalisedDesign, x: Array, design: Design, budget: Budget
) -> tuple[Array, bool]:
    """Return the free coefficients after some L-BFGS iterations, and whether there was time."""
    from scipy.optimize import minimize

    reached, unit = [x], design.unit

    def function(flat: Array) -> tuple[float, Array]:
        if budget.is_over:
            raise OutOfTime
        evaluation = objective.evaluate(unit * flat.reshape(x.shape))
        return evaluation.value, (unit * evaluation.gradient).ravel()

    def keep(flat: Array) -> None:
        reached.append(unit * flat.reshape(x.shape))

    options = {"maxiter": design.options.iterations, "maxcor": MEMORY, "maxls": 30}
    start = (x / unit).ravel()
    try:
        minimize(function, start, jac=True, method="L-BFGS-B", callback=keep, options=options)
    except OutOfTime:
        return reached[-1], False
    return reached[-1], True


def _with_extra_times(design: Design, candidate: Candidate) -> Candidate:
    """Return the candidate with the times at which the whole motion exceeds a limit."""
    plan = design.trajectory(candidate.x)
    found = np.concatenate((excess_times(design.problem, plan), tight_times(design.problem, plan)))
    known = np.round(candidate.extra_times, 3)
    new = np.setdiff1d(np.round(found, 3), known)[: MOST_EXTRA_TIMES - len(known)]
    none = np.zeros((len(new), candidate.multipliers.shape[1]))
    return replace(
        candidate,
        extra_times=np.concatenate((candidate.extra_times, new)),
        multipliers=np.vstack((candidate.multipliers, none)),
    )


def _checked(design: Design, candidate: Candidate, budget: Budget = UNLIMITED) -> Candidate:
    """Return the candidate with its feasible trajectory updated, if the present one is better."""
    for factor in REPAIRS:
        if budget.is_over and candidate.feasible_x is not None:
            break
        x = factor * candidate.x
        score = design.criterion_of(x)
        if not score < candidate.feasible_score:
            break
        if keeps_limits(design.problem, design.trajectory(x)):
            return replace(candidate, feasible_x=x, feasible_score=score)
    return candidate


REPAIRS = (1.0, 0.999, 0.998, 0.996, 0.992, 0.985, 0.97, 0.94, 0.9, 0.8, 0.6, 0.4, 0.2, 0.1)
"""Factors tried until a motion keeps all limits."""
GRID_PER_CYCLE = 25
"""Grid points per period of the highest frequency; see docs/excitation.md for why."""
FEWEST_GRID_POINTS = 60
LIMIT_SHARE = 0.99
"""Share of the limits the search uses; the rest covers peaks between grid points."""
EXTRA_SLACK = 0.003
"""Distance the search keeps beside the required one [m]."""
SMOOTHING_SHARE = 0.03
"""Share of the speed limit below which the search rounds off Coulomb friction's jump."""
MOST_MEMORY, COPIES = 2e9, 3
"""Most memory that a search may take [bytes], and how often each process holds its functions."""
_WORST = 1e6
"""Stands for an infinite criterion: the optimiser needs a number."""


class Design:
    """Everything about one problem that does not change during the search.

    Args:
        problem: the arm.
        options: criterion, basis, and how long to search.
        motion: duration and sample rate.

    Attributes:
        unit: (M,) of each free coefficient in the optimiser's eyes [rad].
        memory: about how much a search will hold, in all its processes [bytes].

    Raises:
        InputError: it is more than any search may hold.
    """

    def __init__(
        self, problem: ExcitationProblem, options: ExcitationOptions, motion: TrajectoryOptions
    ) -> None:
        self.problem, self.options, self.sample_rate = problem, options, motion.sample_rate
        self.basis: FourierBasis = options.basis(motion.duration)
        _require_sampled(self.basis, motion.sample_rate)
        self.memory = _memory(self.basis, options.n_workers)
        self.directions = self.basis.free_directions()
        self.unit = _unit(self.basis, self.n_free)
        self.grid = _grid(self.basis)
        self.criterion: Criterion = CRITERIA[options.criterion]
        self.coordinates = visible_coordinates(problem)
        samples = motion.duration * motion.sample_rate / len(self.grid)
        smoothing = SMOOTHING_SHARE * problem.limits.velocity
        self.information = PredictedInformation(
            problem.chain,
            RowSettings(
                problem.rows,
                problem.sigma / np.sqrt(samples),
                smoothing,
                self.coordinates,
                problem.rotors_sought,
            ),
        )

    @property
    def n_free(self) -> int:
        """Number of free coefficients per joint."""
        return self.directions.shape[1]

    def trajectory(self, x: Array) -> FourierTrajectory:
        """Return the trajectory of the free coefficients x (n, M)."""
        return FourierTrajectory(self.basis, self.problem.rest, x @ self.directions.T)

    @cached_property
    def on_grid(self) -> tuple[Array, Array, Array]:
        """The functions on the grid: most of what a search holds in memory."""
        return self.functions(self.grid)

    def functions(self, time: Array) -> tuple[Array, Array, Array]:
        """Return the basis of the free coefficients, and its derivatives (N, M)."""
        position, velocity, acceleration = self.basis.evaluate(time)
        if self.basis.fade > 0.0:  # All coefficients are free.
            return position, velocity, acceleration
        return (
            position @ self.directions,
            velocity @ self.directions,
            acceleration @ self.directions,
        )

    def criterion_of(self, x: Array) -> float:
        """Return the criterion of free coefficients x (n, M) alone."""
        b, db, ddb = self.on_grid
        q, qd, qdd = self.problem.rest + b @ x.T, db @ x.T, ddb @ x.T
        return self.criterion(self.information.evaluate(q, qd, qdd).information)[0]


@dataclass(frozen=True)
class Evaluation:
    """The objective at one point.

    Attributes:
        value: criterion plus penalty.
        gradient: (n, M).
        criterion: alone.
        constraints: on the grid and the extra times.
    """

    value: float
    gradient: Array
    criterion: float
    constraints: ConstraintCache


class PenalisedDesign:
    """Objective of one inner minimisation, for fixed multipliers and times.

    Args:
        design: the problem.
        extra_times: (E,) times at which constraints hold beside those of the grid [s].
        multipliers: (N + E, 4 n + 2), non-negative.
        weight: of the quadratic penalty.
    """

    def __init__(
        self, design: Design, extra_times: Array, multipliers: Array, weight: float
    ) -> None:
        self._design, self._multipliers, self._weight = design, multipliers, weight
        extra = design.functions(extra_times)
        self._functions = tuple(np.vstack(both) for both in zip(design.on_grid, extra))
        self._constraints = MotionConstraints(design.problem, LIMIT_SHARE, EXTRA_SLACK)

    def evaluate(self, x: Array) -> Evaluation:
        """Return value and gradient at free coefficients x (n, M)."""
        b, db, ddb = self._functions
        q, qd, qdd = self._design.problem.rest + b @ x.T, db @ x.T, ddb @ x.T
        count = len(self._design.grid)
        cache = self._design.information.evaluate(q[:count], qd[:count], qdd[:count])
        criterion, slope = self._design.criterion(cache.information)
        constraints = self._constraints.evaluate((q, qd, qdd))
        active = np.maximum(0.0, self._multipliers + self._weight * constraints.value)
        penalty = float(np.sum(active**2 - self._multipliers**2)) / (2.0 * self._weight)
        adjoints = self._constraints.vjp(constraints, active)
        for adjoint, part in zip(adjoints, cache.vjp(slope)):
            adjoint[:count] += part
        gradient = adjoints[0].T @ b + adjoints[1].T @ db + adjoints[2].T @ ddb
        value = min(criterion, _WORST) + penalty
        return Evaluation(value, gradient, criterion, constraints)

    def updated_multipliers(self, value: Array) -> Array:
        """Return the multipliers after a minimisation that ended with constraints ``value``."""
        return np.maximum(0.0, self._multipliers + self._weight * value)


def _unit(basis: FourierBasis, count: int) -> Array:
    """Return units (M,) in which all harmonics are alike as speeds: so L-BFGS needs fewer steps."""
    if basis.fade == 0.0:  # Its directions are mixtures of harmonics.
        return np.ones(count)
    return np.concatenate(([1.0], np.tile(1.0 / basis.order, 2)))


def _grid_points(basis: FourierBasis) -> int:
    wanted = GRID_PER_CYCLE * basis.top_frequency_hz * basis.duration
    return max(FEWEST_GRID_POINTS, int(np.ceil(wanted)))


def _require_sampled(basis: FourierBasis, rate: float) -> None:
    """Raise InputError where samples [Hz] cannot show the highest harmonic."""
    if basis.top_frequency_hz > 0.5 * rate:
        raise InputError(
            f"--base-frequency {basis.base_frequency_hz:g}: harmonic {basis.harmonics} of it is at "
            f"{basis.top_frequency_hz:.4g} Hz, above half the --sample-rate of {rate:g} Hz, "
            "which samples cannot show; lower it, or leave it off"
        )


def _memory(basis: FourierBasis, processes: int) -> float:
    """Return about how much a search will hold [bytes]: basis functions, three times each."""
    held = processes * COPIES * 3.0 * 8.0 * _grid_points(basis) * basis.size
    if held > MOST_MEMORY:
        fewer = int(basis.harmonics * np.sqrt(MOST_MEMORY / held))
        raise InputError(
            f"designing {basis.harmonics} harmonics over {basis.duration:g} s would take about "
            f"{held / 1e9:.2g} GB of memory, the most is {MOST_MEMORY / 1e9:g} GB; lower "
            f"--harmonics to {fewer}, or make the motion shorter and repeat it"
        )
    return held


def _grid(basis: FourierBasis) -> Array:
    """Return the time grid [s]: midpoints of equal intervals."""
    count = _grid_points(basis)
    return (np.arange(count) + 0.5) * basis.duration / count


def visible_coordinates(problem: ExcitationProblem) -> Array:
    """Return (10, r): scaled directions of theta that some motion of this arm can show.

    Found from unrelated positions, velocities and accelerations, a fixed set of random numbers.
    What such data cannot see, no trajectory of these joints can.
    """
    scale = np.diag(problem.scale)
    settings = RowSettings(
        problem.rows,
        np.ones(len(problem.rows)),
        np.zeros(problem.n_joints),
        scale,
        problem.rotors_sought,
    )
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 400, problem.n_joints))
    q = np.clip(problem.rest + 2.0 * q, problem.limits.lower, problem.limits.upper)
    matrix = PredictedInformation(problem.chain, settings).evaluate(q, qd, qdd).information
    values, vectors = np.linalg.eigh(matrix)
    return scale @ vectors[:, values > 1e-9 * values[-1]]
