"""The torque error to expect of a model file on motions that nobody recorded.

With x the fit of all terms, f what the file holds of them, G the sums of made-up motions and C the
covariance of the errors of x, the squares of the file's torque error there are expected to be

    (x - f)' G (x - f) + tr(C G):

what the file leaves out of what is known, and what is not known. C is that of data, priors and, of
what the fit lets free, priors as wide as an unknown joint or link: a short log leaves combinations
free of which other motions see much. It is raised by the jackknife like every printed error. The
covariance of the file's own fit in its place, or leaving x - f out, promises two to four times too
little. docs/method.md has how well it holds.

Shapes: p parameters of made-up motions, J joints with equations.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import COULOMB, OFFSET, ROTOR, VISCOUS
from robot_sysid.estimate.choose import fastest_of, speeds_in
from robot_sysid.estimate.equations.inverse import solve
from robot_sysid.estimate.fit import Fit, settled_values
from robot_sysid.estimate.links import last_link_scale
from robot_sysid.estimate.questions import LEAST_DRY
from robot_sysid.estimate.restricted_fit import straight_of
from robot_sysid.estimate.rows import Sums
from robot_sysid.estimate.terms import (
    FRICTION,
    FURTHER_FRICTION,
    LAST_LINK,
    MOTORS,
    PAYLOAD,
    PAYLOAD_NAMES,
    SCALES,
    TILT,
    ZEROS,
    ArmTerms,
    Term,
)
from robot_sysid.motion.elsewhere import (
    highest_speed,
    made_up_motions,
    sums_elsewhere,
    without_constant,
)
from robot_sysid.records import Array
from robot_sysid.records.levels import LIKE_LOG, SURE
from robot_sysid.records.messages import Detail, says
from robot_sysid.results.record import (
    Elsewhere,
    ErrorPart,
    Identification,
    MotionErrors,
    NextMotion,
)
from robot_sysid.results.rules import OF_OTHER_MOTIONS
from robot_sysid.results.verdicts import judge

MOST_RAISED = 2.0
"""Most by which the jackknife raises an error here: it is uncertain itself, and of ten blocks its
largest values are chance. Without it, 92 % of 36 pairs of real logs were within 1.5, with it 97 %.
"""
SLOWEST = 0.2
"""Least speed of motions like a log's [rad/s or m/s]: a joint that hardly moved has none."""
PARTS = 5
"""Number of causes that are listed of an error."""
FASTER = 2.0
"""Times the error at the log's speeds from which the faster motions' is said to come from speed,
and times the log's speed of a joint from which its friction is taken to be unknown there."""
GAIN = 0.8
"""Share of the promise that a further motion has to bring it to, to be proposed: files of 20 second
logs were 1.2 times as far off as was expected of them (median), so that less is no gain."""
AS_GOOD = 1.1
"""Times the best promise of a further motion up to which one that costs less is as good."""


@dataclass(frozen=True)
class FurtherMotion:
    """A motion that may be recorded next, as ``plan`` makes it.

    Attributes:
        words: of ``plan``, behind the model.
        duration: of its recording [s].
    """

    words: tuple[str, ...]
    duration: float


FURTHER_MOTIONS = (FurtherMotion((), 15.0), FurtherMotion(("--duration", "60"), 60.0))
"""What ``plan`` makes by default, and for longer; those that cost less first. A slow motion is none
of them: beside a log at full speed it makes the error of a file a tenth smaller at most, where
another one at full speed halves it."""


