"""Designs the trajectory that tells most about the terminal link within all limits.

Random feasible trajectories first; the best of them are improved by L-BFGS rounds. All of the work
is counted in trajectories, rounds and iterations, never in seconds: the same seed and options give
the same trajectory on a fast and on a slow machine, with one worker or with several. The time
budget only cuts the search short, which the result then says.

For a whole arm the best of the random feasible trajectories is taken, by
``prediction.arm_criterion``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.motion.design import workers
from robot_sysid.motion.design.optimise import (
    GRID_PER_CYCLE,
    REPAIRS,
    Candidate,
    Design,
    constraints_of,
    first_candidate,
    improve,
    unchecked_candidate,
)
from robot_sysid.motion.design.workers import WorkerPool
from robot_sysid.motion.limit_check import (
    EXACT_UP_TO,
    LimitCheck,
    breaks_limits_at_few,
    check_limits,
    checked_time,
)
from robot_sysid.motion.problem import OBSTACLE_LENGTH, ROUNDING
from robot_sysid.motion.trajectories import FourierTrajectory
from robot_sysid.records import Array
from robot_sysid.records.progress import Progress

DRAWS_PER_JOB = 5
"""An interruption loses no more of them than one job holds."""
CHECK_COST, EXACT_COST = 1.0 / 40.0, 1.0 / 9.0
"""Time that is left for the last check, per time of motion that it looks at; exactly, if short."""
RAISED, NEARER, WORTH_TELLING = 0.1, 0.005, 0.005
"""Change of a limit [share], of clearances [m], by which its worth is told; the least that is."""
OBJECTIVES = {
    "A": "root of summed variances",
    "D": "mean standard deviation",
    "cond": "condition number",
}
"""Criterion to what exp of its value is; deviations relative to m, m L and m L^2."""
_CUT: Mapping[str, tuple[str, ...]] = {
    "": (),
    "interrupted": (
        "the search was interrupted; this is the best trajectory it had found until then",
    ),
    "time budget": (
        "the time budget ended the search; the same seed may give another trajectory on another "
        "machine, so keep this one with --save-trajectory or raise --excitation-time-budget",
    ),
}
"""What a reader is told of a search that was cut."""
SHRINK = (1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.04, 0.01, 0.003, 0.001)
"""Factors tried until a drawn motion obeys torque limits and touches nothing."""
FULL = 0.99 * np.cos(np.pi / GRID_PER_CYCLE)
"""Share of the limits of motion that a draw uses: as much may be seen of a peak between points."""


@dataclass(frozen=True)
class ExcitationResult:
    """A designed trajectory.

    Attributes:
        objective: exp of the criterion's value.
        start_objective: that of the best random trajectory.
        n_feasible: random trajectories that obey all limits, of ``n_drawn``.
        prices: by how much the criterion falls per share that a family of limits is raised by.
        stopped: "" where the search was finished, else what cut it.
        notes: what the reader should know.
    """

    trajectory: FourierTrajectory
    objective: float
    start_objective: float
    limit_check: LimitCheck
    n_feasible: int
    n_drawn: int
    prices: Mapping[str, float]
    stopped: str
    notes: tuple[str, ...]


def check_time(design: Design) -> float:
    """Return about how long the check of the limits of what is found takes [s]."""
    still = np.zeros((design.problem.n_joints, design.n_free))
    looked_at = checked_time(design.trajectory(still))
    return max(CHECK_COST * looked_at, EXACT_COST * min(EXACT_UP_TO, looked_at))


def design_excitation(
    design: Design, rng: np.random.Generator, progress: Progress | None = None
) -> ExcitationResult:
    """Search for the trajectory that makes the predicted uncertainty smallest.

    Ctrl-C ends the search and keeps the best trajectory so far, a random one if need be. Progress
    is told after every job.

    Raises:
        InputError: no drawn trajectory obeys all limits; names the one that is in the way.
        KeyboardInterrupt: interrupted before there was any trajectory.
    """
    search = _Search(design, int(rng.integers(2**62)), progress or Progress())
    try:
        search.run()
    except KeyboardInterrupt:
        search.stopped = "interrupted"
        search.settle_for_a_draw()
        if search.best is None:
            raise
    return search.result()


class _Search:
    """One search; what it has found so far survives an interruption."""

    def __init__(self, design: Design, seed: int, progress: Progress) -> None:
        self._design, self._seed, self._progress = design, seed, progress
        self._rounds = 0 if design.for_arm else design.options.rounds
        budget = design.options.time_budget
        self._deadline = workers.clock() + budget - min(0.5 * budget, check_time(design))
        self._check: LimitCheck | None = None
        self._draws: list[Draw] = []
        self._candidates: list[Candidate] = []
        self._done, self.stopped = 0, ""

    @property
    def best(self) -> Candidate | None:
        """The best candidate that obeys everything; of equally good ones the first."""
        fit = [c for c in self._candidates if c.feasible_x is not None]
        return min(fit, key=lambda c: c.feasible_score) if fit else None

    def run(self) -> None:
        """Draw, choose, improve; stop early where time is up."""
        draw = partial(draw_trajectories, seed=self._seed, deadline=self._deadline)
        with WorkerPool(self._design, self._design.options.n_workers) as pool:
            for draws in pool.run([partial(draw, numbers=some) for some in self._numbers]):
                self._draws += draws
                self._tell(1)
                if self._is_late() and self._feasible():
                    break
            self._check_starts(pool)
            for _ in range(self._rounds):
                if self._is_late():
                    return
                job = partial(improve, deadline=self._deadline)
                jobs = [partial(job, candidate=c) for c in self._candidates]
                for k, candidate in enumerate(pool.run(jobs)):
                    self._candidates[k] = candidate
                    self._tell(1)

    @property
    def _numbers(self) -> list[range]:
        drawn = range(self._design.options.draws)
        return [drawn[k : k + DRAWS_PER_JOB] for k in drawn[::DRAWS_PER_JOB]]

    def settle_for_a_draw(self) -> None:
        """Take the best draw that keeps all limits, where nothing better was found in time."""
        draws = self._feasible() if self.best is None else []
        for draw, factor in product(draws, REPAIRS):
            found = unchecked_candidate(self._design, factor * draw.x)
            trajectory = self._design.trajectory(found.x)
            if breaks_limits_at_few(self._design.problem, trajectory):
                continue
            check = self._check_of(found.x)
            if check.holds:
                score = self._design.criterion_of(found.x)
                self._candidates = [replace(found, feasible_x=found.x, feasible_score=score)]
                self._check = check
                return

    def _check_of(self, x: Array) -> LimitCheck:
        design = self._design
        return check_limits(design.problem, design.trajectory(x), design.sample_rate)

    def _is_late(self) -> bool:
        if is_late := workers.is_over(self._deadline):
            self.stopped = "time budget"
        return is_late

    def _feasible(self) -> list[Draw]:
        """Return the feasible draws, best first."""
        return sorted((d for d in self._draws if np.isfinite(d.score)), key=lambda d: d.score)

    def _check_starts(self, pool: WorkerPool) -> None:
        """Take the best draws as starts; without a feasible one there is no search."""
        feasible = self._feasible()
        if not feasible:
            raise InputError(_why_none(self._draws, self._design))
        if self._is_late():
            self.settle_for_a_draw()
            return
        starts = feasible[: self._design.options.n_starts]
        for candidate in pool.run([partial(first_candidate, x=draw.x) for draw in starts]):
            self._candidates.append(candidate)
            self._tell(0)

    def _tell(self, done: int) -> None:
        self._done += done
        options = self._design.options
        jobs = len(self._numbers) + self._rounds * options.n_starts
        score = self.best.feasible_score if self.best else _smallest_score(self._draws)
        name = OBJECTIVES["D" if self._design.for_arm else options.criterion]
        text = f"{name} {float(np.exp(score)):.3g}"
        self._progress.advance("Designing the trajectory", self._done, jobs, text)

    def result(self) -> ExcitationResult:
        """Return the best trajectory with the check of its limits."""
        best = self.best
        if best is None or best.feasible_x is None:
            raise InputError(_why_none(self._draws, self._design))
        return ExcitationResult(
            trajectory=self._design.trajectory(best.feasible_x),
            objective=float(np.exp(best.feasible_score)),
            start_objective=float(np.exp(_smallest_score(self._draws))),
            limit_check=self._check or self._check_of(best.feasible_x),
            n_feasible=len(self._feasible()),
            n_drawn=len(self._draws),
            prices=best.prices,
            stopped=self.stopped,
            notes=self._design.problem.notes + _price_note(best.prices) + _CUT[self.stopped],
        )


def _smallest_score(draws: list[Draw]) -> float:
    return min((draw.score for draw in draws), default=np.inf)


def _price_note(prices: Mapping[str, float]) -> tuple[str, ...]:
    """Say which limits keep the motion from telling more, and by how much."""
    raised = {name: 1.0 - np.exp(-RAISED * price) for name, price in prices.items()}
    nearer = 1.0 - np.exp(-NEARER / OBSTACLE_LENGTH * prices["clearance"])
    parts = [
        f"{name} ({100.0 * RAISED:.0f} % more: {100.0 * gain:.2g} %)"
        for name, gain in sorted(raised.items(), key=lambda entry: -entry[1])
        if gain > WORTH_TELLING and name != "clearance"
    ]
    if nearer > WORTH_TELLING:
        parts.append(f"clearance ({1e3 * NEARER:.0f} mm less: {100.0 * nearer:.2g} %)")
    if not parts:
        return ()
    listed = "; ".join(parts)
    return (f"limits that keep the errors from being smaller, and by about how much: {listed}",)


def _why_none(draws: list[Draw], design: Design) -> str:
    """Say which limit is in the way of all drawn trajectories."""
    reasons = [draw.obstacle for draw in draws if draw.obstacle]
    if not reasons:
        hidden = 10 - design.coordinates.shape[1]
        return (
            "no drawn trajectory shows all that these joints could show of the link "
            f"({hidden} directions do not show in principle); use a longer --duration"
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
        score: its criterion; infinite where no factor made it feasible.
        x: (n, M) free coefficients.
        obstacle: which limit even the smallest multiple of it exceeds; "" where one is feasible.
    """

    score: float
    x: Array
    obstacle: str


