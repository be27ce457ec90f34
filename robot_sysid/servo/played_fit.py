"""Numbers of servos with which a model plays a log best, and how sure they are.

Nonlinear least squares (Levenberg and Marquardt), over windows with free starts: residuals are the
position errors of all samples over their size, what is known before, and how far each start is
from the measured one. Starts are solved within each window (variable projection). Friction that
sticks makes rollouts rough, so that derivatives are central differences over steps that a motion
feels, and a search begins at the best of many draws of what is known before.

The joints of an arm are problems of their own, played side by side, and so are several beginnings
of one joint: a problem is a joint's numbers and the tracks that they are judged by.

P is the number of problems, T that of tracks, u that of unknowns, J that of directions of link
errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array
from robot_sysid.servo.loop import LEAST_MOTION
from robot_sysid.servo.play import Tracks, play
from robot_sysid.servo.unknowns import LEAST, MOST, STEPS, column, numbers_at

PASSES = 24
"""Largest number of steps of a search."""
START_DEVIATIONS = np.array([0.002, 0.3])
"""What positions [rad] and velocities [rad/s] at a window's start are off by."""
START_STEPS = np.array([0.004, 0.2])
"""Steps of their derivatives."""
LINK_STEP = 0.3
"""Step of derivatives by link errors, in their deviations."""
LARGEST_STEP = 1.5
"""Largest change of an unknown in one step of a search, in its deviations."""
LEAST_ERROR = 1e-4
"""Position error that no encoder of a servo shows [rad or m]: a fifteenth of a step of 4096."""
FIRST_DAMPING = 1e-2
"""Levenberg's damping at first."""
RELAXED = 0.2
RAISED = 6.0
"""Factors on Levenberg's damping after a step that was better, and one that was not."""
LEAST_DAMPING = 1e-4
"""Least damping: steps of less are those of Gauss and Newton."""
FARTHEST_DAMPING = 1e4
"""Damping at which a search ends."""
CROSSING = 1e-12
"""How far beyond a bound is rounding, in deviations."""
SMALL_GAIN = 0.02
"""Gain of a step at which a search ends, of the sum of squares."""
RENEWED = 3
"""Steps of a search after which the weights of position errors are renewed."""
REPEATED = 4.0
"""Independent residuals that count as one where link errors are searched: what servos do otherwise
comes again with the motion, and would be taken for errors of links."""
LEAST_CORRELATION = 0.1
"""Correlation of residuals from which on they count as independent."""


@dataclass(frozen=True)
class Searched:
    """Where a search stands.

    Attributes:
        x: (P, u) unknowns in deviations from their means.
        links: (P, J) link errors in standard deviations.
        start: (2, T) added to the start of each track.
    """

    x: Array
    links: Array
    start: Array


@dataclass(frozen=True)
class Solved:
    """What a search has found.

    Attributes:
        at: where it ended.
        error: (P,) root mean square position errors [rad or m].
        cost: (P,) how badly tracks and what is known before fit [nats].
        covariance: (P, u + J, u + J) of unknowns and link errors, in their deviations.
    """

    at: Searched
    error: Array
    cost: Array
    covariance: Array


