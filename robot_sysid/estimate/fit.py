"""The fit: all terms of a question solved at once, with noise, bounds, bodies and errors.

Each joint's rows are weighted by 1 / (noise sqrt(correlation time)): rows that are not independent
count less. Noise and estimate are found from each other (iterated feasible generalised least
squares; Oberhofer, Kmenta 1974). Parameters that cross a bound are held at it, and bodies are made
possible ones where they are not.

Errors are the larger one of two: the covariance C = (Y' W Y + P)^-1 that noise and priors imply,
and the jackknife over blocks of time, (B - 1)/B sum_b (x_b - mean)^2 with x_b the estimate without
block b, which also sees what no prior names (Quenouille 1956; Wu, "Jackknife, bootstrap and other
resampling methods in regression analysis", Annals of Statistics 14(4), 1986).

Shapes: p parameters in the sums, k of them estimated, J joints with equations, B blocks.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import OFFSET
from robot_sysid.estimate.equations.bodies import Possible, consistent_least_squares
from robot_sysid.estimate.equations.inverse import RIDGE, solution, solve
from robot_sysid.estimate.equations.normal import Equations, equations_of
from robot_sysid.estimate.links import last_link_scale
from robot_sysid.estimate.questions import (
    Question,
    arm_question,
    common_spread,
    scale_spread,
)
from robot_sysid.estimate.rows import Sums, indices_of, row_chunks
from robot_sysid.estimate.terms import (
    FRICTION,
    FURTHER_FRICTION,
    LAST_LINK,
    PAYLOAD,
    PAYLOAD_NAMES,
    SCALES,
    ArmTerms,
    Point,
    Term,
)
from robot_sysid.records import Array
from robot_sysid.signals.process import FilteredRecording

ROUNDS = 12
"""Most rounds of an iteration, which ends where nothing changes any more."""
FIRST_NOISE = 0.05
"""Noise that a fit begins with, as a share of each joint's torque."""
SAME_NOISE = 1e-3
"""Relative change of the noise below which it has been found."""
NOISE = "noise"
"""The cause of errors that is none of a term: noise of the torques."""
# Variance of a parameter, over that of its column alone, from which on nothing shows it.
_HIDDEN = 1e9


class LeftOut(Enum):
    """Which estimates without one block each a fit has, for errors and held-out validation."""

    NOTHING = auto()
    EACH = auto()
    WITH_BOUNDS = auto()


@dataclass(frozen=True)
class Problem:
    """Rows to which terms can be fitted, and what is asked of them.

    Attributes:
        arm: all terms of the arm.
        recordings: to draw them and to take residuals.
        point: around which terms were linearised.
        sums: of all rows.
        question: from which terms are made.
    """

    arm: ArmTerms
    recordings: tuple[FilteredRecording, ...]
    point: Point
    sums: Sums
    question: Question

    def fit(
        self,
        terms: Sequence[Term],
        held: Mapping[str, float] | None = None,
        noise: Array | None = None,
        correlation: Array | None = None,
        possible: bool = True,
    ) -> Fit:
        """Return the fit of terms.

        Args:
            terms: its parameters, with priors and bounds.
            held: name to value of parameters that are not estimated; the model's values, else zero.
            noise: (J,) to begin with [N m]; that of a joint without rows may be zero.
            correlation: (J,) rows that count as one independent row; one by default.
            possible: whether bodies have to be possible ones.
        """
        equations = equations_of(self.arm, self.sums, terms, held or {})
        torque = self.sums.rms_torque
        noise = self.sums.noise_above_least(
            FIRST_NOISE * torque if noise is None else noise
        )
        correlation = np.ones_like(noise) if correlation is None else correlation
        fitted = self._fit_at(equations, noise, correlation, equations.reference)
        for _ in range(ROUNDS):
            previous = fitted.noise
            fitted = replace(fitted, noise=fitted.residual_noise())
            if np.max(np.abs(fitted.noise / previous - 1.0)) < SAME_NOISE:
                break
        fitted = fitted.solve_within_bounds(fitted.normal, False)
        fitted = replace(fitted, free=fitted.values)
        if not possible:
            return fitted
        if not equations.are_possible_bodies(fitted.free):
            # A bound that impossible bodies push against says nothing of possible ones.
            fitted = replace(fitted, is_free=np.ones_like(fitted.is_free))
            fitted = fitted.solve_within_bounds(fitted.normal, True)
        return replace(fitted, left_out=LeftOut.EACH)

    def expected_fit(self, values: Mapping[str, float], noise: Array) -> Fit:
        """Return the fit to expect of the question before there is data: errors and their causes.

        Args:
            values: name to value of parameters that differ from the model's; no torque is read.
            noise: (J,) of an independent row [N m].
        """
        terms = arm_question(self.arm, self.question, self.sums.rms_torque)
        equations = equations_of(self.arm, self.sums, terms, values)
        given = equations.held[equations.index]
        return self._fit_at(equations, noise, np.ones_like(noise), given)

    def _fit_at(
        self, equations: Equations, noise: Array, correlation: Array, values: Array
    ) -> Fit:
        """Return the fit of equations with a noise (J,) that is known, at values (k,)."""
        return Fit(
            self.arm,
            self.recordings,
            self.point,
            self.sums,
            self.question,
            equations,
            noise,
            correlation,
            values,
            values,
            np.ones(len(values), dtype=bool),
        )


