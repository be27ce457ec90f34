"""The one fit: linearise, weigh, widen, solve, keep bodies possible, until it rests."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import BENT, speed_name
from robot_sysid.dynamics.nuisances import TILT_NAMES
from robot_sysid.errors import SysidError
from robot_sysid.estimation.algebra.autocorrelation import concentration, memory
from robot_sysid.estimation.algebra.consistent_links import ConsistentLinks, LinksProblem
from robot_sysid.estimation.algebra.information import combined, parts_of, restricted
from robot_sysid.estimation.algebra.least_squares import sharpened, solver, weighted
from robot_sysid.estimation.algebra.nuisances import widened_groups, with_prior
from robot_sysid.estimation.columns import Columns, Point
from robot_sysid.estimation.dataset import DecimatedSamples, block_masks, information_of
from robot_sysid.estimation.unknowns import Choice, Question, Unknowns, build_unknowns
from robot_sysid.records import DELAY_NAME, Array, SquareRootInformation
from robot_sysid.signals.repetition import Visits

# Most rounds of the point that rows are made around; of what crosses bounds.
_MOST_ROUNDS, _MOST_BOUNDS = 8, 6
# Rounds of a delay or tilt that is sought; what no longer counts as movement: of the prediction, in
# standard deviations of the noise, of the delay [s], of gravity [rad], of speeds (a share).
_SOUGHT_ROUNDS = 20
_SETTLED, _SETTLED_DELAY, _SETTLED_ANGLE = 0.05, 1e-6, 1e-6
_SPEED_SETTLED = 0.02


def give_back() -> None:
    """Give free memory back to the system, where the C library keeps what was freed between what is
    in use (glibc): of many joints, whose triangles are of all sizes, that is a quarter of all.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


@dataclass(frozen=True)
class Evidence:
    """What recordings say around a point: nothing that grows with their length.

    There are the information of each part that is held out in turn, the sum of squares of its
    measured torque (blocks, joints) [N^2 m^2], and each joint's root mean square (n,) [N m].
    ``whole`` is the information of all parts.
    """

    blocks: tuple[SquareRootInformation, ...]
    squared_torque: Array
    torque: Array
    whole: SquareRootInformation = field(init=False)

    def __post_init__(self) -> None:
        whole = combined(self.blocks)
        object.__setattr__(self, "whole", whole)
        object.__setattr__(self, "blocks", tuple(parts_of(whole, self.blocks)))

    def undivided(self) -> Evidence:
        """Return what all parts say, as one."""
        return Evidence((self.whole,), np.sum(self.squared_torque, axis=0)[None], self.torque)

    def of(self, sought: Unknowns) -> SquareRootInformation:
        """Return what all parts say of what is sought, the rest held."""
        return restricted(self.whole, sought.kept_names, sought.held)

    def squared_residuals(self, values: Array) -> Array:
        """Return (blocks, joints, m) squared residuals of each block at values (blocks, p, m) of
        its own [N^2 m^2].
        """
        pairs = zip(self.blocks, values)
        return np.array([part.squared_residuals(own) for part, own in pairs])

    @cached_property
    def shown(self) -> np.ndarray:
        """Which parameters (p,) have a column that is not zero."""
        found = np.zeros(len(self.whole.names), dtype=bool)
        for joint in self.whole.joints:
            found[joint.columns] |= np.any(joint.triangle[:, :-1] != 0.0, axis=0)
        return found


def evidence(samples: Sequence[DecimatedSamples], torque: Array) -> Evidence:
    """Return what the rows of all recordings say, the same stretches of each together."""
    parts = zip(*[[log.where(mask) for mask in block_masks(log)] for log in samples])
    return evidence_of(list(parts), torque)


def evidence_of(parts: Collection[Sequence[DecimatedSamples]], torque: Array) -> Evidence:
    """Return what rows say, each part of them in a block of its own."""
    squares = [np.sum([each.squared_torque() for each in part], axis=0) for part in parts]
    return Evidence(information_of(parts), np.array(squares), torque)


