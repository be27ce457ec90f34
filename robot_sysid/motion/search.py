"""Search for the trajectory that identifies an arm best within all limits.

A trajectory is a Fourier series per joint (Swevers, Ganseman, Tukel, De Schutter, Van Brussel,
"Optimal robot excitation and identification", IEEE Trans. Robotics and Automation 13(5), 1997, eq.
5) under a window that rises smoothly from 0 to 1 and falls back. It is linear in its coefficients,
and so are velocity and acceleration.

Random feasible trajectories first; the best of them are improved by a round of L-BFGS, and the best
of these by more rounds until one gains next to nothing. All of the work is counted in trajectories,
rounds and iterations, never in seconds: the same seed and options give the same trajectory on a
fast and on a slow machine. Only a time budget that ends the search makes the result depend on the
clock.

The objective is the criterion (``information``) plus an augmented Lagrangian of constraints. For
constraints g <= 0 with multipliers l the penalty is sum (max(0, l + g)^2 - l^2) / 2; between rounds
l becomes max(0, l + g) (Nocedal, Wright, "Numerical Optimization", 2006, section 17.4, with a
weight of one). It leads to a feasible optimum without an infinite weight, so the problem stays well
conditioned. Constraints have to hold at all times, the optimiser sees finitely many: after each
round a motion that breaks a limit is shrunk towards rest until it keeps all, from begin to end.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from operator import attrgetter

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.expected.criterion import Criterion, PriorKnowledge, gradient_of
from robot_sysid.expected.planned_arm import motion_of_samples
from robot_sysid.motion import Effort, ExcitationOptions
from robot_sysid.motion.clearance import SEARCH_HORIZON, TightPairs
from robot_sysid.motion.limit_check import keeps_limits
from robot_sysid.motion.problem import LIMIT_SHARE, OBSTACLE_LENGTH, ExcitationProblem
from robot_sysid.records import Array
from robot_sysid.records.limits import ROUNDING, limit_name, limited_quantities
from robot_sysid.records.messages import Progress
from robot_sysid.records.option_fields import TOP_FREQUENCY_HZ, TrajectoryOptions
from robot_sysid.trajectory import SineTrajectory
from robot_sysid.wording import option_name

GRID_PER_CYCLE = 25
"""Grid points per period of the highest frequency: enough that standard errors on the grid are
those at 1 kHz but for rounding."""
OBSTACLE_STEP = 2
"""Of how many grid points one is looked at for distances, until a motion breaks limits between
them, which it seldom does: mostly the error to expect is the same."""
INFORMATION_POINTS = slice(1, None, 3)
"""Grid points at which the information is computed: 8 per period change no criterion by
more than rounding."""
REPAIRS = (1.0, *(1.0 - 1e-3 * 2.0 ** np.arange(10)), 0.2, 0.1)
"""Factors by which a motion that breaks a limit is scaled down, tried in turn until it keeps all
limits."""
SHRINKING = (1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.04, 0.01, 0.003, 0.001)
"""Factors by which a random trajectory is scaled down, tried in turn until it keeps all limits on
the grid: what is smaller tells next to nothing."""
LONGEST_PERIOD = 60.0
"""Longest period of a trajectory's series [s]: a longer one repeats itself, so that the time of a
search grows only in proportion to the duration."""
FADE = 1.5
"""Longest time in which a motion leaves its start [s]: to leave it by 1 rad takes 7.5 / 1.5^2 = 3.3
rad/s^2, a quarter of the acceleration of a sinusoid of 1 rad at 0.6 Hz. Short ones have a quarter
of their duration."""
BETWEEN_POINTS = 0.003
"""Distance that the search keeps beyond the required one [m], for each step of the grid: a pair
that approaches at 9 cm/s comes so much nearer in half a step, 0.033 s."""
SINGULAR = 1e6
"""The criterion where it is infinite: the optimiser needs a number."""
LEAST_GAIN = 0.01
"""Gain of a round in the mean standard deviation, relative, below which a search ends: what follows
gains less per evaluation, as a rule half of it per round."""
LEAST_LEAD = 0.02
"""How much better the motion that breaks limits is than the best that keeps them, relative, for a
search to go on without a gain: a round may only adapt the multipliers, and the next one turns that
lead into a gain."""
PATIENCE = 3
"""Rounds without a gain after which a search ends, though a better motion breaks limits: what is in
its way lies between the points that the search looks at."""
USUAL_ROUNDS = 15
"""Rounds of a usual search, for its progress alone: arms of six and seven joints take 8 to 21."""
CHECK_RATE_HZ = 100.0
"""Rate at which limits of joints and tool are checked between rounds [Hz]: sinusoids of the highest
frequency hardly exceed their peaks at these samples."""
FEW_POSTURES = 8
"""Of how many postures of a random motion one is looked at first."""
MOST_DRAWS = 3
"""Times the usual number of random trajectories that are drawn at most, where none can be used."""
MIDDLE = (0.2, 0.8)
"""Part of each joint's range about whose positions random trajectories oscillate."""
APPROACH_SHARE = 0.7
"""Largest share of any limit that the way to such a position and back takes."""
LEAST_AMPLITUDE = 0.2
"""Spread of a random harmonic's coefficient at least, over that of the largest."""
SEARCHING = "Searching for the best motion"
"""Label of the search's progress."""