@dataclass(frozen=True)
class Fit(Problem):
    """The answer to a problem: values, errors, noise.

    Attributes:
        equations: of the terms.
        noise: (J,) standard deviation of each joint's torque [N m].
        correlation: (J,) rows that count as one independent row.
        free: (k,) estimate in which bodies may be impossible.
        values: (k,) the estimate.
        is_free: (k,) which parameters are not held at a bound.
        bodies: the search for possible bodies; None where the free estimate has them.
        left_out: which estimates without one block each there are.
        held_apart: (B, p) values of the parameters that are not estimated, in the estimates without
            one block each; None for those of the estimate from all blocks.
        line: of a model file, the fit with straight friction in place of that which bends; None
            where it has none.
    """

    equations: Equations
    noise: Array
    correlation: Array
    free: Array
    values: Array
    is_free: NDArray[np.bool_]
    bodies: Possible | None = None
    left_out: LeftOut = LeftOut.NOTHING
    held_apart: Array | None = None
    line: Fit | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k,) of the estimated parameters."""
        return self.equations.names

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Names of the parameters that are held at a bound."""
        return tuple(n for n, is_free in zip(self.names, self.is_free) if not is_free)

    @property
    def weights(self) -> Array:
        """Weights (J,) of each joint's rows [1/(N m)]."""
        return 1.0 / (self.noise * np.sqrt(self.correlation))

    @property
    def normal(self) -> Array:
        """Products (k + 1, k + 1) of priors and of weighted rows."""
        return self.equations.weighted(self.weights).normal

    @property
    def unbounded_solution(self) -> tuple[Array, Array]:
        """Estimate (k,) without bounds, and the covariance (k, k) that noise and priors imply."""
        return self.equations.weighted(self.weights).solution

    @property
    def inverse(self) -> Array:
        """Covariance (k, k) that noise and priors imply."""
        return self.unbounded_solution[1]

    @property
    def start(self) -> Array:
        """Values (k,) of parameters that are held at a bound, of the others the reference."""
        return np.where(self.is_free, self.equations.reference, self.values)

    def residual_noise(self) -> Array:
        """Return the noise (J,) of each joint's residuals without bounds [N m]."""
        values, inverse = self.unbounded_solution
        leverage = self.weights**2 * self.equations.spread(inverse)
        return self.sums.noise(self.equations.squared_residuals(values), leverage)

    @cached_property
    def full(self) -> Array:
        """All parameters (p,), those that are held included."""
        return self.equations.full(self.values)

    @cached_property
    def by_name(self) -> dict[str, float]:
        """Name of each parameter, estimated or held, to its value."""
        return dict(zip(self.sums.names, self.full.tolist()))

    @cached_property
    def is_hidden(self) -> NDArray[np.bool_]:
        """Which estimated parameters (k,) nothing shows: neither data nor prior."""
        own = np.diag(self.normal)[:-1]
        return (own == 0.0) | (np.diag(self.inverse) * own > _HIDDEN)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (k, k) of the errors: the larger one of formal errors and jackknife.

        A parameter's formal error is raised to that of the jackknife where that is larger. What
        torque scales do to a payload is the same in all blocks, and is added as it is. Rotors and
        friction are confounded with the scale of their joint's sensor: without the factor on it,
        rotors of simulated arms are farther off than stated.
        """
        formal = np.diag(self.inverse)
        raised = np.sqrt(np.maximum(self.jackknife / np.maximum(formal, 1e-300), 1.0))
        raised = np.where(self.is_hidden, 1.0, raised)
        of_scales = np.where(np.isin(self.names, PAYLOAD_NAMES), 1.0, raised)
        covariance = raised[:, None] * self.inverse * raised
        return covariance + of_scales[:, None] * self.scale_errors * of_scales

    @cached_property
    def jackknife(self) -> Array:
        """Variance (k,) of each parameter by the jackknife over blocks."""
        count = len(self.alone)
        if count < 2:
            return np.zeros(len(self.names))
        return (count - 1.0) * np.var(self.alone, axis=0)

    @cached_property
    def scale_errors(self) -> Array:
        """Covariance (k, k) of what torque scales do beyond their columns.

        Friction and rotors are in units of the sensor: their relative error is that of their
        joint's scale and of what all scales share. A payload has that of an error which all scales
        share, which the prior of its question leaves out.
        """
        question = self.question
        deviations = scale_spread(self.arm, question.options, question.loaded)
        common = common_spread(question)
        joints = self.arm.joints
        effects = np.zeros((len(joints) + 1, len(self.names)))
        if SCALES not in (term.cause for term in self.equations.terms):
            return effects.T @ effects
        for term, span in self.equations.spans:
            if term.cause == PAYLOAD:
                shared = np.linalg.norm(deviations) / len(joints)
                effects[-1, span] = np.hypot(shared, common) * self.free[span]
            # The loss of a gear is a share, and has no unit.
            elif term.cause in (FRICTION, FURTHER_FRICTION) and term.parameters[0].unit:
                # A motor that turns several joints has no scale of its own.
                of_joints = [each.of in joints for each in term.parameters]
                at = span[of_joints]
                owners = itertools.compress(term.parameters, of_joints)
                rows = [joints.index(parameter.of) for parameter in owners]
                effects[rows, at] = deviations[rows] * self.values[at]
                effects[-1, at] = common * self.values[at]
        return effects.T @ effects

    @cached_property
    def errors(self) -> Array:
        """Standard errors (k,), infinite where nothing shows a parameter."""
        errors = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return np.where(self.is_hidden, np.inf, errors)

    def error_of(self, name: str) -> float:
        """Return the standard error of a named parameter, infinite if it is not estimated."""
        is_estimated = name in self.names
        return float(self.errors[self.names.index(name)]) if is_estimated else np.inf

    def budget(self, combinations: Array) -> dict[str, Array]:
        """Return cause to the standard errors (m,) that it alone makes in combinations (m, k)."""
        budget: dict[str, Array] = {}
        moved = combinations @ self.inverse
        rest = np.sum(moved * combinations, axis=1)
        for term, span in self.equations.spans:
            if term.prior is not None:
                share = np.sum(
                    (moved[:, span] @ term.prior.rows[:, :-1].T) ** 2, axis=1
                )
                rest = rest - share
                budget[term.cause] = budget.get(term.cause, 0.0) + share
        scales = np.sum((combinations @ self.scale_errors) * combinations, axis=1)
        budget[SCALES] = budget.get(SCALES, 0.0) + scales
        causes = {NOISE: np.maximum(rest, 0.0), **budget}
        return {cause: np.sqrt(variances) for cause, variances in causes.items()}

    def share(self) -> Array:
        """Return the share (k,), 0 to 1, of each value that comes from the data, not the prior."""
        share = np.where(self.is_hidden, 0.0, 1.0)
        for term, span in self.equations.spans:
            if term.prior is not None:
                left = np.diag(self.inverse)[span] / term.prior.variances
                share[span] *= np.clip(1.0 - left, 0.0, 1.0)
        return share

    def at(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return the indices of named parameters among the estimated ones."""
        return indices_of(names, self.names)

    @cached_property
    def _normals_apart(self) -> list[Array]:
        """Products (B,), each (k + 1, k + 1), of priors and of the rows of all blocks but one each.

        They are sums of the others': a difference would leave rounding where they show nothing.
        """
        if self.held_apart is not None:
            pairs = enumerate(self.before)
            return [other.normal_without([block]) for block, other in pairs]
        own = [self.equations.data(self.weights, [block]) for block in self.sums.blocks]
        normals = [self.equations.prior]
        for data in own[:-1]:
            normals.append(normals[-1] + data)
        later = np.zeros_like(self.equations.prior)
        for block in reversed(self.sums.blocks):
            normals[block] = normals[block] + later
            later = later + own[block]
        return normals

    @cached_property
    def alone(self) -> Array:
        """Estimates (B, k) without one block each."""
        if self.left_out is LeftOut.NOTHING:
            return np.array([])
        estimates = []
        for other, normal in zip(self.before, self._normals_apart):
            values = other.solution_of(normal)
            if self.left_out is LeftOut.WITH_BOUNDS:
                values = other._possible_of(normal, values)
            estimates.append(values)
        return np.array(estimates)

    @cached_property
    def before(self) -> tuple[Fit, ...]:
        """Per block (B,) the fit with what it holds where the block is left out."""
        if self.held_apart is None:
            return (self,) * len(self.sums.blocks)
        fits = []
        for held in self.held_apart:
            equations = Equations(self.sums, self.equations.terms, held)
            fits.append(replace(self, equations=equations, held_apart=None))
        return tuple(fits)

    @cached_property
    def held_out(self) -> Array:
        """Squared errors (B, J) of blocks predicted from the others [N^2 m^2]."""
        return self.squares_apart(self.alone)

    @cached_property
    def held_out_as_used(self) -> Array:
        """The same (B, J) without offsets of sensors, which no model file holds [N^2 m^2]."""
        alone = self.alone.copy()
        for term, span in self.equations.spans:
            if term.key == OFFSET.name:
                alone[:, span] = 0.0
        return self.squares_apart(alone)

    def squares_apart(self, alone: Array) -> Array:
        """Return squared errors (B, J) of blocks predicted by estimates (B, k) [N^2 m^2]."""
        return np.array(
            [
                other.equations.squared_residuals(values, [block])
                for block, (other, values) in enumerate(zip(self.before, alone))
            ]
        )

    @cached_property
    def expected_held_out(self) -> Array:
        """Squared errors (B, J) to expect of ``held_out`` if the model is right [N^2 m^2]."""
        if self.left_out is LeftOut.NOTHING:
            return np.array([])
        errors = []
        pairs = zip(self.before, self._normals_apart)
        for block, (other, normal) in enumerate(pairs):
            _, inverse = solve(normal, other.start, other.is_free)
            errors.append(other.expected_squares(inverse, [block]))
        return np.array(errors)

    def expected_squares(self, inverse: Array, blocks: Sequence[int]) -> Array:
        """Return the squared errors (J,) to expect in blocks from noise and an estimate's errors.

        ``inverse`` (k, k) is the covariance of the estimate [N^2 m^2].
        """
        counts = np.sum(self.sums.counts[list(blocks)], axis=0)
        return counts * self.noise**2 + self.equations.spread(inverse, blocks)

    def normal_without(self, blocks: Sequence[int]) -> Array:
        """Return ``normal`` without the rows of some blocks.

        It is that of the others: a difference would leave rounding where they show nothing.
        """
        others = [block for block in self.sums.blocks if block not in blocks]
        return self.equations.prior + self.equations.data(self.weights, others)

    def without(self, blocks: Sequence[int]) -> tuple[Array, Array]:
        """Return (estimate (k,), inverse (k, k)) without some blocks."""
        return solve(self.normal_without(blocks), self.start, self.is_free)

    def solution_of(self, normal: Array) -> Array:
        """Return the solution (k,) of products (k + 1, k + 1), what is at a bound held there."""
        return solution(normal[:-1, :-1], normal[:-1, -1], self.start, self.is_free)

    def _possible_of(self, normal: Array, values: Array) -> Array:
        """Return the solution (k,) of products (k + 1, k + 1) in bounds, with possible bodies.

        ``values`` (k,) is the solution that may break them.
        """
        equations = self.equations
        if equations.are_possible_bodies(values) and not np.any(
            equations.crossing(values)
        ):
            return values
        bounded = self.solve_within_bounds(normal, False)
        if equations.are_possible_bodies(bounded.values):
            return bounded.values
        return self.solve_within_bounds(normal, True).values

    def solve_within_bounds(self, normal: Array, possible: bool) -> Fit:
        """Return the fit with the solution of products (k + 1, k + 1) that obeys all bounds.

        Bodies are possible ones, if they have to be. Otherwise, parameters that cross a bound are
        held at it, and not released: those first that yield, a bend of friction below zero, which
        pushes dry or viscous friction beyond theirs.
        """
        equations = self.equations
        start = self.start
        is_free = self.is_free
        if possible and len(equations.bodies):
            return self._with_possible_bodies(normal)
        while True:
            values = solution(normal[:-1, :-1], normal[:-1, -1], start, is_free)
            crosses = equations.crossing(values) & is_free
            if not np.any(crosses):
                break
            if np.any(crosses & equations.yields):
                crosses &= equations.yields
            is_free = is_free & ~crosses
            start = np.where(crosses, equations.inside(values), start)
        return replace(self, values=equations.inside(values), is_free=is_free)

    def _with_possible_bodies(self, normal: Array) -> Fit:
        """Return the fit with the best possible bodies in bounds, of products (k + 1, k + 1).

        Bounds take part in the search from the first crossing on: a parameter that is held at its
        bound beside one set of bodies may be far from it beside others.
        """
        equations = self.equations
        is_bounded = np.zeros_like(self.is_free)
        bodies = self.bodies
        while True:
            bodies = self._possible_bodies(normal, bodies, is_bounded)
            crosses = equations.crossing(bodies.values) & self.is_free & ~is_bounded
            if not np.any(crosses):
                break
            is_bounded |= crosses
        values = equations.inside(bodies.values)
        return replace(self, values=values, is_free=bodies.is_inside, bodies=bodies)

    def _possible_bodies(
        self, normal: Array, like: Possible | None, is_bounded: NDArray[np.bool_]
    ) -> Possible:
        """Return the best values (k,) of products (k + 1, k + 1) with which bodies are possible.

        Those that are not free (k,) stay where they are; those that are bounded (k,) obey bounds.
        ``like`` is such a search for nearly the same equations; None for none.
        """
        is_free = self.is_free
        start = self.start
        equations = self.equations
        least = equations.least
        at = np.flatnonzero(is_free)
        matrix = normal[at[:, None], at]
        # Searched are bodies without what they have to contain.
        known = np.where(is_free, least, start)
        right_side = normal[at, -1] - normal[at, :-1] @ known
        length = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        scaled = matrix / np.outer(length, length)
        scaled[np.diag_indices_from(scaled)] += RIDGE
        root = np.linalg.cholesky(scaled)
        target = np.linalg.solve(root, right_side / length)
        links = np.searchsorted(at, equations.bodies)
        prior = (equations.reference - least)[at]
        if like is not None:
            like = replace(like, values=(like.values - least)[at])
        found = consistent_least_squares(
            root.T * length,
            target,
            links,
            prior,
            bool(np.any(self.is_hidden)),
            like,
            (
                np.where(is_bounded, equations.lower, -np.inf)[at],
                np.where(is_bounded, equations.upper, np.inf)[at],
            ),
        )
        values = known.copy()
        values[at] += found.values
        is_inside = is_free.copy()
        is_inside[at] = found.is_inside
        return replace(found, values=values, is_inside=is_inside)

    def of(self, sums: Sums) -> Fit:
        """Return this estimate with the sums of other recordings, to judge it on them."""
        held = dict(zip(self.sums.names, self.equations.held.tolist()))
        values = np.array([held[name] for name in sums.names])
        equations = Equations(sums, self.equations.terms, values)
        return replace(self, sums=sums, equations=equations)

    @cached_property
    def noise_per_joint(self) -> dict[str, float]:
        """Joint with data to the noise of its torque [N m]."""
        counts = np.sum(self.sums.counts, axis=0)
        pairs = zip(self.sums.joints, self.noise.tolist(), counts)
        return {joint: noise for joint, noise, count in pairs if count}

    @cached_property
    def torque(self) -> dict[str, float]:
        """Joint to its root mean square torque [N m]."""
        return dict(zip(self.sums.joints, self.sums.rms_torque.tolist()))

    @property
    def measured_torque(self) -> dict[str, float]:
        """Joint to its root mean square torque, where it stood still, too [N m]."""
        samples = np.concatenate([each.tau for each in self.recordings])
        squares = np.mean(samples[:, self.arm.indices] ** 2, axis=0)
        return dict(zip(self.arm.joints, np.sqrt(squares).tolist()))

    @cached_property
    def unexplained(self) -> Array:
        """Torque (J,) that neither model nor noise explains, root mean square [N m].

        It is the part of the residuals that is alike in successive rows: those of white noise
        behind the low-pass hardly are.
        """
        squares = np.maximum(self.sums.successive(self.full), 0.0)
        return np.sqrt(squares / self.sums.row_counts)

    @property
    def unexplained_share(self) -> float:
        """``unexplained`` of all joints, as a share of all torque."""
        torque = float(np.linalg.norm(self.sums.rms_torque))
        return float(np.linalg.norm(self.unexplained)) / max(torque, 1e-300)

    @property
    def residual_share(self) -> float:
        """What a fit leaves of all torque, noise included, root mean square."""
        left = float(np.sum(self.noise**2 * self.sums.row_counts))
        return (left / max(float(np.sum(self.sums.squared_torque)), 1e-300)) ** 0.5

    def refit(self, terms: Sequence[Term], possible: bool = False) -> Fit:
        """Return the fit of other terms, from this noise on."""
        return self.fit(
            terms, noise=self.noise, correlation=self.correlation, possible=possible
        )

    @property
    def thetas(self) -> Array:
        """All links (n, 10), those that are held included; zero for one without mass."""
        values = self.by_name
        thetas = self.arm.robot.thetas
        for link, names in self.arm.links.items():
            thetas[link] = [values[name] for name in names]
        return thetas

    def next_point(self) -> Point:
        """Return the point for the next linearisation, at this estimate."""
        values = self.by_name
        links = self.thetas
        # What a sensor's scale multiplies is no inertia that only noise makes.
        settled = settled_values(self)
        links[-1] = [settled[name] for name in self.arm.terms[LAST_LINK].names]
        thetas = self.arm.robot.thetas
        thetas[-1] = links[-1]
        payload = self.point.payload
        if self.question.loaded:
            payload = self.free[self.at(PAYLOAD_NAMES)]
            thetas = links
        return Point(thetas, links, payload, self.point.gravity, values)

    @cached_property
    def residuals(self) -> Array:
        """Residual torque (K of all recordings, J) [N m]; NaN where a row is not used."""
        arm = self.arm
        residuals = []
        for recording in self.recordings:
            for rows in row_chunks(recording, 36 * arm.robot.n_joints):
                predicted = arm.torque(rows, self.point, self.by_name)
                residuals.append(arm.measured_torque(rows) - predicted)
        return np.concatenate(residuals)

    def split(self, rows: NDArray[Any]) -> list[NDArray[Any]]:
        """Return rows (K of all recordings, ...) as those of each recording."""
        ends = np.cumsum([len(recording) for recording in self.recordings])
        return np.split(rows, ends[:-1])


