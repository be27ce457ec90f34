"""The contest of explanations: faults of a log or its model, named by the marginal likelihood.

The base model has the parameters and priors of the estimate. Each explanation adds columns to it
and is scored by the gain in log marginal likelihood, with noise estimated anew. The best one is
named where it gains ``MARGIN`` nats; explanations within ``TIE`` nats of it are named together with
it, because the log cannot distinguish them. Then the best one joins the base model, and the other
explanations are scored again. Unexplained torque (misfit) is that of ``plausibility.misfit``.

Throughout, K is the number of instants, n that of joints, k that of the base model's estimated
parameters, e that of an explanation's coefficients. Coefficients of a ``Posterior`` are deviations
from the prior's means in units of its standard deviations; the first ten are those of the last
link's inertial parameters, beginning with its mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.diagnosis import Finding, Level
from robot_sysid.diagnosis.base_fit import BaseFit
from robot_sysid.diagnosis.explanations import Explanation, explanations
from robot_sysid.diagnosis.log_model import LogModel, Posterior
from robot_sysid.diagnosis.log_rows import log_rows, rms
from robot_sysid.diagnosis.plausibility import (
    SURE,
    is_plausible,
    last_mass,
    misfit,
    misfit_by_joint,
    reverses_friction,
)
from robot_sysid.diagnosis.relabelling import (
    Correction,
    find_wrong_columns,
    find_wrong_scales,
    find_wrong_torques,
)
from robot_sysid.diagnosis.torque_units import odd_unit_finding, typical_scale
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.messages import percent, with_error
from robot_sysid.signals.process import ProcessedSignals

MARGIN = 15.0
"""Least gain of an explanation in log marginal likelihood [nats]."""
RELABELLED_MARGIN = 8.0
"""Least gain of a relabelling of columns [nats]: there are fewer of them than of explanations."""
TIE = 6.0
"""Difference in gain within which two explanations count as equally likely [nats]."""
LEAST_SHARE = 0.015
"""Share of the torque that an explanation of one joint, or a mere note, has to exceed to be
reported."""
MATTERS = 1.0
"""Change of a parameter of the last link, in standard errors, above which the explanation that
causes it is harmful."""
HARMFUL_SHARE = 0.05
"""Share of the torque above which an explanation is harmful."""
MOST_NAMES = 3
"""Largest number of explanations that are named together."""
UNEXPLAINED = 0.05
"""Share of unexplained torque above which no cause is named: logs without faults have 0.03."""
OTHER_ARM = 0.3
"""Share of unexplained torque above which the model is taken for that of another arm."""
GROSS = 0.05
"""Share of unexplained torque above which relabellings of columns are tried."""
GROSS_JOINT = 0.5
"""Share of one joint's torque that is unexplained above which relabellings are tried."""
SMALL = 0.02
"""Share of unexplained torque that a relabelling may always leave, even where the base model leaves
less."""
ODD_SCALE = 1.3
"""Ratio of measured torque to the model's, or its inverse, above which torque scales are tried."""
# Number of families of explanations whose noise is estimated anew in the first round.
_REFITTED = 8
# Number of families of explanations whose noise is estimated anew in each later round.
_REFITTED_AGAIN = 4
# Least gain at the model's noise of an explanation whose noise is estimated anew [nats].
_WORTH = 3.0
# Largest number of rounds. Each adds one explanation, so it also limits how many act together.
_MOST_ROUNDS = 5