@dataclass(frozen=True)
class ChosenRows:
    """Rows of what is sought, the rest taken off, from each recording's rows of all parameters;
    iterating over it is one pass.
    """

    parts: tuple[DecimatedSamples, ...]
    unknowns: Unknowns

    def __iter__(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield (joint number, rows, right-hand sides) of each joint, all recordings together."""
        for joint in range(len(self.parts[0].columns)):
            yield joint, *self._of(joint)  # nothing is kept while the next joint's are made

    def _of(self, joint: int) -> tuple[Array, Array]:
        columns, ends = self.parts[0].columns[joint], np.cumsum([len(part) for part in self.parts])
        stay, tau = np.isin(columns, self.unknowns.kept), list[Array]()
        known = self.unknowns.held[columns[~stay]]
        chosen = np.empty((ends[-1], np.count_nonzero(stay)))
        for part, room in zip(self.parts, np.split(chosen, ends[:-1])):
            rows = part.rows[joint]
            room[:] = rows[:, stay]
            tau.append(part.tau[joint] - rows[:, ~stay] @ known)
        return chosen, np.concatenate(tau)


@dataclass(frozen=True)
class Fit:
    """An estimate and what it was made from.

    Attributes:
        columns: makes the rows.
        question, choice: what was asked, and what the recordings decided.
        point: around which the rows are.
        samples: each recording's rows; none where only their information is there.
        evidence: what they say.
        unknowns: what was sought, and what was known.
        weights: (joints,) by which each joint's equations count [1/(N m)].
        inflation: (joints,) by how much less than independent samples each joint's count, as
            motion that repeats says.
        memory: (joints,) how many rows of each joint count as one, by its residuals' correlation.
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
        """What data and priors say of the k parameters that are sought; it is large."""
        return with_prior(self.evidence.of(self.unknowns), self.unknowns.groups)

    @property
    def noise(self) -> Array:
        """Standard deviation (joints,) of the torque noise of one sample [N m]."""
        return 1.0 / (self.weights * np.sqrt(self.inflation * self.noise_memory))

    @property
    def noise_memory(self) -> Array:
        """How many rows (joints,) of each joint counted as one independent row."""
        return memory_of(self.choice, len(self.columns.joints))

    @property
    def noise_per_joint(self) -> dict[str, float]:
        """Joint to standard deviation of its torque noise [N m], of joints with samples."""
        pairs = zip(self.evidence.whole.joints, self.noise.tolist())
        return {each.joint: noise for each, noise in pairs if each.n_samples}

    @property
    def constrained(self) -> bool:
        """Whether the plain estimate was replaced by the best possible bodies."""
        return bool(np.any(self.values != self.free))

    @property
    def rows(self) -> ChosenRows:
        """The rows of what was sought."""
        return ChosenRows(self.samples, self.unknowns)

    def value(self, name: str) -> float:
        """Return one parameter, with what the point holds of it."""
        return float(self.final[self.columns.place[name]])

    @property
    def next_point(self) -> Point:
        """The point with what has to settle moved into it.

        Recordings on the wrong side have a payload of negative weight; around a possible one, which
        is far from it, torque scales would take its part.
        """
        values = self.free if self.question.loaded else self.values
        return self.columns.moved(self.point, values, self.unknowns.settle)

    @cached_property
    def final(self) -> Array:
        """All parameters (p,); delay, tilt and speeds with what the point holds of them."""
        values = self.values.copy()
        place = self.columns.place
        values[place[DELAY_NAME]] += self.point.delay
        if TILT_NAMES[0] in place:
            values[self.columns.at(TILT_NAMES)] = self.columns.whole_tilt(self.point, self.values)
        for term, speeds in (self.point.speed or {}).items():
            for joint, speed in zip(self.columns.robot.joint_names, speeds.tolist()):
                name = speed_name(term, joint)
                if name in self.unknowns.settle:
                    values[place[name]] += speed
        return values


@dataclass
class Fitter:
    """Fits one question to recordings; it remembers what a fit before it has settled.

    ``columns`` makes the rows, ``visits`` tells which pass the same states (None where there are
    none), and ``told`` is called before every pass. Torques (n,) are root mean squares [N m].
    """

    columns: Columns
    torque: Array
    visits: Visits | None = None
    told: Callable[[], None] = lambda: None
    _last: tuple[Point, Evidence, tuple[DecimatedSamples, ...]] | None = field(default=None)
    _noise: Array | None = None

    def around(self, point: Point) -> tuple[Evidence, tuple[DecimatedSamples, ...]]:
        """Return what the rows around a point say, and the rows."""
        if self._last is None or self._last[0] is not point:
            self.told()
            self._last = None  # rows go before others are made: they take most of the memory
            give_back()
            samples = self.columns.samples(point)
            self._last = point, evidence(samples, self.torque), samples
        return self._last[1:]

    def noise_memory(self, fit: Fit) -> Array:
        """Return how many rows (joints,) of each joint count as one independent row.

        That is their memory, or how far a few bursts hold all that is left, where that is more.
        """
        residuals = list(_residuals(fit.samples, fit.values))
        in_bursts = np.array([concentration(residual) for residual in residuals])
        if self.visits is None:
            slow = np.array([memory(residual) for residual in residuals])
        else:
            slow = self.visits.inflation(residuals)[1]
        return np.maximum(slow, in_bursts)

    def solve_around(self, point: Point, question: Question, choice: Choice) -> Fit:
        """Return the solution of the equations as they stand around a point."""
        given = self.columns, question, choice, point
        return solved(*given, *self.around(point), self.visits, noise=self._noise)

    def fit(
        self,
        question: Question,
        choice: Choice,
        point: Point | None = None,
        rounds: int = _MOST_ROUNDS,
    ) -> Fit:
        """Return the fit, once bodies, delay, tilt and speeds have settled.

        Args:
            choice: friction terms, couplings, and how far links may be off.
            point: where to begin; None for the model.

        Raises:
            SysidError: a delay or a tilt that is sought keeps moving.
        """
        # Columns that depend on what is sought: those of the load, and those with a speed. While
        # friction is chosen, a load that is only allowed for does without.
        terms = {term for model in choice.friction for term in model.terms}
        exact = not terms.isdisjoint(("load", *BENT)) or choice.dry_friction is not None
        point = point or self.columns.start()
        if (point.exact_load, point.in_file) != (exact, question.in_file):
            point = replace(point, exact_load=exact, in_file=question.in_file)
        options = question.options
        sought = [name for name in ("delay", "tilt") if getattr(options, name) == "auto"]
        rounds = _SOUGHT_ROUNDS if sought and not question.in_file else rounds
        for left in reversed(range(rounds)):
            fit = self.solve_around(point, question, choice)
            self._noise, after = fit.noise, fit.next_point
            if _rests(fit, after):
                return fit
            if left:
                point = after
                del fit  # its rows and what they say, before others are made
        if sought and not question.in_file:
            raise SysidError(
                f"the estimates of {' and '.join(sought)} do not settle within {rounds} rounds "
                f"(last delay {1e3 * fit.point.delay:.3g} ms): this log does not show them well "
                f"enough; lower the cut-off, or leave --{' and --'.join(sought)} off"
            )
        return fit


def squared_effect(fit: Fit, change: Array) -> float:
    """Return by how much a change (p,) of what is sought moves predicted torques and priors.

    That is the sum of squares, in standard deviations of noise and of priors.
    """
    pairs = zip(fit.evidence.whole.joints, fit.weights)
    effects = [w * (joint.triangle[:, :-1] @ change[joint.columns]) for joint, w in pairs]
    kept = fit.unknowns.kept
    names = fit.unknowns.kept_names
    effects += [group.rows(names)[:, :-1] @ change[kept] for group in fit.unknowns.groups]
    return float(sum(map(np.vdot, effects, effects)))


def _rests(fit: Fit, after: Point) -> bool:
    """Tell whether the prediction, delay, tilt and speeds hardly move any more."""
    before, kept = fit.point, fit.unknowns.kept
    steady = [k for k in kept if fit.columns.names[k] not in fit.unknowns.settle]
    moved = np.zeros(len(fit.values))
    moved[steady] = (after.values - before.values)[steady]
    turn = float(np.linalg.norm(np.cross(after.gravity, before.gravity)))
    turn /= float(after.gravity @ after.gravity) or 1.0
    speeds = zip((after.speed or {}).values(), (before.speed or {}).values())
    faster = max((float(np.max(np.abs(a / b - 1.0))) for a, b in speeds), default=0.0)
    late = abs(after.delay - before.delay)
    small = squared_effect(fit, moved) < _SETTLED**2 and late < _SETTLED_DELAY
    return small and turn < _SETTLED_ANGLE and faster < _SPEED_SETTLED


def solved(
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
    """Solve the equations as they stand around a point.

    Args:
        data, samples: what the rows around the point say, and the rows, for motion that repeats.
        visits: which of them pass the same states.
        inflation: as ``Visits.inflation``, where no rows tell it.
        noise: (joints,) to begin with [N m].
        residual_memory: (joints,) as of ``Visits.inflation``, where no rows tell it.
    """
    sought = build_unknowns(columns, question, choice, data.torque, data.shown)
    memory = memory_of(choice, len(columns.joints))
    counted = np.ones_like(memory) if inflation is None else inflation
    widening = memory if residual_memory is None else residual_memory
    inside: Unknowns | None = sought
    for _ in range(_MOST_BOUNDS):
        sought = inside or sought
        divided = counted * memory
        sought, free, counts = _bounded(columns, sought, data, divided, widening / memory, noise)
        noise = counts / np.sqrt(divided)
        if visits is not None and inflation is None:
            before = counted
            counted, widening = visits.inflation(_residuals(samples, free))
            widens = any(group.may_widen for group in sought.groups)
            if widens or not np.array_equal(before, counted):
                divided = counted * memory
                again = columns, sought, data, divided, widening / memory, noise
                sought, free, counts = _bounded(*again)
                noise = counts / np.sqrt(divided)
        values = possible(sought, data, 1.0 / counts, free)
        # Bodies that have to be possible push others across their bounds.
        inside = sought.hold_at_bounds(values)
        if inside is None:
            break
    values = np.clip(values, sought.lower, sought.upper)
    made = columns, question, choice, point, samples, data, sought
    return Fit(*made, 1.0 / counts, counted, widening, free, values)


def memory_of(choice: Choice, n_joints: int) -> Array:
    """Return how many rows (joints,) of each joint count as one independent row."""
    return np.ones(n_joints) if choice.noise_memory is None else np.array(choice.noise_memory)


def _residuals(samples: Sequence[DecimatedSamples], values: Array) -> Iterator[Array]:
    """Yield what values (p,) leave of each joint's torque (K,) [N m], all recordings together."""
    for index in range(len(samples[0].joints)):
        left = [e.tau[index] - e.rows[index] @ values[e.columns[index]] for e in samples]
        yield np.concatenate(left)


def _bounded(
    columns: Columns,
    sought: Unknowns,
    data: Evidence,
    inflation: Array,
    memory: Array,
    noise: Array | None,
) -> tuple[Unknowns, Array, Array]:
    """Return (what is sought in the end, values (p,) within bounds, what each joint's equations are
    divided by (joints,) [N m]).
    """
    while True:  # each round holds at least one more parameter
        prior = columns.prior[sought.kept]
        sought, values, counts, noise = _weighed(sought, data, prior, inflation, memory, noise)
        inside = sought.hold_at_bounds(values)
        if inside is None:
            return sought, np.clip(values, sought.lower, sought.upper), counts
        sought = inside


def _weighed(
    sought: Unknowns,
    data: Evidence,
    prior: Array,
    inflation: Array,
    memory: Array,
    noise: Array | None,
) -> tuple[Unknowns, Array, Array, Array]:
    """Return the same without bounds, and the noise (joints,) [N m]. Rows and their squares, which
    take most of the memory, go with each round.
    """
    plain = data.of(sought)
    known = with_prior(plain, sought.groups)
    best = solver(known, prior)
    noise = weighted(known, best, start=noise)
    counts = noise * np.sqrt(inflation)
    wide = widened_groups(plain, counts * np.sqrt(memory), sought.groups)
    if wide is not sought.groups:
        sought = replace(sought, groups=wide)
        known = with_prior(plain, sought.groups)
        best = solver(known, prior)
    counts = sharpened(known, best, counts)
    return sought, sought.full(best(1.0 / counts)[0]), counts, noise


def possible(sought: Unknowns, data: Evidence, weights: Array, free: Array) -> Array:
    """Return the best values (p,) with which all bodies that are sought are possible.

    Where they are possible already, that is the plain estimate.
    """
    if all(spatial.is_consistent(free[places]) for places, _ in sought.bodies.values()):
        return free
    rows = with_prior(data.of(sought), sought.groups).stacked(weights)
    return sought.full(ConsistentLinks(*rows, links_problem(sought)).best())


def links_problem(sought: Unknowns) -> LinksProblem:
    """Return which of the parameters sought are bodies, and what such bodies usually are."""
    prior, links = np.zeros(len(sought.kept)), []
    for places, usual in sought.bodies.values():
        links.append(np.searchsorted(sought.kept, places))
        prior[links[-1]] = usual
    return LinksProblem(tuple(links), prior)
