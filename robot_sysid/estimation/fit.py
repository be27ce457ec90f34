"""The one fit: linearise, weight rows, widen priors, solve, make bodies possible; repeat."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import NONLINEAR_TERMS, speed_name
from robot_sysid.dynamics.newton_euler import TILT_NAMES
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra.consistent_bodies import (
    ConsistentLinks,
    LinksProblem,
)
from robot_sysid.estimation.algebra.least_squares import (
    combine,
    estimate_noise,
    lower_floor,
    parts_of,
    restrict,
    solver,
)
from robot_sysid.estimation.algebra.priors import widened_groups, with_prior
from robot_sysid.estimation.algebra.uncertainty import concentration, memory
from robot_sysid.estimation.columns import Columns, Point
from robot_sysid.estimation.dataset import DecimatedSamples, block_masks, information_of
from robot_sysid.estimation.question import Choice, Question
from robot_sysid.estimation.unknowns import Unknowns, build_unknowns
from robot_sysid.records import DELAY_NAME, Array, SquareRootInformation
from robot_sysid.signals.repetition import Visits

# Largest number of linearisations, with and without a delay or tilt to estimate.
_MOST_ROUNDS = 8
_AUTO_ROUNDS = 20
# Largest number of solutions that each hold more parameters at bounds.
_MOST_BOUNDS = 6
# Changes that no longer count: of predictions and priors, in standard deviations, of the delay [s],
# of gravity's direction [rad], of speeds (a share).
_SETTLED = 0.05
_SETTLED_DELAY = 1e-6
_SETTLED_ANGLE = 1e-6
_SETTLED_SPEED = 0.02


def release_memory() -> None:
    """Return free memory to the system.

    glibc keeps freed blocks that lie between blocks in use: with many joints, whose triangles are
    of all sizes, that is a quarter of all memory.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


@dataclass(frozen=True)
class Evidence:
    """Information of recordings around a point, of a size that does not grow with their length.

    Attributes:
        blocks: the information of each block of rows that is held out in turn.
        squared_torque: (blocks, joints) sum of squares of the measured torque [N^2 m^2].
        torque: (n,) root mean square of each joint's measured torque [N m].
        total: the information of all blocks.
    """

    blocks: tuple[SquareRootInformation, ...]
    squared_torque: Array
    torque: Array
    total: SquareRootInformation = field(init=False)

    def __post_init__(self) -> None:
        total = combine(self.blocks)
        object.__setattr__(self, "total", total)
        object.__setattr__(self, "blocks", tuple(parts_of(total, self.blocks)))

    def merge_blocks(self) -> Evidence:
        """Return the evidence of all blocks as one block."""
        return Evidence(
            (self.total,), np.sum(self.squared_torque, axis=0)[None], self.torque
        )

    def of(self, unknowns: Unknowns) -> SquareRootInformation:
        """Return the information of all blocks about the unknowns, other parameters held."""
        return restrict(self.total, unknowns.estimated_names, unknowns.held)

    def squared_residuals(self, values: Array) -> Array:
        """Return squared residuals (blocks, joints, m) at values (blocks, p, m) [N^2 m^2]."""
        pairs = zip(self.blocks, values)
        return np.array(
            [block.squared_residuals(block_values) for block, block_values in pairs]
        )

    @cached_property
    def nonzero(self) -> np.ndarray:
        """Which parameters (p,) have a column that is not zero."""
        nonzero = np.zeros(len(self.total.names), dtype=bool)
        for joint in self.total.joints:
            nonzero[joint.columns] |= np.any(joint.triangle[:, :-1] != 0.0, axis=0)
        return nonzero


def evidence(samples: Sequence[DecimatedSamples], torque: Array) -> Evidence:
    """Return the evidence of recordings, each block of the same stretches of all of them."""
    blocks = zip(*[[log.where(mask) for mask in block_masks(log)] for log in samples])
    return evidence_of(list(blocks), torque)


def evidence_of(
    blocks: Collection[Sequence[DecimatedSamples]], torque: Array
) -> Evidence:
    """Return the evidence of blocks, each of rows from several recordings."""
    squares = [
        np.sum([recording.squared_torque() for recording in block], axis=0)
        for block in blocks
    ]
    return Evidence(information_of(blocks), np.array(squares), torque)