@dataclass(frozen=True)
class Knowledge:
    """What a fit knows of the p parameters of made-up motions, those that its logs lack included.

    Attributes:
        values: (p,) of the fit, what it lets free drawn to what it is without any log: the last
            link to the model's, friction and rotors to none; the model's of those that it does
            not estimate.
        precision: (p, p) of data and priors, as little as the jackknife says.
        wide: (p,) precision of wide priors; zero of what the fit has a prior of, or takes as known.
        raised: (p,) times its error by which the jackknife raises that of a parameter.
        of_scales: (p, p) covariance of what torque scales do beyond their columns.
        weights: (J,) of each joint's rows [1/(N m)].
        row_rate: rows per second of its logs [Hz].
    """

    values: Array
    precision: Array
    wide: Array
    raised: Array
    of_scales: Array
    weights: Array
    row_rate: float

    def covariance(self, further: Array | float = 0.0) -> Array:
        """Return the covariance (p, p) of the errors, after ``further`` (p, p) rows are added."""
        # What the jackknife raises is the error of data, not of what nothing is known of.
        raised = self.raised[:, None] * self.raised
        normal = _with_zero_torque(
            (self.precision + further) / raised + np.diag(self.wide)
        )
        is_free = np.diag(self.precision) + self.wide > 0.0
        _, inverse = solve(normal, self.values, is_free)
        return usual_errors.ERRORS_AS_THEY_ARE**2 * (inverse + self.of_scales)

    def rows(self, sums: Sums, length: float, weights: Array) -> Array:
        """Return the products (p, p) of the rows of a log that moves as the motions of sums do.

        Args:
            sums: of made-up motions.
            length: of the log [s].
            weights: (J,) of each joint's rows [1/(N m)].
        """
        total = np.zeros(self.precision.shape)
        shares = self.row_rate * length / sums.row_counts
        for weight, share, gram in zip(weights, shares, grams(sums)):
            total += weight**2 * share * gram[:-1, :-1]
        return total


def knowledge_of(fitted: Fit, sums: Sums) -> Knowledge:
    """Return what a fit of all terms knows of the parameters of made-up motions.

    Of a joint that stood still no row tells anything: its rows weigh as those of an average one.
    """
    is_still = is_without_rows(fitted)
    noise = fitted.noise * np.sqrt(fitted.correlation)
    average = np.sqrt(np.mean(noise[~is_still] ** 2))
    known = [name in fitted.names for name in sums.names]
    at = np.flatnonzero(known)
    of_fit = fitted.at([*itertools.compress(sums.names, known)])
    precision = np.zeros((len(known), len(known)))
    precision[at[:, None], at] = _marginal_precision(fitted.normal[:-1, :-1], of_fit)
    formal = np.maximum(np.diag(fitted.inverse), 1e-300)
    of_data = np.sqrt(np.clip(fitted.jackknife / formal, 1.0, MOST_RAISED**2))
    raised = np.ones(len(known))
    raised[at] = np.where(fitted.is_hidden, 1.0, of_data)[of_fit]
    of_scales = np.zeros_like(precision)
    of_scales[at[:, None], at] = fitted.scale_errors[of_fit[:, None], of_fit]
    wide = np.zeros(len(known))
    for name, error in wide_errors(fitted, sums):
        wide[sums.names.index(name)] = error**-2
    loosened = _loosened_offsets(fitted, sums)
    precision -= np.diag(loosened)
    settled = settled_values(fitted)
    of_sums = np.array([settled[name] for name in sums.names])
    last = sums.at(fitted.arm.terms[LAST_LINK].names)
    values = _drawn_values(of_sums, last, precision, wide, loosened)
    for name, error in _still_errors(fitted, sums, of_sums):
        wide[sums.names.index(name)] = error**-2
    first = fitted.recordings[0]
    return Knowledge(
        values,
        precision,
        wide,
        raised,
        of_scales,
        1.0 / np.where(is_still, average, noise),
        first.rate / (first.low_pass.step * first.every),
    )


def _loosened_offsets(fitted: Fit, sums: Sums) -> Array:
    """Return by how much the priors of torque offsets in a fit are too precise here (p,).

    An offset of which a fit knows that it is as small as usual is taken for weight where it is not,
    and the file has that weight.
    """
    loosened = np.zeros(len(sums.names))
    for term in fitted.equations.terms:
        if term.key == OFFSET.name and term.prior is not None:
            kept = usual_errors.LARGE_OFFSET**-2
            loosened[sums.at(term.names)] = (1.0 - kept) / term.prior.variances
    return loosened


def _drawn_values(
    values: Array,
    last: NDArray[np.int64],
    precision: Array,
    wide: Array,
    loosened: Array,
) -> Array:
    """Return the values (p,) of a fit under other priors than its own.

    Args:
        values: (p,) of the fit.
        last: (10,) indices of the last link's, which its wide prior has drawn already.
        precision: (p, p) of data and priors.
        wide: (p,) precision of wide priors, around zero.
        loosened: (p,) precision that priors around zero have lost.
    """
    mean = np.zeros(len(values))
    mean[last] = values[last]
    normal = precision + np.diag(wide)
    _, inverse = solve(_with_zero_torque(normal), values, np.diag(normal) > 0.0)
    return values + inverse @ (wide * (mean - values) + loosened * values)