def settled_values(fitted: Fit) -> dict[str, float]:
    """Return the names of all parameters to their values, the last link kept near the model's.

    It is at most as far off as nothing known of it allows (``last_link_scale``): a log in which the
    last joint stands still lets its inertia free, and noise alone would decide it.
    """
    values = dict(fitted.by_name)
    at, wide, inverse = _settled(fitted)
    if len(at):
        term = fitted.arm.terms[LAST_LINK]
        pull = inverse[:, at] @ (wide * (term.reference - fitted.values[at]))
        values.update(zip(fitted.names, (fitted.values + pull).tolist()))
    return values


def settled_errors(fitted: Fit) -> dict[str, float]:
    """Return the names of estimated parameters to their errors beside a last link that exists.

    It is at most as far off the model's as in ``settled_values``.
    """
    at, _, inverse = _settled(fitted)
    errors = fitted.errors
    if len(at):
        formal = np.sqrt(np.diag(inverse))
        raised = np.where(fitted.is_hidden, 1.0, errors)
        raised /= np.where(fitted.is_hidden, 1.0, np.sqrt(np.diag(fitted.inverse)))
        errors = raised * formal
    return dict(zip(fitted.names, errors.tolist()))


def _settled(fitted: Fit) -> tuple[NDArray[np.int64], Array, Array]:
    """Return what keeps the last link near the model's, in a fit that lets it free.

    It is (indices (10,) of its parameters, their precisions (10,), covariance (k, k) with these);
    without indices where its question keeps it near the model's already.
    """
    terms = {term.key: term for term in fitted.equations.terms}
    if LAST_LINK not in terms or terms[LAST_LINK].prior is not None:
        return np.zeros(0, dtype=np.int64), np.zeros(0), fitted.inverse
    at = fitted.at(terms[LAST_LINK].names)
    wide = last_link_scale(fitted.arm.robot) ** -2.0
    normal = fitted.normal.copy()
    normal[at, at] += wide
    return at, wide, solve(normal, fitted.values)[1]