@dataclass(frozen=True)
class Score:
    """An explanation fitted to a log, together with the model that it was added to.

    Attributes:
        explanation: the fault that was fitted.
        gain: increase of the log marginal likelihood by the explanation [nats], minus the log of
            ``Explanation.choices``, the number of similar explanations that were tried.
        values: (e,) coefficients of the explanation, in units of its columns.
        errors: (e,) standard errors of ``values``.
        sureness: Mahalanobis distance of the coefficients from zero, in standard errors.
        posterior: posterior of the model with the explanation's columns.
    """

    explanation: Explanation
    gain: float
    values: Array
    errors: Array
    sureness: float
    posterior: Posterior

    @property
    def text(self) -> str:
        """The fault in words, with its size and what the user should do."""
        return self.explanation.describe(self.values, self.errors)

    @property
    def is_possible(self) -> bool:
        """Whether the coefficients have the sign and size that the explanation's words imply."""
        return self.explanation.is_possible(self.values, self.errors)

    @property
    def torque_share(self) -> float:
        """Standard deviation of the explanation's torque over time, as a share of all torque."""
        # (K, n) [N m], or (K,) where the explanation acts at one joint.
        torque = self.explanation.columns @ self.values
        size = np.linalg.norm(np.std(torque, axis=0))
        return float(size / np.linalg.norm(rms(self.posterior.model.log.torque)))

    @property
    def is_reportable(self) -> bool:
        """Whether the explanation is significant, possible, and large enough for a finding.

        It is significant from ``SURE`` standard errors, and large enough if its torque is more than
        ``LEAST_SHARE`` of all torque. A warning or refusal on all joints may be smaller.
        """
        explanation = self.explanation
        if self.sureness < SURE or not self.is_possible:
            return False
        is_of_log = explanation.joint is None and explanation.level is not Level.NOTE
        return is_of_log or self.torque_share > LEAST_SHARE

    def is_harmful(self, previous: Posterior) -> bool:
        """Return whether an estimate that ignores the fault would be wrong.

        It would be if the explanation is of level REFUSE, its first coefficient reaches
        ``harmful_from``, a parameter of the last link changes by more than ``MATTERS`` standard
        errors, or more than ``HARMFUL_SHARE`` of the torque is explained. ``previous`` is the
        posterior of the model to which the explanation was added.
        """
        explanation = self.explanation
        is_large = bool(abs(self.values[0]) >= explanation.harmful_from)
        if is_large or explanation.level is Level.REFUSE:
            return True
        # (10,) of the last link's parameters, in units of their prior standard deviations.
        change = self.posterior.coefficients[:10] - previous.coefficients[:10]
        errors = np.sqrt(np.diag(previous.covariance)[:10])
        moves_last_link = bool(np.any(np.abs(change) > MATTERS * errors))
        return moves_last_link or self.torque_share > HARMFUL_SHARE


class Contest:
    """The base model fitted to one log, with the methods that score corrections and explanations.

    Args:
        robot: the arm with its model.
        signals: low-passed signals of the log's pieces, see ``log_checks.low_pass``.
        options: prior uncertainties of the estimate.

    Attributes:
        posterior: posterior of the base model.
    """

    def __init__(
        self,
        robot: RobotModel,
        signals: Sequence[ProcessedSignals],
        options: EstimationOptions,
    ) -> None:
        self.signals = signals
        self.options = options
        self.posterior = LogModel(log_rows(robot, signals), options).posterior()

    def corrections(self, divided: Array, winner: Score | None) -> list[Correction]:
        """Return plausible corrections of mistaken columns, the largest gain first.

        Corrections of torques are always tried. Those of motions, alone or with torques, need new
        rows and are tried only where the best explanation, or the base model if there is none,
        leaves gross misfit or implausible links, or other torques fit better; torque scales in the
        first two cases, and where the torque is off by a factor of more than ``ODD_SCALE``.

        A correction is plausible if its misfit is at most ``SMALL`` or that of the base model, its
        links pass ``is_plausible``, and it keeps friction braking.

        Args:
            divided: (n,) torque scales by which the torques were divided already.
            winner: the best explanation of the first round; None where there is none.
        """
        base = self.posterior
        corrections = find_wrong_torques(base, self.signals)
        # An explanation that is not possible leaves all that it explains to other causes.
        best = winner.posterior if winner and winner.is_possible else base
        largest_of_joint = float(np.max(misfit_by_joint(best)))
        is_gross = misfit(best) > GROSS or largest_of_joint > GROSS_JOINT
        is_far = is_gross or not is_plausible(best)
        log_scale = abs(np.log(typical_scale(base.model.log)))
        if is_far or log_scale > np.log(ODD_SCALE):
            corrections += find_wrong_scales(base, self.options, divided)
        # Another torque column may only make up for a position of the same joint.
        if is_far or any(c.gain > RELABELLED_MARGIN for c in corrections):
            corrections += find_wrong_columns(base, self.signals, self.options)
        largest_misfit = max(misfit(base), SMALL)
        plausible = []
        for correction in corrections:
            corrected = correction.posterior
            if misfit(corrected) > largest_misfit or not is_plausible(corrected):
                continue
            if not reverses_friction(base, corrected):
                plausible.append(correction)
        return sorted(plausible, key=lambda correction: -correction.gain)

    def rounds(self) -> list[list[Score]]:
        """Return per round the scores within ``TIE`` nats of the largest gain, the winner first.

        Of these the winner is that with the largest gain whose coefficients are possible, or where
        none are, with the largest gain. Each round starts from the model with the
        winners of the previous rounds. The rounds end when no explanation gains ``MARGIN``, or
        after ``_MOST_ROUNDS``.
        """
        trusted = is_plausible(self.posterior)
        fit = BaseFit(self.posterior, self.signals, trusted)
        offered = explanations(fit)
        columns = OfferedColumns.of(self.posterior.model, offered)
        winners: list[list[Score]] = []
        model = self.posterior
        while len(winners) < _MOST_ROUNDS:
            count = _REFITTED if not winners else _REFITTED_AGAIN
            ranked = _rank(model, offered, columns, count)
            if not ranked or ranked[0].gain < MARGIN:
                break
            ties = [score for score in ranked if score.gain > ranked[0].gain - TIE]
            # Of equally likely explanations, those come first whose coefficients are possible.
            ties.sort(key=lambda score: not score.is_possible)
            winners.append(ties)
            model = ties[0].posterior
        return winners