def _with_zero_torque(normal: Array) -> Array:
    """Return products (p, p) of columns as (p + 1, p + 1), those with a torque of zero beside."""
    return np.pad(normal, (0, 1))


def is_without_rows(fitted: Fit) -> NDArray[np.bool_]:
    """Return which joints with equations (J,) have no row that could be used: they stood still."""
    return np.sum(fitted.sums.counts, axis=0) == 0


def _marginal_precision(normal: Array, at: NDArray[np.int64]) -> Array:
    """Return the marginal precision (m, m) of some parameters: the others are not known either.

    Made-up motions lack a column of a log, that of its delay.
    """
    others = np.setdiff1d(np.arange(len(normal)), at)
    across = normal[at[:, None], others]
    of_others = normal[others[:, None], others]
    return normal[at[:, None], at] - across @ np.linalg.solve(of_others, across.T)


def wide_errors(fitted: Fit, sums: Sums) -> Iterator[tuple[str, float]]:
    """Yield the names of parameters that a fit lets free, and how large they may be if unknown.

    The last link may be as far off as a link of the arm is large; friction and rotors make a share
    of a joint's torque.
    """
    for term in fitted.equations.terms:
        if term.prior is None and term.cause == LAST_LINK:
            yield from zip(term.names, last_link_scale(fitted.arm.robot).tolist())
        elif term.prior is None and term.cause in (FRICTION, MOTORS):
            yield from _unknown_sizes(fitted, sums, term)


def _unknown_sizes(fitted: Fit, sums: Sums, term: Term) -> Iterator[tuple[str, float]]:
    """Yield the names of a joint's or motor's parameters to how large they may be if unknown.

    A parameter whose column made-up motions lack is left out.
    """
    torque = fitted.sums.rms_torque
    sizes = usual_errors.UNKNOWN_JOINT * torque
    if term.key == VISCOUS.name:
        dry = np.maximum(fitted.question.dry or 0.0, LEAST_DRY * torque)
        sizes = np.minimum(sizes, usual_errors.VISCOUS_OVER_DRY * dry)
    columns = np.sqrt(sums.squares / sums.row_counts[:, None])
    for name in term.names:
        own = columns[:, sums.names.index(name)]
        is_seen = (own > 0.0) & (torque > 0.0)
        if np.any(is_seen):
            yield name, float(np.max(sizes[is_seen] / own[is_seen]))


def _still_errors(
    fitted: Fit, sums: Sums, values: Array
) -> Iterator[tuple[str, float]]:
    """Yield the dry friction of each joint that stood still, and how far off it may be [N m].

    It is as far off as that of the joint of which the model's friction clearly is farthest off, by
    the root of their torques, but no farther: where the model states none, friction is at most the
    largest that was found. Friction of strong and weak joints is neither the same nor in
    proportion.
    """
    is_still = is_without_rows(fitted)
    if not np.any(is_still):
        return
    names = [
        parameter.key
        for term in fitted.equations.terms
        if term.cause in (FRICTION, FURTHER_FRICTION, MOTORS)
        for parameter in term.parameters
        if parameter.is_friction and parameter.key in sums.names
    ]
    at = sums.at(names)
    own = fitted.at(names)
    off = np.zeros(len(sums.names) + 1)
    off[at] = [fitted.by_name[name] - fitted.arm.model.get(name, 0.0) for name in names]
    errors = np.zeros((len(off), len(off)))
    errors[at[:, None], at] = fitted.covariance[own[:, None], own]
    whole = np.append(values, -1.0)
    sizes = []
    torques = []
    for gram, count in zip(grams(sums), sums.row_counts):
        clear = max(off @ gram @ off - np.vdot(errors, gram), 0.0)
        sizes.append(np.sqrt(clear / count))
        torques.append(np.sqrt(whole @ gram @ whole / count))
    shares = np.array(sizes) / np.sqrt(np.maximum(torques, 1e-300))
    share = np.max(shares[~is_still], initial=0.0)
    largest = np.max(np.array(sizes)[~is_still], initial=0.0)
    for index in np.flatnonzero(is_still):
        size = float(min(share * np.sqrt(torques[index]), largest))
        yield COULOMB.key_of(sums.joints[index]), max(size, 1e-9)


