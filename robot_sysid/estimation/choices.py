"""What the recordings decide: rows to leave out, each joint's friction terms, the prior of links.

Which motors turn several joints is decided in ``couplings``. In-sample errors fall with every
friction term, so terms are chosen by cross-validation: each block of time is predicted from the
others. Blocks are compared by ratios of their errors, because friction may matter far more in one
of them. A joint starts with the simplest candidate and moves on as long as another one is clearly
better on its own held-out torques.
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
from robot_sysid.estimation.algebra.consistent_bodies import ConsistentLinks
from robot_sysid.estimation.algebra.least_squares import (
    normal_matrix,
    restrict,
    sample_counts,
    update_triangle,
)
from robot_sysid.estimation.algebra.priors import (
    LinkEvidence,
    LinkScales,
    WithPriors,
    average_scales,
    is_worth_a_word,
    link_directions,
    link_evidence,
    link_lengths,
)
from robot_sysid.estimation.columns import Columns, Point
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
from robot_sysid.records import Array, Validation
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
"""Friction models to try, the same for every joint of every arm, simplest first."""
IN_FILE = CANDIDATES[0]
"""Friction model that any model file can hold."""
WITH_POLYNOMIAL = CANDIDATES[5]
"""Friction model that an MJCF can hold."""
WITH_ALL = "coulomb-viscous-offset-armature-sqrt-stribeck-load"
"""Friction model that fits any friction by speed and load closely enough to judge its rows."""
SCALES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Factors of the other links' uncertainty to try; 16 times 5 % is nearly all of a link."""
AS_GOOD = 1.02
"""Ratio of squared errors up to which they count as equal: one per cent of the error."""
OWN_SOURCE = "the logs, each fifth predicted from the others"
CLEAR_SHARE = 0.1
"""Share by which a friction term has to lower the held-out squared error."""
CLEARLY = 2.0
"""Standard errors of the mean over the blocks by which a term has to lower that error."""
CLEAR_OFFSET = 3.0
"""Standard errors that a sensor's offset has to be away from zero, and a rotor from the model's."""
OFFSET = 0.01
"""Prior standard deviation of other sensors' offsets beside clear ones, as a share of the joint's
torque: of a KUKA LWR4+, offsets and links are not known better."""
# Less than every squared error [N^2 m^2].
_TINY = 1e-30
# Keeps normal equations regular where parameters have no data.
_RIDGE = 1e-12

Errors = Mapping[str, Mapping[str, float]]
"""Joint to friction model to its held-out root mean square error [N m]."""