@dataclass(frozen=True)
class OfferedColumns:
    """Columns of explanations, transformed like the rows of a model.

    Attributes:
        joints: per joint (K, w) the w columns of all explanations side by side, per prior standard
            deviation of the coefficients; zero where an explanation does not act at the joint.
        spans: the slice of each explanation's columns.
    """

    joints: tuple[Array, ...]
    spans: tuple[slice, ...]

    @classmethod
    def of(cls, model: LogModel, offered: Sequence[Explanation]) -> OfferedColumns:
        """Return the columns of explanations, in their order."""
        widths = [len(explanation.spread) for explanation in offered]
        ends = np.cumsum(widths, dtype=int)
        spans = tuple(map(slice, ends - widths, ends))
        joints = []
        for joint in range(len(model.rows)):
            columns = np.zeros((len(model.right_sides), sum(widths)))
            for explanation, span in zip(offered, spans):
                if explanation.joint in (None, joint):
                    columns[:, span] = explanation.of_joint(joint)
            joints.append(model.transform(joint, columns))
        return cls(tuple(joints), spans)


def screen_gains(posterior: Posterior, columns: OfferedColumns) -> Array:
    """Return the gain of each explanation in log marginal likelihood at fixed noise [nats].

    With E the columns of the explanation, A those of the model, r the residual and C the posterior
    covariance, in units of noise and prior, the gain is 1/2 v' P^-1 v - 1/2 log |P|, with v = E'r
    and P = I + E'E - (A'E)' C (A'E), the posterior precision of the explanation's coefficients.

    Args:
        posterior: posterior of the model without the explanations.
        columns: those of the explanations.
    """
    width = columns.joints[0].shape[1]
    products = np.zeros((len(posterior.coefficients), width))  # A'E
    projections = np.zeros(width)  # v = E'r
    squares = [np.eye(span.stop - span.start) for span in columns.spans]  # I + E'E
    for joint, block in enumerate(columns.joints):
        weighted = block / posterior.noise[:, joint, None]
        indices, rows = posterior.model.equations(joint)
        products[indices] += rows.T @ weighted
        projections += posterior.residual[:, joint] @ weighted
        for square, span in zip(squares, columns.spans):
            square += block[:, span].T @ weighted[:, span]
    solved = posterior.covariance @ products
    gains = np.empty(len(squares))
    for k, (span, square) in enumerate(zip(columns.spans, squares)):
        precision = square - products[:, span].T @ solved[:, span]
        v = projections[span]
        explained = float(v @ np.linalg.solve(precision, v))
        gains[k] = 0.5 * (explained - np.linalg.slogdet(precision)[1])
    return gains


