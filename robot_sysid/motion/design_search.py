"""Designs the trajectory that tells most about the terminal link within all limits.

Random feasible trajectories first; the best of them are improved by a round of L-BFGS, and the
best of these by more rounds until one gains next to nothing. All of the work is counted in
trajectories, rounds and iterations, never in seconds: the same seed and options give the same
trajectory on a fast and on a slow machine, with one worker or with several. Only a time budget
makes the result depend on the clock: the search then goes on with the next trajectories until it is
used up.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from typing import Any, Callable

import numpy as np

from robot_sysid.errors import InputError, delay_signals
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
from robot_sysid.motion.plan_options import ExcitationOptions
from robot_sysid.motion.problem import ROUNDING
from robot_sysid.motion.trajectories import FourierTrajectory
from robot_sysid.records import Array, MotionPlan
from robot_sysid.records.messages import Progress

DRAWS_PER_JOB = 5
"""An interruption loses no more of them than one job holds."""
CHECK_TIME = 2.0
"""Time that is left for the last check [s]: as long as it takes for a seven-joint arm and 15 s."""
FLAT = 0.01
"""Gain of a round in the mean standard deviation from which on a search has settled: what a minute
finds is then at most 5 % better on most public arms."""
NEAR = 0.05
"""How much better a motion that breaks limits may be than the best that keeps them, for that."""
_CUT: Mapping[str, tuple[str, ...]] = {
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
"""What a reader is told of a search that was cut."""
SHRINK = (1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.04, 0.01, 0.003, 0.001)
"""Factors tried until a drawn motion obeys torque limits and touches nothing."""
FULL = 0.99 * np.cos(np.pi / GRID_PER_CYCLE)
"""Share of the limits of motion that a draw uses: as much may be seen of a peak between points."""
FEW = 8
"""A draw is looked at first at every so many points of the grid."""
_THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class ExcitationResult:
    """A designed trajectory.

    Attributes:
        objective: exp of the criterion's value.
        start_objective: that of the best random trajectory.
        n_feasible: random trajectories that obey all limits, of ``n_drawn``.
        stopped: "" where the search was finished, else what cut it.
        notes: what the reader should know.
    """

    trajectory: FourierTrajectory
    objective: float
    start_objective: float
    limit_check: LimitCheck
    n_feasible: int
    n_drawn: int
    stopped: str
    notes: tuple[str, ...]


def design_excitation(
    design: Design,
    rng: np.random.Generator,
    progress: Progress | None = None,
    before: Callable[[MotionPlan], None] | None = None,
) -> ExcitationResult:
    """Search for the trajectory that makes the predicted uncertainty smallest.

    Ctrl-C ends the search and keeps the best trajectory so far, a random one if need be. Progress
    is told after every job. ``before`` is told the best random trajectory, before it is improved.

    Raises:
        InputError: no drawn trajectory obeys all limits; names the one that is in the way.
        KeyboardInterrupt: interrupted before there was any trajectory.
    """
    draws = list[Draw]()
    candidates = list[Candidate]()
    interruption = None
    try:
        seed = int(rng.integers(2**62))
        stopped = _search(
            design, seed, draws, candidates, progress or Progress(), before
        )
    except KeyboardInterrupt as error:
        stopped = "interrupted"
        interruption = error
    best = _best(candidates)
    if best is None:  # Nothing was improved in time.
        tried = (first_candidate(design, draw.x) for draw in _feasible(draws))
        best = next((c for c in tried if c.feasible_x is not None), None)
    if best is None or best.feasible_x is None:
        raise interruption or InputError(_why_none(draws, design))
    trajectory = design.trajectory(best.feasible_x)
    return ExcitationResult(
        trajectory=trajectory,
        objective=float(np.exp(best.feasible_score)),
        start_objective=float(np.exp(min(draw.score for draw in draws))),
        limit_check=check_limits(design.problem, trajectory, design.sample_rate),
        n_feasible=len(_feasible(draws)),
        n_drawn=len(draws),
        stopped=stopped,
        notes=design.problem.notes + _CUT[stopped],
    )


def _search(
    design: Design,
    seed: int,
    draws: list[Draw],
    candidates: list[Candidate],
    progress: Progress,
    before: Callable[[MotionPlan], None] | None,
) -> str:
    """Draw, choose, improve; fill the lists, and return what cut the search, or ""."""
    options = design.options
    began = design_module.clock()
    budget = options.time_budget or np.inf
    deadline = began + budget - min(0.5 * budget, CHECK_TIME)
    drawn = range(options.draws)
    numbers = [drawn[k : k + DRAWS_PER_JOB] for k in drawn[::DRAWS_PER_JOB]]
    most = len(numbers) + options.starts + options.rounds

    def tell(done: int) -> None:
        best = _best(candidates)
        x = best.feasible_x if best else min(draws, key=lambda draw: draw.score).x
        far = (
            (design_module.clock() - began, budget)
            if options.time_budget
            else (done, most)
        )
        progress.advance(
            "Designing the trajectory", min(far), far[1], design.promise(x)
        )

    with _workers(design, options.n_workers) as run:
        draw = partial(draw_trajectories, seed=seed, deadline=deadline)
        jobs = [partial(draw, numbers=some) for some in numbers]
        for done, some in enumerate(run(jobs), start=1):
            draws += some
            tell(done)
            if is_over(deadline) and _feasible(draws):
                return "time budget"
        starts = _feasible(draws) if options.rounds else _feasible(draws)[:1]
        if starts and before is not None:
            before(design.trajectory(starts[0].x))
        for first in range(0, len(starts), options.starts):
            some_starts = [each.x for each in starts[first : first + options.starts]]
            for done in _improved(run, options, some_starts, candidates, deadline):
                tell(len(numbers) + done)
            if is_over(deadline):
                return "time budget"
            if options.time_budget is None:
                break
    tell(most)
    return ""


def _improved(
    run: Callable[[Sequence[Job]], Iterator[Any]],
    options: ExcitationOptions,
    starts: Sequence[Array],
    candidates: list[Candidate],
    deadline: float,
) -> Iterator[int]:
    """Improve some starts by a round each, the best of them until it settles; yield jobs done."""
    own = list(run([partial(first_candidate, x=x) for x in starts]))
    place = len(candidates)
    candidates += own
    jobs = [partial(improve, candidate=each, deadline=deadline) for each in own]
    for k, better in enumerate(run(jobs) if options.rounds else ()):
        candidates[place + k] = better
        yield k + 1
    at = place + int(np.argmin([each.feasible_score for each in candidates[place:]]))
    for done in range(1, options.rounds):
        if is_over(deadline):
            break
        before = candidates[at].feasible_score
        (candidates[at],) = run(
            [partial(improve, candidate=candidates[at], deadline=deadline)]
        )
        yield len(own) + done
        after = candidates[at]
        # A round that only learns which limits matter makes nothing better; the next one does.
        if (
            before - after.feasible_score < FLAT
            and after.feasible_score - after.score < NEAR
        ):
            break


def _best(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the best candidate that obeys everything; of equally good ones the first."""
    fit = [c for c in candidates if c.feasible_x is not None]
    return min(fit, key=lambda c: c.feasible_score) if fit else None