@dataclass(frozen=True)
class HeldOut:
    """Recordings in blocks, each to be predicted from the others.

    Attributes:
        data: evidence of each block.
        noise: (joints,) effective standard deviation of each joint's torque [N m].
        superset: unknowns that contain those of every question, which saves memory with many
            joints; None for all parameters.
    """

    data: Evidence
    noise: Array
    superset: Unknowns | None = None
    _triangles: dict[tuple[bytes, bytes], Sequence[Array]] = field(default_factory=dict)
    _path_ends: dict[int, Any] = field(default_factory=dict)

    @cached_property
    def counts(self) -> Array:
        """How many rows each block has of each joint (blocks, joints)."""
        return np.array([sample_counts(block) for block in self.data.blocks])

    @cached_property
    def _available(self) -> NDArray[np.bool_]:
        """Which parameters (p,) have columns in the Gram matrices."""
        nonzero = self.data.nonzero
        if self.superset is None:
            return nonzero
        is_unknown = np.isin(np.arange(len(nonzero)), self.superset.kept)
        return nonzero & (is_unknown | (self.superset.held != 0.0))

    @cached_property
    def _grams(self) -> Array:
        """Gram matrices (blocks, s+2, s+2) of the whitened equations of all blocks but one in turn.

        Columns are the s available parameters, the right sides, and zeros for all other parameters.
        """
        indices = np.append(np.flatnonzero(self._available), -1)
        grams = np.zeros((len(self.data.blocks), len(indices) + 1, len(indices) + 1))
        for gram, block in zip(grams, self.data.blocks):
            gram[:-1, :-1] = normal_matrix(block, 1.0 / self.noise)[
                np.ix_(indices, indices)
            ]
        for row_of_blocks in grams.swapaxes(0, 1):  # which takes no memory
            row_of_blocks[:] = np.array(_sums_of_others(row_of_blocks, np.add))
        return grams

    def squared_errors(self, unknowns: Unknowns) -> Array:
        """Return the squared error (blocks, joints) of blocks predicted from the others [N^2 m^2].

        Bodies may be physically inconsistent here.
        """
        return self.data.squared_residuals(self._values(unknowns)[..., None])[..., 0]

    def _normal_equations(
        self, unknowns: Unknowns
    ) -> Iterator[tuple[Array, Array, Array]]:
        """Yield scaled normal equations (k, k), right side (k,) and scale (k,) without each block.

        Friction terms that the other blocks do not identify stay near zero; all other parameters
        without data have priors.
        """
        available = self._available
        held = unknowns.held.copy()
        assert not np.any(self.data.nonzero[unknowns.kept] & ~available[unknowns.kept])
        held[unknowns.kept] = 0.0
        prior_rows = _prior_rows(unknowns)
        prior_gram = prior_rows.T @ prior_rows
        gram_indices = np.where(available, np.cumsum(available) - 1, -1)
        indices = gram_indices[unknowns.kept]
        held_indices = np.flatnonzero(held)
        for gram in self._grams:
            crossed = gram[np.ix_(indices, gram_indices[held_indices])]
            right_side = (
                gram[indices, -2] - crossed @ held[held_indices] + prior_gram[:-1, -1]
            )
            matrix = gram[np.ix_(indices, indices)] + prior_gram[:-1, :-1]
            size = np.sqrt(np.diagonal(matrix))
            scale = 1.0 / np.where(size > 0.0, size, 1.0)
            matrix *= scale[:, None] * scale
            matrix[np.diag_indices_from(matrix)] += _RIDGE
            yield matrix, scale * right_side, scale

    def _values(self, unknowns: Unknowns) -> Array:
        """Return the estimate (blocks, p) from all blocks but one in turn."""
        values = [
            unknowns.full(scale * np.linalg.solve(matrix, right_side))
            for matrix, right_side, scale in self._normal_equations(unknowns)
        ]
        return np.array(values)

    def chance(self, fit: Fit) -> Array:
        """Return the expected squared prediction error (blocks, joints) of a right model [N^2 m^2].

        It is the noise of the block's own torque plus the variance of the prediction made from the
        other blocks, which is nearly infinite where none of them identifies a joint's friction.
        """
        unknowns = fit.unknowns
        expected = self.counts * fit.noise**2
        equations = self._normal_equations(unknowns)
        for block, block_expected, (matrix, _, scale) in zip(
            self.data.blocks, expected, equations
        ):
            root = np.linalg.inv(np.linalg.cholesky(matrix)) * scale
            for row, joint in enumerate(block.joints):
                is_unknown = np.isin(joint.columns, unknowns.kept)
                indices = np.searchsorted(unknowns.kept, joint.columns[is_unknown])
                block_expected[row] += np.sum(
                    (joint.triangle[:, :-1][:, is_unknown] @ root[:, indices].T) ** 2
                )
        return expected

    def of(self, fit: Fit) -> Array:
        """Return the ``squared_errors`` of a fit's unknowns, bodies physically consistent."""
        unknowns = fit.unknowns
        values = self._values(unknowns)
        problem = links_problem(unknowns)
        prior_rows = _prior_rows(unknowns)
        bodies = [indices for indices, _ in unknowns.bodies.values()]
        path_end = None
        for block, estimate in enumerate(values):
            if bodies and not all(
                spatial.is_consistent(estimate[indices]) for indices in bodies
            ):
                rows = np.vstack((self._other_triangles(unknowns)[block], prior_rows))
                path_end = self._path_ends.get(block, path_end)
                solver = ConsistentLinks(rows[:, :-1], rows[:, -1], problem, path_end)
                values[block] = unknowns.full(solver.best())
                path_end = solver.first
                self._path_ends[block] = path_end
        return self.data.squared_residuals(values[..., None])[..., 0]

    def _other_triangles(self, unknowns: Unknowns) -> Sequence[Array]:
        """Return triangles (., k+1) of the equations of all blocks but one in turn."""
        key = unknowns.kept.tobytes(), unknowns.held.tobytes()
        if key not in self._triangles:
            restriction = unknowns.kept_names, unknowns.held
            blocks = (restrict(block, *restriction) for block in self.data.blocks)
            stacked = (
                np.column_stack(block.stacked(1.0 / self.noise)) for block in blocks
            )
            empty = np.zeros((0, len(unknowns.kept) + 1))
            triangles = [update_triangle(empty, block) for block in stacked]
            self._triangles[key] = _sums_of_others(triangles, update_triangle)
        return self._triangles[key]

    def score(self, squared: Array) -> Array:
        """Return the mean (blocks,) of squared errors (blocks, joints), over the noise variance."""
        counts = np.maximum(np.sum(self.counts, axis=1), 1.0)
        return np.asarray(np.sum(squared / self.noise**2, axis=-1) / counts)

    def validation(self, squared: Array, source: str = OWN_SOURCE) -> Validation:
        """Return squared errors (blocks, joints) as one record."""
        joints = [joint.joint for joint in self.data.blocks[0].joints]
        torque = np.sum(self.data.squared_torque, axis=0)
        counts = np.sum(self.counts, axis=0)
        return validation_of(joints, np.sum(squared, axis=0), torque, counts, source)