def draw_trajectories(
    design: Design, seed: int, numbers: Sequence[int], deadline: float = np.inf
) -> list[Draw]:
    """Return draws number ``numbers``; each depends on the seed and its own number alone.

    Where time is up, those up to the first feasible one.
    """
    draws = []
    for number in numbers:
        full = _within_motion_limits(design, np.random.default_rng([seed, number]))
        draws.append(_shrunk(design, full))
        if workers.is_over(deadline) and np.isfinite(draws[-1].score):
            break
    return draws


def _within_motion_limits(design: Design, rng: np.random.Generator) -> Array:
    """Return a random motion, each joint as large as position, speed and acceleration allow.

    A faded trajectory moves each joint to a random middle and back, besides; the offset of a
    periodic one follows from the rest. Of harmonics the speeds, not the angles, are alike.
    """
    limits, rest = design.problem.limits, design.problem.rest
    offset = np.zeros((len(rest), design.n_free))
    middle = rng.uniform(0.2, 0.8, size=len(rest))
    if design.basis.fade > 0.0:
        offset[:, 0] = limits.lower + middle * (limits.upper - limits.lower) - rest
    room = _room(design, np.zeros_like(offset), offset)
    offset *= np.minimum(1.0, 0.7 * room)[:, None]
    size = (len(rest), design.basis.size)
    falling = np.tile(1.0 / design.basis.order, 2) ** rng.uniform(0.0, 1.0)
    harmonics = rng.normal(size=size) * rng.uniform(0.2, 1.0, size=size)
    harmonics[:, 1:] *= falling
    harmonics[:, 0] = 0.0
    shape = harmonics @ design.directions
    return offset + shape * (FULL * _room(design, offset, shape))[:, None]