def _feasible(draws: Sequence[Draw]) -> list[Draw]:
    """Return the feasible draws, best first."""
    return sorted((d for d in draws if np.isfinite(d.score)), key=lambda d: d.score)


def _why_none(draws: Sequence[Draw], design: Design) -> str:
    """Say which limit is in the way of all drawn trajectories."""
    reasons = [draw.obstacle for draw in draws if draw.obstacle]
    if not reasons:
        hidden = 10 - design.criterion.seen.shape[1]
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
        if is_over(deadline) and np.isfinite(draws[-1].score):
            break
    return draws


def _within_motion_limits(design: Design, rng: np.random.Generator) -> Array:
    """Return a random motion, each joint as large as position, speed and acceleration allow.

    It moves each joint to a random middle and back, besides. Of harmonics the speeds, not the
    angles, are alike.
    """
    limits = design.problem.limits
    rest = design.problem.rest
    size = (len(rest), design.basis.size)
    offset = np.zeros(size)
    middle = rng.uniform(0.2, 0.8, size=len(rest))
    offset[:, 0] = limits.lower + middle * (limits.upper - limits.lower) - rest
    room = _room(design, np.zeros_like(offset), offset)
    offset *= np.minimum(1.0, 0.7 * room)[:, None]
    falling = (1.0 / design.harmonic) ** rng.uniform(0.0, 1.0)
    shape = rng.normal(size=size) * rng.uniform(0.2, 1.0, size=size)
    shape[:, 1:] *= falling
    shape[:, 0] = 0.0
    return offset + shape * (FULL * _room(design, offset, shape))[:, None]


