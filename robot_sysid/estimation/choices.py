"""What the recordings decide: which rows to leave out, each joint's friction, how far links may be
off. Which motors turn several joints is decided in ``couplings``.

In-sample errors fall with every term; what counts is the error of stretches of time that were not
fitted. They are compared by ratios, because a joint may show its friction in one of them far more
than in the others. A joint starts with the simplest candidate and moves on as long as another one
is clearly better on its own held-out torques.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import BENT, Coupling, FrictionModel, friction_model
from robot_sysid.estimation.algebra.common_scale import is_worth_a_word
from robot_sysid.estimation.algebra.consistent_links import ConsistentLinks
from robot_sysid.estimation.algebra.information import (
    normal_matrix,
    restricted,
    sample_counts,
    update_triangle,
)
from robot_sysid.estimation.algebra.link_scales import LinkEvidence, average_scales, link_evidence
from robot_sysid.estimation.algebra.nuisances import (
    SURE,
    LinkScales,
    WithPriors,
    is_no_chance,
    link_directions,
    link_lengths,
)
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.columns import Columns, Point
from robot_sysid.estimation.couplings import couplings_of
from robot_sysid.estimation.dataset import Dataset, mean_torque
from robot_sysid.estimation.fit import Evidence, Fit, Fitter, links_problem
from robot_sysid.estimation.unknowns import (
    COMMON_SCALE,
    LINKS,
    PER_CENT,
    Choice,
    Question,
    Unknowns,
    build_unknowns,
)
from robot_sysid.records import Array, RobotModel, Validation
from robot_sysid.records.results import validation_of

CANDIDATES = (
    "coulomb-viscous-offset-armature",
    "coulomb-viscous-offset-armature-sqrt",
    "coulomb-viscous-offset-armature-stribeck",
    "coulomb-viscous-offset-armature-load",
    "sigmoid-viscous-offset-armature",
    "coulomb-viscous-offset-armature-quadratic-cubic",
    "coulomb-viscous-offset-armature-sqrt-load",
    "coulomb-viscous-offset-armature-stribeck-load",
)
"""Friction models that are tried, the same for every joint of every arm, simplest first."""
IN_FILE, WITH_POLYNOMIAL = CANDIDATES[0], CANDIDATES[5]
"""Those that a model file can hold."""
WITH_ALL = "coulomb-viscous-offset-armature-sqrt-stribeck-load"
"""What follows any friction that depends on speed and load closely enough to judge its rows by."""
WORSE = 2.0
"""Ratio of mean squared residuals from which on rows make an estimate worse: the variance s^2 / n
of one from n rows falls by m more of variance r s^2 for as long as r < 2 + m / n."""
SCALES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Factors of the other links' uncertainty that are tried; 16 times 5 % is nearly all of a link."""
AS_GOOD = 1.02
"""Ratio of squared errors up to which they are as good as equal: one per cent of the error."""
OWN_SOURCE = "the logs, each fifth predicted from the others"
CLEAR_SHARE, CLEARLY = 0.1, 2.0
"""A term has to lower the held-out squared error by this share, and by this many
standard errors of the mean over the blocks."""
CLEAR_OFFSET, OFFSET = 3.0, 0.01
"""Standard errors that a sensor's offset has to be away from zero, and a rotor from the model's.
Beside clear offsets others may be this part of the joint's torque: of a KUKA LWR4+ and its links
neither is known better."""
# Below every squared error [N^2 m^2]; lifts normal equations of what nothing shows off zero.
_TINY, _RIDGE = 1e-30, 1e-12

Errors = Mapping[str, Mapping[str, float]]
"""Joint to friction model to its held-out root mean square error [N m]."""


