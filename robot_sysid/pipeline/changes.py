"""What has changed between two sides of logs, from the one fit of both; or differs from a model.

A load of the second side, and each drift of friction, a zero, a torque scale or a torque offset
from one side to the other, is fitted alone, beside what such drifts usually are from day to day.
The likeliest of them stays if it is beyond its error, and the others are fitted again beside it.

The ± of a number is that of its measurement. It is said from a multiple of this ± and of usual
drifts together on: that which these alone reach in a share ``FALSE_ALARMS`` / k of all pairs of
logs, of k numbers that are compared (Bonferroni).

A model takes the place of the earlier side the same way: the last link, zeros, torque scales and
offsets, the tilt of the base and the delay are off as they usually are or, one after the other, by
more. Friction is no candidate: no model has it right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from itertools import chain, compress

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import OFFSET
from robot_sysid.errors import SysidError
from robot_sysid.estimate.choose import answer_of, solve_question
from robot_sysid.estimate.fit import Fit, LeftOut
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.quantities import (
    friction_columns,
    friction_errors,
    friction_sum,
)
from robot_sysid.estimate.questions import Question, arm_question
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
    Term,
)
from robot_sysid.faults.loop import run
from robot_sysid.records import Array, parameters
from robot_sysid.records.levels import (
    ALARMING,
    FALSE_ALARMS,
    SURE,
    TELLING,
    UNEXPLAINED,
)
from robot_sysid.records.messages import torque_unit
from robot_sysid.records.parameters import Parameter
from robot_sysid.records.quantities import Quantity
from robot_sysid.records.usual_errors import DELAY as DELAY_ERROR
from robot_sysid.records.usual_errors import (
    LINKS_AS_OFFSET,
    LINKS_AS_SCALE,
    LINKS_AS_TILT,
    LINKS_AS_ZERO,
    WEIGHT,
)
from robot_sysid.spatial import PARAMETER_NAMES

ALL_JOINTS = "all joints alike"
"""What a change of friction is of that is the same in all joints."""
DIFFERS = "differs"
"""Reason of a row in which the sides differ, beyond errors and what is usual from day to day."""
UNKNOWN = "not shown"
"""Reason of a row of which the logs tell too little."""
WITH_ALL = "with all joints"
"""Reason of a joint's friction that is beyond its errors where that of all joints alike differs."""
NOT_JUDGED = "differs, not judged"
"""Reason of a row of friction that the model says clearly another, as models do."""
OTHER_FRICTION = 0.5
"""Difference from the model's friction from which on it is said, as a share of that."""


class Kind(Enum):
    """What is compared; the name of its rows, but for a load, whose rows are numbers of a body."""

    LOAD = "load"
    FRICTION = "friction"
    ZERO = "zero"
    SCALE = "scale"
    OFFSET = "offset"
    DELAY = "delay"
    TILT = "tilt"
    WEIGHT = "weight"
    FRICTION_IN_MOTION = "friction in motion"
    """Of a joint, at its root mean square speed."""


# Drifts from one side to the other, and errors beside a model, to what is compared.
_DRIFTS = {
    DRIFT: Kind.FRICTION,
    ZERO_DRIFT: Kind.ZERO,
    SCALE_DRIFT: Kind.SCALE,
    OFFSET_DRIFT: Kind.OFFSET,
}
_OF_SENSORS = {
    SCALES: Kind.SCALE,
    ZEROS: Kind.ZERO,
    OFFSET.name: Kind.OFFSET,
    DELAY: Kind.DELAY,
}
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
# Most that a friction is taken to have drifted from the middle to an end, of that in the middle.
_LARGEST_FRICTION_DRIFT = 0.999
# The base's tilt about each axis, which is a number of its own.
_TILTS = tuple(
    Parameter(Kind.TILT.value, of=f"the base about {axis}", units=("rad",))
    for axis in "xy"
)