def correlation_times(residuals: Sequence[Array]) -> Array:
    """Return the rows (J,) of residuals that count as one independent row.

    The integrated autocorrelation time 1 + 2 sum_l rho_l, up to the first lag at which rho is no
    longer significant (Bartlett 1946).

    Args:
        residuals: (K, J) of each recording; NaN where a row is not used. The end of one and the
            beginning of the next are no successive rows, whatever their order.
    """
    lags = max(sum(map(len, residuals)) // 10, 1)
    times = []
    for joint in range(residuals[0].shape[1]):
        pairs = covariance = np.zeros(lags + 1)
        for residual in (own[:, joint] for own in residuals):
            is_used = np.isfinite(residual)
            pairs = pairs + lagged_sums(is_used.astype(float), lags)
            covariance = covariance + lagged_sums(
                np.where(is_used, residual, 0.0), lags
            )
        rho = covariance / np.maximum(pairs, 1.0)
        rho = np.append(rho, 0.0) / max(rho[0], 1e-300)
        last = np.argmax(rho <= 2.0 / np.sqrt(max(pairs[0], 1.0)))
        times.append(1.0 + 2.0 * np.sum(rho[1:last]))
    return np.array(times)


def lagged_sums(signal: Array, lags: int) -> Array:
    """Return sums (lags + 1,) over t of s_t s_(t+l), l = 0 ... lags, of a signal (N,)."""
    size = 1 << (len(signal) + lags).bit_length()
    power = np.abs(np.fft.rfft(signal, size)) ** 2
    return np.fft.irfft(power, size)[: lags + 1]