def held_out(fit: Fit, superset: Unknowns | None = None) -> HeldOut:
    """Return the blocks of a fit, which judge choices whose unknowns are in the superset."""
    return HeldOut(fit.evidence, 1.0 / fit.weights, superset)


def _sums_of_others(
    summands: Sequence[Array], add: Callable[[Array, Array], Array]
) -> list[Array]:
    """Return for each summand, two at least, the sum of all others.

    They are added up from both ends: subtracting a summand from the total would leave rounding
    errors where the others have no data.
    """
    sums_before = list(accumulate(summands[:-1], add))
    sums_after = list(accumulate(summands[:0:-1], add))[::-1]
    return [sums_after[0], *map(add, sums_before[:-1], sums_after[1:]), sums_before[-1]]


def _prior_rows(unknowns: Unknowns) -> Array:
    rows = [group.rows(unknowns.kept_names) for group in unknowns.groups]
    return np.vstack(rows) if rows else np.zeros((0, len(unknowns.kept) + 1))


def is_clearly_lower(errors: Array, reference: Array) -> bool:
    """Tell whether squared errors (blocks,) are clearly lower than those of a reference."""
    if not np.all(np.isfinite(errors)) or not np.all(np.isfinite(reference)):
        return bool(np.all(np.isfinite(errors)))
    ratio = np.log((errors + _TINY) / (reference + _TINY))
    mean = float(np.mean(ratio))
    standard_error = float(np.std(ratio, ddof=1)) / np.sqrt(len(ratio))
    threshold = np.log(1.0 - CLEAR_SHARE)
    lower = np.sum(errors) < (1.0 - CLEAR_SHARE) * np.sum(reference)
    return bool(lower and mean < threshold and mean + CLEARLY * standard_error < 0.0)


def choose(
    fitter: Fitter,
    question: Question,
    model: FrictionModel | None,
    couplings: tuple[Coupling, ...] | None = None,
) -> tuple[Choice, Errors, Point]:
    """Return what the recordings decide, held-out errors of friction models, and a point to start.

    Args:
        model: friction of every joint, where the user states it; None to choose it.
        couplings: those of ``select_couplings``; None for all that have columns.
    """
    if couplings is None:
        couplings = fitter.columns.couplings
    joint_model = model or friction_model(CANDIDATES[0])
    choice = Choice((joint_model,) * fitter.columns.robot.n_joints, couplings)
    fit = replace(fitter.fit(question, choice, rounds=1), samples=())
    errors: Errors = {}
    if model is None and fitter.columns.torques == "chain":
        point = replace(fit.point, values=fit.values)
        noise = 1.0 / fit.weights
        del fit  # its evidence, before other rows are made
        choice, errors, point = _select_friction(fitter, question, choice, point, noise)
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
    """Return a fit's evidence on links that the model states; None where none is unknown."""
    group = next((group for group in fit.unknowns.groups if group.cause == LINKS), None)
    if group is None:
        return None
    columns = fit.columns
    number = {link.body_name: index for index, link in enumerate(columns.robot.links)}
    names = list(dict.fromkeys(group.members))
    thetas = [columns.robot.links[number[name]].theta for name in names]
    is_stated = np.array(
        [columns.usual[name] is theta for name, theta in zip(names, thetas)]
    )
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


def _unknowns_of(fit: Fit, question: Question, choice: Choice) -> Unknowns:
    return build_unknowns(
        fit.columns, question, choice, fit.evidence.torque, fit.evidence.nonzero
    )