def grams(sums: Sums) -> Iterator[Array]:
    """Yield the products (p + 1, p + 1) of each joint's rows, of all columns and the torque."""
    size = len(sums.names) + 1
    for columns, total in zip(sums.columns, sums.totals):
        gram = np.zeros((size, size))
        gram[columns[:, None], columns] = total
        yield gram


def parts_of(arm: ArmTerms, sums: Sums) -> list[str]:
    """Return what each parameter (p,) is a part of, in words."""
    words: dict[str, str] = {}
    for term in arm.terms.values():
        words.update(_parts_of_term(term))
    for link, names in arm.links.items():
        body = arm.robot.links[link].body_name
        words.update(dict.fromkeys(names[:4], f"mass and centre of {body}"))
        words.update(dict.fromkeys(names[4:], f"inertia of {body}"))
    return [words[name] for name in sums.names]


def _parts_of_term(term: Term) -> Iterator[tuple[str, str]]:
    """Yield the name of each parameter of a term and what it is a part of, in words."""
    shared = {TILT: "direction of gravity", PAYLOAD: "payload"}.get(term.cause)
    of_sensor = {SCALES: "torque scale of ", ZEROS: "encoder zero of "}.get(term.cause)
    for parameter in term.parameters:
        kind = of_sensor or f"{term.cause} of "
        if term.cause in (FRICTION, FURTHER_FRICTION, MOTORS):
            others = {ROTOR.name: "rotor of ", OFFSET.name: "torque offset of "}
            kind = others.get(parameter.name, "friction of ")
        yield parameter.key, shared or f"{kind}{parameter.of}"


@dataclass(frozen=True)
class ExpectedSquares:
    """Squares of a torque error to expect on made-up motions.

    Attributes:
        joints: names of the J joints.
        of_parameters: (J, p) those that each parameter makes; of what two make together, each has a
            half, so that some are negative.
        torque: (J,) squares of the whole torque.
    """

    joints: tuple[str, ...]
    of_parameters: Array
    torque: Array

    @property
    def errors(self) -> MotionErrors:
        """The error over the torque, of all joints together and of each."""
        squares = np.maximum(np.sum(self.of_parameters, axis=1), 0.0)
        each = np.sqrt(squares / np.maximum(self.torque, 1e-300))
        return MotionErrors(
            float(np.sqrt(np.sum(squares) / self.whole_torque)),
            dict(zip(self.joints, each.tolist())),
        )

    @property
    def whole_torque(self) -> float:
        """Squares of the torque of all joints [N^2 m^2]."""
        return max(float(np.sum(self.torque)), 1e-300)

    @property
    def worst_joint(self) -> str:
        """Name of the joint that makes most of the error."""
        return self.joints[int(np.argmax(np.sum(self.of_parameters, axis=1)))]

    def largest_parts(self, parts: Sequence[str]) -> tuple[ErrorPart, ...]:
        """Return the largest parts of the error, by what each parameter (p,) is a part of."""
        squares: dict[str, float] = {}
        for part, square in zip(parts, np.sum(self.of_parameters, axis=0).tolist()):
            squares[part] = squares.get(part, 0.0) + square
        ordered = sorted(squares.items(), key=lambda entry: -entry[1])
        return tuple(
            ErrorPart(part, float(np.sqrt(square / self.whole_torque)))
            for part, square in ordered[:PARTS]
            if square > 0.0
        )


def expected_squares(
    known: Knowledge,
    held: Mapping[str, float],
    sums: Sums,
    covariance: Array,
    counts_offsets: bool = False,
) -> ExpectedSquares:
    """Return the squares of a model's torque error to expect in motions.

    Args:
        known: of the arm.
        held: name of each parameter that the model holds to its value.
        sums: of the motions.
        covariance: (p, p) of the errors of what is known.
        counts_offsets: whether offsets of torque sensors, which no model holds, are errors; if not,
            no joint's mean error is one.
    """
    offsets = [OFFSET.key_of(joint) for joint in sums.joints]
    is_offset = np.isin(sums.names, offsets)
    in_model = np.array([held.get(name, 0.0) for name in sums.names])
    torque = np.append(np.where(is_offset, 0.0, known.values), -1.0)
    apart = known.values - np.where(is_offset, 0.0, in_model)
    of_parameters = []
    torques = []
    for offset, gram in zip(offsets, grams(sums)):
        torques.append(torque @ gram @ torque)
        gram = gram[:-1, :-1]
        if not counts_offsets:
            gram = without_constant(gram, sums.names.index(offset))
        own = np.sum(covariance * gram, axis=1)
        of_parameters.append(apart * (gram @ apart) + own)
    return ExpectedSquares(sums.joints, np.array(of_parameters), np.array(torques))