@dataclass(frozen=True)
class HeldOut:
    """Recordings in blocks, each to be predicted from the others; the noise (joints,) is the
    standard deviation of each joint's torque, as it counts [N m]. Nothing but a part of what is
    ``asked`` is sought, where that is given: of many joints that takes less memory.
    """

    data: Evidence
    noise: Array
    asked: Unknowns | None = None
    _known: dict[tuple[bytes, bytes], Sequence[Array]] = field(default_factory=dict)
    _near: dict[int, Any] = field(default_factory=dict)

    @cached_property
    def counts(self) -> Array:
        """How many rows each block has of each joint (blocks, joints)."""
        return np.array([sample_counts(part) for part in self.data.blocks])

    @cached_property
    def _there(self) -> NDArray[np.bool_]:
        """Which parameters (p,) have columns, and may be asked for."""
        shown, asked = self.data.nonzero, self.asked
        if asked is None:
            return shown
        return shown & (np.isin(np.arange(len(shown)), asked.kept) | (asked.held != 0.0))

    @cached_property
    def _grams(self) -> Array:
        """Gram matrices (blocks, s+2, s+2) of all whitened equations without each block in turn, of
        what has a column, right sides and nothing, which stands for all else.
        """
        at = np.append(np.flatnonzero(self._there), -1)
        found = np.zeros((len(self.data.blocks), len(at) + 1, len(at) + 1))
        for gram, block in zip(found, self.data.blocks):
            gram[:-1, :-1] = normal_matrix(block, 1.0 / self.noise)[np.ix_(at, at)]
        for rows in found.swapaxes(0, 1):  # which takes no memory
            rows[:] = np.array(_others(rows, np.add))
        return found

    def squared(self, sought: Unknowns) -> Array:
        """Return (blocks, joints) squared error of each block, predicted from the others."""
        return self.data.squared_residuals(self._predicted(sought)[..., None])[..., 0]

    def _normal(self, sought: Unknowns) -> Iterator[tuple[Array, Array, Array]]:
        """Yield normal equations (k, k), right side (k,) and their scale (k,) of each block.

        What the other blocks do not show stays near zero; priors and friction terms leave nothing
        else.
        """
        shown, held = self._there, sought.held.copy()
        assert not np.any(self.data.nonzero[sought.kept] & ~shown[sought.kept])
        held[sought.kept] = 0.0
        prior, places = _prior_rows(sought), np.where(shown, np.cumsum(shown) - 1, -1)
        known, rest = prior.T @ prior, np.flatnonzero(held)
        kept, others = places[sought.kept], places[rest]
        for gram in self._grams:
            right = gram[kept, -2] - gram[np.ix_(kept, others)] @ held[rest] + known[:-1, -1]
            scaled = gram[np.ix_(kept, kept)] + known[:-1, :-1]
            size = np.sqrt(np.diagonal(scaled))
            scale = 1.0 / np.where(size > 0.0, size, 1.0)
            scaled *= scale[:, None] * scale
            scaled[np.diag_indices_from(scaled)] += _RIDGE
            yield scaled, scale * right, scale

    def _predicted(self, sought: Unknowns) -> Array:
        """Return the values (blocks, p) that all other blocks ask for."""
        each = self._normal(sought)
        found = [scale * np.linalg.solve(scaled, right) for scaled, right, scale in each]
        return np.array([sought.full(values) for values in found])

    def chance(self, fit: Fit) -> Array:
        """Return the same (blocks, joints) as noise makes it, in torques and in what others tell.

        Of friction that no other block shows, nothing is told: that error has no bound.
        """
        sought, found = fit.unknowns, self.counts * fit.noise**2
        for block, own, (scaled, _, scale) in zip(self.data.blocks, found, self._normal(sought)):
            root = np.linalg.inv(np.linalg.cholesky(scaled)) * scale
            for place, joint in enumerate(block.joints):
                stay = np.isin(joint.columns, sought.kept)
                at = np.searchsorted(sought.kept, joint.columns[stay])
                own[place] += np.sum((joint.triangle[:, :-1][:, stay] @ root[:, at].T) ** 2)
        return found

    def of(self, fit: Fit) -> Array:
        """Return the same of a fit, with bodies that are possible."""
        sought, values = fit.unknowns, self._predicted(fit.unknowns)
        problem, known = links_problem(sought), _prior_rows(sought)
        places, near = [at for at, _ in sought.bodies.values()], None
        for number, found in enumerate(values):
            if places and not all(spatial.is_consistent(found[at]) for at in places):
                rows = np.vstack((self._rests(sought)[number], known))
                near = self._near.get(number, near)
                solver = ConsistentLinks(rows[:, :-1], rows[:, -1], problem, near)
                values[number] = sought.full(solver.best())
                self._near[number] = near = solver.first
        return self.data.squared_residuals(values[..., None])[..., 0]

    def _rests(self, sought: Unknowns) -> Sequence[Array]:
        """Return triangles (., k+1) of all equations of what is sought without each block."""
        key = sought.kept.tobytes(), sought.held.tobytes()
        if key not in self._known:
            wanted = sought.kept_names, sought.held
            parts = (restricted(part, *wanted) for part in self.data.blocks)
            rows = (np.column_stack(part.stacked(1.0 / self.noise)) for part in parts)
            nothing = np.zeros((0, len(sought.kept) + 1))
            each = [update_triangle(nothing, block) for block in rows]
            self._known[key] = _others(each, update_triangle)
        return self._known[key]

    def score(self, squared: Array) -> Array:
        """Return (blocks,) mean of squared errors (blocks, joints) over their variance."""
        counts = np.maximum(np.sum(self.counts, axis=1), 1.0)
        return np.asarray(np.sum(squared / self.noise**2, axis=-1) / counts)

    def validation(self, squared: Array, source: str = OWN_SOURCE) -> Validation:
        """Return squared errors (blocks, joints) as one record."""
        joints = [joint.joint for joint in self.data.blocks[0].joints]
        torque, counts = np.sum(self.data.squared_torque, axis=0), np.sum(self.counts, axis=0)
        return validation_of(joints, np.sum(squared, axis=0), torque, counts, source)


