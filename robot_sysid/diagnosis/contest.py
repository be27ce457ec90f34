"""What is wrong with a log or its model: explanations and corrections compete by evidence.

A log is fitted first. Each explanation is one more term of the same fit, and is scored by the gain
in log marginal likelihood, both fits with the noise that it leaves. The best one is named where it
gains ``CLEAR`` nats, together with those within ``TIE`` nats of it, because the log cannot
distinguish them. Then it joins the fit, and the others are scored again. Corrections of columns
(``relabelling``) compete with the first explanation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robot_sysid.diagnosis import Finding, Level
from robot_sysid.diagnosis.causes import Explanation, explanations
from robot_sysid.diagnosis.log_fit import (
    LogFit,
    LogRows,
    dry_friction,
    evidence,
    fixed_evidence,
    log_rows,
    with_term,
)
from robot_sysid.diagnosis.relabelling import Correction, corrections, odd_unit_finding
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimate.choose import CLEAR
from robot_sysid.estimate.fit import Fit, correlation_times
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import PER_CENT
from robot_sysid.estimate.rows import Recording
from robot_sysid.estimate.terms import Term
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.messages import percent, with_error

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
ALL_OFF = 1.4
"""Ratio of the torque of all links but the last to the model's, or its inverse, above which the
model or the torques are wrong as a whole: links that are off by 20 %, one by 40 %, reach 1.34."""
SURE = 2.0
"""Standard errors that count as sure."""
ALL_LINKS = (
    "all links make {:.3g} times the model's torque: either the torques read that many times too "
    "much, or all masses of the model are wrong by as much, or it is the model of another arm; "
    "torques cannot tell these apart: weigh a link, or a known mass (payload --known-mass)"
)
"""Text of the finding that all links are off alike."""
ODD_LINKS = 7.25
"""Factor on the stated uncertainty of links' masses, as the log shows it, above which the model is
not of this arm: links that are off by 20 %, one by 40 %, reach 6.5, a KUKA LWR4+ 7.1, models of
siblings 6.1 to 7.7."""
ODD_MODEL = (
    "the links contradict the model, by {} of their masses: it is probably wrong, the model of "
    "another arm, a sibling, or with another link; check its masses and lengths"
)
"""Text of the finding that links are off as no usual arm's."""
OTHER_ARM = 0.3
"""Share of unexplained torque above which the model is taken for that of another arm."""
LIKE_GRAVITY = ("force", "gravity", "tilt", "payload-step")
"""Checks whose explanations may stand for gravity in another direction."""
# Number of explanations whose noise is estimated anew in each round.
_REFITTED = 4
# Least gain of an explanation before that, at white noise [nats].
_WORTH = 8.0
# Largest number of explanations that act together.
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

    @property
    def torque_share(self) -> float:
        """Standard deviation of the explanation's torque over time, as a share of all torque."""
        typical = self.log.rows.typical_torque
        return float(
            np.linalg.norm(self.joint_shares * typical) / np.linalg.norm(typical)
        )

    @cached_property
    def joint_shares(self) -> Array:
        """Standard deviation of the explanation's torque, as a share of each joint's (J,)."""
        names = self.explanation.term.names
        values, _ = self.values
        is_old = np.isin(names, self.before.names)
        old = [self.before.by_name.get(name, 0.0) for name in names]
        torque = self.log.rows.torque_of(names, values - np.where(is_old, old, 0.0))
        return np.asarray(np.std(torque, axis=0) / self.log.rows.typical_torque)

    @property
    def is_possible(self) -> bool:
        """Whether the values are of the sign and size that the explanation's words imply."""
        return self.explanation.is_possible(*self.values)

    @property
    def is_reportable(self) -> bool:
        """Whether the explanation is large enough for a finding."""
        explanation = self.explanation
        is_of_log = explanation.joint is None and explanation.level is not Level.NOTE
        is_large = self.torque_share > LEAST_SHARE
        if explanation.is_norm:
            is_large |= float(np.max(self.joint_shares)) > LEAST_OF_JOINT
        return is_of_log or is_large

    @property
    def level(self) -> Level:
        """The explanation's level where an estimate that ignores it would be wrong, else NOTE.

        It would be if a parameter of the last link changes by more than ``MATTERS`` standard
        errors, or more than ``HARMFUL_SHARE`` of the torque is explained.
        """
        explanation = self.explanation
        if explanation.level is Level.REFUSE:
            return Level.REFUSE
        last = self.before.at(PARAMETER_NAMES)
        moved = self.log.fit.free[self.log.fit.at(PARAMETER_NAMES)]
        change = np.abs(moved - self.before.free[last])
        is_harmful = (
            abs(float(self.values[0][0])) >= explanation.harmful_from
            or bool(
                np.any(change > MATTERS * np.sqrt(np.diag(self.before.inverse)[last]))
            )
            or self.torque_share > HARMFUL_SHARE
        )
        return explanation.level if is_harmful else Level.NOTE