def squared_errors(
    judge: HeldOut, columns: Columns, question: Question, choice: Choice
) -> Array:
    """Return held-out squared errors (blocks, joints) of a choice [N^2 m^2]."""
    data = judge.data
    return judge.squared_errors(
        build_unknowns(columns, question, choice, data.torque, data.nonzero)
    )


def score_of(judge: HeldOut, fit: Fit, question: Question, choice: Choice) -> Array:
    """Return ``HeldOut.score`` (blocks,) of a choice, bodies physically consistent."""
    return judge.score(
        judge.of(replace(fit, unknowns=_unknowns_of(fit, question, choice)))
    )


def _select_friction(
    fitter: Fitter, question: Question, choice: Choice, point: Point, noise: Array
) -> tuple[Choice, Errors, Point]:
    """Return the choice with friction terms that predict held-out torques clearly better, the root
    mean square error of each candidate, and the point with the speeds of these terms.

    The noise (joints,) [N m] is that of a fit of simple friction around the point.
    """
    squared, speeds, counts = _candidate_errors(fitter, question, choice, point, noise)
    friction = list(choice.friction)
    point_speeds = dict(point.speed or {})
    errors = {}
    for row, (index, joint) in enumerate(
        zip(fitter.columns.rows_of, fitter.columns.joints)
    ):
        joint_errors = {name: error[:, row] for name, error in squared.items()}
        rows = np.maximum(counts[:, row], 1.0)
        total = max(np.sum(counts[:, row]), 1.0)
        best = clearly_best(
            {name: error / rows for name, error in joint_errors.items()}
        )
        errors[joint] = {
            name: float(np.sqrt(np.sum(error) / total))
            for name, error in joint_errors.items()
        }
        friction[index] = friction_model(best)
        for term in friction[index].bent:
            point_speeds[term] = point_speeds[term].copy()
            point_speeds[term][index] = speeds[best][row]
    choice = replace(choice, friction=tuple(friction))
    return choice, errors, replace(point, speed=point_speeds)


def _candidate_errors(
    fitter: Fitter, question: Question, choice: Choice, point: Point, noise: Array
) -> tuple[dict[str, Array], dict[str, Array], Array]:
    """Return candidate to its squared errors (blocks, joints) [N^2 m^2], candidate to the speeds
    (joints,) of its nonlinear term [rad/s], and ``HeldOut.counts``.

    A term that is nonlinear in a speed is tried at several speeds; each joint keeps its best.
    """
    robot = fitter.columns.robot
    squared: dict[str, Array] = {}
    speeds: dict[str, Array] = {}
    for number in range(max(len(bent.tried) for bent in BENT.values())):
        trial_speeds = {
            term: np.full(robot.n_joints, bent.tried[number])
            for term, bent in BENT.items()
        }
        data, _ = fitter.around(replace(point, speed=trial_speeds, exact_load=True))
        judge = HeldOut(data, noise)
        for name in CANDIDATES:
            model = friction_model(name)
            if number and not model.bent:
                continue
            trial = replace(choice, friction=(model,) * robot.n_joints)
            error = squared_errors(judge, fitter.columns, question, trial)
            speed = trial_speeds[model.bent[0]][0] if model.bent else 0.0
            least = squared.get(name, np.full_like(error, np.inf))
            lower = error.sum(axis=0) < least.sum(axis=0)
            squared[name] = np.where(lower, error, least)
            speeds[name] = np.where(
                lower, speed, speeds.get(name, np.zeros(error.shape[1]))
            )
        counts = judge.counts
        del (
            data,
            judge,
        )  # before the next ones are made: they take as much memory as the rows
    return squared, speeds, counts


def clearly_best(scores: Mapping[str, Array]) -> str:
    """Return the best candidate, from the squared errors (blocks,) of each."""
    best = next(iter(scores))
    while True:
        better = [
            name for name in scores if is_clearly_lower(scores[name], scores[best])
        ]
        if not better:
            return best
        fewest = min(len(friction_model(name).terms) for name in better)
        short = [name for name in better if len(friction_model(name).terms) == fewest]
        best = min(short, key=lambda name: float(np.mean(scores[name])))