def held_out(fit: Fit, asked: Unknowns | None = None) -> HeldOut:
    """Return what judges choices around a fit, of what is ``asked`` at most."""
    return HeldOut(fit.evidence, 1.0 / fit.weights, asked)


def _others(each: Sequence[Array], add: Callable[[Array, Array], Array]) -> list[Array]:
    """Return the sum of all others for each of some, two at least, with an addition that counts
    their number: differences would leave rounding where nothing is.
    """
    before = list(accumulate(each[:-1], add))
    after = list(accumulate(each[:0:-1], add))[::-1]
    return [after[0], *map(add, before[:-1], after[1:]), before[-1]]


def _prior_rows(sought: Unknowns) -> Array:
    rows = [group.rows(sought.kept_names) for group in sought.groups]
    return np.vstack(rows) if rows else np.zeros((0, len(sought.kept) + 1))


def is_clearly_lower(after: Array, before: Array) -> bool:
    """Tell whether squared errors per block (blocks,) are clearly lower."""
    if not np.all(np.isfinite(after)) or not np.all(np.isfinite(before)):
        return bool(np.all(np.isfinite(after)))
    ratio = np.log((after + _TINY) / (before + _TINY))
    mean, spread = float(np.mean(ratio)), float(np.std(ratio, ddof=1)) / np.sqrt(len(ratio))
    needed = np.log(1.0 - CLEAR_SHARE)
    lower = np.sum(after) < (1.0 - CLEAR_SHARE) * np.sum(before)
    return bool(lower and mean < needed and mean + CLEARLY * spread < 0.0)


def without_standing(robot: RobotModel, dataset: Dataset, options: EstimationOptions) -> Dataset:
    """Return a recording without the rows over turns at which joints stand for a while.

    Low-passed positions do not show that (``signals.turning``), but residuals do. Rows over turns
    also tell the most of inertia, and where friction turns round at once they would be lost for
    nothing, so they are left out where they fit worse than all others. Every recording decides for
    itself: logs that are added up one by one say the same together.

    Raises:
        InputError: no joint moves fast enough, or the recording is too short.
    """
    signals = dataset.signals
    if signals is None or not np.any(signals.turning):
        return dataset

    columns = Columns(robot, [dataset], options.torques, couplings_of(robot, options)[0])
    model = friction_model(WITH_ALL)
    if options.friction is not None and not options.friction.terms:
        model = options.friction
    choice = Choice((model,) * robot.n_joints, columns.couplings)
    question = Question(replace(options, delay="off", tilt="off"), loaded=dataset.is_loaded)
    fit = Fitter(columns, mean_torque([dataset])).fit(question, choice, rounds=1)

    (samples,) = fit.samples
    turns_left_out = replace(signals, standing=tuple(range(robot.n_joints))).usable()
    standing = []
    for row, joint in enumerate(columns.rows_of):
        predicted = samples.rows[row] @ fit.values[samples.columns[row]]
        if _are_worse(samples.tau[row] - predicted, ~turns_left_out[:, joint]):
            standing.append(joint)
    return replace(dataset, source=replace(signals, standing=tuple(standing)))


