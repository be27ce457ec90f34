"""What has changed between two sides of logs, from the one fit of both; or differs from a model.

A load of the second side, and each drift of friction, a zero, a torque scale or a torque offset
from one side to the other, is fitted alone, beside what such drifts usually are from day to day.
The likeliest of them stays if it is beyond its error, and the others are fitted again beside it.

Of k things that are compared, one is named where errors and usual drifts alone would make it as
large in a share ``FALSE_ALARMS`` / k of all pairs of logs (Bonferroni).

A model takes the place of the earlier side the same way: the last link, zeros, torque scales and
offsets, the tilt of the base and the delay are off as they usually are or, one after the other, by
more. Friction is no candidate: no model has it right.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, compress

import numpy as np

from robot_sysid.dynamics.friction import OFFSET
from robot_sysid.errors import SysidError
from robot_sysid.estimate.fit import Fit, LeftOut
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question, arm_question
from robot_sysid.estimate.result import friction_columns
from robot_sysid.estimate.terms import (
    DELAY,
    DRIFT,
    LAST_LINK,
    LINKS,
    OFFSET_DRIFT,
    PAYLOAD_NAMES,
    SCALE_DRIFT,
    SCALES,
    TILT,
    ZERO_DRIFT,
    ZEROS,
    ArmTerms,
)
from robot_sysid.records import Array, parameters
from robot_sysid.records.levels import ALARMING, FALSE_ALARMS, SURE, TELLING
from robot_sysid.records.messages import torque_unit
from robot_sysid.records.parameters import Parameter
from robot_sysid.records.usual_errors import DELAY as DELAY_ERROR
from robot_sysid.records.usual_errors import (
    LINKS_AS_OFFSET,
    LINKS_AS_SCALE,
    LINKS_AS_TILT,
    LINKS_AS_ZERO,
    WEIGHT,
)
from robot_sysid.results.record import Quantity
from robot_sysid.spatial import PARAMETER_NAMES

ALL_JOINTS = "all joints alike"
"""What a change of friction is of that is the same in all joints."""
DIFFERS = "differs"
"""Reason of a row in which the sides differ, beyond errors and what is usual from day to day."""
UNKNOWN = "not shown"
"""Reason of a row of which the logs tell too little."""
FRICTION_ROW = "friction in motion"
"""Name of a row of the friction of a joint at its root mean square speed."""
_DRIFTS = (DRIFT, ZERO_DRIFT, SCALE_DRIFT, OFFSET_DRIFT)
# Least share of a number that comes from the data, and not from its prior.
_SHOWN = 0.75
# Most changes at once. A log of another arm, or in other columns, needs more.
_MOST = 3
# Unit of a number to that of a row, and the number of it.
_UNITS = {"rad": ("degrees", np.degrees(1.0)), "": ("%", 100.0), "s": ("ms", 1e3)}
# A drift is that from the middle to an end, and a change the whole of it.
_WHOLE = 2.0
# Least torque of a joint whose weight is compared, over the strongest joint's: a wrist's is that of
# one link, which may be 40 % off.
_LOADED = 0.1
# Parameters of a body that are compared: mass and first moments.
_OF_BODY = 4


@dataclass(frozen=True)
class Change(Quantity):
    """A number of the second side less that of the first, of friction in per cent of the first.

    Its reason is ``DIFFERS`` where the sides do, ``UNKNOWN`` where the logs show too little.

    Attributes:
        least: the size from which on it would be named.
    """

    least: float = 0.0


def change_question(arm: ArmTerms, options: EstimationOptions) -> Question:
    """Return the question in which load, friction and sensors may all have changed."""
    drifts = chain(*(arm.terms[cause].names for cause in _DRIFTS))
    return Question(options, loaded=True, changed=(*PAYLOAD_NAMES, *drifts))


@dataclass(frozen=True)
class Candidate:
    """Something that may have changed or differ.

    Attributes:
        names: its parameters in the fit.
        parameter: what it is, and of what.
        compared: how many of its parameters are compared with zero; 0 for the mean of all.
    """

    names: tuple[str, ...]
    parameter: Parameter
    compared: int = 1

    @property
    def is_body(self) -> bool:
        """Whether it is a body, with ten parameters."""
        return self.compared == _OF_BODY


def model_question(options: EstimationOptions) -> Question:
    """Return the question in which an arm is as far from its model as arms usually are."""
    return Question(options, differing=())


def changes(fitted: Fit) -> list[Change]:
    """Return what may have changed: the last link, friction, zeros, torque sensors.

    Args:
        fitted: fit of ``change_question`` to both sides, whose recordings have the order -1 and 1.

    Raises:
        SysidError: more would have changed than changes of one arm explain.
    """
    terms = fitted.arm.terms
    load = Parameter("load", of=fitted.arm.robot.body_name)
    friction = parameters.DRIFT.at(ALL_JOINTS)
    candidates = [
        Candidate(PAYLOAD_NAMES, load, _OF_BODY),
        Candidate(terms[DRIFT].names, friction, 0),
    ]
    for parameter in chain(*(terms[cause].parameters for cause in _DRIFTS)):
        candidates.append(Candidate((parameter.key,), parameter))
    # What gears lose of a load, no model has exactly: it looks like a sensor's error.
    like_load = terms[SCALE_DRIFT].names + terms[OFFSET_DRIFT].names
    return _Comparison(fitted, candidates, _DRIFTS, like_load, _WHOLE).rows()


@dataclass(frozen=True)
class Differences:
    """How an arm differs from its model.

    Attributes:
        rows: the numbers that were compared.
        fit: the fit in which those that differ do so.
        is_certain: whether one of them is more than links as wrong as usual look like.
    """

    rows: tuple[Change, ...]
    fit: Fit
    is_certain: bool


def differences(fitted: Fit) -> Differences:
    """Return how an arm differs from its model: last link, sensors, base; and its friction.

    Args:
        fitted: fit of ``model_question`` to the logs.

    Raises:
        SysidError: more would differ than differences of one arm explain.
    """
    arm = fitted.arm
    body = Parameter("load", of=arm.robot.body_name)
    # A factor on all torques or masses is looked for by the checks of logs.
    candidates = [Candidate(PARAMETER_NAMES, body, _OF_BODY)]
    torques = fitted.sums.rms_torque
    loaded = {*compress(arm.joints, torques > _LOADED * np.max(torques))}
    for cause in (SCALES, ZEROS, OFFSET.name, DELAY):
        for parameter in arm.terms[cause].parameters:
            # What a joint reads that carries next to nothing is friction, of any size.
            if cause != SCALES or parameter.of in loaded:
                candidates.append(Candidate((parameter.key,), parameter))
    if TILT in arm.terms:
        names = arm.terms[TILT].names
        candidates.append(Candidate(names, Parameter("tilt", units=("rad",)), 2))
    causes = SCALES, ZEROS, OFFSET.name, DELAY, TILT, LAST_LINK
    comparison = _Comparison(fitted, candidates, causes, (), 1.0)
    rows = (*comparison.rows(), *_weights(comparison.right, fitted), *_friction(fitted))
    is_certain = any(
        row.reason == DIFFERS and _is_certain(row, comparison.right, candidates)
        for row in rows
    )
    return Differences(rows, comparison.right, is_certain)


def _is_certain(row: Change, fitted: Fit, candidates: Sequence[Candidate]) -> bool:
    """Return whether a row that differs is more than what links as wrong as usual look like.

    Args:
        row: of a candidate, or of the weight of all links, whose bound has these links in it.
        fitted: the fit in which it differs.
        candidates: all that were compared.
    """
    usual = 0.0
    share = 1.0
    for each in candidates:
        if not each.is_body and (_name(each.parameter), each.parameter.of) == (
            row.name,
            row.of,
        ):
            usual = _like_links(row, fitted)
            share = _torque_share(fitted, each.names)
    error = float(np.hypot(row.error or 0.0, usual))
    return share > TELLING and abs(row.value) > ALARMING * error


def _like_links(row: Change, fitted: Fit) -> float:
    """Return what links as wrong as usual look like as a row's number, in its unit."""
    if row.name == "offset":
        torque = fitted.sums.rms_torque[fitted.arm.joints.index(row.of)]
        return LINKS_AS_OFFSET * float(torque)
    return {
        "scale": LINKS_AS_SCALE,
        "zero": LINKS_AS_ZERO,
        "tilt": LINKS_AS_TILT,
        "delay": DELAY_ERROR,
    }[row.name]


