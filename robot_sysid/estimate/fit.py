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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import link_names, split_name
from robot_sysid.dynamics.spatial import N_INERTIAL
from robot_sysid.estimate.bodies import LinksProblem, Possible, consistent_least_squares
from robot_sysid.estimate.questions import Question, scale_spread
from robot_sysid.estimate.rows import Recording, Sums
from robot_sysid.estimate.terms import (
    FRICTION,
    FURTHER_FRICTION,
    PAYLOAD,
    PAYLOAD_NAMES,
    SCALES,
    ArmTerms,
    Point,
    Term,
)
from robot_sysid.records import Array

# Rounds in which noise and estimate are found from each other.
_NOISE_ROUNDS = 12
# Relative change of the noise below which it has converged.
_SETTLED = 1e-3
# Rounds that hold further parameters at their bounds.
_BOUND_ROUNDS = 6
# Least noise of a joint, as a share of the root mean square torque of all: the error of filtering.
_LEAST_NOISE = 1e-4
# Added to the diagonal of scaled equations: parameters that nothing shows stay at the model's.
_RIDGE = 1e-12
# Variance of a parameter, over that of its column alone, above which nothing shows it.
_HIDDEN = 1e9
# Largest lag of a residual's autocorrelation, as a share of the rows.
_LONGEST_LAG = 0.1


class Equations:
    """Normal equations of a question's k parameters: data and priors, all others held.

    Args:
        sums: of all rows, in p parameters.
        terms: the question.
        held: (p,) values of the parameters that are not estimated.

    Attributes:
        index: (k,) of the estimated parameters in ``sums.names``.
        own: the sums in the estimated parameters alone.
        names: (k,) their names.
        reference: (k,) values that stay where nothing shows them.
        prior: (k + 1, k + 1) products of the priors' equations.
    """

    def __init__(self, sums: Sums, terms: Sequence[Term], held: Array) -> None:
        self.sums = sums
        self.held = held
        self.terms = tuple(terms)
        self.names = tuple(name for term in terms for name in term.names)
        self.index = sums.at(self.names)
        self.own = sums.of(self.names, held)
        size = len(self.names)
        self.prior = np.zeros((size + 1, size + 1))
        self.reference = np.zeros(size)
        self.lower = np.full(size, -np.inf)
        self.upper = np.full(size, np.inf)
        self.spans: list[slice] = []
        self.log_prior = 0.0
        start = 0
        for term in terms:
            span = slice(start, start + len(term.names))
            start = span.stop
            self.spans.append(span)
            self.lower[span] = term.lower
            self.upper[span] = term.upper
            if term.reference is not None:
                self.reference[span] = term.reference
            if term.prior is not None:
                at = np.append(np.arange(span.start, span.stop), size)
                self.prior[np.ix_(at, at)] += term.prior.rows.T @ term.prior.rows
                self.log_prior += np.linalg.slogdet(term.prior.factor)[1]
                self.reference[span] = term.prior.mean

    def normal(self, weights: Array, left_out: Sequence[int] = ()) -> Array:
        """Return the products (k + 1, k + 1) of priors and of weighted rows.

        The held torque is subtracted, and the rows of some blocks are left out.
        """
        normal = self.own.normal(weights) + self.prior
        return normal - self.own.normal(weights, left_out) if left_out else normal

    def inside(self, values: Array) -> Array:
        """Return values (k,) with those that cross a bound moved to it."""
        return np.clip(values, self.lower, self.upper)

    def crossing(self, values: Array) -> NDArray[np.bool_]:
        """Return which of values (k,) cross a bound by more than rounding."""
        inside = self.inside(values)
        return np.abs(values - inside) > 1e-9 * (1.0 + np.abs(inside))

    def full(self, values: Array) -> Array:
        """Return all parameters (p,) from the estimated ones (k,)."""
        full = self.held.copy()
        full[self.index] = values
        return full