def _are_worse(residual: Array, doubtful: NDArray[np.bool_]) -> bool:
    """Tell whether doubtful rows (K,) have clearly larger residuals (K,), NaN where not in use."""
    used = np.isfinite(residual)
    doubted = residual[used & doubtful]
    others = residual[used & ~doubtful]
    if len(doubted) == 0 or len(others) < len(doubted):
        return False
    usual = float(np.mean(others**2))
    squared = float(np.sum(doubted**2)) / usual if usual > 0.0 else 0.0
    return squared > WORSE * len(doubted) and is_no_chance(squared, len(doubted), 1.0 - SURE)


def choose(
    fitter: Fitter,
    question: Question,
    given: FrictionModel | None,
    couplings: tuple[Coupling, ...] | None = None,
) -> tuple[Choice, Errors, Point]:
    """Return what the recordings decide, by which errors, and where to begin.

    The user may have given the friction of every joint, and ``select_couplings`` have chosen some;
    else all those that have columns are taken.
    """
    choice = _simplest(fitter, given, fitter.columns.couplings if couplings is None else couplings)
    fit = replace(fitter.fit(question, choice, rounds=1), samples=())
    errors: Errors = {}
    if given is None and fitter.columns.torques == "chain":
        begun = replace(fit.point, values=fit.values), 1.0 / fit.weights
        del fit  # what its rows say, before others are made
        choice, errors, point = _with_friction(fitter, question, choice, *begun)
        fit = replace(fitter.fit(question, choice, point, rounds=1), samples=())
    if is_scaled(fit, question, choice):
        choice = replace(choice, common_scale=COMMON_SCALE)
        fit = fitter.fit(question, choice, fit.point, rounds=1)
    choice = replace(choice, dry_friction=dry_friction(fit))
    fit = fitter.fit(question, choice, fit.point, rounds=1)
    choice = replace(choice, noise_memory=tuple(fitter.noise_memory(fit).tolist()))
    fit = replace(fitter.fit(question, choice, fit.point, rounds=1), samples=())
    evidence = _link_evidence(fit)
    if evidence is not None:
        choice = replace(choice, link_scales=average_scales(evidence))
    return choice, errors, fit.point


def _link_evidence(fit: Fit) -> LinkEvidence | None:
    """Return what a fit says of the links that the model states; None where none is sought."""
    group = next((group for group in fit.unknowns.groups if group.cause == LINKS), None)
    if group is None:
        return None
    columns = fit.columns
    number = {link.body_name: index for index, link in enumerate(columns.robot.links)}
    names = list(dict.fromkeys(group.members))
    thetas = [columns.robot.links[number[name]].theta for name in names]
    is_stated = np.array([columns.usual[name] is theta for name, theta in zip(names, thetas)])
    if not np.any(is_stated):
        return None
    stated = np.flatnonzero(is_stated).tolist()
    lengths = link_lengths(columns.robot, [number[names[index]] for index in stated])
    bodies = tuple(tuple(thetas[index]) for index in stated)
    share = PER_CENT * fit.question.options.link_uncertainty
    directions = share * link_directions(bodies, tuple(lengths))
    others = [other for other in fit.unknowns.groups if other is not group]
    data = fit.evidence.of(fit.unknowns)
    return link_evidence(data, fit.weights, others, group, directions, is_stated)


def _simplest(
    fitter: Fitter, given: FrictionModel | None, couplings: tuple[Coupling, ...]
) -> Choice:
    model = given or friction_model(CANDIDATES[0])
    return Choice((model,) * fitter.columns.robot.n_joints, couplings)