@dataclass(frozen=True)
class Change(Quantity):
    """A number of the second side less that of the first, of friction in per cent of the first.

    Its ``error`` is that of the measurement. Its reason is ``DIFFERS`` where the sides do,
    ``UNKNOWN`` where the logs show too little.

    Attributes:
        usual: what it usually is where nothing has changed, a standard deviation.
        least: the size from which on it would be named, a multiple of both together.
        kind: what is compared.
    """

    usual: float = 0.0
    least: float = 0.0
    kind: Kind = Kind.LOAD

    @property
    def least_either_way(self) -> float:
        """The size from which on it would be named whichever way it had gone.

        A friction that falls to a half has changed as much as one that doubles.
        """
        if self.kind is Kind.FRICTION and self.value < 0.0:
            return self.least / (1.0 - self.least / 100.0)
        return self.least


def change_question(
    arm: ArmTerms, options: EstimationOptions, same_day: bool = False
) -> Question:
    """Return the question in which load, friction and sensors may all have changed."""
    drifts = chain(*(arm.terms[cause].names for cause in _DRIFTS))
    changed = (*PAYLOAD_NAMES, *drifts)
    return Question(options, loaded=True, changed=changed, same_day=same_day)


@dataclass(frozen=True)
class Candidate:
    """Something that may have changed or differ.

    Attributes:
        kind: what is compared.
        names: its parameters in the fit.
        numbers: what is compared with zero: its first parameters, or the mean of all.
        whole: the whole difference over a parameter.
        is_mean: whether it is the mean of all its parameters.
    """

    kind: Kind
    names: tuple[str, ...]
    numbers: tuple[Parameter, ...]
    whole: float = 1.0
    is_mean: bool = False

    @property
    def is_body(self) -> bool:
        """Whether it is a body, with ten parameters."""
        return self.kind is Kind.LOAD

    @property
    def words(self) -> str:
        """What it is, and of what."""
        return f"{self.kind.value} of {self.numbers[0].of}"


def _body(arm: ArmTerms, names: tuple[str, ...]) -> Candidate:
    """Return the candidate of the last link, or of what hangs there."""
    of = arm.robot.body_name
    numbers = (replace(each, of=of) for each in parameters.INERTIAL[:_OF_BODY])
    return Candidate(Kind.LOAD, names, tuple(numbers))


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
    arm = fitted.arm
    terms = arm.terms
    friction = parameters.DRIFT.at(ALL_JOINTS)
    candidates = [
        _body(arm, PAYLOAD_NAMES),
        Candidate(Kind.FRICTION, terms[DRIFT].names, (friction,), _WHOLE, is_mean=True),
    ]
    for cause, kind in _DRIFTS.items():
        for parameter in terms[cause].parameters:
            candidates.append(Candidate(kind, (parameter.key,), (parameter,), _WHOLE))
    # What gears lose of a load, no model has exactly: it looks like a sensor's error.
    like_load = terms[SCALE_DRIFT].names + terms[OFFSET_DRIFT].names
    sides = _Sides(fitted, tuple(candidates), (*_DRIFTS,), like_load, weigh)
    state = run(_State(sides), _State.step)
    if state.is_too_much:
        raise SysidError(_too_much(state.changed))
    return state.rows


def weigh(fitted: Fit, is_on: bool) -> tuple[Array, Array]:
    """Return the load (10,) that came on or off as ``payload`` finds it, and its errors (10,).

    There, the heavier side carries a possible body, and neither friction nor sensors drift. What
    gears lose of a load looks like such a drift, which hides a share of it from other fits.
    """
    recordings = [
        recording.with_all_rows(is_loaded=recording.is_loaded == is_on)
        for recording in fitted.recordings
    ]
    question = Question(fitted.question.options, loaded=True)
    weighed = answer_of(solve_question(fitted.arm.robot, recordings, question))
    at = weighed.at(PAYLOAD_NAMES)
    return (1.0 if is_on else -1.0) * weighed.values[at], weighed.errors[at]


