"""The fit of parameters: linearise, weight rows, widen priors, solve, make bodies consistent.

Shapes: n joints of the chain, "joints" those with equations; p parameters (``Columns.names``), k of
them estimated; K rows of a joint. Equations are weighted by 1 / effective noise, which counts rows
that are not independent: noise times sqrt(correlation factor).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from robot_sysid.dynamics.friction import NONLINEAR_TERMS, speed_name
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES
from robot_sysid.estimation.algebra.consistent_bodies import (
    LinksProblem,
    consistent_least_squares,
)
from robot_sysid.estimation.algebra.least_squares import (
    block_views,
    combine,
    estimate_noise,
    lower_floor,
    restrict,
    solver,
)
from robot_sysid.estimation.algebra.priors import widened_groups, with_prior
from robot_sysid.estimation.algebra.uncertainty import (
    concentration,
    residual_correlation_time,
)
from robot_sysid.estimation.columns import Columns, Point
from robot_sysid.estimation.dataset import (
    DecimatedSamples,
    block_masks,
    information_of,
    release_memory,
)
from robot_sysid.estimation.question import Choice, Question
from robot_sysid.estimation.unknowns import EstimatedRows, Unknowns, build_unknowns
from robot_sysid.records import DELAY_NAME, Array, SquareRootInformation

# Largest number of linearisations.
_MAX_ROUNDS = 8
# Largest number of solutions, each of which holds more parameters at their bounds.
_MAX_BOUND_ROUNDS = 6
# Change of predicted torques and unknowns at convergence, in standard deviations of noise, priors.
_SETTLED = 0.05
# Change of the delay at convergence [s].
_SETTLED_DELAY = 1e-6
# Change of gravity's direction at convergence [rad].
_SETTLED_ANGLE = 1e-6
# Relative change of friction's speeds at convergence.
_SETTLED_SPEED = 0.02


@dataclass(frozen=True)
class Evidence:
    """Information of recordings around a point, of a size that does not grow with their length.

    Attributes:
        blocks: square-root information of each block of rows, about all p parameters.
        squared_torque: (blocks, joints) sum of squares of the measured torque [N^2 m^2].
        torque: (n,) root mean square of each joint's measured torque [N m].
        total: square-root information of all blocks together.
    """

    blocks: tuple[SquareRootInformation, ...]
    squared_torque: Array
    torque: Array
    total: SquareRootInformation = field(init=False)

    def __post_init__(self) -> None:
        # Blocks become views of the total where it contains their rows: half of the memory.
        total = combine(self.blocks)
        object.__setattr__(self, "total", total)
        object.__setattr__(self, "blocks", tuple(block_views(total, self.blocks)))

    def merge_blocks(self) -> Evidence:
        """Return the evidence of all blocks as one block."""
        squared_torque = np.sum(self.squared_torque, axis=0)[None]
        return Evidence((self.total,), squared_torque, self.torque)

    def unknowns(
        self, columns: Columns, question: Question, choice: Choice
    ) -> Unknowns:
        """Return which parameters a question and a choice leave unknown, with priors and bounds.

        Friction's priors follow from the measured torque. A friction term whose column is zero in
        these rows is held.
        """
        return build_unknowns(columns, question, choice, self.torque, self.nonzero)

    def of(self, unknowns: Unknowns) -> SquareRootInformation:
        """Return the information of all blocks about the unknowns, without their priors."""
        return restrict(self.total, unknowns.estimated_names, unknowns.held)

    def squared_residuals(self, values: Array) -> Array:
        """Return sums of squared residuals (blocks, joints, m) at values (blocks, p, m) [N^2 m^2].

        Every block has m sets of parameters of its own.
        """
        squares = []
        for block, block_values in zip(self.blocks, values):
            squares.append(block.squared_residuals(block_values))
        return np.array(squares)

    @cached_property
    def nonzero(self) -> np.ndarray:
        """Mask (p,) of the parameters that act in some row: their column is not zero."""
        nonzero = np.zeros(len(self.total.names), dtype=bool)
        for joint in self.total.joints:
            # The last column is the right-hand side.
            nonzero[joint.columns] |= np.any(joint.triangle[:, :-1] != 0.0, axis=0)
        return nonzero


def evidence(samples: Sequence[DecimatedSamples], torque: Array) -> Evidence:
    """Return the evidence of recordings in the blocks of ``dataset.block_masks``.

    Args:
        samples: equations of each recording.
        torque: (n,) root mean square of each joint's measured torque [N m].
    """
    recordings = []
    for log in samples:
        recordings.append([log.where(mask) for mask in block_masks(log)])
    return evidence_of(list(zip(*recordings)), torque)


def evidence_of(
    blocks: Collection[Sequence[DecimatedSamples]], torque: Array
) -> Evidence:
    """Return the evidence of blocks, each of rows from one or several recordings.

    Args:
        blocks: per block the equations of each recording, of which the block's rows are in use.
        torque: (n,) root mean square of each joint's measured torque [N m].
    """
    squared_torque = []
    for block in blocks:
        squares = [recording.squared_torque() for recording in block]
        squared_torque.append(np.sum(squares, axis=0))
    return Evidence(information_of(blocks), np.array(squared_torque), torque)


@dataclass(frozen=True)
class Fit:
    """An estimate of all parameters around one linearisation point, and its data.

    Attributes:
        columns: parameter names, and the rows of recordings.
        question: which parameters are wanted.
        choice: settings that were selected from the recordings.
        point: around which the equations were linearised.
        samples: rows of each recording; () where only their evidence is available.
        evidence: of the rows of all recordings.
        unknowns: which parameters were estimated, and their priors, widened by the data.
        weights: (joints,) of each joint's equations, 1 / effective noise [1/(N m)].
        residual_correlation: (joints,) rows per independent row, by the autocorrelation of this
            fit's residuals; the weights use ``correlation_factors`` of the choice.
        free: (p,) the estimate with bodies that may be physically inconsistent.
        values: (p,) the estimate with consistent bodies; its delay, tilt and friction speeds are
            increments on those of the point, and ``final`` has their totals.
    """

    columns: Columns
    question: Question
    choice: Choice
    point: Point
    samples: tuple[DecimatedSamples, ...]
    evidence: Evidence
    unknowns: Unknowns
    weights: Array
    residual_correlation: Array
    free: Array
    values: Array

    @property
    def information(self) -> SquareRootInformation:
        """Information of data and priors about the k unknowns, computed on each access."""
        return with_prior(self.evidence.of(self.unknowns), self.unknowns.groups)

    @property
    def noise(self) -> Array:
        """Standard deviation (joints,) of the torque noise of one sample [N m]."""
        return 1.0 / (self.weights * np.sqrt(self.correlation_factors))

    @property
    def correlation_factors(self) -> Array:
        """Rows per independent row (joints,) by which the equations were weighted."""
        return correlation_factors_of(self.choice, len(self.columns.joints))

    @property
    def noise_per_joint(self) -> dict[str, float]:
        """Joint to standard deviation of its torque noise [N m], only joints with used rows."""
        noise_per_joint = {}
        for joint, noise in zip(self.evidence.total.joints, self.noise.tolist()):
            if joint.n_samples:
                noise_per_joint[joint.joint] = noise
        return noise_per_joint

    @property
    def is_constrained(self) -> bool:
        """Whether bodies were made physically consistent: ``values`` differ from ``free``."""
        return bool(np.any(self.values != self.free))

    @property
    def rows(self) -> EstimatedRows:
        """Rows of all recordings in the columns of the unknowns, needs ``samples``."""
        return EstimatedRows(self.samples, self.unknowns)

    def value(self, name: str) -> float:
        """Return a named parameter of ``final`` in its SI unit."""
        return float(self.final[self.columns.index[name]])

    @property
    def next_point(self) -> Point:
        """The point for the next linearisation: this estimate, its increments added to the point.

        Recordings given as loaded and empty the wrong way round have a payload of negative mass.
        Around a consistent payload, far from that estimate, torque scales would fit its torque, so
        that with a payload the point is the unconstrained estimate.
        """
        values = self.free if self.question.loaded else self.values
        return self.columns.move_point(self.point, values, self.unknowns.increments)

    @cached_property
    def final(self) -> Array:
        """All parameters (p,): ``values`` with the point's delay, tilt and estimated speeds added.

        Speeds that are not estimated stay zero, as in ``values``.
        """
        values = self.values.copy()
        indices = self.columns.index
        values[indices[DELAY_NAME]] += self.point.delay
        if TILT_NAMES[0] in indices:
            tilt = self.columns.total_tilt(self.point, self.values)
            values[self.columns.indices(TILT_NAMES)] = tilt
        for term, speeds in (self.point.speed or {}).items():
            for joint, speed in zip(self.columns.robot.joint_names, speeds.tolist()):
                name = speed_name(term, joint)
                if name in self.unknowns.increments:
                    values[indices[name]] += speed
        return values


@dataclass
class Fitter:
    """Fits recordings; each fit starts with the noise of the previous one.

    Attributes:
        columns: parameter names, and the rows of recordings.
        torque: (n,) root mean square of each joint's measured torque [N m].
        on_pass: called before every pass over the recordings.
        linearised: the last point with the evidence and rows around it; None before there are any.
    """

    columns: Columns
    torque: Array
    on_pass: Callable[[], None] = lambda: None
    linearised: tuple[Point, Evidence, tuple[DecimatedSamples, ...]] | None = None
    _noise: Array | None = None

    def around(self, point: Point) -> tuple[Evidence, tuple[DecimatedSamples, ...]]:
        """Return (evidence of all rows around a point, rows of each recording).

        The results of the last point (the identical object) are cached and shared: callers drop
        their references before other rows are computed, as rows take most of the memory.
        """
        if self.linearised is None or self.linearised[0] is not point:
            self.on_pass()
            self.forget_rows()
            release_memory()
            samples = self.columns.samples(point)
            self.linearised = point, evidence(samples, self.torque), samples
        return self.linearised[1:]

    def forget_rows(self) -> None:
        """Drop the cached rows, to have memory for others."""
        self.linearised = None

    def correlation_factors(self, fit: Fit) -> Array:
        """Return how many rows (joints,) of each joint count as one independent row in a fit.

        It is the larger one of the autocorrelation time of the residuals, and the concentration of
        residuals in a few bursts.
        """
        residuals = list(residuals_of(fit.samples, fit.values))
        burst_factors = list(map(concentration, residuals))
        return np.maximum(_correlation_times(residuals), burst_factors)

    def solve_around(self, point: Point, question: Question, choice: Choice) -> Fit:
        """Return the solution of the equations linearised around a point, without iterating.

        Parameters are within their bounds, bodies are physically consistent. Each round holds
        further parameters at their bounds, and solves again where the data may widen priors, with
        the autocorrelation of its first residuals. The noise starts at that of the last ``fit``.
        """
        data, samples = self.around(point)
        factors = correlation_factors_of(choice, len(self.columns.joints))
        correlation = factors
        noise = self._noise
        start = data.unknowns(self.columns, question, choice)
        for _ in range(_MAX_BOUND_ROUNDS):
            unknowns, free, effective_noise = _solve_within_bounds(
                self.columns,
                start,
                data,
                inflation=factors,
                correlation=correlation / factors,
                noise=noise,
            )
            noise = effective_noise / np.sqrt(factors)
            if samples:
                correlation = _correlation_times(residuals_of(samples, free))
                if any(group.may_widen for group in unknowns.groups):
                    unknowns, free, effective_noise = _solve_within_bounds(
                        self.columns,
                        unknowns,
                        data,
                        inflation=factors,
                        correlation=correlation / factors,
                        noise=noise,
                    )
                    noise = effective_noise / np.sqrt(factors)
            weights = 1.0 / effective_noise
            values = make_consistent(unknowns, data, weights, free)
            # Bodies that are made consistent push other parameters across their bounds.
            bounded = unknowns.hold_at_bounds(values)
            if bounded is None:
                break
            start = bounded
        return Fit(
            columns=self.columns,
            question=question,
            choice=choice,
            point=point,
            samples=samples,
            evidence=data,
            unknowns=unknowns,
            weights=weights,
            residual_correlation=correlation,
            free=free,
            values=np.clip(values, unknowns.lower, unknowns.upper),
        )

    def fit(
        self,
        question: Question,
        choice: Choice,
        point: Point | None = None,
        rounds: int = _MAX_ROUNDS,
    ) -> Fit:
        """Return the fit at the point where linearisation has converged.

        Bodies, gravity of a file and friction's speeds have to converge; the last of ``rounds``
        fits is returned even if they have not.

        Args:
            question: which parameters are wanted.
            choice: friction terms, couplings, and priors of the links.
            point: at which to start; None for the model's own values.
            rounds: largest number of linearisations.
        """
        # Columns of load and of nonlinear terms depend on the estimate. While friction terms are
        # selected, load-dependent friction that only a prior allows for needs no exact columns.
        terms = set[str]()
        for model in choice.friction:
            terms.update(model.terms)
        has_nonlinear_terms = not terms.isdisjoint(("load", *NONLINEAR_TERMS))
        exact_load = has_nonlinear_terms or choice.dry_friction is not None
        point = point or self.columns.start()
        if (point.exact_load, point.in_file) != (exact_load, question.in_file):
            point = replace(point, exact_load=exact_load, in_file=question.in_file)
        for rounds_left in reversed(range(rounds)):
            fit = self.solve_around(point, question, choice)
            self._noise = fit.noise
            next_point = fit.next_point
            if _has_converged(fit, next_point):
                return fit
            if rounds_left:
                point = next_point
                del fit  # its rows and their evidence, before others are made
        return fit


def squared_effect(fit: Fit, change: Array) -> float:
    """Return the sum of squares by which a change (p,) of parameters moves torques and unknowns.

    Torques count in standard deviations of the noise, unknowns in those of their priors.
    """
    # Right-hand sides, the last column of triangles and priors, do not change.
    effects = []
    for joint, weight in zip(fit.evidence.total.joints, fit.weights):
        effects.append(weight * (joint.triangle[:, :-1] @ change[joint.columns]))
    names = fit.unknowns.estimated_names
    for group in fit.unknowns.groups:
        effects.append(group.prior_rows(names)[:, :-1] @ change[fit.unknowns.estimated])
    return float(sum(map(np.vdot, effects, effects)))


def _has_converged(fit: Fit, next_point: Point) -> bool:
    """Tell whether the step from a fit's point to the next one is below every ``_SETTLED`` limit.

    The limits are on predicted torques and unknowns together, delay, gravity and friction's speeds.
    """
    point = fit.point
    change = np.zeros(len(fit.values))
    indices = np.setdiff1d(
        fit.unknowns.estimated, fit.columns.indices(fit.unknowns.increments)
    )
    change[indices] = (next_point.values - point.values)[indices]
    gravity_change = float(np.linalg.norm(np.cross(next_point.gravity, point.gravity)))
    # Without gravity, nothing is divided by zero.
    gravity_change /= float(next_point.gravity @ next_point.gravity) or 1.0
    speed_change = 0.0
    for term, speeds in (point.speed or {}).items():
        relative_change = np.abs((next_point.speed or {})[term] / speeds - 1.0)
        speed_change = max(speed_change, float(np.max(relative_change)))
    return (
        squared_effect(fit, change) < _SETTLED**2
        and abs(next_point.delay - point.delay) < _SETTLED_DELAY
        and gravity_change < _SETTLED_ANGLE
        and speed_change < _SETTLED_SPEED
    )


def correlation_factors_of(choice: Choice, n_joints: int) -> Array:
    """Return how many rows of each joint (joints,) count as one independent row in a choice.

    It is one for every joint where the choice does not say.
    """
    factors = choice.correlation_factors
    return np.ones(n_joints) if factors is None else np.array(factors)


def residuals_of(samples: Sequence[DecimatedSamples], values: Array) -> Iterator[Array]:
    """Yield each joint's residuals (K,) at parameters (p,) [N m]; NaN where a row is not used."""
    torques = [recording.torque(values) for recording in samples]
    for joint in range(len(samples[0].joints)):
        residuals = []
        for recording, torque in zip(samples, torques):
            residuals.append(recording.tau[joint] - torque[joint])
        yield np.concatenate(residuals)