def _sought(fit: Fit, question: Question, choice: Choice) -> Unknowns:
    return build_unknowns(fit.columns, question, choice, fit.evidence.torque, fit.evidence.nonzero)


def squared_errors(judge: HeldOut, columns: Columns, question: Question, choice: Choice) -> Array:
    """Return held-out squared errors (blocks, joints) of a choice."""
    data = judge.data
    return judge.squared(build_unknowns(columns, question, choice, data.torque, data.nonzero))


def score_of(judge: HeldOut, fit: Fit, question: Question, choice: Choice) -> Array:
    """Return ``HeldOut.score`` (blocks,) of a choice, with bodies that are possible."""
    return judge.score(judge.of(replace(fit, unknowns=_sought(fit, question, choice))))


def _with_friction(
    fitter: Fitter, question: Question, choice: Choice, point: Point, noise: Array
) -> tuple[Choice, Errors, Point]:
    """Give each joint the terms that predict its held-out torques clearly better, around a point,
    beside noise (joints,) [N m].
    """
    squared, speeds, counts = _tried(fitter, question, choice, point, noise)
    friction, speed = list(choice.friction), dict(point.speed or {})
    errors = {}
    for place, (index, joint) in enumerate(zip(fitter.columns.rows_of, fitter.columns.joints)):
        own = {name: each[:, place] for name, each in squared.items()}
        rows, total = np.maximum(counts[:, place], 1.0), max(np.sum(counts[:, place]), 1.0)
        best = clearly_best({name: each / rows for name, each in own.items()})
        errors[joint] = {name: float(np.sqrt(np.sum(each) / total)) for name, each in own.items()}
        friction[index] = friction_model(best)
        for term in friction[index].bent:
            speed[term] = speed[term].copy()
            speed[term][index] = speeds[best][place]
    choice = replace(choice, friction=tuple(friction))
    return choice, errors, replace(point, speed=speed)


def _tried(
    fitter: Fitter, question: Question, choice: Choice, point: Point, noise: Array
) -> tuple[dict[str, Array], dict[str, Array], Array]:
    """Return candidate to its squared errors (blocks, joints), and to the speeds (joints,), and
    ``HeldOut.counts``.

    A term that is nonlinear in a speed is tried at several; each joint keeps its best.
    """
    robot = fitter.columns.robot
    squared: dict[str, Array] = {}
    speeds: dict[str, Array] = {}
    for number in range(max(len(bent.tried) for bent in BENT.values())):
        tried = {term: np.full(robot.n_joints, bent.tried[number]) for term, bent in BENT.items()}
        data, _ = fitter.around(replace(point, speed=tried, exact_load=True))
        judge = HeldOut(data, noise)
        for name in CANDIDATES:
            model = friction_model(name)
            if number and not model.bent:
                continue
            each = replace(choice, friction=(model,) * robot.n_joints)
            error = squared_errors(judge, fitter.columns, question, each)
            speed = tried[model.bent[0]][0] if model.bent else 0.0
            before = squared.get(name, np.full_like(error, np.inf))
            lower = error.sum(axis=0) < before.sum(axis=0)
            squared[name] = np.where(lower, error, before)
            speeds[name] = np.where(lower, speed, speeds.get(name, np.zeros(error.shape[1])))
        counts = judge.counts
        del data, judge  # before others are made: they take as much memory as the rows
    return squared, speeds, counts


def clearly_best(scores: Mapping[str, Array]) -> str:
    """Return the candidate to take, from its squared errors per block (blocks,)."""
    chosen = next(iter(scores))
    while True:
        better = [name for name in scores if is_clearly_lower(scores[name], scores[chosen])]
        if not better:
            return chosen
        fewest = min(len(friction_model(name).terms) for name in better)
        short = [name for name in better if len(friction_model(name).terms) == fewest]
        chosen = min(short, key=lambda name: float(np.mean(scores[name])))


def is_scaled(fit: Fit, question: Question, choice: Choice) -> bool:
    """Tell whether all torques together read too much or too little, or all links are off alike.

    Where the links are the only witness neither is more likely than the other.
    """
    sought = _sought(fit, question, replace(choice, common_scale=COMMON_SCALE))
    names = [f"scale[{joint}]" for joint in fit.columns.joints]
    return sought.may_be_scaled(question) and is_worth_a_word(*asked_of(fit, sought, names))