def _room(design: Design, base: Array, x: Array) -> Array:
    """Return the largest factors (n,) for which base + factor x keeps the motion limits."""
    limits = design.problem.limits
    rest = design.problem.rest
    ranges = (
        (limits.lower - rest, limits.upper - rest),
        (-limits.velocity, limits.velocity),
        (-limits.acceleration, limits.acceleration),
    )
    factor = np.full(len(rest), np.inf)
    for function, (low, high) in zip(design.on_grid, ranges):
        at = function @ base.T
        step = function @ x.T
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
        # Most of those that are not feasible show it at a few samples too.
        for step in (FEW, 1):
            places, speeds, changes = (part[::step] for part in motion)
            value = constraints_of(design.problem, (places, speeds, changes)).value
            if np.max(value) > ROUNDING:
                break
        else:
            return Draw(design.criterion_of(x), x, "")
    # The constraint that is exceeded most.
    sample, column = np.unravel_index(int(np.argmax(value)), value.shape)
    names = design.problem.signal_names
    obstacles = design.problem.obstacles
    if column < len(names):
        return Draw(np.inf, np.zeros_like(full), names[column])
    label = obstacles.closest(places[sample]).label
    return Draw(np.inf, np.zeros_like(full), f"clearance of {label}")


Job = Callable[[Any], Any]
"""A function of what is shared; ``functools.partial`` of a module's function, to be sent."""

# What the jobs of this process work on, where this process is a worker.
_received: Any = None


@contextlib.contextmanager
def _workers(
    shared: Any, count: int
) -> Iterator[Callable[[Sequence[Job]], Iterator[Any]]]:
    """Give a function that yields the results of jobs, in order, from processes.

    They are started afresh ("spawn"), so nothing depends on what this process has loaded; each
    receives what is shared once and keeps it. With one worker the present process does the work.
    """
    pool = None
    others = multiprocessing.active_children()
    # Without room for another process, for its pipes or its semaphores there is no pool.
    with contextlib.suppress(OSError, RuntimeError, ImportError):
        if count > 1:
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(count, context, _receive, (shared,))
    try:
        yield partial(_run, shared, pool)
    finally:
        if pool is not None:
            ours = [p for p in multiprocessing.active_children() if p not in others]
            pool.shutdown(wait=False, cancel_futures=True)
            # A job that nobody waits for any more would keep this program from ending.
            for process in ours:
                process.terminate()


def _run(
    shared: Any, pool: ProcessPoolExecutor | None, jobs: Sequence[Job]
) -> Iterator[Any]:
    """Yield the results; what workers that died, or could not be started, left is done here."""
    done = 0
    with contextlib.suppress(BrokenProcessPool, OSError, RuntimeError):
        for future in () if pool is None else _submitted(pool, jobs):
            yield future.result()
            done += 1
    # An error in a job is seen here.
    yield from (job(shared) for job in jobs[done:])


def _submitted(pool: ProcessPoolExecutor, jobs: Sequence[Job]) -> list[Future[Any]]:
    """Return the futures of jobs; the first ones start processes, as far as the system lets.

    These never get Ctrl-C, and do their linear algebra in one thread: the matrices are small, and
    threads that wait for each other would cost as much as they do. Whoever has set one of the
    variables for that keeps his value.
    """
    unset = [name for name in _THREAD_COUNTS if name not in os.environ]
    os.environ.update(dict.fromkeys(unset, "1"))
    try:
        with delay_signals((signal.SIGINT,)):
            return [pool.submit(_do, job) for job in jobs]
    finally:
        for name in unset:
            os.environ.pop(name, None)


def _receive(shared: Any) -> None:
    """Make this process a worker on an object, which ends with the one that started it."""
    global _received
    _received = shared
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    # Workers hold both ends of their queue: one whose parent was killed would wait for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _do(job: Job) -> Any:
    return job(_received)