def _correlation_times(residuals: Iterable[Array]) -> Array:
    """Return the integrated autocorrelation time (joints,) of joints' residuals (K,) [rows]."""
    return np.array(list(map(residual_correlation_time, residuals)))


def _solve_within_bounds(
    columns: Columns,
    unknowns: Unknowns,
    data: Evidence,
    inflation: Array,
    correlation: Array,
    noise: Array | None,
) -> tuple[Unknowns, Array, Array]:
    """Return the weighted solution, with each parameter that would cross a bound held at the bound.

    Args:
        columns: gives the model's values, which unknowns keep that nothing identifies.
        unknowns: which parameters to estimate, and their priors.
        data: evidence of the rows.
        inflation: (joints,) variance inflation of the noise of an equation.
        correlation: (joints,) further variance inflation by autocorrelated residuals, which
            ``inflation`` does not contain; it counts only where the data widens priors.
        noise: (joints,) noise to begin with [N m]; None estimates it from the data alone.

    Returns:
        (unknowns with widened priors, values (p,), effective noise (joints,) [N m]).
    """
    while True:  # each round holds at least one more parameter
        model_values = columns.model_values[unknowns.estimated]
        unknowns, values, effective_noise, noise = _solve_weighted(
            unknowns, data, model_values, inflation, correlation, noise
        )
        bounded = unknowns.hold_at_bounds(values)
        if bounded is None:
            values = np.clip(values, unknowns.lower, unknowns.upper)
            return unknowns, values, effective_noise
        unknowns = bounded