class Design:
    """Everything about one design that does not change during the search.

    Args:
        problem: the arm and its limits.
        options: of the search.
        motion: duration and sample rate.
        knowledge: of the parameters before the recording.

    Attributes:
        problem: the arm and its limits.
        options: of the search.
        effort: of the search.
        duration: of the motion [s].
        top_frequency_hz: frequency of the last harmonic [Hz].
        size: number M of free coefficients per joint: offset, sines, cosines.
        unit: (M,) scale of each free coefficient for the optimiser [rad].
        grid: (N,) times at which constraints are computed [s].
        on_grid: (3, N, M) the M basis functions and their first two derivatives there. They take
            most of the memory of a design.
        criterion: the number that is minimised.
    """

    def __init__(
        self,
        problem: ExcitationProblem,
        options: ExcitationOptions,
        motion: TrajectoryOptions,
        knowledge: PriorKnowledge,
    ) -> None:
        self.problem = problem
        self.options = options
        self.effort = options.search_effort
        self.duration = motion.duration
        base = math.ceil(self.duration / LONGEST_PERIOD) / self.duration
        # At least three. A quotient that rounding puts just below a whole number counts as that.
        count = max(3, math.floor(TOP_FREQUENCY_HZ / base + 1e-9))
        self.size = 2 * count + 1
        # A constant, sines and cosines.
        number = np.arange(1.0, count + 1.0)
        frequency = base * np.concatenate(([0.0], number, number))
        phase = 0.5 * np.pi * np.repeat((1.0, 0.0, 1.0), (1, count, count))
        self._waves = frequency, phase
        self._fade = min(FADE, self.duration / 4.0)
        top = self.top_frequency_hz = count * base
        points = math.ceil(GRID_PER_CYCLE * top * self.duration)
        # In these units a step changes the speed equally in all harmonics: L-BFGS needs fewer.
        self.unit = 1.0 / np.maximum(1.0, self._waves[0] / base)
        self.grid = (np.arange(points) + 0.5) * self.duration / points
        functions = self._series(np.zeros(self.size), np.eye(self.size))
        on_grid = functions.evaluate(self.grid)
        self.on_grid: Array = np.stack((on_grid.q, on_grid.qd, on_grid.qdd))
        # Each point of the coarse grid stands for several samples of the recording: it has as much
        # information as all of them.
        n_points = len(self.grid[INFORMATION_POINTS])
        samples = motion.duration * motion.sample_rate / n_points
        self.criterion = Criterion(problem, knowledge, samples)

    def _series(self, center: Array, x: Array) -> SineTrajectory:
        """Return the series with coefficients x (n, M) about a position (n,)."""
        frequency, phase = (np.tile(row, (len(center), 1)) for row in self._waves)
        return SineTrajectory(center, x, frequency, phase, self.duration, self._fade)

    def trajectory(self, x: Array) -> SineTrajectory:
        """Return the trajectory of the free coefficients x (n, M)."""
        return self._series(self.problem.rest, x)

    def motion(self, x: Array) -> Array:
        """Return q, qd and qdd (3, N, n) of the free coefficients x (n, M) on the grid."""
        motion = self.on_grid @ x.T
        motion[0] += self.problem.rest
        return motion

    def criterion_of(self, x: Array) -> float:
        """Return the criterion of free coefficients x (n, M)."""
        return self.criterion.evaluate(self.motion(x)[:, INFORMATION_POINTS])