def _torque_share(fitted: Fit, names: Sequence[str]) -> float:
    """Return which share of all torque the named parameters make, root mean square."""
    sums = fitted.sums
    values = np.zeros(len(sums.names) + 1)
    values[sums.at(names)] = fitted.free[fitted.at(names)]
    squares = sum(
        float(values[columns] @ total @ values[columns]) / count
        for columns, total, count in zip(sums.columns, sums.totals, sums.row_counts)
    )
    return float(np.sqrt(squares / np.sum(sums.rms_torque**2)))


def _weights(fitted: Fit, usual: Fit) -> Iterator[Change]:
    """Yield by how much the links' torque at each joint is larger than the model's.

    What is usual of it is what the priors of the links say, in the fit in which nothing differs.

    With products G of a joint's rows, the model's links m and their deviations d it is
    m' G d / m' G m: what a factor on the model's torque would be.
    """
    sums = fitted.sums
    terms = fitted.arm.terms
    names = [*terms[LAST_LINK].names]
    stated = [*terms[LAST_LINK].reference]
    if LINKS in terms:
        names += terms[LINKS].names
        stated += [*terms[LINKS].reference]
    reference = np.zeros(len(sums.names))
    reference[sums.at(names)] = stated
    index = fitted.equations.index
    is_of_link = np.isin(fitted.names, names)
    strongest = float(np.max(sums.rms_torque))
    change = np.where(is_of_link, fitted.free - reference[index], 0.0)
    priors = [
        (sums.at(term.names), term.prior.factor)
        for term in usual.equations.terms
        if term.prior is not None and term.cause in (LAST_LINK, LINKS)
    ]
    for joint, columns, total in zip(sums.joints, sums.columns, sums.totals):
        own = np.append(reference, 0.0)[columns]
        slope = np.zeros(len(reference) + 1)
        slope[columns] = total @ own
        square = float(own @ total @ own)
        if square <= 0.0:
            continue
        slopes = np.where(is_of_link, slope[index], 0.0) / square
        value = float(slopes @ change)
        error = max(float(slopes @ fitted.covariance @ slopes), 0.0) ** 0.5
        variance = sum(
            float(np.sum((slope[at] @ factor) ** 2)) for at, factor in priors
        )
        least = SURE * float(np.sqrt(WEIGHT**2 + error**2 + variance / square**2))
        is_loaded = sums.rms_torque[sums.joints.index(joint)] > _LOADED * strongest
        is_beyond = is_loaded and abs(value) > least
        yield Change(
            "weight",
            joint,
            "%",
            None,
            100.0 * value,
            100.0 * error,
            reason=_reason(is_beyond, least < 1.0),
            least=100.0 * least,
        )