def largest_errors(
    known: Knowledge, held: Mapping[str, float], sums: Sums, covariance: Array
) -> ExpectedSquares:
    """Return the squares of a model's torque error, offsets counted where that makes them larger.

    The arguments are those of ``expected_squares``.
    """
    both = (
        expected_squares(known, held, sums, covariance, counts_offsets)
        for counts_offsets in (False, True)
    )
    return max(both, key=lambda squares: squares.errors.relative_error)


def with_promise(result: Identification, fitted: Fit, file: Fit) -> Identification:
    """Return a result with what its model files promise for other motions, and the words on it.

    Nothing is promised where the fit does not fit.

    Args:
        result: of the fit and the file.
        fitted: the fit of all terms.
        file: the fit of the model file, whose friction may bend.
    """
    if result.file is None or not result.verdict.is_trustworthy:
        return result
    promise = Promise(fitted)
    written = replace(result.file, elsewhere=promise.of(straight_of(file)))
    if written.curved is not None:
        curved = replace(written.curved, elsewhere=promise.of(file))
        written = replace(written, curved=curved)
    remarks = [*result.remarks, *says(promise.limits())]
    elsewhere = (written.curved or written).elsewhere
    # A payload is what was asked for, whatever the file beside it is worth.
    if result.payload is None and elsewhere is not None:
        remarks += judge(OF_OTHER_MOTIONS, elsewhere)
    return replace(result, file=written, remarks=tuple(remarks))