def solve(
    normal: Array, reference: Array, is_free: NDArray[np.bool_] | None = None
) -> tuple[Array, Array]:
    """Return (solution (k,), inverse (k, k)) of products [A b]'[A b] (k + 1, k + 1).

    Directions that nothing shows stay at ``reference`` (k,). Parameters that are not ``is_free``
    (k,) stay there, too; their rows of the inverse are zero.
    """
    size = len(reference)
    at = np.arange(size) if is_free is None else np.flatnonzero(is_free)
    matrix = normal[np.ix_(at, at)]
    gradient = normal[at, -1] - normal[at, :size] @ reference
    unit = _inverse(matrix)
    inverse = np.zeros((size, size))
    inverse[np.ix_(at, at)] = unit
    values = reference.copy()
    values[at] += unit @ gradient
    # One step of refinement: the inverse of nearly singular equations has lost digits.
    values[at] += unit @ (normal[at, -1] - normal[at, :size] @ values)
    return values, inverse


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a normal matrix (k, k), regular but for rounding."""
    length = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale = 1.0 / np.where(length > 0.0, length, 1.0)
    scaled = scale[:, None] * matrix * scale
    scaled[np.diag_indices_from(scaled)] += _RIDGE
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        # Rounding has made it indefinite: its positive rows.
        values, vectors = np.linalg.eigh(scaled)
        half = vectors / np.sqrt(np.maximum(values, _RIDGE))
        return scale[:, None] * (half @ half.T) * scale
    inverse = np.linalg.inv(scaled)
    return scale[:, None] * (0.5 * (inverse + inverse.T)) * scale


@dataclass(frozen=True)
class Fit:
    """The answer to a question: values, errors, noise.

    Attributes:
        arm: all terms of the arm.
        recordings: that were fitted.
        point: around which terms were linearised.
        equations: the question's equations.
        noise: (J,) standard deviation of each joint's torque [N m].
        correlation: (J,) rows that count as one independent row.
        free: (k,) estimate in which bodies may be impossible.
        values: (k,) the estimate.
        inverse: (k, k) covariance that noise and priors imply.
        alone: (B, k) estimate without each block in turn.
        start: (k,) values of parameters that are held at a bound, of the others the reference.
        is_free: (k,) which parameters are not held at a bound.
        question: that was asked.
        bodies: the search for possible bodies; None where the free estimate has them.
    """

    arm: ArmTerms
    recordings: tuple[Recording, ...]
    point: Point
    equations: Equations
    noise: Array
    correlation: Array
    free: Array
    values: Array
    inverse: Array
    alone: Array
    start: Array
    is_free: NDArray[np.bool_]
    question: Question
    bodies: Possible | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k,) of the estimated parameters."""
        return self.equations.names

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Names of the parameters that are held at a bound."""
        return tuple(n for n, is_free in zip(self.names, self.is_free) if not is_free)

    @property
    def sums(self) -> Sums:
        """Sums of all rows."""
        return self.equations.sums

    @property
    def weights(self) -> Array:
        """Weights (J,) of each joint's rows [1/(N m)]."""
        return 1.0 / (self.noise * np.sqrt(self.correlation))

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
        """Which estimated parameters (k,) nothing shows."""
        return _hidden(self.inverse, self.equations.normal(self.weights))

    @cached_property
    def covariance(self) -> Array:
        """Covariance (k, k) of the errors: the larger one of formal errors and jackknife.

        A parameter's formal error is raised to that of the jackknife where that is larger. What
        torque scales do to a payload is the same in all blocks, and is added as it is. Rotors and
        friction are confounded with the scale of their joint's sensor: without the factor on it,
        rotors of simulated arms are 1.25 of their errors off (root mean square; 1.19 with it).
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
        joint's scale. A payload has that of an error which all scales share, which the prior of
        its question leaves out.
        """
        question = self.question
        deviations = scale_spread(self.arm, question.options, question.loaded)
        joints = self.arm.joints
        terms = self.equations.terms
        effects = np.zeros((len(joints) + 1, len(self.names)))
        if SCALES not in (term.cause for term in terms):
            return effects.T @ effects
        for term, span in zip(terms, self.equations.spans):
            if term.cause == PAYLOAD:
                shared = np.linalg.norm(deviations) / len(joints)
                effects[-1, span] = shared * self.free[span]
            if term.cause not in (FRICTION, FURTHER_FRICTION):
                continue
            for k, name in enumerate(term.names, span.start):
                kind, owner = split_name(name)
                # The loss of a gear is a share, and has no unit.
                if kind != "load":
                    row = joints.index(owner)
                    effects[row, k] = deviations[row] * self.values[k]
        return effects.T @ effects

    @property
    def errors(self) -> Array:
        """Standard errors (k,), infinite where nothing shows a parameter."""
        errors = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return np.where(self.is_hidden, np.inf, errors)

    def budget(self, combinations: Array) -> dict[str, Array]:
        """Return cause to the standard errors (m,) that it alone makes in combinations (m, k)."""
        budget: dict[str, Array] = {}
        moved = combinations @ self.inverse
        rest = np.sum(moved * combinations, axis=1)
        for term, span in zip(self.equations.terms, self.equations.spans):
            if term.prior is not None:
                share = np.sum(
                    (moved[:, span] @ term.prior.rows[:, :-1].T) ** 2, axis=1
                )
                rest = rest - share
                budget[term.cause] = budget.get(term.cause, 0.0) + share
        scales = np.sum((combinations @ self.scale_errors) * combinations, axis=1)
        budget[SCALES] = budget.get(SCALES, 0.0) + scales
        causes = {"noise": np.maximum(rest, 0.0), **budget}
        return {cause: np.sqrt(variances) for cause, variances in causes.items()}

    def share(self) -> Array:
        """Return the share (k,), 0 to 1, of each value that comes from the data, not the prior."""
        share = np.where(self.is_hidden, 0.0, 1.0)
        for term, span in zip(self.equations.terms, self.equations.spans):
            if term.prior is not None:
                left = np.diag(self.inverse)[span] / term.prior.variances
                share[span] = np.minimum(share[span], np.clip(1.0 - left, 0.0, 1.0))
        return share

    def at(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return the indices of named parameters among the estimated ones."""
        return self.equations.own.at(names)

    @cached_property
    def held_out(self) -> Array:
        """Squared errors (B, J) of blocks predicted from the others [N^2 m^2]."""
        own = self.equations.own
        return np.array([own.squared_residuals(x, b) for b, x in enumerate(self.alone)])

    def expected(self, inverse: Array, block: int) -> Array:
        """Return the squared errors (J,) to expect in a block from noise and an estimate's errors.

        ``inverse`` (k, k) is the covariance of the estimate [N^2 m^2].
        """
        own = self.equations.own
        return own.counts[block] * self.noise**2 + own.spread(inverse, block)

    @cached_property
    def expected_held_out(self) -> Array:
        """Squared errors (B, J) to expect of ``held_out`` if the model is right [N^2 m^2]."""
        blocks = self.sums.blocks
        return np.array([self.expected(self.without([b])[1], b) for b in blocks])

    def without(self, blocks: Sequence[int]) -> tuple[Array, Array]:
        """Return (estimate (k,), inverse (k, k)) without some blocks."""
        normal = self.equations.normal(self.weights, blocks)
        return solve(normal, self.start, self.is_free)

    def possible_without(self, block: int) -> Array:
        """Return the estimate (k,) without a block that obeys all bounds, its bodies possible."""
        equations = self.equations
        values = self.alone[block]
        if np.any(equations.crossing(values)) or not _are_possible(equations, values):
            normal = equations.normal(self.weights, [block])
            possible = partial(
                _possible, equations, normal, self.is_hidden, self.bodies
            )
            values, *_ = _within_bounds(
                equations, lambda *at: possible(*at).values, self.start, self.is_free
            )
        return values

    def of(self, sums: Sums) -> Fit:
        """Return this estimate with the sums of other recordings, to judge it on them."""
        held = dict(zip(self.sums.names, self.equations.held.tolist()))
        values = np.array([held[name] for name in sums.names])
        return replace(self, equations=Equations(sums, self.equations.terms, values))

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

    @cached_property
    def independent_share(self) -> dict[str, float]:
        """Joint to the share of its rows that are independent."""
        return dict(zip(self.sums.joints, (1.0 / self.correlation).tolist()))

    @cached_property
    def log_evidence(self) -> float:
        """Log marginal likelihood of the data under the question, up to a constant (MacKay 1992).

        Noise is that of this fit: its size counts, by the number of independent rows.
        """
        normal = self.equations.normal(self.weights)
        values, inverse = solve(normal, self.equations.reference)
        change = np.append(-values, 1.0)
        misfit = change @ normal @ change
        independent = np.sum(self.sums.counts, axis=0) / self.correlation
        size = independent @ np.log(self.noise)
        log_inverse = np.linalg.slogdet(inverse)[1]
        return 0.5 * (log_inverse - misfit) - size - self.equations.log_prior

    @cached_property
    def unexplained(self) -> Array:
        """Torque (J,) that neither model nor noise explains, root mean square [N m].

        It is the part of the residuals that is alike in successive rows: those of white noise
        behind the low-pass hardly are.
        """
        return slow_part(self.sums.successive(self.full), self.sums)

    @property
    def unexplained_share(self) -> float:
        """``unexplained`` of all joints, as a share of all torque."""
        torque = float(np.linalg.norm(self.sums.rms_torque))
        return float(np.linalg.norm(self.unexplained)) / max(torque, 1e-300)

    def refit(self, terms: Sequence[Term], possible: bool = False) -> Fit:
        """Return the fit of other terms to the question, from this noise on."""
        return fit(
            self.arm,
            self.recordings,
            self.point,
            self.sums,
            terms,
            self.question,
            noise=self.noise,
            correlation=self.correlation,
            possible=possible,
        )

    @property
    def thetas(self) -> Array:
        """All links (n, 10), those that are held included; zero for one without mass."""
        robot = self.arm.robot
        values = self.by_name
        thetas = robot.thetas
        for link in self.arm.others:
            thetas[link] = [values[name] for name in link_names(robot, link)]
        thetas[-1] = [values[name] for name in spatial.PARAMETER_NAMES]
        return thetas

    def next_point(self) -> Point:
        """Return the point for the next linearisation, at this estimate."""
        values = self.by_name
        links = self.thetas
        thetas = self.arm.robot.thetas
        thetas[-1] = links[-1]
        payload = self.point.payload
        if self.question.loaded:
            payload = self.free[self.at(PAYLOAD_NAMES)]
            thetas = links
        friction = {name: values[name] for name in values if "[" in name}
        return Point(thetas, links, payload, self.point.gravity, friction)

    @cached_property
    def residuals(self) -> Array:
        """Residual torque (K of all recordings, J) [N m]; NaN where a row is not used."""
        arm = self.arm
        residuals = []
        for recording in self.recordings:
            for rows in recording.chunks(36 * arm.robot.n_joints):
                predicted = arm.torque(rows, self.point, self.by_name)
                residuals.append(arm.measured(rows) - predicted)
        return np.concatenate(residuals)


def slow_part(successive: Array, sums: Sums) -> Array:
    """Return the root mean square (J,) of torque from sums of products of successive rows (J,)."""
    counts = np.maximum(np.sum(sums.counts, axis=0), 1.0)
    return np.sqrt(np.maximum(successive, 0.0) / counts)


def _hidden(inverse: Array, normal: Array) -> NDArray[np.bool_]:
    """Return which parameters (k,) nothing shows: neither data nor prior."""
    own = np.diag(normal)[:-1]
    return (own == 0.0) | (np.diag(inverse) * own > _HIDDEN)


def fit(
    arm: ArmTerms,
    recordings: Sequence[Recording],
    point: Point,
    sums: Sums,
    terms: Sequence[Term],
    question: Question,
    held: Mapping[str, float] | None = None,
    noise: Array | None = None,
    correlation: Array | None = None,
    possible: bool = True,
) -> Fit:
    """Return the fit of a question.

    Args:
        arm: all terms of the arm.
        recordings: the recordings, to draw them and to take residuals.
        point: around which the sums were made.
        sums: of all rows.
        terms: the question's: its parameters, with priors and bounds.
        question: from which the terms were made.
        held: name to value of parameters that are not estimated; the model's values, else zero.
        noise: (J,) to begin with [N m]; that of a joint without rows may be zero.
        correlation: (J,) rows that count as one independent row; one by default.
        possible: whether bodies have to be possible ones.
    """
    equations = equations_of(arm, sums, terms, held or {})
    correlation = np.ones(len(sums.joints)) if correlation is None else correlation
    torque = sums.rms_torque
    least = max(_LEAST_NOISE * np.sqrt(np.mean(torque**2)), 1e-12)
    noise = np.maximum(0.05 * torque if noise is None else noise, least)
    for _ in range(_NOISE_ROUNDS):
        weights = 1.0 / (noise * np.sqrt(correlation))
        values, inverse = solve(equations.normal(weights), equations.reference)
        previous = noise
        noise = np.maximum(_noise(equations, values, inverse, weights), least)
        if np.max(np.abs(noise / previous - 1.0)) < _SETTLED:
            break
    weights = 1.0 / (noise * np.sqrt(correlation))
    normal = equations.normal(weights)
    _, inverse = solve(normal, equations.reference)
    free, start, is_free = _within_bounds(
        equations,
        lambda start, is_free: solve(normal, start, is_free)[0],
        equations.reference,
        np.ones(len(inverse), dtype=bool),
    )
    values = free
    bodies = None
    if possible and not _are_possible(equations, free):
        is_hidden = _hidden(inverse, normal)

        def of_bodies(start: Array, is_free: NDArray[np.bool_]) -> Array:
            """Return the solution with possible bodies, and keep the search."""
            nonlocal bodies
            bodies = _possible(equations, normal, is_hidden, bodies, start, is_free)
            return bodies.values

        values, start, is_free = _within_bounds(equations, of_bodies, start, is_free)
    alone = []
    for block in sums.blocks if possible else ():
        smaller = equations.normal(weights, [block])
        alone.append(solve(smaller, start, is_free)[0])
    return Fit(
        arm,
        tuple(recordings),
        point,
        equations,
        noise,
        correlation,
        free,
        values,
        inverse,
        np.array(alone),
        start,
        is_free,
        question,
        bodies,
    )


def expected(
    arm: ArmTerms,
    recordings: Sequence[Recording],
    point: Point,
    sums: Sums,
    terms: Sequence[Term],
    question: Question,
    values: Mapping[str, float],
    noise: Array,
) -> Fit:
    """Return the fit to expect of a question before there is data: its errors and their causes.

    Arguments are as in ``fit``, but for these:

    Args:
        values: name to value of parameters that differ from the model's; no torque is read.
        noise: (J,) of an independent row [N m].
    """
    equations = equations_of(arm, sums, terms, values)
    _, inverse = solve(equations.normal(1.0 / noise), equations.reference)
    given = equations.held[equations.index]
    return Fit(
        arm,
        tuple(recordings),
        point,
        equations,
        noise,
        np.ones_like(noise),
        given,
        given,
        inverse,
        np.zeros((0, len(given))),
        given,
        np.ones(len(given), dtype=bool),
        question,
    )


def equations_of(
    arm: ArmTerms, sums: Sums, terms: Sequence[Term], held: Mapping[str, float]
) -> Equations:
    """Return the equations of a question, without parameters that have neither data nor prior.

    All others are held at ``held``, else at the model's values, else at zero.
    """
    values = {**arm.model, **held}
    shown = [_shown(term, sums) for term in terms]
    return Equations(
        sums,
        [term for term in shown if term.names],
        np.array([values.get(name, 0.0) for name in sums.names]),
    )


def _shown(term: Term, sums: Sums) -> Term:
    """Return a term without the parameters that have neither data nor prior."""
    if term.prior is not None or term.bodies:
        return term
    squares = np.sum(sums.squares, axis=0)[sums.at(term.names)]
    return term.only([name for name, square in zip(term.names, squares) if square])


def _noise(
    equations: Equations, values: Array, inverse: Array, weights: Array
) -> Array:
    """Return the noise (J,) of each joint's residuals at values (k,) [N m].

    sigma_j^2 = |r_j|^2 / (n_j - l_j), l_j the number of parameters that the joint's rows determine.
    """
    own = equations.own
    leverage = weights**2 * own.spread(inverse)
    freedom = np.maximum(np.sum(own.counts, axis=0) - leverage, 1.0)
    return np.sqrt(own.squared_residuals(values) / freedom)


def _within_bounds(
    equations: Equations,
    solution: Callable[[Array, NDArray[np.bool_]], Array],
    start: Array,
    is_free: NDArray[np.bool_],
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return a solution (k,) with the parameters that cross a bound held at it.

    With it, values (k,) to start from and which parameters (k,) are not held.

    Args:
        equations: the question, with its bounds.
        solution: returns the values (k,) for the next two.
        start: (k,) to begin with.
        is_free: (k,) to begin with.
    """
    values = solution(start, is_free)
    for _ in range(_BOUND_ROUNDS):
        crosses = equations.crossing(values) & is_free
        if not np.any(crosses):
            break
        is_free = is_free & ~crosses
        start = np.where(crosses, equations.inside(values), start)
        values = solution(start, is_free)
    return equations.inside(values), start, is_free


def _bodies(equations: Equations) -> Iterator[tuple[NDArray[np.int64], Array]]:
    """Yield the indices (10,) of each body among the estimated parameters.

    With them comes the body (10,) that it has to contain, zero for none.
    """
    for term, span in zip(equations.terms, equations.spans):
        if term.bodies:
            indices = np.arange(span.start, span.stop)
            least = np.zeros(len(indices)) if term.least is None else term.least
            yield from zip(*(each.reshape(-1, N_INERTIAL) for each in (indices, least)))


def _are_possible(equations: Equations, values: Array) -> bool:
    """Tell whether all estimated bodies are possible at values (k,)."""
    bodies = _bodies(equations)
    return all(spatial.is_consistent(values[body] - least) for body, least in bodies)


def _possible(
    equations: Equations,
    normal: Array,
    is_hidden: NDArray[np.bool_],
    like: Possible | None,
    start: Array,
    is_free: NDArray[np.bool_],
) -> Possible:
    """Return the best values (k,) with which all bodies are possible.

    ``like`` is such a search for nearly the same equations; None for none.
    """
    at = np.flatnonzero(is_free)
    matrix = normal[np.ix_(at, at)]
    fixed = np.flatnonzero(~is_free)
    right_side = normal[at, -1] - normal[np.ix_(at, fixed)] @ start[fixed]
    length = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / np.outer(length, length)
    scaled[np.diag_indices_from(scaled)] += _RIDGE
    root = np.linalg.cholesky(scaled)
    rows = root.T * length
    target = np.linalg.solve(root, right_side / length)
    prior = np.zeros(len(at))
    contained = np.zeros(len(at))
    links = []
    for body, least in _bodies(equations):
        link = np.searchsorted(at, body)
        links.append(link)
        prior[link] = equations.reference[body] - least
        contained[link] = least
    if like is not None:
        like = replace(like, values=like.values[at] - contained)
    problem = LinksProblem(tuple(links), prior)
    has_hidden = bool(np.any(is_hidden))
    found = consistent_least_squares(
        rows, target - rows @ contained, problem, has_hidden, like
    )
    values = start.copy()
    values[at] = contained + found.values
    return replace(found, values=values)


def correlation_times(residuals: Array) -> Array:
    """Return the rows (J,) of residuals (K, J) that count as one independent row.

    The integrated autocorrelation time 1 + 2 sum_l rho_l, up to the first lag at which rho is no
    longer significant (Bartlett 1946).
    """
    times = []
    for residual in residuals.T:
        is_used = np.isfinite(residual)
        signal = np.where(is_used, residual, 0.0)
        lags = max(int(_LONGEST_LAG * len(signal)), 1)
        pairs = np.maximum(lagged_sums(is_used.astype(float), lags), 1.0)
        covariance = lagged_sums(signal, lags) / pairs
        rho = np.append(covariance, 0.0) / max(covariance[0], 1e-300)
        last = np.argmax(rho <= 2.0 / np.sqrt(pairs[0]))
        times.append(1.0 + 2.0 * np.sum(rho[1:last]))
    return np.array(times)


def lagged_sums(signal: Array, lags: int) -> Array:
    """Return sums (lags + 1,) over t of s_t s_(t+l), l = 0 ... lags, of a signal (N,)."""
    size = 1 << (len(signal) + lags).bit_length()
    power = np.abs(np.fft.rfft(signal, size)) ** 2
    return np.fft.irfft(power, size)[: lags + 1]