class Contest:
    """The fit of a log, with the methods that score explanations.

    Args:
        log: the fit of a log.

    Attributes:
        rows: with the columns of explanations.
    """

    def __init__(self, log: LogFit) -> None:
        self.log = log
        self.offered: list[Explanation] = []
        self.offer(explanations(log.fit))

    def offer(self, more: Sequence[Explanation]) -> None:
        """Add explanations to those that are scored."""
        self.offered += more
        self.rows = self.rows_of([each.term for each in self.offered])

    def rows_of(self, terms: Sequence[Term]) -> LogRows:
        """Return the rows of the log with the columns of terms that it has not."""
        fitted = self.log.fit
        known = {*fitted.arm.names}
        new = [term for term in terms if term.names[0] not in known]
        return log_rows(fitted.arm, fitted.recordings, fitted.point, new)

    def score(self, current: Fit, explanation: Explanation, rows: LogRows) -> Score:
        """Return the score of an explanation; both fits have the noise that it leaves."""
        terms = current.equations.terms
        wider_terms = with_term(terms, explanation.term)
        wider = rows.fit(wider_terms, current, np.ones(len(current.noise)))
        correlation = correlation_times(rows.residuals(wider))
        correlation = np.minimum(correlation, current.correlation)
        wider = rows.fit(wider_terms, wider, correlation)
        before = rows.fit(terms, current, correlation)
        gain = evidence(wider) - evidence(before) - float(np.log(explanation.choices))
        return Score(explanation, gain, before, LogFit(wider, rows))

    def ranked(self, current: Fit) -> list[Score]:
        """Return the scores of the best explanations that are possible, the largest gain first.

        Of those of one check and joint that differ in a setting, the best one counts. A fault makes
        noise slow, and hides in it: explanations are compared as if it were white.
        """
        white = self.rows.fit(
            current.equations.terms, current, np.ones(len(current.noise))
        )
        best: dict[object, tuple[float, Explanation]] = {}
        for explanation in self.offered:
            gain = white.gain(explanation.term) - float(np.log(explanation.choices))
            family = (*explanation.subject, len(explanation.term.names))
            if gain > best.get(family, (_WORTH,))[0]:
                best[family] = gain, explanation
        scores: list[Score] = []
        for _, explanation in sorted(best.values(), key=lambda pair: -pair[0]):
            score = self.score(current, explanation, self.rows)
            if score.is_possible:
                scores.append(score)
            if len(scores) == _REFITTED:
                break
        scores.sort(key=lambda score: -score.gain)
        if scores and scores[0].gain > CLEAR:
            scores[0] = self.refine(current, scores[0])
        return scores

    def refine(self, current: Fit, score: Score) -> Score:
        """Return the best score that ``Explanation.nearby`` leads to, step by step."""
        terms = current.equations.terms
        first = score
        while nearby := score.explanation.nearby():
            rows = self.rows_of([*terms, *(each.term for each in nearby)])
            gains = [
                fixed_evidence(rows, with_term(terms, each.term), score.log.fit)
                for each in nearby
            ]
            better = self.score(current, nearby[int(np.argmax(gains))], rows)
            if better.gain < score.gain:
                break
            score = better
        if score is not first:
            self.offer([score.explanation])
            score = self.score(current, score.explanation, self.rows)
        return score

    def rounds(self) -> list[list[Score]]:
        """Return per round the scores within ``TIE`` nats of the largest gain, the winner first.

        Of these one with a single value wins. Each round starts from the fit with the
        winners of the rounds before.
        """
        winners: list[list[Score]] = []
        current = self.log.fit
        while len(winners) < _MOST_ROUNDS:
            ranked = self.ranked(current)
            if not ranked or ranked[0].gain < CLEAR:
                break
            ties = [score for score in ranked if score.gain > ranked[0].gain - TIE]
            ties.sort(key=lambda score: len(score.values[0]) > 1)
            winners.append(ties)
            current = ties[0].log.fit
        return winners