def _rank(
    model: Posterior,
    offered: Sequence[Explanation],
    columns: OfferedColumns,
    count: int,
) -> list[Score]:
    """Return the scores of the best explanations of the best families, the largest gain first.

    A family consists of the explanations of one check and joint that differ in a setting, such as
    the instant of a payload's change. All explanations are compared at the noise of the model. The
    best one of each of the ``count`` best families, if it gains more than ``_WORTH``, is scored
    with noise estimated anew; if it then gains more than ``MARGIN``, its setting is refined.

    Args:
        model: posterior of the model that the explanations are added to.
        offered: explanations to score.
        columns: those of the explanations.
        count: largest number of families to score.
    """
    penalties = np.log([explanation.choices for explanation in offered])
    gains = screen_gains(model, columns) - penalties
    best_of_family: dict[object, int] = {}
    for k in np.argsort(-gains):
        if gains[k] > _WORTH:
            best_of_family.setdefault(offered[k].family, int(k))
    scores = []
    for k in list(best_of_family.values())[:count]:
        score = _score(model, offered[k], columns, columns.spans[k])
        if score.gain > MARGIN:
            score = _refine(model, score)
        scores.append(score)
    return sorted(scores, key=lambda score: -score.gain)


def _score(
    previous: Posterior, explanation: Explanation, columns: OfferedColumns, span: slice
) -> Score:
    """Return the score of an explanation added to a model, with noise estimated anew.

    Args:
        previous: posterior of the model without the explanation.
        explanation: the fault to add.
        columns: those of this and other explanations.
        span: of this explanation in them.
    """
    width = len(explanation.spread)
    added = [block[:, span] for block in columns.joints]
    posterior = previous.model.with_columns(added).posterior(previous.noise)
    penalty = float(np.log(explanation.choices))
    coefficients = posterior.coefficients[-width:]
    covariance = posterior.covariance[-width:, -width:]
    squared_distance = coefficients @ np.linalg.solve(covariance, coefficients)
    return Score(
        explanation,
        posterior.log_evidence - previous.log_evidence - penalty,
        explanation.spread * coefficients,
        explanation.spread * np.sqrt(np.diag(covariance)),
        float(np.sqrt(squared_distance)),
        posterior,
    )


def _refine(previous: Posterior, score: Score) -> Score:
    """Return the best score that hill climbing from an explanation to similar ones reaches.

    Each step goes to the best of the explanations that ``Explanation.nearby`` returns, as long as
    the gain increases.

    Args:
        previous: posterior of the model without the explanation.
        score: score of the explanation to start from.
    """
    best = score
    model = previous.model
    while nearby := best.explanation.nearby():
        columns = OfferedColumns.of(model, nearby)
        # At the noise of the best score: at the model's, similar explanations gain nearly the same.
        gains = screen_gains(model.at_noise(best.posterior.noise), columns)
        k = int(np.argmax(gains))
        candidate = _score(previous, nearby[k], columns, columns.spans[k])
        if candidate.gain <= best.gain:
            break
        best = candidate
    return best


def findings(contest: Contest, divided: Array) -> list[Finding]:
    """Return the findings of a contest; none where the log fits its model.

    Mistaken columns are considered first, then unexplained torque, implausible links, too many
    causes, and last the explanations of the first ``MOST_NAMES`` rounds. Only the findings of the
    first of these that applies are returned.

    Args:
        contest: the log with its base model.
        divided: (n,) torque scales by which the torques were divided already.
    """
    rounds = contest.rounds()
    winner = rounds[0][0] if rounds else None
    corrections = contest.corrections(divided, winner)
    correction = corrections[0] if corrections else None
    # An exchange of joints also gives one of them torque that is far too large for it.
    odd_unit = odd_unit_finding(contest.posterior.model.log)
    is_other = correction is not None and correction.finding.name in ("order", "tilt")
    if odd_unit and not is_other:
        return [odd_unit]
    if correction and is_better(correction, winner):
        finding = correction.finding
        if misfit(correction.posterior) > UNEXPLAINED:
            text = "this looks like the model of another arm; if it is not, "
            finding = replace(finding, text=f"{text}{finding.text}")
        return [finding]
    named = name_causes(contest.posterior, rounds)
    last = rounds[-1][0].posterior if rounds else contest.posterior
    if misfit(last) > UNEXPLAINED:
        return [unexplained_torque(last)]
    if not is_plausible(last):
        return [implausible_links(last)]
    if len(named) > MOST_NAMES:
        return [unexplained_torque(contest.posterior)]
    # Explanations of later rounds only fit what the first ``MOST_NAMES`` leave unexplained.
    return name_causes(contest.posterior, rounds[:MOST_NAMES])


