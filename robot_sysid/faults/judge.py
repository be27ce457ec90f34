"""What a fit says of an explanation: its size, its gain, and whether it explains.

A fault is named where

(a) the fit with all that is found leaves no more unexplained than right logs do
    (``search.Search.explains``);
(b) no column that is independent of it contradicts it (``candidates``);
(c) its value is ``SURE`` of its own errors, and of a size that exists (``Score.is_sure``);
(d) it changes what was asked, or else it is a note (``Score.level``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Effect, Offer, Offers
from robot_sysid.estimate.rows import Rows, Sums
from robot_sysid.estimate.terms import (
    FRICTION,
    LAST_LINK,
    LINKS,
    PAYLOAD,
    PAYLOAD_NAMES,
    Point,
    Term,
    independent,
)
from robot_sysid.estimate.trust import most_moved
from robot_sysid.faults.plausibility import EXACT, structural
from robot_sysid.faults.table import Explanation, explanations
from robot_sysid.records import Array
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import CLEAR, INTERVAL, SURE, UNEXPLAINED
from robot_sysid.records.messages import Level, with_error
from robot_sysid.records.parameters import Parameter
from robot_sysid.spatial import PARAMETER_NAMES
from robot_sysid.wording import with_option_names

BY_SIGN = {
    "more": ("more", "less"),
    "much": ("much", "little"),
    "later": ("later", "earlier"),
    "rises": ("rises", "falls"),
    "higher": ("higher", "lower"),
    "heavier": ("heavier", "lighter"),
    "long": ("long", "short"),
    "balancer": (", or a balancer carries a part of the weight", ""),
    "larger": ("larger", "smaller"),
    "opposite": ("", ", with the opposite sign"),
}
"""Word of a text to what it is for a positive number and for a negative one."""
UNIT_SIZES = {"%": 100.0, "ms": 1e3, "degrees": np.degrees(1.0)}
"""Units that are no SI units, to their number per SI unit."""
HARMFUL_SHAPE = 0.015
"""Share of all torque that a torque of any shape at one joint has to make before a result without
it is wrong: less of it the other terms of the joint take up. Of a fault that links would follow,
``UNEXPLAINED`` counts, or that what was asked moves by an error."""
NOTED = 0.005
"""Share of all torque from which on a fault of one joint is noted: half of what logs of right
models leave unexplained."""
SURELY_CLEAR = 3.0 * CLEAR
"""Gain from which on a fault is shown that makes no more torque than friction leaves [nats]."""
MOST_WEIGHED = 8
"""Explanations that are weighed in a round: to weigh one takes much longer than to offer it."""
SLOW_SHARE = 0.5
"""Least share of what a cause explains that is not noise."""
CAUSES_IN_RESULT = (LAST_LINK, LINKS, PAYLOAD, FRICTION)
"""Causes whose numbers a result has."""
SHARED_RELIEF = 0.5
"""Gain per squared deviation from the priors that an effect relieves [nats]."""


@dataclass(frozen=True)
class Score:
    """An explanation, and what a fit says of it.

    Attributes:
        explanation: the fault.
        offer: its values, and what it leaves.
        gain: of the offer, minus the log of ``Explanation.choices``.
        fitted: the fit that it was offered to.
        errors: standard errors (10,) of what was asked, as they are printed.
    """

    explanation: Explanation
    offer: Offer
    gain: float
    fitted: Fit
    errors: Array

    @property
    def name(self) -> FaultName:
        """Name of the fault."""
        return self.explanation.fault.name

    @property
    def value(self) -> float:
        """The number, as the fit has it."""
        values = self.offer.values
        is_norm = self.explanation.fault.is_norm
        return float(np.linalg.norm(values[:3]) if is_norm else values[0])

    @property
    def error(self) -> float:
        """Standard error of the number in the fit."""
        return float(
            np.max(self.offer.errors[: 3 if self.explanation.fault.is_norm else 1])
        )

    @property
    def distance(self) -> float:
        """The value in its own errors; zero where it is of no size that exists."""
        fault = self.explanation.fault
        least, largest = fault.sizes
        if not least < self.value < min(largest, self.explanation.largest):
            return 0.0
        # What has no single number is judged by all its values.
        if fault.is_norm or not fault.has_number:
            return self.offer.distance
        return abs(self.value) / max(self.error, 1e-300)

    @property
    def is_sure(self) -> bool:
        """Whether its value is clearly not zero, and of a size that exists."""
        return self.distance >= SURE

    @cached_property
    def explained(self) -> Array:
        """Square of the torque (J,) that is left unexplained without it only."""
        left = np.maximum(self.offer.successive, 0.0) / self.fitted.sums.row_counts
        return self.fitted.unexplained**2 - left

    @property
    def share(self) -> float:
        """The torque that is left unexplained without it only, as a share of all torque."""
        explained = np.sum(np.maximum(self.explained, 0.0))
        return float(np.sqrt(explained / np.sum(self.fitted.sums.rms_torque**2)))

    @cached_property
    def is_structural(self) -> bool:
        """Whether it explains no more, at any joint that it blames, than real friction leaves."""
        is_more = self.explained > structural(self.fitted) ** 2
        joint = self.explanation.effect.joint
        return not np.any(is_more if joint is None else is_more[joint])

    @property
    def level(self) -> Level:
        """The fault's where an estimate that ignores it would be wrong, else SAYS.

        What is no more than real friction leaves is a note, unless it gains very much.
        """
        is_shown = not self.is_structural or self.gain >= SURELY_CLEAR
        return (
            self.explanation.fault.level if self.is_harmful and is_shown else Level.SAYS
        )

    @property
    def is_harmful(self) -> bool:
        """Whether it changes what was asked, or makes much of the torque."""
        explanation = self.explanation
        # What was asked may change by more than a standard error. Other terms take less for a
        # shape.
        change = np.abs(self.offer.change[self.fitted.at(asked_names(self.fitted))])
        least = HARMFUL_SHAPE if explanation.is_shape else UNEXPLAINED
        # An arm that is compared with its model is asked for no link: only its torques count.
        is_of_link = not explanation.is_shape and self.fitted.question.differing is None
        moves_links = is_of_link and (bool(np.any(change > self.errors)) or self.spoils)
        return self.share > least or moves_links

    @property
    def spoils(self) -> bool:
        """Whether links before the last, which the file holds, are wrong without it.

        What a payload is asked for, an empty and a loaded log have in common.
        """
        fitted = self.fitted
        of_links = [
            span for term, span in fitted.equations.spans if term.cause == LINKS
        ]
        if not of_links or fitted.question.loaded:
            return False
        change = np.abs(self.offer.change[of_links[0]])
        return bool(np.any(change > INTERVAL * fitted.errors[of_links[0]]))

    @property
    def is_reportable(self) -> bool:
        """Whether it explains enough for a finding."""
        explanation = self.explanation
        is_of_log = explanation.effect.joint is None
        is_of_log = is_of_log and explanation.fault.level is not Level.SAYS
        return is_of_log or self.is_harmful or self.share > NOTED

    @property
    def text(self) -> str:
        """The fault, with its number, and what it does to the estimate that has not got it."""
        text = f"{self._with_words(self.explanation.fault.text)}{self._bias}"
        log = self.explanation.log
        return f"in {log}, {text}" if log else text

    @property
    def _bias(self) -> str:
        """The words on the number of a result that is most off by the fault, in its errors."""
        if self.level is Level.REFUSES:
            return ""
        fitted = self.fitted
        # Within bounds, which the offer does not know.
        after = fit_with(fitted, [self.explanation.effect])
        terms = [t for t in fitted.equations.terms if t.cause in CAUSES_IN_RESULT]
        parameters = [parameter for term in terms for parameter in term.parameters]
        return bias_text(parameters, fitted, after)

    @property
    def remedy(self) -> str:
        """What to do, with the number."""
        return self._with_words(self.explanation.fault.remedy)

    def _with_words(self, template: str) -> str:
        """Return a text with the number and the words that its sign and its place ask for."""
        explanation = self.explanation
        unit = explanation.unit or explanation.fault.unit
        size = explanation.fault.factor * UNIT_SIZES.get(unit, 1.0)
        error = math.hypot(self.error, explanation.relative_error * self.value)
        is_negative = not self.value > 0.0
        words = {word: pair[is_negative] for word, pair in BY_SIGN.items()}
        words["value"] = with_error(size * abs(self.value), size * error, unit)
        # Values of other faults, which do not show it, may be below -1.
        words["inverse"] = f"{max(1.0 + self.value, 1e-9) ** -0.5:.3g}"
        describe = explanation.fault.describe
        if describe is not None:
            words["values"] = describe(self.fitted, self.offer)
        return with_option_names(template, {**words, **explanation.words})


def bias_text(parameters: Sequence[Parameter], fitted: Fit, after: Fit) -> str:
    """Return how far the number is off that is most of its standard errors off; "" within one.

    Args:
        parameters: those that may be named.
        fitted: a fit of torques with the fault.
        after: one without it.
    """
    if not parameters:
        return ""
    most, (off, error) = most_moved(parameters, fitted, after)
    if abs(off) <= error:
        return ""
    way = "large" if off > 0.0 else "small"
    size = with_error(abs(off), error, most.unit)
    return f", which makes the {most.words} too {way} by {size}"


def asked_names(fitted: Fit) -> tuple[str, ...]:
    """Return the names of the ten parameters that are asked for."""
    return PAYLOAD_NAMES if fitted.question.loaded else PARAMETER_NAMES


def candidates(
    fitted: Fit, effects: Sequence[Effect], errors: Array, is_time_right: bool
) -> list[Score]:
    """Return the likeliest explanations that are possible, the largest gain first.

    Of those of one fault and joint that differ in a setting, the best one counts. A fault makes
    noise slow, and hides in it: explanations are compared as if it were white, and the likeliest
    weighed with the noise that they leave.

    Args:
        fitted: the fit that they are offered to.
        effects: those that have joined it.
        errors: standard errors (10,) of what was asked, as they are printed.
        is_time_right: whether recorded velocities contradict an error of time.
    """
    white = Offers(fitted)
    best: dict[object, tuple[float, Explanation, Offer]] = {}
    for explanation in explanations(fitted):
        offer = white.offer(explanation.effect)
        gain = offer.gain - np.log(explanation.choices)
        family = (*explanation.subject, len(offer.values))
        if gain > best.get(family, (0.5 * CLEAR,))[0]:
            best[family] = gain, explanation, offer
    likeliest = sorted(best.values(), key=lambda each: -each[0])
    scores = []
    for _, explanation, offer in likeliest[:MOST_WEIGHED]:
        if leaves_noise(explanation, offer, white):
            score = weigh(explanation, offer, white, effects, errors)
            is_contradicted = score.name is FaultName.CLOCK and is_time_right
            if score.distance > INTERVAL and not is_contradicted:
                scores.append(score)
    return sorted(scores, key=lambda score: -score.gain)


def leaves_noise(explanation: Explanation, offer: Offer, white: Offers) -> bool:
    """Return whether what an explanation takes away is torque of a cause, and not noise."""
    fitted = white.fitted
    total, slow = white.slow_gain(offer)
    # Links that a joint's own shape relieves are no evidence for it. Nor is what all logs share
    # evidence for what differs between empty and loaded ones.
    is_evidence = not (explanation.is_shape or fitted.question.loaded)
    relief = SHARED_RELIEF * offer.relief * is_evidence
    # Of all joints together, no more torque may be left over than without it.
    rounding = EXACT**2 * np.sum(fitted.sums.squared_torque)
    is_less = np.sum(offer.squares) < np.sum(white.squares) + rounding
    return bool(is_less and slow + relief > max(SLOW_SHARE * (total + relief), CLEAR))


def weigh(
    explanation: Explanation,
    offer: Offer,
    white: Offers,
    effects: Sequence[Effect],
    errors: Array,
) -> Score:
    """Return the score of an explanation with the noise that it leaves.

    The instant at which a load changes is found first, to a row.
    """
    relief = SHARED_RELIEF * white.fitted.question.loaded
    if explanation.fault.name is FaultName.PAYLOAD_STEP:
        explanation, fitted = from_its_instant(
            explanation, offer, white.fitted, effects
        )
        white = Offers(fitted)
        relief = 0.0
    offer = white.weigh(explanation.effect)
    gain = offer.gain - np.log(explanation.choices) - relief * offer.relief
    return Score(explanation, offer, float(gain), white.fitted, errors)


def from_its_instant(
    explanation: Explanation, offer: Offer, fitted: Fit, effects: Sequence[Effect]
) -> tuple[Explanation, Fit]:
    """Return a change of load at the instant that fits best, and a fit with its columns."""
    instant, log = instant_of(fitted, offer)
    last = fitted.arm.terms[LAST_LINK]
    names = tuple(f"{name} from {instant:.4f} s" for name in last.names)

    def columns(rows: Rows, point: Point) -> Array:
        """Return the torque (m, J, 10) of the last link's parameters after the instant."""
        key = "after", instant
        after = rows.low_passed(key, lambda m: (m.time >= instant).astype(float))
        is_own = rows.recording.name == log
        return last.columns(rows, point) * (after * is_own)[:, None, None]

    arm = fitted.arm.beside([Term("", tuple(map(Parameter, names)), columns)])
    wider = replace(fitted, arm=arm, sums=arm.sums(fitted.recordings, fitted.point))
    words = {**explanation.words, "instant": f"{instant:.3g} s"}
    effect = Effect(names, explanation.effect.factor)
    return replace(explanation, effect=effect, words=words), fit_with(wider, effects)