@dataclass(frozen=True)
class EstimatedRows:
    """Rows of the unknowns, made from recordings' rows of all parameters.

    The torque of held parameters is subtracted; iterating makes the rows of one joint at a time.
    """

    samples: tuple[DecimatedSamples, ...]
    unknowns: Unknowns

    def __iter__(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield (joint number, rows, right-hand sides) of each joint, all recordings together."""
        for joint in range(len(self.samples[0].columns)):
            yield (
                joint,
                *self._joint_rows(joint),
            )  # no variable here keeps rows in memory meanwhile

    def _joint_rows(self, joint: int) -> tuple[Array, Array]:
        columns = self.samples[0].columns[joint]
        ends = np.cumsum([len(recording) for recording in self.samples])
        is_unknown = np.isin(columns, self.unknowns.estimated)
        tau = list[Array]()
        held = self.unknowns.held[columns[~is_unknown]]
        all_rows = np.empty((ends[-1], np.count_nonzero(is_unknown)))
        for recording, recording_rows in zip(
            self.samples, np.split(all_rows, ends[:-1])
        ):
            rows = recording.rows[joint]
            recording_rows[:] = rows[:, is_unknown]
            tau.append(recording.tau[joint] - rows[:, ~is_unknown] @ held)
        return all_rows, np.concatenate(tau)


@dataclass(frozen=True)
class Fit:
    """An estimate and what it was made from.

    Attributes:
        columns: parameter names, and the rows of recordings.
        question, choice: what to estimate, and what the recordings decided.
        point: around which the equations were linearised.
        samples: each recording's rows; none where only their evidence is there.
        evidence: of these rows.
        unknowns: which parameters were estimated, and their priors.
        weights: (joints,) of each joint's equations [1/(N m)].
        inflation: (joints,) variance inflation of each joint's noise, from motion that repeats.
        memory: (joints,) rows of each joint per independent row, by its residuals' correlation.
        free: (p,) the estimate before bodies had to be possible.
        values: (p,) the estimate.
    """

    columns: Columns
    question: Question
    choice: Choice
    point: Point
    samples: tuple[DecimatedSamples, ...]
    evidence: Evidence
    unknowns: Unknowns
    weights: Array
    inflation: Array
    memory: Array
    free: Array
    values: Array

    @property
    def information(self) -> SquareRootInformation:
        """Information of data and priors about the k unknowns; it is large."""
        return with_prior(self.evidence.of(self.unknowns), self.unknowns.groups)

    @property
    def noise(self) -> Array:
        """Standard deviation (joints,) of the torque noise of one sample [N m]."""
        return 1.0 / (self.weights * np.sqrt(self.inflation * self.correlation_factors))

    @property
    def correlation_factors(self) -> Array:
        """Rows per independent row (joints,), as this fit weighted them."""
        return autocorrelation_time(self.choice, len(self.columns.joints))

    @property
    def noise_per_joint(self) -> dict[str, float]:
        """Joint to standard deviation of its torque noise [N m], of joints with samples."""
        pairs = zip(self.evidence.total.joints, self.noise.tolist())
        return {joint.joint: noise for joint, noise in pairs if joint.n_samples}

    @property
    def is_constrained(self) -> bool:
        """Whether the plain estimate was replaced by one with physically consistent bodies."""
        return bool(np.any(self.values != self.free))

    @property
    def rows(self) -> EstimatedRows:
        """Rows of the unknowns."""
        return EstimatedRows(self.samples, self.unknowns)

    def value(self, name: str) -> float:
        """Return one parameter, the part of it that the point holds included."""
        return float(self.final[self.columns.index[name]])

    @property
    def next_point(self) -> Point:
        """The point for the next linearisation, with the increments of this fit added.

        Recordings given as loaded and empty the wrong way round have a payload of negative mass;
        around a possible one, which is far from it, torque scales would fit its torque.
        """
        values = self.free if self.question.loaded else self.values
        return self.columns.move_point(self.point, values, self.unknowns.increments)

    @cached_property
    def final(self) -> Array:
        """All parameters (p,); delay, tilt and speeds include the part that the point holds."""
        values = self.values.copy()
        indices = self.columns.index
        values[indices[DELAY_NAME]] += self.point.delay
        if TILT_NAMES[0] in indices:
            values[self.columns.indices(TILT_NAMES)] = self.columns.whole_tilt(
                self.point, self.values
            )
        for term, speeds in (self.point.speed or {}).items():
            for joint, speed in zip(self.columns.robot.joint_names, speeds.tolist()):
                name = speed_name(term, joint)
                if name in self.unknowns.increments:
                    values[indices[name]] += speed
        return values


@dataclass
class Fitter:
    """Fits one question to recordings, and begins with the noise of the fit before.

    Attributes:
        columns: parameter names, and the rows of recordings.
        torque: (n,) root mean square of each joint's measured torque [N m].
        visits: which rows pass the same states; None where there are none.
        on_pass: called before every pass over the recordings.
    """

    columns: Columns
    torque: Array
    visits: Visits | None = None
    on_pass: Callable[[], None] = lambda: None
    _last: tuple[Point, Evidence, tuple[DecimatedSamples, ...]] | None = field(
        default=None
    )
    _noise: Array | None = None

    def around(self, point: Point) -> tuple[Evidence, tuple[DecimatedSamples, ...]]:
        """Return the evidence of the rows around a point, and the rows of each recording."""
        if self._last is None or self._last[0] is not point:
            self.on_pass()
            self._last = (
                None  # rows go before others are made: they take most of the memory
            )
            release_memory()
            samples = self.columns.samples(point)
            self._last = point, evidence(samples, self.torque), samples
        return self._last[1:]

    def correlation_factors(self, fit: Fit) -> Array:
        """Return how many rows (joints,) of each joint count as one independent row.

        That is the memory of their residuals, or the concentration of residuals in a few bursts,
        whichever is larger.
        """
        residuals = list(_residuals(fit.samples, fit.values))
        burst_memory = np.array([concentration(residual) for residual in residuals])
        if self.visits is None:
            correlation_memory = np.array([memory(residual) for residual in residuals])
        else:
            correlation_memory = self.visits.inflation(residuals)[1]
        return np.maximum(correlation_memory, burst_memory)

    def solve_around(self, point: Point, question: Question, choice: Choice) -> Fit:
        """Return the solution of the equations around a point."""
        data, samples = self.around(point)
        return solve(
            self.columns,
            question,
            choice,
            point,
            data,
            samples,
            self.visits,
            noise=self._noise,
        )

    def fit(
        self,
        question: Question,
        choice: Choice,
        point: Point | None = None,
        rounds: int = _MOST_ROUNDS,
    ) -> Fit:
        """Return the fit, once bodies, delay, tilt and speeds have settled.

        Args:
            choice: friction terms, couplings, and priors of the links.
            point: where to begin; None for the model.
            rounds: how often to linearise at most.

        Raises:
            SysidError: a delay or a tilt to estimate does not settle.
        """
        # Columns of the load and those with a speed depend on the estimate. While friction is
        # chosen, a load that only its prior allows for needs no exact columns.
        terms = {term for model in choice.friction for term in model.terms}
        exact_load = (
            not terms.isdisjoint(("load", *NONLINEAR_TERMS))
            or choice.dry_friction is not None
        )
        point = point or self.columns.start()
        if (point.exact_load, point.in_file) != (exact_load, question.in_file):
            point = replace(point, exact_load=exact_load, in_file=question.in_file)
        options = question.options
        auto_names = [
            name for name in ("delay", "tilt") if getattr(options, name) == "auto"
        ]
        rounds = _AUTO_ROUNDS if auto_names and not question.in_file else rounds
        for rounds_left in reversed(range(rounds)):
            fit = self.solve_around(point, question, choice)
            self._noise = fit.noise
            next_point = fit.next_point
            if _is_settled(fit, next_point):
                return fit
            if rounds_left:
                point = next_point
                del fit  # its rows and their evidence, before others are made
        if auto_names and not question.in_file:
            raise SysidError(
                f"the estimates of {' and '.join(auto_names)} do not settle within {rounds} rounds "
                f"(last delay {1e3 * fit.point.delay:.3g} ms): this log does not show them well "
                f"enough; lower the cut-off, or leave --{' and --'.join(auto_names)} off"
            )
        return fit


def squared_effect(fit: Fit, change: Array) -> float:
    """Return the sum of squares by which a change (p,) moves predicted torques and priors.

    Each is in standard deviations: torques in those of the noise, unknowns in those of the prior.
    """
    pairs = zip(fit.evidence.total.joints, fit.weights)
    effects = [
        w * (joint.triangle[:, :-1] @ change[joint.columns]) for joint, w in pairs
    ]
    indices = fit.unknowns.estimated
    names = fit.unknowns.estimated_names
    effects += [
        group.rows(names)[:, :-1] @ change[indices] for group in fit.unknowns.groups
    ]
    return float(sum(map(np.vdot, effects, effects)))


def _is_settled(fit: Fit, next_point: Point) -> bool:
    """Tell whether prediction, delay, gravity and speeds change less than the limits above."""
    point = fit.point
    indices = [
        k
        for k in fit.unknowns.estimated
        if fit.columns.names[k] not in fit.unknowns.increments
    ]
    change = np.zeros(len(fit.values))
    change[indices] = (next_point.values - point.values)[indices]
    gravity_change = float(np.linalg.norm(np.cross(next_point.gravity, point.gravity)))
    gravity_change /= float(next_point.gravity @ next_point.gravity) or 1.0
    speeds = zip((next_point.speed or {}).values(), (point.speed or {}).values())
    speed_change = max(
        (float(np.max(np.abs(a / b - 1.0))) for a, b in speeds), default=0.0
    )
    delay_change = abs(next_point.delay - point.delay)
    is_small = (
        squared_effect(fit, change) < _SETTLED**2 and delay_change < _SETTLED_DELAY
    )
    return (
        is_small and gravity_change < _SETTLED_ANGLE and speed_change < _SETTLED_SPEED
    )


def solve(
    columns: Columns,
    question: Question,
    choice: Choice,
    point: Point,
    data: Evidence,
    samples: tuple[DecimatedSamples, ...] = (),
    visits: Visits | None = None,
    inflation: Array | None = None,
    noise: Array | None = None,
    residual_memory: Array | None = None,
) -> Fit:
    """Solve the equations around a point.

    Args:
        data: evidence of the rows around the point.
        samples: these rows of each recording, for motion that repeats.
        visits: which rows pass the same states.
        inflation: (joints,) as ``Visits.inflation`` returns it, where there are no rows.
        noise: (joints,) to begin with [N m].
        residual_memory: (joints,) as ``Visits.inflation`` returns it, where there are no rows.
    """
    unknowns = build_unknowns(columns, question, choice, data.torque, data.nonzero)
    memory = autocorrelation_time(choice, len(columns.joints))
    repetition = np.ones_like(memory) if inflation is None else inflation
    correlation_memory = memory if residual_memory is None else residual_memory
    next_unknowns: Unknowns | None = unknowns
    for _ in range(_MOST_BOUNDS):
        unknowns = next_unknowns or unknowns
        variance_factor = repetition * memory
        unknowns, free, effective_noise = _solve_within_bounds(
            columns, unknowns, data, variance_factor, correlation_memory / memory, noise
        )
        noise = effective_noise / np.sqrt(variance_factor)
        if visits is not None and inflation is None:
            assumed = repetition
            repetition, correlation_memory = visits.inflation(_residuals(samples, free))
            widens = any(group.may_widen for group in unknowns.groups)
            if widens or not np.array_equal(assumed, repetition):
                variance_factor = repetition * memory
                unknowns, free, effective_noise = _solve_within_bounds(
                    columns,
                    unknowns,
                    data,
                    variance_factor,
                    correlation_memory / memory,
                    noise,
                )
                noise = effective_noise / np.sqrt(variance_factor)
        values = possible(unknowns, data, 1.0 / effective_noise, free)
        # Bodies that are made possible push other parameters across their bounds.
        next_unknowns = unknowns.hold_at_bounds(values)
        if next_unknowns is None:
            break
    values = np.clip(values, unknowns.lower, unknowns.upper)
    return Fit(
        columns,
        question,
        choice,
        point,
        samples,
        data,
        unknowns,
        1.0 / effective_noise,
        repetition,
        correlation_memory,
        free,
        values,
    )


def autocorrelation_time(choice: Choice, n_joints: int) -> Array:
    """Return how many rows (joints,) of each joint count as one independent row."""
    return (
        np.ones(n_joints)
        if choice.correlation_factors is None
        else np.array(choice.correlation_factors)
    )


def _residuals(samples: Sequence[DecimatedSamples], values: Array) -> Iterator[Array]:
    """Yield residual torques (K,) of each joint at values (p,) [N m], all recordings together."""
    for joint in range(len(samples[0].joints)):
        residuals = [
            recording.tau[joint]
            - recording.rows[joint] @ values[recording.columns[joint]]
            for recording in samples
        ]
        yield np.concatenate(residuals)


def _solve_within_bounds(
    columns: Columns,
    unknowns: Unknowns,
    data: Evidence,
    inflation: Array,
    memory: Array,
    noise: Array | None,
) -> tuple[Unknowns, Array, Array]:
    """Return (unknowns, values (p,), effective noise (joints,) [N m]), values held at bounds that
    they would cross; equations are divided by the effective noise.
    """
    while True:  # each round holds at least one more parameter
        prior = columns.prior[unknowns.estimated]
        unknowns, values, effective_noise, noise = _solve_weighted(
            unknowns, data, prior, inflation, memory, noise
        )
        next_unknowns = unknowns.hold_at_bounds(values)
        if next_unknowns is None:
            return (
                unknowns,
                np.clip(values, unknowns.lower, unknowns.upper),
                effective_noise,
            )
        unknowns = next_unknowns


def _solve_weighted(
    unknowns: Unknowns,
    data: Evidence,
    prior: Array,
    inflation: Array,
    memory: Array,
    noise: Array | None,
) -> tuple[Unknowns, Array, Array, Array]:
    """Return (unknowns with widened priors, values (p,), effective noise, noise (joints,) [N m]).

    Bounds do not count here. A call frees rows and their squares, which take most of the memory.
    """
    information = data.of(unknowns)
    posterior = with_prior(information, unknowns.groups)
    solve_posterior = solver(posterior, prior)
    noise = estimate_noise(posterior, solve_posterior, start=noise)
    effective_noise = noise * np.sqrt(inflation)
    groups = widened_groups(
        information, effective_noise * np.sqrt(memory), unknowns.groups
    )
    if groups is not unknowns.groups:
        unknowns = replace(unknowns, groups=groups)
        posterior = with_prior(information, unknowns.groups)
        solve_posterior = solver(posterior, prior)
    effective_noise = lower_floor(posterior, solve_posterior, effective_noise)
    values = unknowns.full(solve_posterior(1.0 / effective_noise)[0])
    return unknowns, values, effective_noise, noise


def possible(unknowns: Unknowns, data: Evidence, weights: Array, free: Array) -> Array:
    """Return the best values (p,) with which all unknown bodies are physically consistent.

    Where they are so already, that is the plain estimate ``free`` (p,).
    """
    if all(
        spatial.is_consistent(free[indices]) for indices, _ in unknowns.bodies.values()
    ):
        return free
    rows = with_prior(data.of(unknowns), unknowns.groups).equations(weights)
    return unknowns.full(ConsistentLinks(*rows, links_problem(unknowns)).best())


def links_problem(unknowns: Unknowns) -> LinksProblem:
    """Return the indices of each body among the unknowns, and a usual body in its place."""
    prior = np.zeros(len(unknowns.estimated))
    links = []
    for indices, usual_body in unknowns.bodies.values():
        links.append(np.searchsorted(unknowns.estimated, indices))
        prior[links[-1]] = usual_body
    return LinksProblem(tuple(links), prior)


def restrict_samples(samples: DecimatedSamples, unknowns: Unknowns) -> DecimatedSamples:
    """Return a recording's rows in the estimated parameters, with all held ones subtracted."""
    rows_by_joint = list(EstimatedRows((samples,), unknowns))
    columns = [
        np.searchsorted(unknowns.estimated, at[np.isin(at, unknowns.estimated)])
        for at in samples.columns
    ]
    return replace(
        samples,
        names=unknowns.estimated_names,
        columns=tuple(columns),
        rows=tuple(rows for _, rows, _ in rows_by_joint),
        tau=tuple(tau for _, _, tau in rows_by_joint),
    )