def findings(
    robot: RobotModel,
    recordings: Sequence[Recording],
    options: EstimationOptions,
    divided: Array,
) -> list[Finding]:
    """Return what is wrong with a log or its model; nothing where the log fits its model.

    Args:
        robot: the arm with its model.
        recordings: the log's pieces.
        options: prior uncertainties of the estimate.
        divided: (n,) torque scales by which the torques were divided already.
    """
    log = LogFit.of(robot, recordings, options)
    if is_computed(log):
        return [Finding("computed", Level.WARN, COMPUTED)]
    rounds = Contest(log).rounds()
    winner = rounds[0][0] if rounds else None
    best = log if winner is None else winner.log
    is_of_gravity = winner is not None and winner.explanation.term.cause in LIKE_GRAVITY
    odd_unit = odd_unit_finding(log)
    corrected = corrections(log, best, options, divided, is_of_gravity)
    is_exchanged = bool(corrected) and corrected[0].finding.name in ("order", "tilt")
    # An exchange of joints also gives one of them torque that is far too large for it.
    if odd_unit and not is_exchanged:
        return [odd_unit]
    if corrected and is_better(corrected[0], winner, best.is_plausible):
        return [corrected[0].finding]
    last = rounds[-1][0].log if rounds else log
    named = name_causes(rounds[:MOST_NAMES])
    if last.misfit > UNEXPLAINED:
        return [*named, unexplained_torque(last)]
    if not last.is_plausible:
        return [*named, implausible_links(last)]
    ratio, error = last.links_ratio
    # Of few joints, other links take up what the last one does not: the ratio is hardly known.
    off = max(abs(ratio - 1.0) - SURE * error, 0.0)
    is_named = any(finding.level is not Level.NOTE for finding in named)
    if not is_named and off > (ALL_OFF - 1.0) / max(1.0, ALL_OFF * (ratio < 1.0)):
        return [*named, Finding("torque-scale", Level.WARN, ALL_LINKS.format(ratio))]
    spread = log.fit.question.link_scales.mass
    if not is_named and spread > ODD_LINKS:
        share = percent(spread * PER_CENT * options.priors.link)
        return [*named, Finding("model", Level.WARN, ODD_MODEL.format(share))]
    return named


def is_better(correction: Correction, winner: Score | None, is_plausible: bool) -> bool:
    """Return whether a correction explains the log better than the best explanation does.

    An explanation of the correction's own check describes the same fault and is no rival. Where
    links are not plausible without the correction, it need not be likelier.
    """
    if not is_plausible:
        return correction.gain > -CLEAR
    least = CLEAR
    if winner is not None and winner.explanation.term.cause != correction.finding.name:
        least = max(least, winner.gain - TIE)
    return correction.gain > least


def name_causes(rounds: Sequence[Sequence[Score]]) -> list[Finding]:
    """Return a finding for each round whose winner is reportable and has a new subject.

    Those that tie with the winner and are reportable, too, are named in its finding, the best one
    of each check. The finding has the check of the winner, and the most severe level of all.
    """
    named: list[Finding] = []
    known: set[tuple[str, int | None]] = set()
    ascending = (Level.NOTE, Level.WARN, Level.REFUSE)
    for ranked in rounds:
        best: dict[str, Score] = {}
        for score in ranked:
            if score.is_reportable and score.explanation.subject not in known:
                best.setdefault(score.explanation.term.cause, score)
        winner = ranked[0].explanation
        if best.get(winner.term.cause) is not ranked[0]:
            continue
        known |= {score.explanation.subject for score in ranked}
        texts = [score.explanation.text(*score.values) for score in best.values()]
        severity = max(ascending.index(score.level) for score in best.values())
        named.append(
            Finding(winner.term.cause, ascending[severity], "; or ".join(texts))
        )
    return named


EXACT = 0.004
"""Largest unexplained torque of one that was computed, as a share of the joint's."""
FRICTIONLESS = 0.004
"""Largest dry friction of a torque that was computed, as a share of the joint's."""
COMPUTED = (
    "the torque follows rigid-body dynamics and has no friction: it was computed, or commanded, "
    "not measured; record the measured torque"
)


def is_computed(log: LogFit) -> bool:
    """Return whether the torque was computed from a model: no joint that links load has friction.

    Noise that was added to it does not matter.
    """
    loaded = log.loaded
    typical = log.rows.typical_torque
    dry, error = dry_friction(log.fit)
    least = np.maximum(np.abs(dry) - 2.0 * error, 0.0) / typical
    is_known = 2.0 * error < FRICTIONLESS * typical
    is_none = is_known & (least < 0.25 * FRICTIONLESS)
    return bool(np.all((is_none & (log.misfit_by_joint < EXACT))[loaded]))


def unexplained_torque(log: LogFit) -> Finding:
    """Return the finding that torque is unexplained: its share, and the three worst joints."""
    share = log.misfit
    worst = np.argsort(-log.misfit_by_joint * log.rows.typical_torque)[:3].tolist()
    listed = ", ".join(
        f"{log.fit.arm.joints[k]} {percent(float(log.misfit_by_joint[k]))}"
        for k in worst
    )
    text = (
        f"{percent(share)} of the torque is explained by nothing that is looked for ({listed} of "
        "its own): is the model of this arm, with what is fixed to its links, and did it carry the "
        "same all the time with nothing touching it?"
    )
    return Finding("model" if share > OTHER_ARM else "unexplained", Level.WARN, text)


def implausible_links(log: LogFit) -> Finding:
    """Return the finding that the estimated links are implausible for this arm."""
    mass, error = log.last_mass
    arm = log.fit.arm.robot.mass
    text = (
        f"to fit this log, the terminal link would have {with_error(mass, error, 'kg')} on an arm "
        f"of {arm:.3g} kg, or other links far from the model's: is the model of this arm, and its "
        "base mounted as the model says?"
    )
    return Finding("model", Level.WARN, text)