def asked_of(fit: Fit, sought: Unknowns, names: Sequence[str]) -> tuple[Array, Array]:
    """Return values (m,) and covariance (m, m) of some of what is sought, around a fit's point."""
    values, spread, _ = WithPriors(fit.evidence.of(sought), 1.0 / fit.weights).solve(sought.groups)
    places = np.searchsorted(sought.kept, fit.columns.at(names))
    return values[places], spread[np.ix_(places, places)]


def shown_offsets(fit: Fit, question: Question, choice: Choice) -> Choice:
    """Let those torque sensors have an offset of which the recordings show one.

    An offset and the weight of links read alike in a small motion, so that noise alone would give
    sensors what links weigh: offsets that are not clear are zero, the least clear first. Sensors of
    an arm are of one kind: where one clearly has an offset, the others may have a small one.
    """
    size = dict(zip(fit.columns.robot.joint_names, OFFSET * fit.evidence.torque))
    sought, gone = _sought(fit, question, choice), list(choice.offsets)
    free = [j for j in fit.columns.joints if j not in gone and f"offset[{j}]" in sought.kept_names]
    found, spread = asked_of(fit, sought, [f"offset[{joint}]" for joint in free])
    while free:
        clear = np.abs(found) / np.sqrt(np.diag(spread))
        least = int(np.argmin(clear))
        if clear[least] > CLEAR_OFFSET:
            return replace(choice, offsets={joint: size[joint] for joint in gone})
        # What the others are where this one is zero.
        gain, stay = spread[:, least] / spread[least, least], np.arange(len(free)) != least
        found = (found - gain * found[least])[stay]
        spread = (spread - np.outer(gain, spread[least]))[stay][:, stay]
        gone.append(free.pop(least))
    return replace(choice, offsets=dict.fromkeys(gone, 0.0))


def shown_rotors(fit: Fit) -> dict[str, float]:
    """Return joint, or motor that turns several, to the rotor that a file gets: that of a fit with
    all that friction does, where it is clearly another than the model's, else the model's.

    A file lacks most of what friction does, and in slow motion a rotor of its own would take that
    part.
    """
    columns, sought = fit.columns, _sought(fit, fit.question, fit.choice)
    owners = [*columns.robot.joint_names, *(motor.name for motor in fit.choice.couplings)]
    owners = [owner for owner in owners if f"armature[{owner}]" in sought.kept_names]
    names = [f"armature[{owner}]" for owner in owners]
    if not names:
        return {}
    found, spread = asked_of(fit, sought, names)
    places, error = columns.at(names), np.sqrt(np.diag(spread))
    clear = np.abs(found - columns.prior[places]) > CLEAR_OFFSET * error
    values = np.where(clear, fit.values[places], columns.prior[places])
    return dict(zip(owners, values.tolist()))


def dry_friction(fit: Fit) -> tuple[float, ...]:
    """Return about how much dry friction (joints,) each row's joint has [N m]."""
    sizes = np.zeros(len(fit.columns.joints))
    for place, joint in enumerate(fit.columns.joints):
        names = [f"{term}[{joint}]" for term in ("coulomb", "sigmoid")]
        sizes[place] = np.sum(np.abs(fit.values[fit.columns.at(names)]))
    return tuple(sizes.tolist())


def predictive_link_scales(
    judge: HeldOut, fit: Fit, question: Question, choice: Choice
) -> LinkScales:
    """Return the least multiple of the links' uncertainty that predicts about as well as any.

    It grows for as long as that does not predict worse. A file keeps what predicts best; how far
    off links may be is another question (``link_scales``).
    """
    scores = list[float]()
    for scale in SCALES:
        wider = replace(choice, link_scales=LinkScales(scale, scale, scale, scale))
        scores.append(float(np.mean(score_of(judge, fit, question, wider))))
        if scores[-1] > AS_GOOD * min(scores):
            break
    as_good = np.flatnonzero(np.array(scores) <= AS_GOOD * min(scores))
    best = SCALES[int(as_good[0])]
    return LinkScales(best, best, best, best)