@dataclass(frozen=True)
class Candidate:
    """A trajectory on its way to the optimum.

    Attributes:
        x: (n, M) free coefficients of each joint [rad or m]; the motion may break a limit.
        feasible_x: (n, M) the best coefficients so far that keep all limits.
        multipliers: (N, m + p) Lagrange multipliers of the constraints at the N grid points; zero
            at first.
        score: the criterion at ``x``, smaller is better; infinite if singular.
        feasible_score: the criterion at ``feasible_x``; infinite where none are known.
        obstacle_step: of how many grid points one is looked at for distances.
    """

    x: Array
    feasible_x: Array
    multipliers: Array | float = 0.0
    score: float = np.inf
    feasible_score: float = np.inf
    obstacle_step: int = OBSTACLE_STEP

    @property
    def lead(self) -> float:
        """How much better the motion is that may break a limit, relative."""
        return self.feasible_score - self.score


def constraints_of(
    problem: ExcitationProblem,
    motion: Array,
    extra_slack: float = 0.0,
    obstacle_step: int = 1,
) -> tuple[Array, TightPairs]:
    """Return all constraints g at the samples of a motion, and the pairs that are near each other.

    The columns of g (N, m + p), which are fulfilled where <= 0, are ``problem.signals``: absolute
    values over ``LIMIT_SHARE`` of their limits, minus one; then the missing distance of each pair
    of links over ``OBSTACLE_LENGTH``. One column for the tightest pair alone would have a kink
    wherever another pair becomes the tightest one, and no step of the optimiser leads on there.

    Args:
        problem: the arm and its limits.
        motion: (3, N, n) q, qd and qdd.
        extra_slack: distance to keep in addition to the required one [m].
        obstacle_step: of how many samples one is looked at for distances.
    """
    pairs = problem.obstacles.tight_pairs(motion[0, ::obstacle_step])
    pairs = pairs._replace(posture=obstacle_step * pairs.posture)
    # What is not looked at is far from its limit.
    missing = np.full((motion.shape[1], problem.obstacles.n_pairs), -1.0)
    missing[::obstacle_step] = (extra_slack - SEARCH_HORIZON) / OBSTACLE_LENGTH
    at = pairs.posture, pairs.number
    missing[at] = (extra_slack - pairs.slack) / OBSTACLE_LENGTH
    signals = np.abs(problem.signals(motion_of_samples(*motion)))
    limits = LIMIT_SHARE * problem.limits.columns
    return np.column_stack((signals / limits - 1.0, missing)), pairs


def constraint_gradient(
    problem: ExcitationProblem, motion: Array, pairs: TightPairs, weight: Array
) -> Array:
    """Return the gradient (3, N, n) of sum(weight * g) by q, qd and qdd.

    Args:
        problem: the arm and its limits.
        motion: (3, N, n) q, qd and qdd.
        pairs: that are near each other in this motion.
        weight: (N, m + p) of the constraints g.
    """
    n_linear = 3 * problem.n_joints
    n_signals = len(problem.limits.columns)
    factor = weight[:, :n_signals] / (LIMIT_SHARE * problem.limits.columns)
    linear, functions = np.split(factor, [n_linear], axis=1)
    q, qd, qdd = motion
    directions = np.sign((q - problem.limits.center, qd, qdd))
    gradients = directions * np.split(linear, 3, axis=1)
    of_pairs = weight[pairs.posture, n_signals + pairs.number] / OBSTACLE_LENGTH
    np.subtract.at(gradients[0], pairs.posture, of_pairs[:, None] * pairs.slope)
    # Torques and the tool's speed are functions of the motion.
    active = np.flatnonzero(np.any(functions != 0.0, axis=1))
    if len(active):

        def total(*at: Array) -> Array:
            """Return the weighted sums (m, N) of torques and the tool's speed."""
            signals = np.abs(problem.signals(motion_of_samples(*at))[:, n_linear:])
            weighted = signals.reshape(-1, *functions[active].shape) * functions[active]
            return np.sum(weighted, axis=2)

        gradients[:, active] += gradient_of(total, motion[:, active])
    return gradients