def instant_of(fitted: Fit, offer: Offer) -> tuple[float, str]:
    """Return (instant at which a load changed, log): that which explains the residuals best.

    Residuals without the load count before it, those with it from then on.
    """
    assert offer.effect.shares is not None
    log = fitted.sums.logs[int(np.argmax(offer.effect.shares))]
    recordings = tuple(each for each in fitted.recordings if each.name == log)
    values = fitted.free + offer.change
    loaded = values.copy()
    loaded[fitted.at(PARAMETER_NAMES)] += offer.values
    before, after = (
        replace(fitted, recordings=recordings, values=v).residuals
        for v in (values, loaded)
    )
    better = np.nansum((before**2 - after**2) / fitted.noise**2, axis=1)
    gains = np.cumsum(better[::-1])[::-1]
    time = np.concatenate([recording.motion.time for recording in recordings])
    return float(time[np.argmax(gains)]), log


def fit_with(fitted: Fit, effects: Sequence[Effect]) -> Fit:
    """Return the fit of its terms that have columns in its sums, and of effects that join them."""
    terms = [t for t in fitted.equations.terms if t.names[0] in fitted.sums.names]
    sums, terms = with_effects(fitted.sums, terms, effects)
    return replace(fitted, sums=sums).refit(terms)


def with_effects(
    sums: Sums, terms: Sequence[Term], effects: Sequence[Effect]
) -> tuple[Sums, list[Term]]:
    """Return sums with the columns of effects, and terms with a term for each."""
    joined = [*terms]
    for effect in effects:
        size = effect.factor.shape[1]
        names = tuple(f"cause {len(sums.names)} {k}" for k in range(size))
        at = sums.at(effect.names)
        sums = sums.with_columns(names, at, effect.factor, effect.joint, effect.shares)
        prior = independent(np.ones(size))
        joined.append(Term("", tuple(map(Parameter, names)), in_sums_alone, prior))
    return sums, joined


def in_sums_alone(rows: Rows, point: Point) -> Array:
    """Raise an error: columns of an effect that has joined a fit stand in its sums alone."""
    raise NotImplementedError