class Promise:
    """What is expected of the model files of a fit on motions that nobody recorded.

    Args:
        fitted: the fit of all terms.
    """

    def __init__(self, fitted: Fit) -> None:
        self._fitted = fitted
        self._robot = fitted.arm.robot
        thetas, links = fitted.point.thetas.copy(), fitted.point.links.copy()
        settled = settled_values(fitted)
        last = [settled[name] for name in fitted.arm.terms[LAST_LINK].names]
        thetas[-1] = links[-1] = last
        self._point = replace(fitted.point, thetas=thetas, links=links)
        # The motions of a promise are the same in every run, others than a further log's.
        self._rng = np.random.default_rng(0)
        self._highest = self._robot.limits.velocity
        self._of_log = fastest_of(
            speeds_in(fitted.recordings), np.eye(self._robot.n_joints)
        )
        self._fast = self._sums(self._highest)
        self._slowly = np.clip(self._of_log, SLOWEST, self._highest)
        self._slow = self._sums(self._slowly)
        self._known = knowledge_of(fitted, self._fast)
        self._covariance = self._known.covariance()

    def _sums(self, speeds: Array) -> Sums:
        """Return the sums of motions up to some speeds (n,) [rad/s or m/s]."""
        fitted = self._fitted
        motions = [*made_up_motions(self._robot, speeds, self._rng)]
        return sums_elsewhere(fitted.arm, self._point, motions, fitted.question.loaded)

    def of(self, file: Fit) -> Elsewhere:
        """Return what is expected of a model file, ``file`` its fit, and of the model before."""
        fitted = self._fitted
        model = dict(fitted.arm.model)
        if fitted.question.loaded:
            model.update((name, file.by_name[name]) for name in PAYLOAD_NAMES)
        before = self._errors(model, self._fast)
        after = self._errors(file.by_name, self._fast)
        of_log = self._errors(file.by_name, self._slow).errors
        speed, unit = highest_speed(self._robot, self._highest)
        log_speed, _ = highest_speed(self._robot, self._slowly)
        share = after.errors.relative_error
        to_record = ""
        if share >= FASTER * of_log.relative_error:
            to_record = after.worst_joint
        return Elsewhere(
            speed=speed,
            speed_unit=unit,
            before=before.errors,
            after=after.errors,
            at_log_speeds=of_log,
            log_speed=log_speed,
            faster=to_record,
            still=self.still,
            parts=after.largest_parts(parts_of(fitted.arm, self._fast)),
            for_like_motions=share > LIKE_LOG * before.errors.relative_error,
            next=self._next(file, share),
        )

    @property
    def still(self) -> tuple[str, ...]:
        """Names of the joints that stood still."""
        is_still = is_without_rows(self._fitted)
        return tuple(itertools.compress(self._fitted.arm.joints, is_still))

    @cached_property
    def _further(self) -> Sums:
        """The sums of further motions."""
        return self._sums(self._highest)

    def _errors(self, held: Mapping[str, float], sums: Sums) -> ExpectedSquares:
        """Return the squares of the error of a model that holds some values."""
        return largest_errors(self._known, held, sums, self._covariance)

    def _next(self, file: Fit, now: float) -> NextMotion | None:
        """Return the motion whose log lowers the promise most; None where none lowers it much.

        Of those that are nearly as good, it is the one that costs least.
        """
        expected = [
            self._after(file, self._further, motion.duration)
            for motion in FURTHER_MOTIONS
        ]
        best = min(expected)
        if best > GAIN * now:
            return None
        pairs = zip(FURTHER_MOTIONS, expected)
        motion, error = next(pair for pair in pairs if pair[1] <= AS_GOOD * best)
        return NextMotion(motion.words, error)

    def _after(self, file: Fit, sums: Sums, length: float) -> float:
        """Return the error to expect of a file after a further log, ``length`` [s] long.

        The log makes what is known better known, and the file nearer to it: with the file's normal
        equations N f = b and rows W of the log, f' = (N + W)^-1 (b + W x).
        """
        known = self._known
        covariance = known.covariance(known.rows(sums, length, known.weights))
        held = dict(self._file_after(file, sums, length))
        after = largest_errors(known, held, self._fast, covariance)
        return after.errors.relative_error

    def _file_after(
        self, file: Fit, sums: Sums, length: float
    ) -> Iterator[tuple[str, float]]:
        """Yield the names of what a file holds to their expected values after a further log."""
        names = sums.names
        weights = np.where(is_without_rows(file), self._known.weights, file.weights)
        rows = self._known.rows(sums, length, weights)
        of_file = file.at([name for name in file.names if name in names])
        at = sums.at([file.names[k] for k in of_file])
        values = np.array([file.by_name.get(name, 0.0) for name in names])
        normal = _with_zero_torque(
            file.normal[of_file[:, None], of_file] + rows[at[:, None], at]
        )
        normal[:-1, -1] = rows[at] @ (self._known.values - values)
        moved, _ = solve(normal, np.zeros(len(at)))
        values[at] += moved
        return zip(names, values.tolist())

    def limits(self) -> Iterator[str]:
        """Yield sentences on where the promise does not hold."""
        fitted = self._fitted
        if self.still:
            yield (
                f"{', '.join(self.still)} stood still: the error on other motions takes friction "
                "there to be as far off the model's as that of other joints, and rotors to be the "
                "model's"
            )
        is_fast = self._highest > FASTER * np.maximum(self._of_log, SLOWEST)
        moved = [name not in self.still for name in self._robot.joint_names]
        joints = [*itertools.compress(self._robot.joint_names, is_fast & moved)]
        if joints:
            are_all = len(joints) == len(self._robot.joint_names)
            listed = "all joints" if are_all else ", ".join(joints)
            yield (
                f"the logs are slow for {listed}: friction at twice their speed and more is not "
                "measured, so that the error to expect on other motions is more likely too high, "
                "at most twice, than too low"
            )
        offsets = fitted.arm.terms[OFFSET.name].parameters
        clear = [
            f"{each.of} {fitted.by_name[each.key]:.2g} {each.unit}"
            for each in offsets
            if abs(fitted.by_name[each.key]) > SURE * fitted.error_of(each.key)
        ]
        if clear:
            yield Detail(
                f"offsets of torque are taken to be the sensors' ({', '.join(clear)}): if a cable "
                "or a spring makes them, no number here knows how they change with the position"
            )
        yield Detail(
            "the error on other motions is of this arm as it was: after a change of its friction, "
            "or of another arm of its type, files were up to 3.4 times as far off"
        )