def is_scaled(fit: Fit, question: Question, choice: Choice) -> bool:
    """Tell whether all torque scales, or all links' parameters, share one clear error.

    Torques and links that are too large by the same share give the same rows.
    """
    unknowns = _unknowns_of(fit, question, replace(choice, common_scale=COMMON_SCALE))
    names = [f"scale[{joint}]" for joint in fit.columns.joints]
    return unknowns.may_be_scaled(question) and is_worth_a_word(
        *posterior_of(fit, unknowns, names)
    )


def posterior_of(
    fit: Fit, unknowns: Unknowns, names: Sequence[str]
) -> tuple[Array, Array]:
    """Return values (m,) and covariance (m, m) of some unknowns, around a fit's point."""
    problem = WithPriors(fit.evidence.of(unknowns), 1.0 / fit.weights)
    values, covariance, _ = problem.solve(unknowns.groups)
    indices = np.searchsorted(unknowns.kept, fit.columns.at(names))
    return values[indices], covariance[np.ix_(indices, indices)]


def select_offsets(fit: Fit, question: Question, choice: Choice) -> Choice:
    """Return the choice with offsets of those torque sensors that clearly have one.

    In a small motion an offset and the weight of links make the same torque, so that noise alone
    would move weight into offsets: offsets that are not clear become zero, the least clear first.
    Sensors of an arm are of one kind: beside a clear offset, the others may have small ones.
    """
    deviations = dict(zip(fit.columns.robot.joint_names, OFFSET * fit.evidence.torque))
    unknowns = _unknowns_of(fit, question, choice)
    zero_joints = list(choice.offsets)
    names = unknowns.kept_names
    free = [
        j
        for j in fit.columns.joints
        if j not in zero_joints and f"offset[{j}]" in names
    ]
    offsets, covariance = posterior_of(
        fit, unknowns, [f"offset[{joint}]" for joint in free]
    )
    while free:
        significance = np.abs(offsets) / np.sqrt(np.diag(covariance))
        index = int(np.argmin(significance))
        if significance[index] > CLEAR_OFFSET:
            return replace(
                choice, offsets={joint: deviations[joint] for joint in zero_joints}
            )
        # Condition the other offsets on zero for this one.
        gain = covariance[:, index] / covariance[index, index]
        others = np.arange(len(free)) != index
        offsets = (offsets - gain * offsets[index])[others]
        covariance = (covariance - np.outer(gain, covariance[index]))[others][:, others]
        zero_joints.append(free.pop(index))
    return replace(choice, offsets=dict.fromkeys(zero_joints, 0.0))


def select_rotors(fit: Fit) -> dict[str, float]:
    """Return joint, or motor that turns several, to its rotor inertia in a file [kg m^2].

    That is the estimate of a fit with all friction terms, where it clearly differs from the model's
    rotor, else the model's. A file lacks most of these terms: in slow motion, a rotor fitted beside
    its friction would take their torque.
    """
    columns = fit.columns
    unknowns = _unknowns_of(fit, fit.question, fit.choice)
    owners = [
        *columns.robot.joint_names,
        *(motor.name for motor in fit.choice.couplings),
    ]
    owners = [owner for owner in owners if f"armature[{owner}]" in unknowns.kept_names]
    names = [f"armature[{owner}]" for owner in owners]
    if not names:
        return {}
    rotors, covariance = posterior_of(fit, unknowns, names)
    indices = columns.at(names)
    error = np.sqrt(np.diag(covariance))
    is_clear = np.abs(rotors - columns.prior[indices]) > CLEAR_OFFSET * error
    values = np.where(is_clear, fit.values[indices], columns.prior[indices])
    return dict(zip(owners, values.tolist()))


def dry_friction(fit: Fit) -> tuple[float, ...]:
    """Return the dry friction (joints,) of each row's joint in a fit [N m]."""
    sizes = np.zeros(len(fit.columns.joints))
    for row, joint in enumerate(fit.columns.joints):
        names = [f"{term}[{joint}]" for term in ("coulomb", "sigmoid")]
        sizes[row] = np.sum(np.abs(fit.values[fit.columns.at(names)]))
    return tuple(sizes.tolist())


def predictive_link_scales(
    judge: HeldOut, fit: Fit, question: Question, choice: Choice
) -> LinkScales:
    """Return the least factor on the links' uncertainty whose held-out error is about the lowest.

    Factors are tried until the error rises. They are for a file, which has to predict well; the
    uncertainty of links is estimated in ``link_scales``.
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
