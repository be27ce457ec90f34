"""Search for the trajectory that identifies the terminal link best within all limits.

Random feasible trajectories first; the best of them are improved by a round of L-BFGS, and the
best of these by more rounds until one gains next to nothing. All of the work is counted in
trajectories, rounds and iterations, never in seconds: the same seed and options give the same
trajectory on a fast and on a slow machine. Only a time budget makes the result depend on the clock:
the search then goes on with the next trajectories until it is used up.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.motion import design as design_module
from robot_sysid.motion.design import (
    GRID_PER_CYCLE,
    Candidate,
    Design,
    constraints_of,
    first_candidate,
    improve,
    is_over,
)
from robot_sysid.motion.limit_check import LimitCheck, check_limits
from robot_sysid.motion.problem import ROUNDING
from robot_sysid.motion.trajectories import FourierTrajectory
from robot_sysid.records import Array
from robot_sysid.records.messages import Progress

DRAWS_PER_ROUND = 5
"""Random trajectories that take about as long as a round of improvement, for the progress."""
CHECK_TIME = 2.0
"""Time of a budget that is reserved for the final check of all limits [s]: what the check of a 15 s
motion of a seven-joint arm takes."""
LEAST_GAIN = 0.01
"""Relative gain of a round in the mean standard deviation below which a search ends. On most public
arms another minute of search would then gain at most 5 %."""
LARGEST_LEAD = 0.05
"""How much better (relative, in the mean standard deviation) the motion that breaks limits may be
than the best one that keeps them when a search ends; it goes on while the lead is larger."""
_STOP_NOTES: Mapping[str, tuple[str, ...]] = {
    "": (),
    "interrupted": (
        "the search was interrupted; this is the best trajectory it had found until then",
    ),
    "time budget": (
        "the time budget ended the search; the same seed may give another trajectory on another "
        "machine, so keep this one (robot-sysid plan --save-trajectory) or raise "
        "--excitation-time-budget",
    ),
}
"""Reason why a search ended early, "" for none, to the notes for the user."""
SHRINK_FACTORS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.04, 0.01, 0.003, 0.001)
"""Factors by which a random motion is scaled, tried in turn until it keeps torque limits and
touches nothing."""
DRAW_SHARE = 0.99 * np.cos(np.pi / GRID_PER_CYCLE)
"""Share of the limits of position, speed and acceleration that a random motion uses at grid points;
the remainder is for peaks between them."""
COARSE_STEP = 8
"""A random motion is first checked at every eighth grid point, which is cheap."""


@dataclass(frozen=True)
class ExcitationResult:
    """A designed trajectory and how the search for it went.

    Attributes:
        trajectory: the best one that was found; it keeps all limits.
        objective: exp of the criterion's value: the geometric mean of the standard deviations of
            the scaled parameters.
        start_objective: objective of the best random trajectory.
        limit_check: of the trajectory.
        stopped: "" where the search was finished, else "interrupted" or "time budget".
        notes: sentences for the user on the limits, and on a search that ended early.
    """

    trajectory: FourierTrajectory
    objective: float
    start_objective: float
    limit_check: LimitCheck
    stopped: str
    notes: tuple[str, ...]


def design_excitation(
    design: Design, rng: np.random.Generator, progress: Progress | None = None
) -> ExcitationResult:
    """Search for the trajectory that makes the predicted uncertainty smallest.

    Ctrl-C ends the search and keeps the best trajectory so far, a random one if need be.

    Args:
        design: the arm, its limits and what is minimised.
        rng: source of randomness; a seed is drawn from it.
        progress: is advanced after every trajectory and round; None to show nothing.

    Raises:
        InputError: no drawn trajectory keeps all limits; names the limit that is in the way.
        KeyboardInterrupt: interrupted before there was any trajectory.
    """
    draws = list[Draw]()
    candidates = list[Candidate]()
    interruption = None
    try:
        seed = int(rng.integers(2**62))
        stopped = _search(design, seed, draws, candidates, progress or Progress())
    except KeyboardInterrupt as error:
        stopped = "interrupted"
        interruption = error
    best = _best(candidates)
    if best is None:  # Nothing was improved in time.
        starts = (first_candidate(design, draw.x) for draw in _feasible_draws(draws))
        best = next((start for start in starts if start.feasible_x is not None), None)
    if best is None or best.feasible_x is None:
        raise interruption or InputError(_infeasibility(draws, design))
    trajectory = design.trajectory(best.feasible_x)
    return ExcitationResult(
        trajectory=trajectory,
        objective=float(np.exp(best.feasible_score)),
        start_objective=float(np.exp(min(draw.score for draw in draws))),
        limit_check=check_limits(design.problem, trajectory, design.sample_rate),
        stopped=stopped,
        notes=design.problem.notes + _STOP_NOTES[stopped],
    )


def _search(
    design: Design,
    seed: int,
    draws: list[Draw],
    candidates: list[Candidate],
    progress: Progress,
) -> str:
    """Draw random trajectories and improve the best; return "time budget" where that ended the
    search, else "".

    Args:
        design: the arm, its limits and what is minimised.
        seed: of the random trajectories.
        draws: every random trajectory is appended, so that an interruption loses none.
        candidates: every improved trajectory is appended.
        progress: is advanced after every trajectory and round.
    """
    options = design.options
    started = design_module.clock()
    budget = options.time_budget or np.inf
    deadline = started + budget - min(0.5 * budget, CHECK_TIME)
    draws_time = options.draws / DRAWS_PER_ROUND
    n_rounds = draws_time + options.starts + options.rounds

    def report(done: float, text: str) -> None:
        """Show the progress after as much work as ``done`` rounds take."""
        total = n_rounds
        if options.time_budget:
            done = min(design_module.clock() - started, budget)
            total = budget
        progress.advance("Designing the trajectory", min(done, total), total, text)

    for number in range(options.draws):
        draws.append(draw_trajectory(design, seed, number))
        report((number + 1) / DRAWS_PER_ROUND, "random motions")
        if is_over(deadline) and _feasible_draws(draws):
            return "time budget"
    starts = [draw.x for draw in _feasible_draws(draws)]
    if not options.rounds:
        starts = starts[:1]
    for first in range(0, len(starts), options.starts):
        batch = starts[first : first + options.starts]
        for n_done in _improve_starts(design, batch, candidates, deadline):
            report(draws_time + n_done, "improving the best")
        if is_over(deadline):
            return "time budget"
        if options.time_budget is None:
            break
    report(n_rounds, "improving the best")
    return ""


def _improve_starts(
    design: Design,
    starts: Sequence[Array],
    candidates: list[Candidate],
    deadline: float,
) -> Iterator[int]:
    """Improve starts by a round each, then the best of them until it gains next to nothing; yield
    the number of rounds done after each round.

    Args:
        design: the arm, its limits and what is minimised.
        starts: coefficients (n, M) of random trajectories that keep all limits.
        candidates: one candidate per start is appended, and replaced there when it improves.
        deadline: time of ``design.clock`` after which no round begins [s].
    """
    first = len(candidates)
    candidates += [first_candidate(design, x) for x in starts]
    if design.options.rounds:
        for k in range(first, len(candidates)):
            candidates[k] = improve(design, candidates[k], deadline)
            yield k - first + 1
    scores = [candidate.feasible_score for candidate in candidates[first:]]
    best = first + int(np.argmin(scores))
    for n_rounds in range(1, design.options.rounds):
        if is_over(deadline):
            break
        previous = candidates[best]
        improved = improve(design, previous, deadline)
        candidates[best] = improved
        yield len(starts) + n_rounds
        gain = previous.feasible_score - improved.feasible_score
        # A round may only adapt the multipliers: the motion that breaks limits then leads, and the
        # next round turns that lead into a gain.
        lead = improved.feasible_score - improved.score
        if gain < LEAST_GAIN and lead < LARGEST_LEAD:
            break


def _best(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the best candidate with feasible coefficients, of equally good ones the first; None
    where no candidate has any.
    """
    best = min(candidates, key=lambda c: c.feasible_score, default=None)
    return None if best is None or best.feasible_x is None else best