def penalised_objective(
    design: Design, candidate: Candidate, x: Array
) -> tuple[float, Array, Array]:
    """Return (objective, gradient (n, M), new multipliers (N, m + p)) at coefficients x (n, M).

    The objective is the criterion plus the augmented Lagrangian's penalty, with the multipliers and
    the weight of the candidate. The new multipliers max(0, l + m g) are for the next round, if the
    minimisation ends at x.
    """
    multipliers = candidate.multipliers
    motion = design.motion(x)
    value, gradients = design.criterion.with_gradient(motion[:, INFORMATION_POINTS])
    step = candidate.obstacle_step
    constraints, pairs = constraints_of(
        design.problem, motion, step * BETWEEN_POINTS, step
    )
    active = np.maximum(0.0, multipliers + constraints)
    penalty = 0.5 * np.sum(active**2 - multipliers**2)
    # Gradients (3, N, n) by q, qd and qdd on the grid: of the penalty, then of the criterion too.
    adjoints = constraint_gradient(design.problem, motion, pairs, active)
    adjoints[:, INFORMATION_POINTS] += gradients
    # q, qd and qdd are linear in x, by the basis functions and their derivatives.
    gradient = np.sum([a.T @ f for a, f in zip(adjoints, design.on_grid)], axis=0)
    return min(value, SINGULAR) + penalty, gradient, active


def first_candidate(design: Design, x: Array) -> Candidate:
    """Return a candidate at free coefficients x (n, M) with zero multipliers, its score, and the
    largest multiple of x that keeps all limits as ``feasible_x``.
    """
    return _update_feasible(design, Candidate(x, np.zeros_like(x)))


def improve(
    design: Design, candidate: Candidate, tick: Callable[[], None]
) -> Candidate:
    """Return the candidate after one more round: minimisation, new multipliers, repair.

    ``tick`` is called after each iteration, and may raise what ends the search.
    """
    from scipy.optimize import minimize

    # The optimiser works on the flat array of x / unit, with 20 gradient pairs: the upper end of
    # what Nocedal, Wright, section 7.2, recommend.
    unit = design.unit
    shape = candidate.x.shape

    def function(flat: Array) -> tuple[float, Array]:
        """Return the penalised objective and its gradient (n M,) by ``flat`` (n M,)."""
        x = unit * flat.reshape(shape)
        value, gradient, _ = penalised_objective(design, candidate, x)
        return value, (unit * gradient).ravel()

    found = minimize(
        function,
        (candidate.x / unit).ravel(),
        jac=True,
        method="L-BFGS-B",
        callback=lambda _: tick(),
        options={"maxiter": design.effort.iterations, "maxcor": 20, "maxls": 30},
    )
    x = unit * found.x.reshape(shape)
    _, _, multipliers = penalised_objective(design, candidate, x)
    improved = _update_feasible(
        design, replace(candidate, x=x, multipliers=multipliers)
    )
    if improved.lead >= LEAST_LEAD:
        # It may come too near between the points that were looked at.
        improved = replace(improved, obstacle_step=1)
    return improved


def _update_feasible(design: Design, candidate: Candidate) -> Candidate:
    """Return the candidate with the score of its x, and with the largest multiple of x that keeps
    all limits as ``feasible_x``, if that is better than the feasible coefficients it has.

    Joints and tool are sampled at ``CHECK_RATE_HZ``; what the search returns is checked as finely
    as any motion (``_checked_trajectory``).
    """
    candidate = replace(candidate, score=design.criterion_of(candidate.x))
    for factor in REPAIRS:
        x = factor * candidate.x
        score = design.criterion_of(x)
        if not score < candidate.feasible_score:
            break
        if keeps_limits(design.problem, design.trajectory(x), CHECK_RATE_HZ):
            return replace(candidate, feasible_x=x, feasible_score=score)
    return candidate


def _checked_trajectory(design: Design, x: Array) -> SineTrajectory:
    """Return the largest multiple of coefficients x (n, M) that keeps all limits at any time."""
    for factor in REPAIRS:
        plan = design.trajectory(factor * x)
        if keeps_limits(design.problem, plan):
            break
    return plan