def _room(design: Design, base: Array, x: Array) -> Array:
    """Return the largest factors (n,) for which base + factor x keeps the motion limits."""
    limits, rest = design.problem.limits, design.problem.rest
    ranges = (
        (limits.lower - rest, limits.upper - rest),
        (-limits.velocity, limits.velocity),
        (-limits.acceleration, limits.acceleration),
    )
    factor = np.full(len(rest), np.inf)
    for function, (low, high) in zip(design.on_grid, ranges):
        at, step = function @ base.T, function @ x.T
        room = np.where(step > 0.0, high - at, low - at)
        share = np.abs(step) > 1e-12
        ratio = np.where(share, room / np.where(share, step, 1.0), np.inf)
        factor = np.minimum(factor, np.min(ratio, axis=0))
    return np.where(np.isfinite(factor), np.maximum(factor, 0.0), 0.0)


def _shrunk(design: Design, full: Array) -> Draw:
    """Return the largest tried multiple of a motion that is feasible on the grid."""
    for factor in SHRINK:
        x = factor * full
        motion = design.motion(x)
        value = constraints_of(design.problem, motion).value
        if np.max(value) <= ROUNDING:
            return Draw(design.criterion_of(x), x, "")
    return Draw(np.inf, np.zeros_like(full), _obstacle(design, value, motion[0]))


def _obstacle(design: Design, value: Array, q: Array) -> str:
    """Name the constraint that is exceeded most."""
    sample, column = np.unravel_index(int(np.argmax(value)), value.shape)
    if column < value.shape[1] - 1:
        return design.problem.signal_names[column]
    return f"clearance of {design.problem.obstacles.closest(q[sample]).label}"
