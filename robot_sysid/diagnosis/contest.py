"""What is wrong with a log or its model: explanations and corrections compete by evidence.

A log is fitted first. Each explanation is one more term of the same fit, and is scored by the gain
in log marginal likelihood, both fits with the noise that it leaves; corrections of mistaken columns
(``relabelling``) by that of the corrected log. The best one is named where it gains ``CLEAR`` nats,
together with the explanations within ``TIE`` nats of it, because the log cannot distinguish them.
Then it joins the fit, and the others are scored again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter

import numpy as np

from robot_sysid.diagnosis import Finding
from robot_sysid.diagnosis.causes import Explanation, explanations
from robot_sysid.diagnosis.log_fit import LogFit, compare, dry_friction, log_rows
from robot_sysid.diagnosis.relabelling import (
    SMALLER,
    Correction,
    common_scale,
    corrections,
    odd_unit_finding,
)
from robot_sysid.dynamics import spatial
from robot_sysid.estimate.choose import CLEAR
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import PER_CENT
from robot_sysid.estimate.rows import Recording
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.messages import Level, percent, with_error

TIE = 6.0
"""Difference in gain within which two explanations count as equally likely [nats]."""
LEAST_SHARE = 0.015
"""Share of the torque that an explanation of one joint, or a mere note, has to exceed to be
reported."""
LEAST_OF_JOINT = 0.06
"""Share of a joint's own torque that is enough of a hum or a ripple."""
MATTERS = 1.0
"""Change of a parameter of the last link, in standard errors, above which the explanation that
causes it is harmful."""
HARMFUL_SHARE = 0.05
"""Share of the torque above which an explanation is harmful."""
MOST_NAMES = 3
"""Largest number of explanations that are named together."""
UNEXPLAINED = 0.05
"""Share of unexplained torque above which no cause is named: logs without faults have 0.03."""
ODD_LINKS = 7.25
"""Factor on the stated uncertainty of links' masses, as the log shows it, above which it is said:
models of siblings reach 6.1 to 7.7, but one right arm in forty with a link that is 40 % off 8.0.
No torque tells these apart, but models of other arms leave more than 1 % of it unexplained."""
OTHER_ARM = 0.3
"""Share of unexplained torque above which the model is taken for that of another arm."""
LIKE_GRAVITY = ("force", "gravity", "tilt", "payload-step")
"""Checks whose explanations may stand for gravity in another direction."""
FRICTIONLESS = 0.004
"""Largest error of dry friction, as a share of the torque, with which none can be told."""
EXACT = 0.001
"""Error of filtering in dry friction, as a share of the joint's torque."""
MEASURED = "record the measured joint torque"
RIGHT_MODEL = "check that the model is of this arm, with all that is fixed to its links"
# Number of explanations whose noise is estimated anew in each round.
_REFITTED = 6
# Least gain of an explanation before that, at white noise [nats].
_WORTH = 8.0
# Largest number of explanations and corrections that act together.
_MOST_ROUNDS = 5