def _friction(fitted: Fit) -> Iterator[Change]:
    """Yield what each joint's friction is more than the model's, which is said and not judged.

    It is the torque of all terms of friction at the joint's root mean square speed and torque: how
    much of it each term has, a short motion does not tell.
    """
    arm = fitted.arm
    speeds = np.concatenate([each.motion.qd for each in fitted.recordings])
    used = np.concatenate([each.used for each in fitted.recordings])
    counts = np.maximum(np.sum(used, axis=0), 1)
    rms_speeds = np.sqrt(np.sum(np.where(used, speeds, 0.0) ** 2, axis=0) / counts)
    torques = fitted.sums.rms_torque
    for row, joint in enumerate(arm.joints):
        speed = np.array([rms_speeds[arm.indices[row]]])
        slopes = np.zeros(len(fitted.names))
        stated = 0.0
        columns = friction_columns(arm, joint, speed, float(torques[row]))
        for key, column in columns.items():
            stated += float(column[0]) * arm.model.get(key, 0.0)
            if key in fitted.names:
                slopes[fitted.at([key])] = column[0]
        value = float(slopes @ fitted.values)
        error = max(float(slopes @ fitted.covariance @ slopes), 0.0) ** 0.5
        unit = torque_unit(joint in arm.robot.slides)
        yield Change(FRICTION_ROW, joint, unit, stated, value - stated, error)