def design_excitation(
    design: Design,
    rng: np.random.Generator,
    progress: Progress,
    clock: Callable[[], float] = time.monotonic,
) -> SineTrajectory:
    """Search for the trajectory that makes the predicted uncertainty smallest; it keeps all limits.

    Ctrl-C and the time budget end the search and keep the best trajectory so far, which a note then
    says.

    Args:
        design: the arm, its limits and what is minimised.
        rng: source of randomness; a seed is drawn from it.
        progress: is advanced after every trajectory and iteration.
        clock: returns the time that counts for the budget [s].

    Raises:
        InputError: no drawn trajectory keeps all limits; names the limit that is in the way.
        KeyboardInterrupt: interrupted among the random trajectories.
    """
    effort = design.effort
    time_budget = design.options.time_budget
    # The two best random trajectories are improved by one round; only the best of these gets more
    # rounds.
    n_starts = 2
    begin = clock()
    done = 0

    def is_late() -> bool:
        """Show that one more trajectory or iteration is done; return whether time is used up."""
        nonlocal done
        done += 1
        elapsed = clock() - begin
        used = elapsed / (time_budget or np.inf)
        share = min(max(_share_done(effort, done), used), 1.0)
        progress.advance(SEARCHING, share, 1.0, f"{elapsed:.0f} s")
        return used > 1.0

    def tick() -> None:
        """Count an iteration of a round; raise TimeoutError where time is used up."""
        if is_late():
            raise TimeoutError

    seed = int(rng.integers(2**62))
    draws: list[Draw] = []
    n_usable = 0
    for number in range(MOST_DRAWS * effort.draws):
        if n_usable and number >= effort.draws:
            break
        draws.append(draw_trajectory(design, seed, number))
        n_usable += int(np.isfinite(draws[-1].score))
        if is_late() and np.isfinite(draws[-1].score):
            break
    starts = (
        first_candidate(design, draw.x)
        for draw in sorted(draws, key=attrgetter("score"))
    )
    feasible = (start for start in starts if np.isfinite(start.feasible_score))
    candidates = list(islice(feasible, n_starts))
    if not candidates:
        raise InputError(_infeasibility(draws))
    try:
        for number, start in enumerate(candidates):
            candidates[number] = improve(design, start, tick)
        rounds_without_gain = 0
        for _ in range(1, effort.rounds):
            previous = min(candidates, key=attrgetter("feasible_score"))
            best = improve(design, previous, tick)
            candidates = [best]
            if previous.feasible_score - best.feasible_score >= LEAST_GAIN:
                rounds_without_gain = 0
                continue
            rounds_without_gain += 1
            if best.lead < LEAST_LEAD or rounds_without_gain == PATIENCE:
                break
    except (KeyboardInterrupt, TimeoutError):
        progress.note(
            "the search was ended early, so that another run may find another trajectory; this is "
            "the best one until then"
        )
    best = min(candidates, key=attrgetter("feasible_score"))
    plan = _checked_trajectory(design, best.feasible_x)
    progress.advance(SEARCHING, 1.0, 1.0, "")
    return plan


def _share_done(effort: Effort, done: int) -> float:
    """Return the share of a search that is done after some trajectories and iterations.

    Nobody knows which round is the last one: before it, a few always seem to follow.
    """
    usual = effort.draws + min(effort.rounds, USUAL_ROUNDS) * effort.iterations
    least_ahead = min(effort.rounds, PATIENCE) * effort.iterations
    ahead = max(usual - done, least_ahead)
    return done / (done + ahead)


def _infeasibility(draws: list[Draw]) -> str:
    """Return an error message on drawn trajectories of which none can be used.

    It names the limit that stops most of them, if any is stopped.
    """
    reasons = [draw.obstacle for draw in draws if draw.obstacle]
    if not reasons:
        return (
            "no drawn trajectory shows all that these joints could show of the link; use a longer "
            f"{option_name('duration')}"
        )
    ((name, count),) = Counter(reasons).most_common(1)
    return (
        f"no trajectory is feasible: {count} of {len(draws)} random ones, however small, are "
        f"stopped by the {name}; relax that limit or change the model's reference configuration"
    )