def is_better(correction: Correction, winner: Score | None) -> bool:
    """Return whether a correction explains the log better than the best explanation does.

    It has to gain more than ``RELABELLED_MARGIN``, and more than the explanation's gain less
    ``TIE``. An explanation of the correction's own check describes the same fault and is no rival.

    Args:
        correction: the correction to judge.
        winner: the best explanation of the first round; None where there is none.
    """
    least = RELABELLED_MARGIN
    if winner is not None and winner.explanation.name != correction.finding.name:
        least = max(least, winner.gain - TIE)
    return correction.gain > least


def name_causes(base: Posterior, rounds: Sequence[Sequence[Score]]) -> list[Finding]:
    """Return a finding for each round whose winner is reportable and has a new subject.

    The subject of an explanation is its check and joint. It is new if no earlier round has named
    it. Explanations that tie with the winner and are reportable, too, are named in the winner's
    finding, the best one of each check.

    Args:
        base: posterior of the base model.
        rounds: scores of each round, the winner first (``Contest.rounds``).
    """
    named: list[Finding] = []
    previous = base
    named_subjects: set[tuple[str, int | None]] = set()
    for ranked in rounds:
        winner = ranked[0]
        best_of_check: dict[str, Score] = {}
        subjects = set()
        for score in ranked:
            explanation = score.explanation
            if score.is_reportable and explanation.subject not in named_subjects:
                subjects.add(explanation.subject)
                best_of_check.setdefault(explanation.name, score)
        if best_of_check.get(winner.explanation.name) is winner:
            named_subjects |= subjects
            named.append(_finding([*best_of_check.values()], previous))
        previous = winner.posterior
    return named


def _finding(scores: Sequence[Score], previous: Posterior) -> Finding:
    """Return one finding that names all explanations of a tie.

    It has the check of the first score. Its level is the most severe one of the harmful
    explanations, NOTE where none is harmful.

    Args:
        scores: scores of the explanations, the winner first.
        previous: posterior of the model without these explanations.
    """
    ascending = (Level.NOTE, Level.WARN, Level.REFUSE)
    severity = 0
    texts = []
    for score in scores:
        if score.text not in texts:
            texts.append(score.text)
        if score.is_harmful(previous):
            severity = max(severity, ascending.index(score.explanation.level))
    name = scores[0].explanation.name
    return Finding(name, ascending[severity], "; or ".join(texts))


def unexplained_torque(posterior: Posterior) -> Finding:
    """Return the finding that torque is unexplained: its share, the three worst joints, and when.

    It is of the check "model" above ``OTHER_ARM``, else of "unexplained".
    """
    log = posterior.model.log
    by_joint = misfit_by_joint(posterior)
    share = misfit(posterior)
    names = log.robot.joint_names
    worst = np.argsort(-by_joint * log.typical_torque)[:3].tolist()
    listed = ", ".join(f"{names[k]} {percent(float(by_joint[k]))}" for k in worst)
    text = (
        f"{percent(share)} of the torque is explained by nothing that is looked for ({listed} of "
        f"its own): is the model of this arm, with what is "
        "fixed to its links, and did it carry the same all the time with nothing touching it?"
    )
    return Finding("model" if share > OTHER_ARM else "unexplained", Level.WARN, text)


def implausible_links(posterior: Posterior) -> Finding:
    """Return the finding that the estimated links are implausible for this arm."""
    mass, error = last_mass(posterior)
    arm = posterior.model.log.robot.mass
    text = (
        f"to fit this log, the terminal link would have {with_error(mass, error, 'kg')} on an arm "
        f"of {arm:.3g} kg, or other links far from the model's: is the model of this arm, and its "
        "base mounted as the model says?"
    )
    return Finding("model", Level.WARN, text)