class _Comparison:
    """What differs between two sides, in fits in which one thing after the other may.

    Args:
        fitted: the fit in which nothing differs by more than usual.
        candidates: what may differ.
        causes: of the terms whose priors say what is usual.
        like_body: names of what does not count where the body has changed.
        whole: the whole difference over a parameter that is no body's.

    Attributes:
        right: the fit in which what differs does so, after ``rows``.
    """

    def __init__(
        self,
        fitted: Fit,
        candidates: Sequence[Candidate],
        causes: Sequence[str],
        like_body: Sequence[str],
        whole: float,
    ) -> None:
        self._fitted = fitted
        self._candidates = candidates
        self._like_body = like_body
        self._whole = whole
        self.right = fitted
        self._names = tuple(chain(*(candidate.names for candidate in candidates)))
        self._usual_terms = [
            term
            for term in self._fit_with([]).equations.terms
            if term.prior is not None and {term.cause, term.key} & {*causes}
        ]

    def rows(self) -> list[Change]:
        """Return a row for each number that is compared; SysidError where too much differs."""
        from scipy.special import ndtri

        level = FALSE_ALARMS / len(self._candidates)
        sure = float(ndtri(1.0 - 0.5 * level))
        changed: list[Candidate] = []
        while True:
            compared = {
                each: self._compared(each, changed) for each in self._candidates
            }
            # What was likeliest alone may be nothing beside what came after it.
            needless = [n for n in changed if compared[n].chance(True)[0] > level]
            if needless:
                changed.remove(needless[0])
                continue
            known = {*chain(*(each.names for each in changed))}
            if any(each.is_body for each in changed):
                known.update(self._like_body)
            others = [each for each in compared if not known.issuperset(each.names)]
            # Errors by the jackknife are too uncertain to choose by.
            chances = [compared[each].chance(False) for each in others]
            likeliest = others[chances.index(min(chances))]
            if compared[likeliest].chance(True)[0] > level:
                break
            changed.append(likeliest)
            if len(changed) > _MOST:
                raise SysidError(_too_much(changed))
        self.right = self._fit_with(changed)
        rows: list[Change] = []
        for each, own in compared.items():
            if each.is_body:
                rows += _load(own, each.parameter, each in changed, sure)
            else:
                rows.append(_single(own, each, each in changed, sure, self._whole))
        return rows

    def _fit_with(self, changed: Sequence[Candidate]) -> Fit:
        """Return the fit in which some things have changed, and all others are as usual."""
        names = tuple(chain(*(each.names for each in changed)))
        question = self._fitted.question
        if question.differing is None:
            question = replace(question, changed=names)
        else:
            question = replace(question, differing=names)
        terms = arm_question(self._fitted.arm, question, self._fitted.sums.rms_torque)
        return replace(self._fitted.refit(terms), left_out=LeftOut.EACH)

    def _compared(
        self, candidate: Candidate, changed: Sequence[Candidate]
    ) -> _Compared:
        """Return a candidate in the fit in which it may have changed beside others."""
        fitted = self._fit_with([*changed, candidate])
        size = len(candidate.names)
        usual = np.zeros((size, size))
        for term in self._usual_terms:
            if term.prior is not None and set(candidate.names) <= {*term.names}:
                at = [term.names.index(name) for name in candidate.names]
                usual = (term.prior.factor @ term.prior.factor.T)[np.ix_(at, at)]
        return _Compared(fitted, candidate, usual)


def _too_much(changed: Sequence[Candidate]) -> str:
    """Return that more differs than one arm explains."""
    parts = [f"{_name(each.parameter)} of {each.parameter.of}" for each in changed]
    return (
        f"more differs than a few changes of one arm explain ({', '.join(parts)}): check that both "
        "logs are of this arm, with the same columns, units and zeros"
    )