@dataclass(frozen=True)
class Differences:
    """How an arm differs from its model.

    Attributes:
        rows: the numbers that were compared; () where more differs than one arm explains.
        fit: the fit in which those that differ do so.
        is_certain: whether one of them is more than links as wrong as usual look like.
    """

    rows: tuple[Change, ...]
    fit: Fit
    is_certain: bool

    @property
    def explains(self) -> bool:
        """Whether the log fits with what differs."""
        return bool(self.rows) and self.fit.unexplained_share < UNEXPLAINED


def differences(fitted: Fit) -> Differences:
    """Return how an arm differs from its model: last link, sensors, base; and its friction.

    Args:
        fitted: fit of ``model_question`` to the logs.
    """
    arm = fitted.arm
    # A factor on all torques or masses is looked for by the checks of logs.
    candidates = [_body(arm, PARAMETER_NAMES)]
    torques = fitted.sums.rms_torque
    loaded = {*compress(arm.joints, torques > _LOADED * np.max(torques))}
    for cause, kind in _OF_SENSORS.items():
        for parameter in arm.terms[cause].parameters:
            # What a joint reads that carries next to nothing is friction, of any size.
            if cause != SCALES or parameter.of in loaded:
                candidates.append(Candidate(kind, (parameter.key,), (parameter,)))
    if TILT in arm.terms:
        candidates.append(Candidate(Kind.TILT, arm.terms[TILT].names, _TILTS))
    causes = *_OF_SENSORS, TILT, LAST_LINK
    state = run(_State(_Sides(fitted, tuple(candidates), causes)), _State.step)
    right = state.sides.fit_with(state.changed)
    if state.is_too_much:
        return Differences((), right, False)
    of_candidates = state.rows
    differing = [state.compared[each] for each in state.changed]
    is_certain = any(_is_certain(own, right) for own in differing)
    weights = [*_weights(right, fitted)]
    for row in weights:
        # What links as wrong as usual look like is in the row's bound.
        is_alarming = abs(row.value) > ALARMING * (row.error or 0.0)
        is_certain = is_certain or (row.reason == DIFFERS and is_alarming)
    rows = (*of_candidates, *weights, *_friction(fitted))
    return Differences(rows, right, is_certain)


def _is_certain(own: _Compared, fitted: Fit) -> bool:
    """Return whether what differs is more than what links as wrong as usual look like.

    Args:
        own: the candidate, in the fit in which it differs.
        fitted: that fit.
    """
    candidate = own.candidate
    usual = 0.0
    share = 1.0
    if not candidate.is_body:
        usual = _like_links(candidate.kind, candidate.numbers[0], fitted)
        share = _torque_share(fitted, candidate.names)
    is_alarming = np.abs(own.values) > ALARMING * np.hypot(own.errors, usual)
    return share > TELLING and bool(np.any(is_alarming & own.are_beyond))