def _feasible_draws(draws: Sequence[Draw]) -> list[Draw]:
    """Return the draws that keep all limits on the grid, best first."""
    feasible = [draw for draw in draws if np.isfinite(draw.score)]
    return sorted(feasible, key=lambda draw: draw.score)


def _infeasibility(draws: Sequence[Draw], design: Design) -> str:
    """Return an error message on drawn trajectories of which none can be used.

    It names the limit that stops most of them. Where no limit stops any of them, it says that none
    determines every direction of the link's parameters that these joints can show.
    """
    reasons = [draw.obstacle for draw in draws if draw.obstacle]
    if not reasons:
        # ``visible`` (10, r) has a column per direction that the joints can show.
        n_invisible = 10 - design.criterion.visible.shape[1]
        return (
            "no drawn trajectory shows all that these joints could show of the link "
            f"({n_invisible} directions do not show in principle); use a longer --duration"
        )
    names, counts = np.unique(reasons, return_counts=True)
    worst = int(np.argmax(counts))
    return (
        f"no trajectory is feasible: {counts[worst]} of {len(draws)} random ones, however small, "
        f"are stopped by the {names[worst]}; relax that limit or change the model's reference "
        "configuration"
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
    """Return a random trajectory, scaled to keep the limits; of an infeasible one the score is inf.

    Args:
        design: the arm, its limits and the criterion.
        seed: of the search.
        number: of the trajectory, which depends on both numbers alone.
    """
    x = _draw_within_motion_limits(design, np.random.default_rng([seed, number]))
    return _shrink_to_limits(design, x)


def _draw_within_motion_limits(design: Design, rng: np.random.Generator) -> Array:
    """Return random coefficients (n, M) [rad] of a motion in which each joint uses ``DRAW_SHARE``
    of its limit of position, speed or acceleration, whichever it reaches first.

    Each joint oscillates about a random position in the middle 60 % of its range. The random
    coefficients of harmonic k are divided by k to a random power between 0 and 1.
    """
    limits = design.problem.limits
    start_pose = design.problem.rest
    size = (len(start_pose), design.basis.size)
    # Column 0 is the offset, the others are the harmonics.
    offset = np.zeros(size)
    middle = rng.uniform(0.2, 0.8, size=len(start_pose))
    offset[:, 0] = limits.lower + middle * (limits.upper - limits.lower) - start_pose
    # The way to the offset and back takes at most 70 % of any limit.
    factor = _largest_factor(design, np.zeros_like(offset), offset)
    offset *= np.minimum(1.0, 0.7 * factor)[:, None]
    decay = (1.0 / design.harmonic) ** rng.uniform(0.0, 1.0)
    shape = rng.normal(size=size) * rng.uniform(0.2, 1.0, size=size)
    shape[:, 1:] *= decay
    shape[:, 0] = 0.0
    factor = DRAW_SHARE * _largest_factor(design, offset, shape)
    return offset + shape * factor[:, None]


def _largest_factor(design: Design, base: Array, x: Array) -> Array:
    """Return per joint the largest factor (n,) for which the coefficients base + factor x keep the
    limits of position, speed and acceleration on the grid; 0 where no factor does.

    Args:
        design: the arm, its limits and the basis.
        base: (n, M) coefficients of a motion that keeps them.
        x: (n, M) coefficients that are scaled.
    """
    limits = design.problem.limits
    start_pose = design.problem.rest
    ranges = (
        (limits.lower - start_pose, limits.upper - start_pose),
        (-limits.velocity, limits.velocity),
        (-limits.acceleration, limits.acceleration),
    )
    factor = np.full(len(start_pose), np.inf)
    for function, (low, high) in zip(design.on_grid, ranges):
        start = function @ base.T
        step = function @ x.T
        distance = np.where(step > 0.0, high - start, low - start)
        is_moving = np.abs(step) > 1e-12
        ratio = np.where(is_moving, distance / np.where(is_moving, step, 1.0), np.inf)
        factor = np.minimum(factor, np.min(ratio, axis=0))
    return np.where(np.isfinite(factor), np.maximum(factor, 0.0), 0.0)


def _shrink_to_limits(design: Design, full: Array) -> Draw:
    """Return the largest multiple of coefficients ``full`` (n, M), by ``SHRINK_FACTORS``, that
    keeps all limits on the grid; a draw with infinite score and zero coefficients where none does.
    """
    for factor in SHRINK_FACTORS:
        x = factor * full
        motion = design.motion(x)
        # Most motions that break a limit on the grid break it at one of every eighth points too.
        for step in (COARSE_STEP, 1):
            q, qd, qdd = (signal[::step] for signal in motion)
            value = constraints_of(design.problem, (q, qd, qdd)).value
            if np.max(value) > ROUNDING:
                break
        else:  # No limit is broken at either step.
            return Draw(design.criterion_of(x), x, "")
    # The constraint that the smallest multiple exceeds most.
    sample, column = np.unravel_index(int(np.argmax(value)), value.shape)
    names = design.problem.signal_names
    if column < len(names):
        obstacle = names[column]
    else:
        closest = design.problem.obstacles.closest(q[sample])
        obstacle = f"clearance of {closest.label}"
    return Draw(np.inf, np.zeros_like(full), obstacle)