@dataclass(frozen=True)
class Draw:
    """One random trajectory.

    Attributes:
        score: the criterion; infinite where no factor makes the trajectory feasible, or where the
            trajectory does not determine all visible parameters.
        x: (n, M) free coefficients.
        obstacle: the limit that even its smallest multiple exceeds; "" where one is feasible.
    """

    score: float
    x: Array
    obstacle: str


def draw_trajectory(design: Design, seed: int, number: int) -> Draw:
    """Return the largest multiple of a random trajectory that keeps all limits on the grid; where
    none of those that are tried does, the score is infinite and the coefficients are zero.

    Args:
        design: the arm, its limits and the criterion.
        seed: of the search.
        number: of the trajectory, which depends on both numbers alone.
    """
    full = _draw_within_motion_limits(design, np.random.default_rng([seed, number]))
    for factor in SHRINKING:
        x = factor * full
        motion = design.motion(x)
        if _is_feasible(design.problem, motion):
            return Draw(design.criterion_of(x), x, "")
    # The constraint that the smallest multiple exceeds most.
    value, _ = constraints_of(design.problem, motion)
    sample, column = np.unravel_index(np.argmax(value), value.shape)
    problem = design.problem
    closest = problem.obstacles.closest_pair(motion[0][sample])
    of_pairs = problem.obstacles.n_pairs * [("clearance", closest.label)]
    limits = [*limited_quantities(problem.owners), *of_pairs]
    return Draw(np.inf, np.zeros_like(full), limit_name(*limits[column]))


def _is_feasible(problem: ExcitationProblem, motion: Array) -> bool:
    """Return whether the samples of a motion (3, N, n) keep ``LIMIT_SHARE`` of all limits, and
    distances.

    What is quickly computed comes first, as most motions break a limit: distances of a few
    postures, then torques and speeds, then the distances of all.
    """
    least = -ROUNDING * OBSTACLE_LENGTH
    some_postures = motion[0, ::FEW_POSTURES]
    if np.min(problem.obstacles.slack(some_postures)) < least:
        return False
    signals = np.abs(problem.signals(motion_of_samples(*motion)))
    if np.max(signals / problem.limits.columns) > LIMIT_SHARE * (1.0 + ROUNDING):
        return False
    return bool(np.min(problem.obstacles.slack(motion[0])) >= least)


def _draw_within_motion_limits(design: Design, rng: np.random.Generator) -> Array:
    """Return random coefficients (n, M) [rad] of a motion in which each joint uses ``LIMIT_SHARE``
    of its limit of position, speed or acceleration, whichever it reaches first.

    Each joint oscillates about a random position in the ``MIDDLE`` of its range. The random
    coefficients of harmonic k are divided by k to a random power between 0 and 1.
    """
    limits = design.problem.limits
    start_pose = design.problem.rest
    size = (len(start_pose), design.size)
    # Column 0 is the offset, the others are the harmonics.
    offset = np.zeros(size)
    middle = rng.uniform(*MIDDLE, size=len(start_pose))
    offset[:, 0] = limits.lower + middle * (limits.upper - limits.lower) - start_pose
    factor = _largest_factor(design, np.zeros_like(offset), offset)
    offset *= np.minimum(1.0, APPROACH_SHARE * factor)[:, None]
    decay = design.unit ** rng.uniform(0.0, 1.0)
    normal = rng.normal(size=size)
    shape = normal * rng.uniform(LEAST_AMPLITUDE, 1.0, size=size) * decay
    shape[:, 0] = 0.0
    factor = _largest_factor(design, offset, shape)
    return offset + shape * factor[:, None]


def _largest_factor(design: Design, base: Array, x: Array) -> Array:
    """Return per joint the largest factor (n,) for which the coefficients base + factor x use
    ``LIMIT_SHARE`` of a limit of position, speed or acceleration on the grid; 0 where none does.

    Args:
        design: the arm, its limits and the basis.
        base: (n, M) coefficients of a motion that keeps them.
        x: (n, M) coefficients that are scaled.
    """
    limits = design.problem.limits
    start = design.motion(base)
    start[0] -= limits.center
    step = design.on_grid @ x.T
    largest = LIMIT_SHARE * limits.largest[:3, None]
    room = largest - np.sign(step) * start
    factor = np.min(room / np.maximum(np.abs(step), 1e-12), axis=(0, 1))
    return np.maximum(factor, 0.0)