@dataclass(frozen=True)
class Score:
    """An explanation in the fit of a log.

    Attributes:
        explanation: the fault.
        gain: in log marginal likelihood [nats], minus the log of ``Explanation.choices``.
        before: fit that it was added to.
        log: the log with it.
    """

    explanation: Explanation
    gain: float
    before: Fit
    log: LogFit

    @property
    def values(self) -> tuple[Array, Array]:
        """Values (e,) of the parameters, and their standard errors (e,)."""
        at = self.log.fit.at(self.explanation.term.names)
        return self.log.fit.free[at], np.sqrt(np.diag(self.log.fit.inverse)[at])

    @cached_property
    def torque(self) -> Array:
        """Standard deviation (J,) of the explanation's torque over time [N m]."""
        names = self.explanation.term.names
        return np.std(self.log.rows.torque_of(names, self.values[0]), axis=0)

    @property
    def torque_share(self) -> float:
        """The explanation's torque as a share of all torque."""
        typical = self.log.rows.typical_torque
        return float(np.linalg.norm(self.torque) / np.linalg.norm(typical))

    @property
    def is_gross(self) -> bool:
        """Whether the first value is as large as is harmful in any case."""
        return abs(self.values[0][0]) >= self.explanation.harmful_from

    @property
    def is_reportable(self) -> bool:
        """Whether the explanation is large enough for a finding."""
        explanation = self.explanation
        is_of_log = explanation.joint is None and explanation.level is not Level.SAYS
        shares = self.torque / self.log.rows.typical_torque
        is_wave = explanation.is_norm and bool(np.max(shares) > LEAST_OF_JOINT)
        is_large = self.torque_share > LEAST_SHARE or is_wave
        return is_of_log or is_large or self.is_gross

    @property
    def level(self) -> Level:
        """The explanation's level where an estimate that ignores it would be wrong, else SAYS.

        It would be if a parameter of the last link changes by more than ``MATTERS`` standard
        errors, or more than ``HARMFUL_SHARE`` of the torque is explained.
        """
        explanation = self.explanation
        if explanation.level is Level.REFUSES:
            return Level.REFUSES
        last = self.before.at(spatial.PARAMETER_NAMES)
        moved = self.log.fit.free[self.log.fit.at(spatial.PARAMETER_NAMES)]
        change = np.abs(moved - self.before.free[last])
        errors = np.sqrt(np.diag(self.before.inverse)[last])
        is_harmful = (
            self.is_gross
            or np.any(change > MATTERS * errors)
            or self.torque_share > HARMFUL_SHARE
        )
        return explanation.level if is_harmful else Level.SAYS


class Contest:
    """The fit of a log, with the methods that score explanations.

    Args:
        log: the fit of a log.
        advance: is called after each explanation that is tried.
        found: explanations that act in it.

    Attributes:
        log: the fit with the explanations that are found, its rows with the columns of all.
        offered: the explanations.
    """

    def __init__(
        self,
        log: LogFit,
        advance: Callable[[], object],
        found: Sequence[Explanation] = (),
    ) -> None:
        self.log = log
        self._advance = advance
        self.offered: list[Explanation] = []
        self.offer([*found, *explanations(log.fit)])

    def offer(self, more: Sequence[Explanation]) -> None:
        """Offer more explanations, and give the rows their columns."""
        self.offered += more
        fitted = self.log.fit
        terms = [explanation.term for explanation in self.offered]
        rows = log_rows(fitted.arm, fitted.recordings, fitted.point, terms)
        self.log = replace(self.log, rows=rows)

    def score(self, explanation: Explanation) -> Score:
        """Return the score of an explanation; both fits have the noise that it leaves."""
        self._advance()
        log = self.log
        term = explanation.term
        terms = [*log.fit.equations.terms, term]
        wider = log.rows.fit(terms, log.fit, np.ones(len(log.fit.noise)))
        after = replace(log, fit=wider, found=(*log.found, term))
        gain, after = compare(log, after)
        return Score(explanation, gain - np.log(explanation.choices), log.fit, after)

    def ranked(self) -> list[Score]:
        """Return the scores of the best explanations that are possible, the largest gain first.

        Of those of one check and joint that differ in a setting, the best one counts. A fault makes
        noise slow, and hides in it: explanations are compared as if it were white.
        """
        current = self.log.fit
        ones = np.ones(len(current.noise))
        white = self.log.rows.fit(current.equations.terms, current, ones)
        best: dict[object, tuple[float, Explanation]] = {}
        for explanation in self.offered:
            if explanation.term.names[0] not in white.names:
                gain = white.gain(explanation.term) - np.log(explanation.choices)
                family = (*explanation.subject, len(explanation.term.names))
                if gain > best.get(family, (_WORTH,))[0]:
                    best[family] = gain, explanation
        scores = []
        for _, explanation in sorted(best.values(), key=lambda pair: -pair[0]):
            score = self.score(explanation)
            # Of all joints together, less torque has to be left over than without it.
            before, after = (
                np.sum(each.sums.squared_residuals(each.full))
                for each in (current, score.log.fit)
            )
            if explanation.is_sure(*score.values) and after < before:
                scores.append(score)
            if len(scores) == _REFITTED:
                break
        scores.sort(key=attrgetter("gain"), reverse=True)
        if scores and scores[0].gain > CLEAR:
            scores[0] = self.refine(scores[0])
        return scores

    def wrong_time(self, share: float) -> Iterator[Finding]:
        """Yield the finding that time is too long by a share, by recorded velocities.

        Nothing is yielded where the share is zero, or torques rather say that time is right.
        """
        clock = next(e for e in self.offered if e.term.cause == "clock")
        value = self.score(clock).values[0][0]
        if abs(value - share) < abs(value):
            text, remedy = clock.describe(np.array([share]), np.zeros(1))
            text += ", and so do the recorded velocities"
            yield Finding(Level.REFUSES, "clock", text, remedy)

    def refine(self, score: Score) -> Score:
        """Return the best score that ``Explanation.nearby`` leads to, step by step."""
        while nearby := score.explanation.nearby():
            self.offer(nearby)
            better = max(map(self.score, nearby), key=attrgetter("gain"))
            if better.gain < score.gain:
                break
            score = better
        return score