class PlayedFit:
    """A search for the numbers with which tracks are played best.

    Args:
        tracks: of all problems.
        problem: (T,) number of each track's problem.
        likely_gain: (P,) gains before the data [N m/rad].
        mean: (P, u) of the unknowns before the data, in deviations from ``unknowns``' means.
        deviation: (P, u) of the unknowns, over theirs.
        is_free: (u,) which unknowns are searched; the others stay.
        with_links: whether link errors are.
    """

    def __init__(
        self,
        tracks: Tracks,
        problem: NDArray[np.int64],
        likely_gain: Array,
        mean: Array,
        deviation: Array,
        is_free: NDArray[np.bool_],
        with_links: bool,
    ) -> None:
        self.tracks = tracks
        self.problem = problem
        self.likely_gain = likely_gain
        self.mean = mean
        self.deviation = deviation
        self.free = np.flatnonzero(is_free)
        self.n_links = len(tracks.errors) if with_links else 0
        self.repeated = REPEATED if with_links else 1.0
        self.count = len(likely_gain)
        # Errors are those of motion: a joint that stands for most of a log shows none.
        q = np.where(tracks.is_sample, tracks.measured, np.nan)
        is_moving = np.nanmax(q, axis=1) - np.nanmin(q, axis=1) >= LEAST_MOTION
        moves = self._by_problem(is_moving.astype(float)) > 0.0
        self.counted = (is_moving | ~moves[problem]).astype(float)
        samples = np.sum(tracks.is_sample, axis=1) * self.counted
        self.samples = self._by_problem(samples)

    def _by_problem(self, values: Array) -> Array:
        """Return the sums (P, ...) of values (T, ...) of each problem's tracks."""
        sums = np.zeros((self.count, *values.shape[1:]))
        np.add.at(sums, self.problem, values)
        return sums

    def missed(self, x: Array, links: Array, start: Array) -> Array:
        """Return position errors (v, T, m) of sets of unknowns, link errors and starts.

        Args:
            x: (v, P, u) unknowns.
            links: (v, P, J) link errors in standard deviations.
            start: (v, 2, T) added to the start of each track.
        """
        numbers = numbers_at(x)
        numbers[..., column("gain")] *= self.likely_gain
        own = self.problem
        return play(self.tracks, numbers[:, own], links[:, own], start)

    def begin(self, candidates: Array, best: int) -> list[Searched]:
        """Return the best of sets of unknowns (v, P, u) of each problem, as places to begin."""
        n_links = len(self.tracks.errors)
        count = len(candidates)
        links = np.zeros((count, self.count, n_links))
        start = np.zeros((count, 2, len(self.tracks)))
        missed = self.missed(candidates, links, start)
        squares = np.array(
            [self._by_problem(np.sum(each**2, axis=1)) for each in missed]
        )
        order = np.argsort(squares, axis=0)[:best]
        return [
            Searched(candidates[row, np.arange(self.count)], links[0], start[0])
            for row in order
        ]

    def search(
        self,
        at: Searched,
        passes: int = PASSES,
        report: Callable[[int, int, Array], None] | None = None,
    ) -> Solved:
        """Return the nearest place from which no step makes the squares smaller.

        Args:
            at: where to begin.
            passes: largest number of steps.
            report: receives the steps that are done, of how many, and the errors (P,) so far.
        """
        damping = np.full(self.count, FIRST_DAMPING)
        missed, slopes = self._derivatives(at)
        # Of many correlated samples each counts as a part of one.
        weight = self._weight(missed)
        is_fresh = True
        for count in range(1, passes + 1):
            normal = self._normal(at, missed, slopes, weight)
            tried = self._step(at, normal, damping)
            missed_there, slopes_there = self._derivatives(tried)
            before = self._squares(at, missed, weight)
            gain = before - self._squares(tried, missed_there, weight)
            is_better = gain > 0.0
            at = self._mixed(at, tried, is_better)
            of_track = is_better[self.problem]
            missed[of_track] = missed_there[of_track]
            slopes[:, of_track] = slopes_there[:, of_track]
            damping = np.where(
                is_better,
                np.maximum(RELAXED * damping, LEAST_DAMPING),
                RAISED * damping,
            )
            if report is not None:
                report(count, passes, self._sizes(missed))
            is_done = (np.abs(gain) < SMALL_GAIN) | (damping > FARTHEST_DAMPING)
            if np.all(is_done) and is_fresh:
                break
            is_fresh = bool(np.all(is_done)) or count % RENEWED == 0
            if is_fresh:
                weight = self._weight(missed)
                damping = np.minimum(damping, 1.0)
        sizes = self._sizes(missed)
        weight = self._weight(missed)
        matrix, *_ = self._normal(at, missed, slopes, weight)
        covariance = np.asarray(np.linalg.inv(matrix), dtype=float)
        known = self._squares(at, 0.0 * missed, weight)
        independent = self.samples / self._correlated(missed)
        cost = independent * np.log(sizes) + 0.5 * known
        return Solved(at, sizes, cost, self._whole(covariance))

    def rise(self, at: Searched, name: str, to: Array) -> Array:
        """Return by how much squares (P,) of position errors rise with one unknown elsewhere (P,).

        Of what is not reached, such as a limit, they do not, whatever their curvature where a
        search ended.
        """
        x = np.stack((at.x, at.x))
        x[1, :, column(name)] = to
        links, start = np.stack((at.links, at.links)), np.stack((at.start, at.start))
        here, there = self.missed(x, links, start)
        rises = self._by_problem(np.sum(there**2 - here**2, axis=1))
        return np.asarray(self._weight(here) * rises)

    def _mixed(
        self, old: Searched, new: Searched, is_new: NDArray[np.bool_]
    ) -> Searched:
        """Return the new place of some problems, the old one of the others."""
        return Searched(
            np.where(is_new[:, None], new.x, old.x),
            np.where(is_new[:, None], new.links, old.links),
            np.where(is_new[self.problem], new.start, old.start),
        )

    def _whole(self, covariance: Array) -> Array:
        """Return covariances of all unknowns and link errors, zero of those that are not free."""
        n_unknowns = self.mean.shape[1]
        size = n_unknowns + len(self.tracks.errors)
        index = np.append(self.free, n_unknowns + np.arange(self.n_links))
        whole = np.zeros((self.count, size, size))
        whole[:, index[:, None], index] = covariance
        return whole

    def _weight(self, missed: Array) -> Array:
        """Return the weights (P,) of squares of position errors (T, m)."""
        return np.asarray(1.0 / (self._sizes(missed) ** 2 * self._correlated(missed)))

    def _sizes(self, missed: Array) -> Array:
        """Return the root mean square position errors (P,) of errors (T, m)."""
        squares = self._by_problem(self.counted * np.sum(missed**2, axis=1))
        return np.sqrt(squares / self.samples) + LEAST_ERROR

    def _correlated(self, missed: Array) -> Array:
        """Return how many samples (P,) count as one, by the autocorrelation of their errors."""
        squares = self.counted * np.sum(missed**2, axis=1)
        power = self._by_problem(squares) + LEAST_ERROR**2
        total = np.ones(self.count)
        is_on = np.ones(self.count, dtype=bool)
        for lag in range(1, missed.shape[1]):
            product = np.sum(missed[:, lag:] * missed[:, :-lag], axis=1)
            correlation = self._by_problem(self.counted * product) / power
            is_on &= correlation > LEAST_CORRELATION
            if not np.any(is_on):
                break
            total += np.where(is_on, 2.0 * correlation, 0.0)
        return self.repeated * total

    def _squares(self, at: Searched, missed: Array, weight: Array) -> Array:
        """Return the sums of squares (P,) of errors, of what is known before, and of starts."""
        known = ((at.x - self.mean) / self.deviation)[:, self.free]
        starts = np.sum((at.start / START_DEVIATIONS[:, None]) ** 2, axis=0)
        errors = weight * self._by_problem(np.sum(missed**2, axis=1))
        before = np.sum(known**2, axis=1) + np.sum(at.links**2, axis=1)
        return np.asarray(errors + before + self._by_problem(starts))

    def _derivatives(self, at: Searched) -> tuple[Array, Array]:
        """Return position errors (T, m) and their derivatives (f, T, m).

        They are by the free unknowns, the link errors, then position and velocity of the start.
        """
        sizes = np.concatenate(
            (STEPS[self.free], np.full(self.n_links, LINK_STEP), START_STEPS)
        )
        n_free = len(self.free)
        lanes = 1 + 2 * len(sizes)
        x = np.tile(at.x, (lanes, 1, 1))
        links = np.tile(at.links, (lanes, 1, 1))
        start = np.tile(at.start, (lanes, 1, 1))
        signed = np.repeat(sizes, 2) * np.tile((1.0, -1.0), len(sizes))
        for lane, (k, step) in enumerate(
            zip(np.repeat(np.arange(len(sizes)), 2).tolist(), signed), 1
        ):
            if k < n_free:
                free = self.free[k]
                x[lane, :, free] = np.clip(
                    x[lane, :, free] + step, LEAST[free], MOST[free]
                )
            elif k < n_free + self.n_links:
                links[lane, :, k - n_free] += step
            else:
                start[lane, k - n_free - self.n_links] += step
        missed = self.missed(x, links, start)
        widths = np.repeat(2.0 * sizes[:, None], self.count, axis=1)
        # Narrower at a bound.
        moved = x[1::2] - x[2::2]
        for k, free in enumerate(self.free.tolist()):
            widths[k] = moved[k, :, free]
        slopes = (missed[1::2] - missed[2::2]) / widths[:, self.problem, None]
        return missed[0], slopes

    def _normal(
        self, at: Searched, missed: Array, slopes: Array, weight: Array
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Return normal equations (P, f, f), (P, f) beside the starts, and those of the starts."""
        of_track = weight[self.problem]
        table = np.moveaxis(slopes, 0, 1)
        products = of_track[:, None, None] * (table @ np.moveaxis(table, 1, 2))
        pulls = of_track[:, None] * np.einsum("tfm,tm->tf", table, missed)
        n = products.shape[1] - 2
        own = products[:, n:, n:] + np.diag(START_DEVIATIONS**-2.0)
        own_pull = pulls[:, n:] + (at.start / START_DEVIATIONS[:, None] ** 2).T
        inverse = np.asarray(np.linalg.inv(own), dtype=float)
        shared = products[:, :n, n:]
        through = shared @ inverse
        matrix = self._by_problem(
            products[:, :n, :n] - through @ np.moveaxis(shared, 1, 2)
        )
        pull = self._by_problem(
            pulls[:, :n] - np.einsum("tfs,ts->tf", through, own_pull)
        )
        precision = np.ones((self.count, n))
        precision[:, : len(self.free)] = self.deviation[:, self.free] ** -2.0
        offset = np.hstack((at.x[:, self.free] - self.mean[:, self.free], at.links))
        matrix += precision[:, :, None] * np.eye(n)
        pull += precision * offset[:, :n]
        return matrix, pull, inverse, own_pull, shared

    def _step(
        self,
        at: Searched,
        normal: tuple[Array, Array, Array, Array, Array],
        damping: Array,
    ) -> Searched:
        """Return the place to which damped normal equations lead; bounds are kept."""
        matrix, pull, inverse, own_pull, shared = normal
        n_free = len(self.free)
        least, most = np.full((2, pull.shape[1]), [[-np.inf], [np.inf]])
        least[:n_free] = LEAST[self.free]
        most[:n_free] = MOST[self.free]
        change = np.zeros_like(pull)
        for k in range(self.count):
            position = np.append(at.x[k, self.free], at.links[k, : self.n_links])
            damped = matrix[k] + damping[k] * np.diag(np.diag(matrix[k]))
            change[k] = _bounded(damped, -pull[k], least - position, most - position)
        change = np.clip(change, -LARGEST_STEP, LARGEST_STEP)
        x = at.x.copy()
        x[:, self.free] += change[:, :n_free]
        x = np.clip(x, LEAST, MOST)
        links = at.links.copy()
        links[:, : self.n_links] += change[:, n_free:]
        toward = own_pull + np.einsum("tfs,tf->ts", shared, change[self.problem])
        start = at.start - np.einsum("tsr,tr->st", inverse, toward)
        return replace(at, x=x, links=links, start=start)


def _bounded(matrix: Array, right: Array, least: Array, most: Array) -> Array:
    """Return what solves equations (f, f), (f,) where what crosses its bounds (f,) is held there.

    Bounds that were crossed stay active: the next step may leave them.
    """
    change = np.zeros_like(right)
    is_held = np.zeros(len(right), dtype=bool)
    while True:
        free = np.flatnonzero(~is_held)
        rest = right - matrix @ np.where(is_held, change, 0.0)
        change[free] = np.linalg.solve(matrix[np.ix_(free, free)], rest[free])
        within = np.clip(change, least, most)
        crosses = (np.abs(within - change) > CROSSING) & ~is_held
        if not np.any(crosses):
            return change
        change = np.where(crosses, within, change)
        is_held |= crosses