def _like_links(kind: Kind, number: Parameter, fitted: Fit) -> float:
    """Return what links as wrong as usual look like as a number."""
    if kind is Kind.OFFSET:
        torque = fitted.sums.rms_torque[fitted.arm.joints.index(number.of)]
        return LINKS_AS_OFFSET * float(torque)
    size = {
        Kind.SCALE: LINKS_AS_SCALE,
        Kind.ZERO: LINKS_AS_ZERO,
        Kind.TILT: LINKS_AS_TILT,
        Kind.DELAY: DELAY_ERROR,
    }[kind]
    return size / _UNITS.get(number.unit, (number.unit, 1.0))[1]


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
    """Yield by how much the links' torque at each joint is larger than the model's [%].

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
        spread = float(np.sqrt(WEIGHT**2 + error**2 + variance / square**2))
        least = SURE * spread
        is_loaded = sums.rms_torque[sums.joints.index(joint)] > _LOADED * strongest
        is_beyond = is_loaded and abs(value) > least
        yield Change(
            Kind.WEIGHT.value,
            joint,
            "%",
            None,
            100.0 * value,
            100.0 * error,
            reason=_reason(is_beyond, is_loaded and least < 1.0),
            usual=100.0 * float(np.hypot(WEIGHT, np.sqrt(variance) / square)),
            least=100.0 * least,
            kind=Kind.WEIGHT,
        )


def _friction(fitted: Fit) -> Iterator[Change]:
    """Yield what each joint's friction is more than the model's, which is said and not judged.

    It is the torque of all terms of friction at the joint's root mean square speed and torque: how
    much of it each term has, a short motion does not tell.
    """
    arm = fitted.arm
    speeds = np.concatenate([each.motion.qd for each in fitted.recordings])
    is_used = np.concatenate([each.is_used for each in fitted.recordings])
    counts = np.maximum(np.sum(is_used, axis=0), 1)
    rms_speeds = np.sqrt(np.sum(np.where(is_used, speeds, 0.0) ** 2, axis=0) / counts)
    torques = fitted.sums.rms_torque
    for row, joint in enumerate(arm.joints):
        speed = np.array([rms_speeds[arm.indices[row]]])
        columns = friction_columns(arm, joint, speed, float(torques[row]))
        stated, value = (
            float(friction_sum(columns, values)[0])
            for values in (arm.model, fitted.by_name)
        )
        error = float(friction_errors(fitted, columns)[0])
        least = max(SURE * error, OTHER_FRICTION * stated)
        reason = NOT_JUDGED if abs(value - stated) > least else ""
        unit = torque_unit(joint in arm.robot.slides)
        kind = Kind.FRICTION_IN_MOTION
        differing = Change(kind.value, joint, unit, stated, value - stated, error)
        yield replace(differing, reason=reason, least=least, kind=kind)


@dataclass(frozen=True)
class _Sides:
    """Two sides that are compared, and what may differ between them.

    Attributes:
        fitted: the fit in which nothing differs by more than usual.
        candidates: what may differ.
        causes: of the terms whose priors say what is usual.
        like_body: names of what does not count where the body has changed.
        weigh: returns the body that came on or off by another fit; None for none.
    """

    fitted: Fit
    candidates: tuple[Candidate, ...]
    causes: tuple[str, ...]
    like_body: tuple[str, ...] = ()
    weigh: Callable[[Fit, bool], tuple[Array, Array]] | None = None

    @cached_property
    def sure(self) -> float:
        """Times its ± from which on a number is named (Bonferroni)."""
        from scipy.special import ndtri

        count = sum(len(each.numbers) for each in self.candidates)
        return float(ndtri(1.0 - 0.5 * FALSE_ALARMS / count))

    @cached_property
    def usual_terms(self) -> list[Term]:
        """Terms whose priors say what is usual."""
        return [
            term
            for term in self.fit_with(()).equations.terms
            if term.prior is not None and {term.cause, term.key} & {*self.causes}
        ]

    @cached_property
    def weighed_on(self) -> tuple[Array, Array]:
        """A body that came on, by ``weigh``."""
        assert self.weigh is not None
        return self.weigh(self.fitted, True)

    @cached_property
    def weighed_off(self) -> tuple[Array, Array]:
        """A body that came off, by ``weigh``."""
        assert self.weigh is not None
        return self.weigh(self.fitted, False)

    def fit_with(self, changed: Sequence[Candidate]) -> Fit:
        """Return the fit in which some things have changed, and all others are as usual."""
        names = tuple(chain(*(each.names for each in changed)))
        question = self.fitted.question
        if question.differing is None:
            question = replace(question, changed=names)
        else:
            question = replace(question, differing=names)
        terms = arm_question(self.fitted.arm, question, self.fitted.sums.rms_torque)
        return replace(self.fitted.refit(terms), left_out=LeftOut.EACH)

    def compared(self, candidate: Candidate, changed: Sequence[Candidate]) -> _Compared:
        """Return a candidate in the fit in which it may have changed beside others."""
        fitted = self.fit_with([*changed, candidate])
        size = len(candidate.names)
        usual = np.zeros((size, size))
        for term in self.usual_terms:
            if term.prior is not None and set(candidate.names) <= {*term.names}:
                at = [term.names.index(name) for name in candidate.names]
                usual = (term.prior.factor @ term.prior.factor.T)[np.ix_(at, at)]
        own = _Compared(fitted, candidate, usual, self.sure)
        if self.weigh is None or not (candidate.is_body and own.is_beyond):
            return own
        return own.beside(
            *(self.weighed_on if own.values[0] > 0.0 else self.weighed_off)
        )


@dataclass(frozen=True)
class _State:
    """What differs between two sides, as far as it was found; steps of the one loop of faults.

    Attributes:
        sides: that are compared.
        changed: what differs.
    """

    sides: _Sides
    changed: tuple[Candidate, ...] = ()

    @cached_property
    def compared(self) -> dict[Candidate, _Compared]:
        """Each candidate in the fit in which it may differ, beside what does."""
        every = self.sides.candidates
        return {each: self.sides.compared(each, self.changed) for each in every}

    @property
    def has_body(self) -> bool:
        """Whether a body has come on or off."""
        return any(each.is_body for each in self.changed)

    @property
    def known(self) -> set[str]:
        """Names of all that is no news any more."""
        like_body = self.sides.like_body if self.has_body else ()
        return {*chain(*(each.names for each in self.changed)), *like_body}

    @property
    def is_too_much(self) -> bool:
        """Whether more differs than one arm explains."""
        return len(self.changed) > _MOST

    def step(self) -> _State:
        """Return the state that the likeliest difference has joined, or a needless one has left."""
        if self.is_too_much:
            return self
        # What was likeliest alone may be nothing beside what came after it.
        for each in self.changed:
            if not self.compared[each].is_beyond:
                kept = tuple(other for other in self.changed if other is not each)
                return replace(self, changed=kept)
        others = [
            own
            for each, own in self.compared.items()
            if own.is_beyond and not self.known.issuperset(each.names)
        ]
        if not others:
            return self
        # Errors by the jackknife are too uncertain to choose by.
        joining = min(others, key=lambda own: own.chance).candidate
        return replace(self, changed=(*self.changed, joining))

    @property
    def rows(self) -> list[Change]:
        """A row for each number that is compared."""
        rows: list[Change] = []
        for each, own in self.compared.items():
            beyond = ""
            if each in self.changed:
                beyond = DIFFERS
            elif self.known.issuperset(each.names):
                is_like_body = {*each.names} <= {*self.sides.like_body}
                beyond = UNKNOWN if self.has_body and is_like_body else WITH_ALL
            rows += _rows(own, beyond)
        return rows


def _too_much(changed: Sequence[Candidate]) -> str:
    """Return that more differs than one arm explains."""
    parts = ", ".join(each.words for each in changed)
    return (
        f"more differs than a few changes of one arm explain ({parts}): check that both "
        "logs are of this arm, with the same columns, units and zeros"
    )


class _Compared:
    """What has changed, in a fit in which it may.

    Args:
        fitted: the fit.
        candidate: what may have changed, with k parameters.
        usual: covariance (k, k) of what is usual.
        sure: times its ± from which on a number is named.

    Attributes:
        candidate: what may have changed, with m numbers.
        sure: as the argument.
        values: (m,) what is compared with zero: of a load its mass and first moments, of several
            drifts their mean.
        errors: (m,) their standard errors.
        usual: (m,) standard deviations of what is usual.
        spreads: (m,) their standard deviations by errors and what is usual.
        chance: the chance of values as large without a change, and minus their chi-square, which
            orders chances that are too small for a number; the jackknife is left out.
    """

    def __init__(
        self, fitted: Fit, candidate: Candidate, usual: Array, sure: float
    ) -> None:
        from scipy.special import chdtrc

        self.candidate = candidate
        self.sure = sure
        at = fitted.at(candidate.names)
        formal = fitted.inverse[np.ix_(at, at)] + usual
        combinations = np.eye(len(candidate.numbers), len(at))
        if candidate.is_mean:
            weights = 1.0 / np.diag(formal)
            combinations = weights[None] / np.sum(weights)
        deviations = fitted.free[at]
        if candidate.names == PARAMETER_NAMES:
            deviations = deviations - fitted.arm.terms[LAST_LINK].reference
        self.values = combinations @ deviations
        own = fitted.covariance[np.ix_(at, at)]
        squares = combinations @ own @ combinations.T
        self.errors = np.sqrt(np.diag(squares))
        usual_squares = combinations @ usual @ combinations.T
        self.usual = np.sqrt(np.diag(usual_squares))
        self.spreads = np.hypot(self.errors, self.usual)
        spread = combinations @ formal @ combinations.T
        inverse = np.linalg.pinv(spread, hermitian=True)
        square = float(self.values @ inverse @ self.values)
        self.chance = float(chdtrc(len(self.values), square)), -square
        share = fitted.share()[at]
        # Whether the logs tell more of a number than is known without them.
        self._are_shown = share[: len(self.values)] > _SHOWN
        if candidate.is_body:
            self._are_shown = np.isfinite(fitted.errors[at])[: len(self.values)]

    def beside(self, values: Array, errors: Array) -> _Compared:
        """Return the values (k,) and errors (k,) of another fit in place of these.

        Errors contain half of what the two fits differ by.
        """
        other = copy(self)
        count = len(self.values)
        other.values = values[:count]
        apart = 0.5 * (other.values - self.values)
        other.errors = np.hypot(np.fmax(self.errors, errors[:count]), apart)
        other.spreads = np.hypot(np.fmax(self.spreads, errors[:count]), apart)
        return other

    @property
    def are_beyond(self) -> NDArray[np.bool_]:
        """Which values (m,) are beyond errors and what is usual."""
        return np.abs(self.values) > self.sure * self.spreads

    @property
    def is_beyond(self) -> bool:
        """Whether one of them is."""
        return bool(np.any(self.are_beyond))

    def is_shown(self, number: int) -> bool:
        """Return whether the logs show a number."""
        return bool(self._are_shown[number])


def _rows(own: _Compared, beyond: str) -> Iterator[Change]:
    """Yield the rows of a candidate; ``beyond`` is the reason of numbers beyond their bounds."""
    candidate = own.candidate
    bounds = own.sure * own.spreads
    for number, parameter in enumerate(candidate.numbers):
        value, bound = float(own.values[number]), float(bounds[number])
        unit, factor = _UNITS.get(parameter.unit, (parameter.unit, 1.0))
        factor *= candidate.whole
        kind = candidate.kind
        sizes = np.array([own.errors[number], own.usual[number]])
        change, least = factor * value, factor * bound
        widest = least
        error, usual = (factor * sizes).tolist()
        if kind is Kind.FRICTION:
            change, least, widest, error, usual = (
                _friction_change(each)
                for each in (
                    *(value, float(np.copysign(bound, value)), bound),
                    *sizes.tolist(),
                )
            )
        # A share that may be as large as all of it is none that is known.
        is_shown = own.is_shown(number) and (unit != "%" or widest < 100.0)
        reason = (
            beyond if own.are_beyond[number] and beyond else _reason(False, is_shown)
        )
        yield Change(
            parameter.name if kind is Kind.LOAD else kind.value,
            parameter.of,
            unit,
            None,
            change,
            error,
            reason=reason,
            usual=usual,
            least=abs(least),
            kind=kind,
        )


def _friction_change(drift: float) -> float:
    """Return the change of a friction that drifts by a share from the middle to each end [%].

    It is 1 - d on the first side and 1 + d on the second.
    """
    most = _LARGEST_FRICTION_DRIFT
    return 100.0 * float(np.expm1(2.0 * np.arctanh(np.clip(drift, -most, most))))


def _reason(is_changed: bool, is_shown: bool) -> str:
    """Return the reason of a row."""
    if is_changed:
        return DIFFERS
    return "" if is_shown else UNKNOWN
