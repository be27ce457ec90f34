"""What has changed between two sides of logs, from the one fit of both.

A load of the second side, and each drift of friction, a zero, a torque scale or a torque offset
from one side to the other, is fitted alone, beside what such drifts usually are from day to day.
The likeliest of them stays if it is beyond its error, and the others are fitted again beside it.

Of k things that are compared, one is named where errors and usual drifts alone would make it as
large in a share ``FALSE_ALARMS`` / k of all pairs of logs (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from robot_sysid.errors import SysidError
from robot_sysid.estimate.fit import Fit, LeftOut
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question, arm_question
from robot_sysid.estimate.terms import (
    DRIFT,
    OFFSET_DRIFT,
    PAYLOAD_NAMES,
    SCALE_DRIFT,
    ZERO_DRIFT,
    ArmTerms,
)
from robot_sysid.records import Array, parameters
from robot_sysid.records.levels import FALSE_ALARMS
from robot_sysid.records.parameters import Parameter
from robot_sysid.results.record import Quantity

ALL_JOINTS = "all joints alike"
"""What a change of friction is of that is the same in all joints."""
DIFFERS = "differs"
"""Reason of a row in which the sides differ, beyond errors and what is usual from day to day."""
UNKNOWN = "not shown"
"""Reason of a row of which the logs tell too little."""
_DRIFTS = (DRIFT, ZERO_DRIFT, SCALE_DRIFT, OFFSET_DRIFT)
# Least share of a number that comes from the data, and not from its prior.
_SHOWN = 0.75
# Most changes at once. A log of another arm, or in other columns, needs more.
_MOST = 3
# Unit of a drift from the middle to an end to the unit and the number of the whole change.
_UNITS = {"rad": ("degrees", np.degrees(2.0)), "": ("%", 200.0)}


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


def changes(fitted: Fit) -> list[Change]:
    """Return what may have changed: the last link, friction, zeros, torque sensors.

    Args:
        fitted: fit of ``change_question`` to both sides, whose recordings have the order -1 and 1.

    Raises:
        SysidError: more would have changed than changes of one arm explain.
    """
    from scipy.special import ndtri

    terms = fitted.arm.terms
    candidates = {
        PAYLOAD_NAMES: Parameter("load", of=fitted.arm.robot.body_name),
        terms[DRIFT].names: parameters.DRIFT.at(ALL_JOINTS),
    }
    for parameter in chain(*(terms[cause].parameters for cause in _DRIFTS)):
        candidates[parameter.key,] = parameter
    level = FALSE_ALARMS / len(candidates)
    sure = float(ndtri(1.0 - 0.5 * level))
    usual: dict[str, float] = {}
    for term in _fit_with(fitted, []).equations.terms:
        if term.cause in _DRIFTS and term.prior is not None:
            usual.update(zip(term.names, term.prior.variances.tolist()))
    changed: list[tuple[str, ...]] = []
    while True:
        fits = {names: _fit_with(fitted, [*changed, names]) for names in candidates}
        compared = {n: _Compared(fits[n], n, usual) for n in candidates}
        # What was likeliest alone may be nothing beside what came after it.
        needless = [n for n in changed if compared[n].chance(True)[0] > level]
        if needless:
            changed.remove(needless[0])
            continue
        known = {*chain(*changed)}
        if PAYLOAD_NAMES in changed:
            # What gears lose of a load, no model has exactly: it looks like a sensor's error.
            known.update(terms[SCALE_DRIFT].names, terms[OFFSET_DRIFT].names)
        others = [names for names in candidates if not known.issuperset(names)]
        # Errors by the jackknife are too uncertain to choose by.
        likeliest = min(others, key=lambda names: compared[names].chance(False))
        if compared[likeliest].chance(True)[0] > level:
            break
        changed.append(likeliest)
        if len(changed) > _MOST:
            parts = [candidates[names] for names in changed]
            listed = ", ".join(f"{_name(each)} of {each.of}" for each in parts)
            raise SysidError(
                f"more differs than a few changes of one arm explain ({listed}): check that both "
                "logs are of this arm, with the same columns, units and zeros"
            )
    rows: list[Change] = []
    for names, parameter in candidates.items():
        make = _load if names == PAYLOAD_NAMES else _drift
        rows += make(compared[names], parameter, names in changed, sure)
    return rows


def _fit_with(fitted: Fit, changed: Sequence[tuple[str, ...]]) -> Fit:
    """Return the fit in which some parameters have changed, and all others drift as usual."""
    question = replace(fitted.question, changed=tuple(chain(*changed)))
    terms = arm_question(fitted.arm, question, fitted.sums.rms_torque)
    return replace(fitted.refit(terms), left_out=LeftOut.EACH)


class _Compared:
    """What has changed, in a fit in which it may.

    Args:
        fitted: the fit.
        names: (k,) of its parameters.
        usual: name of a drift to its variance from day to day.

    Attributes:
        values: (m,) what is compared with zero: of a load its mass and first moments, of several
            drifts their mean.
    """

    def __init__(
        self, fitted: Fit, names: Sequence[str], usual: Mapping[str, float]
    ) -> None:
        self.fitted = fitted
        self.at = fitted.at(names)
        self._usual = np.diag([usual.get(name, 0.0) for name in names])
        weights = 1.0 / np.diag(self._covariance(False))
        self._combinations = weights[None] / np.sum(weights)
        if names == PAYLOAD_NAMES:
            self._combinations = np.eye(4, len(names))
        self.values = self._combinations @ fitted.free[self.at]

    def _covariance(self, jackknife: bool) -> Array:
        """Return the covariance (k, k) of errors and usual drifts."""
        covariance = self.fitted.covariance if jackknife else self.fitted.inverse
        return covariance[np.ix_(self.at, self.at)] + self._usual

    def spread(self, jackknife: bool = True) -> Array:
        """Return the covariance (m, m) of the values by errors and usual drifts."""
        return self._combinations @ self._covariance(jackknife) @ self._combinations.T

    @property
    def error(self) -> float:
        """Standard error of a single value."""
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
    values = own.fitted.free[own.at]
    errors = own.fitted.errors[own.at]
    distances = np.abs(values) / errors
    least = min(sure, np.max(distances[:4]))
    numbers = zip(parameters.INERTIAL, values, errors, distances)
    for entry, value, error, distance in numbers:
        reason = _reason(is_changed and distance >= least, np.isfinite(error))
        yield Change(
            entry.name,
            load.of,
            entry.unit,
            None,
            value,
            error,
            reason=reason,
            least=sure * error,
        )


def _drift(
    own: _Compared, parameter: Parameter, is_changed: bool, sure: float
) -> Iterator[Change]:
    """Yield the change of a joint's friction, zero, torque scale or torque offset."""
    (value,) = own.values
    unit, factor = _UNITS.get(parameter.unit, (parameter.unit, 2.0))
    least = sure * float(np.sqrt(own.spread()[0, 0]))
    change = factor * np.array([value, own.error, least])
    name = _name(parameter)
    if name == "friction":
        # It is 1 - d on the first side and 1 + d on the second: the logarithm of their ratio.
        ratio = np.exp(2.0 * np.arctanh(np.clip(value, -0.9, 0.9)))
        change = 100.0 * np.array(
            [ratio - 1.0, 2.0 * ratio * own.error, np.expm1(2.0 * least)]
        )
    yield Change(
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