def findings(
    robot: RobotModel,
    recordings: Sequence[Recording],
    options: EstimationOptions,
    divided: Array,
    share: float,
    advance: Callable[[], object],
) -> list[Finding]:
    """Return what is wrong with a log or its model; nothing where the log fits its model.

    Args:
        robot: the arm with its model.
        recordings: the log's pieces.
        options: prior uncertainties of the estimate.
        divided: (n,) torque scales by which the torques were divided already.
        share: by which time is too long if recorded velocities are right; 0 where they say nothing.
        advance: is called after each explanation and correction that is tried.
    """
    first = LogFit.of(robot, recordings, options)
    if is_computed(first):
        text = "the torque follows rigid-body dynamics and has no friction: it was computed, or "
        text += "commanded, not measured"
        return [Finding(Level.DOUBTS, "computed", text, MEASURED)]
    odd_unit = odd_unit_finding(first)
    contest = Contest(first, advance)
    if wrong_time := [*contest.wrong_time(share)]:
        return wrong_time
    rounds: list[list[Score]] = []
    corrected: list[Finding] = []
    while len(rounds) + len(corrected) < _MOST_ROUNDS:
        log = contest.log
        ranked = contest.ranked()
        winner = ranked[0] if ranked and ranked[0].gain > CLEAR else None
        best = log if winner is None else winner.log
        tried: list[Correction] = []
        # Where the log fits with what was found, corrections were tried before.
        if not rounds or log.misfit > UNEXPLAINED or not log.is_plausible:
            is_turned = bool(winner and winner.explanation.term.cause in LIKE_GRAVITY)
            tried = corrections(log, best, divided, is_turned, advance)
        is_exchanged = bool(tried) and tried[0].finding.about in ("order", "tilt")
        # An exchange of joints also gives one of them torque that is far too large for it.
        if odd_unit and not corrected and not is_exchanged:
            return [odd_unit]
        if tried and is_better(tried[0], winner, best.is_plausible):
            corrected.append(tried[0].finding)
            found = [scores[0].explanation for scores in rounds]
            contest = Contest(tried[0].log, advance, found)
        elif winner is None:
            break
        else:
            ties = [score for score in ranked if score.gain > winner.gain - TIE]
            # Of equally likely ones, one with a single value joins the fit.
            ties.sort(key=lambda score: len(score.values[0]) > 1)
            rounds.append(ties)
            contest.log = replace(ties[0].log, rows=contest.log.rows)
    # No single cause takes that much of the weight.
    if not corrected and np.median(first.torque_ratio[first.loaded]) < SMALLER:
        text = "the torque has little of the links' weight: it may be external torque, left after "
        text += "a controller's model, or motor current"
        remedy = f"{MEASURED}, or give --torque-constants for a current"
        return [Finding(Level.REFUSES, "gravity", text, remedy)]
    named = [*corrected, *name_causes(rounds[:MOST_NAMES])]
    if all(finding.level is Level.SAYS for finding in named):
        named += wrong_models(first, contest.log, divided)
    return named