class _Compared:
    """What has changed, in a fit in which it may.

    Args:
        fitted: the fit.
        candidate: what may have changed, with k parameters.
        usual: covariance (k, k) of what is usual.

    Attributes:
        at: (k,) indices of its parameters among the estimated ones.
        deviations: (k,) their values less the model's.
        values: (m,) what is compared with zero: of a load its mass and first moments, of several
            drifts their mean.
    """

    def __init__(self, fitted: Fit, candidate: Candidate, usual: Array) -> None:
        self.fitted = fitted
        self.at = fitted.at(candidate.names)
        self._usual = usual
        weights = 1.0 / np.diag(self._covariance(False))
        self._combinations = weights[None] / np.sum(weights)
        if candidate.compared:
            self._combinations = np.eye(candidate.compared, len(candidate.names))
        self.deviations = fitted.free[self.at]
        if candidate.names == PARAMETER_NAMES:
            self.deviations = self.deviations - fitted.arm.terms[LAST_LINK].reference
        self.values = self._combinations @ self.deviations

    def _covariance(self, jackknife: bool) -> Array:
        """Return the covariance (k, k) of errors and usual differences."""
        covariance = self.fitted.covariance if jackknife else self.fitted.inverse
        return covariance[np.ix_(self.at, self.at)] + self._usual

    def spread(self, jackknife: bool = True) -> Array:
        """Return the covariance (m, m) of the values by errors and usual differences."""
        return self._combinations @ self._covariance(jackknife) @ self._combinations.T

    @cached_property
    def usual_variances(self) -> Array:
        """Usual variance (k,) of each parameter."""
        return np.diag(self._usual)

    @property
    def error(self) -> float:
        """Standard error of the first value."""
        usual = self._combinations @ self._usual @ self._combinations.T
        return float(np.sqrt(self.spread()[0, 0] - usual[0, 0]))

    def chance(self, jackknife: bool) -> tuple[float, float]:
        """Return the chance of values as large without a change, and minus their chi-square.

        The latter orders chances that are too small for a number.
        """
        from scipy.special import chdtrc

        inverse = np.linalg.pinv(self.spread(jackknife), hermitian=True)
        square = float(self.values @ inverse @ self.values)
        return float(chdtrc(len(self.values), square)), -square

    @property
    def is_shown(self) -> bool:
        """Whether the logs tell more of the first value than is known without them."""
        return bool(np.max(self.fitted.share()[self.at[:1]]) > _SHOWN)


def _load(
    own: _Compared, load: Parameter, is_changed: bool, sure: float
) -> Iterator[Change]:
    """Yield the changes of the last link's ten parameters."""
    values = own.deviations
    errors = own.fitted.errors[own.at]
    spreads = np.sqrt(errors**2 + own.usual_variances)
    distances = np.abs(values) / spreads
    least = min(sure, np.max(distances[:_OF_BODY]))
    numbers = zip(parameters.INERTIAL, values, errors, spreads, distances)
    for entry, value, error, spread, distance in numbers:
        reason = _reason(is_changed and distance >= least, np.isfinite(error))
        yield Change(
            entry.name,
            load.of,
            entry.unit,
            None,
            value,
            error,
            reason=reason,
            least=sure * spread,
        )


def _single(
    own: _Compared, candidate: Candidate, is_changed: bool, sure: float, whole: float
) -> Change:
    """Return the change of a joint's friction, zero, torque scale or offset, or of the base."""
    parameter = candidate.parameter
    value = float(own.values[0])
    if len(own.values) > 1:
        value = float(np.linalg.norm(own.values))
    unit, factor = _UNITS.get(parameter.unit, (parameter.unit, 1.0))
    least = sure * float(np.sqrt(own.spread()[0, 0]))
    change = whole * factor * np.array([value, own.error, least])
    name = _name(parameter)
    if name == "friction":
        # It is 1 - d on the first side and 1 + d on the second: the logarithm of their ratio.
        ratio = np.exp(2.0 * np.arctanh(np.clip(value, -0.9, 0.9)))
        change = 100.0 * np.array(
            [ratio - 1.0, 2.0 * ratio * own.error, np.expm1(2.0 * least)]
        )
    return Change(
        name,
        parameter.of,
        unit,
        None,
        float(change[0]),
        float(change[1]),
        # A share that may be as large as all of it is none that is known.
        reason=_reason(is_changed, own.is_shown and (unit != "%" or change[2] < 100.0)),
        least=float(change[2]),
    )


def _name(parameter: Parameter) -> str:
    """Return what drifts: "friction", "zero", "scale" or "offset"."""
    is_friction = parameter.name == parameters.DRIFT.name
    return "friction" if is_friction else parameter.name.removesuffix("_drift")


def _reason(is_changed: bool, is_shown: bool) -> str:
    """Return the reason of a row."""
    if is_changed:
        return DIFFERS
    return "" if is_shown else UNKNOWN
