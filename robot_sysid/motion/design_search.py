"""Search for the trajectory that identifies the terminal link best within all limits.

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
from robot_sysid.motion import ExcitationOptions
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

DRAWS_PER_JOB = 5
"""Random trajectories per job; an interruption loses those of the unfinished jobs."""
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
_THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables for the number of threads of linear algebra."""


@dataclass(frozen=True)
class ExcitationResult:
    """A designed trajectory and how the search for it went.

    Attributes:
        trajectory: the best one that was found; it keeps all limits.
        objective: exp of the criterion's value: the geometric mean of the standard deviations of
            the scaled parameters.
        start_objective: objective of the best random trajectory.
        limit_check: of the trajectory.
        n_feasible: number of random trajectories that keep all limits.
        n_drawn: number of random trajectories.
        stopped: "" where the search was finished, else "interrupted" or "time budget".
        notes: sentences for the user on the limits, and on a search that ended early.
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
    design: Design, rng: np.random.Generator, progress: Progress | None = None
) -> ExcitationResult:
    """Search for the trajectory that makes the predicted uncertainty smallest.

    Ctrl-C ends the search and keeps the best trajectory so far, a random one if need be.

    Args:
        design: the arm, its limits and what is minimised.
        rng: source of randomness; a seed is drawn from it.
        progress: is advanced after every job; None to show nothing.

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
        n_feasible=len(_feasible_draws(draws)),
        n_drawn=len(draws),
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
        progress: is advanced after every job.
    """
    options = design.options
    started = design_module.clock()
    budget = options.time_budget or np.inf
    deadline = started + budget - min(0.5 * budget, CHECK_TIME)
    # Numbers of the random trajectories, those of one job in each batch.
    numbers = range(options.draws)
    batches = [numbers[k : k + DRAWS_PER_JOB] for k in numbers[::DRAWS_PER_JOB]]
    n_jobs = len(batches) + options.starts + options.rounds

    def report(n_done: int) -> None:
        """Show the progress after ``n_done`` jobs, and the errors by the best trajectory so far."""
        best = _best(candidates)
        # Zero coefficients of a draw that keeps no limits give no errors.
        x = best.feasible_x if best else min(draws, key=lambda draw: draw.score).x
        errors = design.expected_errors(x)
        done: float = n_done
        total: float = n_jobs
        if options.time_budget:
            done = min(design_module.clock() - started, budget)
            total = budget
        progress.advance("Designing the trajectory", min(done, total), total, errors)

    with _worker_pool(design, options.n_workers) as run:
        draw = partial(draw_trajectories, seed=seed, deadline=deadline)
        jobs = [partial(draw, numbers=batch) for batch in batches]
        for n_done, batch_draws in enumerate(run(jobs), start=1):
            draws += batch_draws
            report(n_done)
            if is_over(deadline) and _feasible_draws(draws):
                return "time budget"
        starts = [draw.x for draw in _feasible_draws(draws)]
        if not options.rounds:
            starts = starts[:1]
        for first in range(0, len(starts), options.starts):
            batch = starts[first : first + options.starts]
            for n_done in _improve_starts(run, options, batch, candidates, deadline):
                report(len(batches) + n_done)
            if is_over(deadline):
                return "time budget"
            if options.time_budget is None:
                break
    report(n_jobs)
    return ""


def _improve_starts(
    run: Callable[[Sequence[Job]], Iterator[Any]],
    options: ExcitationOptions,
    starts: Sequence[Array],
    candidates: list[Candidate],
    deadline: float,
) -> Iterator[int]:
    """Improve starts by a round each, then the best of them until it gains next to nothing; yield
    the number of jobs done after each job.

    Args:
        run: yields the results of jobs in order, see ``_worker_pool``.
        options: of the search.
        starts: coefficients (n, M) of random trajectories that keep all limits.
        candidates: one candidate per start is appended, and replaced there when it improves.
        deadline: time of ``design.clock`` after which no round begins [s].
    """
    first = len(candidates)
    candidates += list(run([partial(first_candidate, x=x) for x in starts]))
    jobs = []
    if options.rounds:
        for candidate in candidates[first:]:
            jobs.append(partial(improve, candidate=candidate, deadline=deadline))
    for k, improved in enumerate(run(jobs)):
        candidates[first + k] = improved
        yield k + 1
    scores = [candidate.feasible_score for candidate in candidates[first:]]
    best = first + int(np.argmin(scores))
    for n_rounds in range(1, options.rounds):
        if is_over(deadline):
            break
        previous = candidates[best]
        (improved,) = run([partial(improve, candidate=previous, deadline=deadline)])
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


def draw_trajectories(
    design: Design, seed: int, numbers: Sequence[int], deadline: float = np.inf
) -> list[Draw]:
    """Return random trajectories, scaled to keep the limits; of an infeasible one the score is inf.

    Args:
        design: the arm, its limits and the criterion.
        seed: of the search.
        numbers: of the trajectories; each depends on the seed and its own number alone.
        deadline: time of ``design.clock`` [s]; once it has passed, drawing ends with the first
            feasible trajectory.
    """
    draws = []
    for number in numbers:
        x = _draw_within_motion_limits(design, np.random.default_rng([seed, number]))
        draws.append(_shrink_to_limits(design, x))
        if is_over(deadline) and np.isfinite(draws[-1].score):
            break
    return draws


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


Job = Callable[[Any], Any]
"""A function of the shared object of a ``_worker_pool``. It is sent to other processes, so it is a
function of a module or a ``functools.partial`` of one."""

# The shared object that the jobs of this process work on, where this process is a worker.
_received: Any = None


@contextlib.contextmanager
def _worker_pool(
    shared: Any, count: int
) -> Iterator[Callable[[Sequence[Job]], Iterator[Any]]]:
    """Provide a function that takes jobs and yields their results, in order, from worker processes.

    Workers are started afresh ("spawn"), so nothing depends on what this process has loaded; each
    receives the shared object once and keeps it. At the end they are ended at once, in the middle
    of a job too.

    Args:
        shared: the argument of every job; it is pickled once per worker.
        count: number of workers; with 1 the present process does the work.
    """
    pool = None
    earlier_children = set(multiprocessing.active_children())
    # Without memory for another process, for its pipes or its semaphores there is no pool.
    with contextlib.suppress(OSError, RuntimeError, ImportError):
        if count > 1:
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(count, context, _receive, (shared,))
    try:
        yield partial(_run_jobs, shared, pool)
    finally:
        if pool is not None:
            workers = set(multiprocessing.active_children()) - earlier_children
            pool.shutdown(wait=False, cancel_futures=True)
            # A job that nobody waits for any more would keep this program from ending.
            for worker in workers:
                worker.terminate()


def _run_jobs(
    shared: Any, pool: ProcessPoolExecutor | None, jobs: Sequence[Job]
) -> Iterator[Any]:
    """Yield the results of jobs in order; this process does the jobs of workers that died or could
    not start, and all jobs where there is no pool.
    """
    n_done = 0
    with contextlib.suppress(BrokenProcessPool, OSError, RuntimeError):
        for future in () if pool is None else _submit(pool, jobs):
            yield future.result()
            n_done += 1
    # A job that fails by itself, and not for want of a worker, fails here again and raises.
    for job in jobs[n_done:]:
        yield job(shared)


def _submit(pool: ProcessPoolExecutor, jobs: Sequence[Job]) -> list[Future[Any]]:
    """Return the futures of jobs, in their order; submitting the first ones starts the workers.

    The workers ignore Ctrl-C, and do their linear algebra in one thread: the matrices are small,
    and threads that wait for each other would cost as much as they gain. For that,
    ``_THREAD_COUNTS`` are set in this process while workers start, where they have no value yet.
    """
    unset = [name for name in _THREAD_COUNTS if name not in os.environ]
    os.environ.update(dict.fromkeys(unset, "1"))
    try:
        with delay_signals((signal.SIGINT,)):
            return [pool.submit(_run_received, job) for job in jobs]
    finally:
        for name in unset:
            os.environ.pop(name, None)


def _receive(shared: Any) -> None:
    """Keep the shared object for the jobs of this worker process, and make the process end when its
    parent process ends.
    """
    global _received
    _received = shared
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait for the end of the parent process, then end this one at once."""
    # Workers hold both ends of their queue: one whose parent was killed would wait for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run_received(job: Job) -> Any:
    """Return the result of a job on the object that this worker has received."""
    return job(_received)