def wrong_models(first: LogFit, last: LogFit, divided: Array) -> list[Finding]:
    """Return what is wrong as a whole, where no cause is named that forbids an estimate.

    Args:
        first: the fit of the log.
        last: that with all that is named.
        divided: (n,) torque scales by which the torques were divided already.
    """
    for correction in common_scale(last, divided):
        if correction.log.misfit < max(UNEXPLAINED, last.misfit):
            return [correction.finding]
    robot = last.fit.arm.robot
    if last.misfit > UNEXPLAINED:
        worst = np.argsort(-last.misfit_by_joint * last.rows.typical_torque)[:3]
        shares = [
            f"{last.fit.arm.joints[k]} {percent(float(last.misfit_by_joint[k]))}"
            for k in worst.tolist()
        ]
        text = (
            f"{percent(last.misfit)} of the torque is explained by none of the faults that are "
            f"looked for (of its own torque, {', '.join(shares)})"
        )
        check = "model" if last.misfit > OTHER_ARM else "unexplained"
        remedy = f"{RIGHT_MODEL}, and that it carried the same load all the time, with no contact"
        return [Finding(Level.DOUBTS, check, text, remedy)]
    if not last.is_plausible:
        text = (
            f"to fit this log, the terminal link would have {with_error(*last.last_mass, 'kg')} on "
            f"an arm of {robot.mass:.3g} kg, or other links would be far from the model's"
        )
        remedy = f"{RIGHT_MODEL}, and its base mounted as the model says"
        return [Finding(Level.DOUBTS, "model", text, remedy)]
    spread = first.fit.question.link_scales.mass
    if spread > ODD_LINKS:
        link_prior = first.options.priors.link
        text = (
            f"the links differ from the model by {percent(spread * PER_CENT * link_prior)}"
            " of their masses: it may be the model of a sibling of this arm; the standard errors "
            "of links before the last may be too small"
        )
        level = Level.DOUBTS if last.misfit > PER_CENT else Level.SAYS
        return [Finding(level, "model", text, RIGHT_MODEL)]
    return []


def is_better(correction: Correction, winner: Score | None, is_plausible: bool) -> bool:
    """Return whether a correction explains the log better than the best explanation does.

    An explanation of the correction's own check describes the same fault and is no rival. Where
    links are not plausible without the correction, it need not be likelier.
    """
    if not is_plausible:
        return correction.gain > -CLEAR
    least = CLEAR
    # A unit of all torques is a scale of theirs.
    check = correction.finding.about.replace("unit", "scale")
    if winner and winner.explanation.term.cause != check:
        least = max(least, winner.gain - TIE)
    return correction.gain > least


def name_causes(rounds: Sequence[Sequence[Score]]) -> list[Finding]:
    """Return a finding for each round whose winner is reportable and has a new subject.

    Those that tie with the winner and are reportable, too, are named in its finding, the best one
    of each check. The finding has the check of the winner, and the most severe level of all.
    """
    named: list[Finding] = []
    known: set[tuple[str, int | None]] = set()
    for ranked in rounds:
        best: dict[str, Score] = {}
        for score in ranked:
            if score.is_reportable and score.explanation.subject not in known:
                best.setdefault(score.explanation.term.cause, score)
        winner = ranked[0].explanation
        if best.get(winner.term.cause) is not ranked[0]:
            continue
        known |= {score.explanation.subject for score in ranked}
        descriptions = [s.explanation.describe(*s.values) for s in best.values()]
        texts, remedies = map(dict.fromkeys, zip(*descriptions))
        level = min((score.level for score in best.values()), key=[*Level].index)
        remedy = ", or ".join(filter(None, remedies))
        named.append(Finding(level, winner.term.cause, "; or ".join(texts), remedy))
    return named


def is_computed(log: LogFit) -> bool:
    """Return whether the torque was computed from a model: no joint has friction.

    It has to be so well known that friction of a real arm would show.
    """
    torque = log.rows.typical_torque
    dry, error = dry_friction(log.fit)
    known = np.linalg.norm(error[log.loaded]) / np.linalg.norm(torque[log.loaded])
    distance = np.sum((dry / np.hypot(error, EXACT * torque)) ** 2)
    limit = len(dry) + 3.0 * np.sqrt(2.0 * len(dry))
    return bool(known < FRICTIONLESS and distance < limit)