def _solve_weighted(
    unknowns: Unknowns,
    data: Evidence,
    prior: Array,
    inflation: Array,
    correlation: Array,
    noise: Array | None,
) -> tuple[Unknowns, Array, Array, Array]:
    """Return (unknowns with widened priors, values (p,), effective noise, noise (joints,) [N m]).

    Bounds do not count here. It is a function of its own because returning from it frees the rows
    and their squares, which take most of the memory.

    Args:
        prior: (k,) values for unknowns that neither data nor priors identify.
        inflation, correlation, noise: as in ``_solve_within_bounds``.
    """
    information = data.of(unknowns)
    posterior = with_prior(information, unknowns.groups)
    solve_posterior = solver(posterior, prior)
    noise = estimate_noise(posterior, solve_posterior, start=noise)
    effective_noise = noise * np.sqrt(inflation)
    groups = widened_groups(
        information, effective_noise * np.sqrt(correlation), unknowns.groups
    )
    # The identical tuple where no prior may widen.
    if groups is not unknowns.groups:
        unknowns = replace(unknowns, groups=groups)
        posterior = with_prior(information, unknowns.groups)
        solve_posterior = solver(posterior, prior)
    effective_noise = lower_floor(posterior, solve_posterior, effective_noise)
    values = unknowns.full(solve_posterior(1.0 / effective_noise)[0])
    return unknowns, values, effective_noise, noise


def make_consistent(
    unknowns: Unknowns, data: Evidence, weights: Array, free: Array
) -> Array:
    """Return the best values (p,) with which all unknown bodies are physically consistent.

    Args:
        weights: (joints,) of each joint's equations [1/(N m)].
        free: (p,) the unconstrained estimate, which is returned where its bodies are consistent.
    """
    if unknowns.has_consistent_bodies(free):
        return free
    information = with_prior(data.of(unknowns), unknowns.groups)
    equations = information.equations(weights)
    return unknowns.full(consistent_least_squares(*equations, links_problem(unknowns)))


def links_problem(unknowns: Unknowns) -> LinksProblem:
    """Return the unknown bodies of a fit with k unknowns as links of a least-squares problem.

    The record holds, per unknown body, indices (10,) among the unknowns, and a vector (k,) with
    the parameters of usual bodies at these indices, zero elsewhere.
    """
    prior = np.zeros(len(unknowns.estimated))
    links = []
    for indices, usual_body in unknowns.bodies.values():
        link = np.searchsorted(unknowns.estimated, indices)
        links.append(link)
        prior[link] = usual_body
    return LinksProblem(tuple(links), prior)
