"""The contest of explanations: faults of a log or its model, named by the marginal likelihood.

The base model has the parameters and priors of the estimate. Each explanation adds columns to it
and is scored by the gain in log marginal likelihood, with noise estimated anew. The best one is
named where it gains ``MARGIN`` nats; explanations within ``TIE`` nats of it are named together with
it, because the log cannot distinguish them. Then the best one joins the base model, and the others
are scored again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.diagnosis import Finding, Level
from robot_sysid.diagnosis.evidence import Hypotheses, Posterior
from robot_sysid.diagnosis.explanations import BaseFit, Explanation, explanations
from robot_sysid.diagnosis.relabelling import (
    Correction,
    find_wrong_columns,
    find_wrong_scales,
    find_wrong_torques,
    odd_unit_finding,
    typical_scale,
)
from robot_sysid.diagnosis.rows import LogRows, Prior, base_prior, log_rows, rms
from robot_sysid.dynamics.equations import link_names, other_links
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
"""Least share of the torque that an explanation of one joint has to explain to be reported."""
SURE = 3.0
"""Standard errors by which the coefficients of an explanation have to differ from zero."""
MATTERS = 1.0
"""Change of a parameter of the last link, in standard errors, that makes an explanation harmful."""
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
"""Share of unexplained torque that a relabelling may always leave, even if the log has less."""
TYPICAL_STRAIN = 7.0
"""``Contest.strain`` of typical arms: squared deviation of their links from the model."""
FAR = 40.0
"""``Contest.strain`` that no arm reaches with its own model."""
ODD_SCALE = 1.3
"""Ratio of measured torque to the model's above which torque scales are tried."""
STRETCHES = 8
"""Number of stretches of a log whose unexplained torque is compared."""
CONCENTRATED = 0.4
"""Share of all unexplained torque in one stretch above which the stretch is named."""
HEAVIEST = 0.6
"""Largest mass of a plausible last link, as a share of the arm's mass."""
# Number of explanations whose noise is estimated anew in the first round.
_REFITTED = 8
# Number of explanations whose noise is estimated anew in each later round.
_REFITTED_AGAIN = 4
# Least gain, with the noise of the model, of explanations whose noise is estimated anew [nats].
_WORTH = 3.0
# Largest number of rounds, and so of explanations that act together.
_MOST_ROUNDS = 5


@dataclass(frozen=True)
class Score:
    """An explanation fitted to a log together with a model.

    Attributes:
        explanation: the fault that was fitted.
        gain: increase of the log marginal likelihood [nats], minus the log of ``choices``.
        values: (e,) coefficients of the explanation, in units of its columns.
        errors: (e,) their standard errors.
        sureness: distance of all coefficients together from zero, in standard errors.
        hypotheses: equations of the model with the explanation's columns.
        posterior: posterior of these equations.
    """

    explanation: Explanation
    gain: float
    values: Array
    errors: Array
    sureness: float
    hypotheses: Hypotheses
    posterior: Posterior

    @property
    def text(self) -> str:
        """The explanation in words, with what to do."""
        return self.explanation.describe(self.values, self.errors)

    @property
    def is_possible(self) -> bool:
        """Whether the coefficients have the sign and size that the explanation's words imply."""
        return self.explanation.is_possible(self.values, self.errors)

    @property
    def torque(self) -> Array:
        """Torque (K, n) of the explanation, (K, 1) where it acts at one joint [N m]."""
        torque = self.explanation.columns @ self.values
        return torque if torque.ndim == 2 else torque[:, None]


class Contest:
    """One log, the fit of the base model to it, and the scores of explanations.

    Args:
        robot: the arm with its model.
        signals: low-passed signals of the log's pieces, see ``rows.low_pass``.
        options: prior uncertainties of the estimate.

    Attributes:
        log: equations of the log.
        prior: prior of the base model.
        base: transformed equations of the base model.
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
        self.log = log_rows(robot, signals)
        self.prior = base_prior(self.log, options)
        self.base = Hypotheses(self.log, self.prior)
        self.posterior = self.base.posterior()

    def last_mass(
        self, posterior: Posterior, prior: Prior | None = None
    ) -> tuple[float, float]:
        """Return the last link's mass and its standard error [kg]; ``prior`` None: the base's."""
        prior = prior or self.prior
        mass = prior.mean[0] + prior.spread[0] * posterior.values[0]
        return float(mass), float(prior.spread[0] * np.sqrt(posterior.covariance[0, 0]))

    def is_plausible(self, posterior: Posterior, prior: Prior | None = None) -> bool:
        """Return whether the last link's mass and the strain of all links are plausible."""
        arm = self.log.robot.mass
        largest_mass = max(HEAVIEST * arm, self.log.robot.prior.mass + 0.3 * arm)
        mass, error = self.last_mass(posterior, prior)
        possible = mass + 2.0 * error > 0.0 and mass - 2.0 * error < largest_mass
        return possible and self.strain(posterior, prior) < FAR

    def dry_friction(self, posterior: Posterior, prior: Prior) -> tuple[Array, Array]:
        """Return the Coulomb friction (n,) of each joint and its standard error (n,) [N m]."""
        names = [f"coulomb[{name}]" for name in self.log.robot.joint_names]
        indices = self.log.columns.indices(names)
        positions = np.searchsorted(prior.estimated, indices)
        error = prior.spread[positions] * np.sqrt(
            np.diag(posterior.covariance)[positions]
        )
        return prior.parameters(posterior.values)[indices], error

    def friction_share(self, posterior: Posterior) -> Array:
        """Return a lower bound (n,) of Coulomb friction, as a share of the typical torque."""
        dry, error = self.dry_friction(posterior, self.prior)
        return np.asarray(
            np.maximum(np.abs(dry) - SURE * error, 0.0) / self.log.typical_torque
        )

    def reverses_friction(self, mistake: Correction) -> bool:
        """Return whether a correction turns a joint's friction from braking into driving.

        Where links hardly load a joint, everything but its friction fits with either sign.
        """
        dry, error = self.dry_friction(self.posterior, self.prior)
        undone, undone_error = self.dry_friction(mistake.posterior, mistake.prior)
        return bool(np.any((dry > SURE * error) & (undone < -SURE * undone_error)))

    def strain(self, posterior: Posterior, prior: Prior | None = None) -> float:
        """Return the other links' squared deviation from the model, in prior standard deviations.

        The prior with the smallest deviation, the widest one, counts.
        """
        prior = prior or self.prior
        robot = self.log.robot
        names = [
            name for link in other_links(robot) for name in link_names(robot, link)
        ]
        at = np.searchsorted(prior.estimated, self.log.columns.indices(names))
        off = posterior.values[at]
        quadratic_forms = [off @ p[np.ix_(at, at)] @ off for p in prior.precisions]
        return float(min(quadratic_forms))

    def corrections(self, divided: Array, winner: Score | None) -> list[Correction]:
        """Return plausible corrections of mistaken columns, the largest gain first.

        Corrections that need new rows are tried only where neither the base model nor the best
        explanation fits with plausible links.

        Args:
            divided: (n,) torque scales by which the torques were divided already.
            winner: the best explanation of the first round; None where there is none.
        """
        corrections = find_wrong_torques(
            self.log, self.signals, self.base, self.posterior
        )
        best = self.posterior if winner is None else winner.posterior
        by_joint = misfit_by_joint(self.log, best)
        is_gross = (
            misfit(self.log, best) > GROSS or float(np.max(by_joint)) > GROSS_JOINT
        )
        is_far = is_gross or not self.is_plausible(best)
        if is_far or abs(np.log(typical_scale(self.log))) > np.log(ODD_SCALE):
            corrections += find_wrong_scales(
                self.log, self.posterior, self.options, divided
            )
        if is_far:
            corrections += find_wrong_columns(
                self.log, self.signals, self.posterior, self.options
            )
        largest_misfit = max(misfit(self.log, self.posterior), SMALL)
        plausible = []
        for correction in corrections:
            is_fitting = misfit(correction.log, correction.posterior) <= largest_misfit
            if (
                is_fitting
                and self.is_plausible(correction.posterior, correction.prior)
                and not self.reverses_friction(correction)
            ):
                plausible.append(correction)
        return sorted(plausible, key=lambda correction: -correction.gain)

    def rounds(self) -> list[list[Score]]:
        """Return, for each round, the winning score and those within ``TIE`` of it, winner first.

        Each round starts from the model with the winners of the previous rounds.
        """
        trusted = self.is_plausible(self.posterior)
        fit = BaseFit(self.log, self.signals, self.prior, self.posterior, trusted)
        offered = [e for e in explanations(fit) if not self.is_estimated(e)]
        columns = transform_columns(self.base, offered)
        winners: list[list[Score]] = []
        model = self.base
        posterior = self.posterior
        while len(winners) < _MOST_ROUNDS:
            count = _REFITTED if not winners else _REFITTED_AGAIN
            ranked = self._rank(model, posterior, offered, columns, count)
            if not ranked or ranked[0].gain < MARGIN:
                break
            ties = [score for score in ranked if score.gain > ranked[0].gain - TIE]
            # Of equally likely explanations, one that its coefficients do not contradict.
            ties.sort(key=lambda score: not score.is_possible)
            winners.append(ties)
            model = ties[0].hypotheses
            posterior = ties[0].posterior
        return winners

    def is_estimated(self, explanation: Explanation) -> bool:
        """Return whether the estimate has a free parameter for the cause of an explanation."""
        settings = {"delay": self.options.delay, "tilt": self.options.tilt}
        return explanation.joint is None and settings.get(explanation.name) == "auto"

    def _rank(
        self,
        model: Hypotheses,
        posterior: Posterior,
        offered: Sequence[Explanation],
        columns: Sequence[Sequence[Array | None]],
        count: int,
    ) -> list[Score]:
        """Return the score of the best explanation of each family, the best families first.

        Args:
            model: equations that the explanations are added to, with their ``posterior``.
            offered: explanations to score.
            columns: ``transform_columns`` of these explanations.
            count: largest number of families, whose noise is estimated anew.
        """
        penalties = np.log([explanation.choices for explanation in offered])
        gains = screen_gains(model, posterior, columns) - penalties
        best_of_family: dict[object, int] = {}
        for k in np.argsort(-gains):
            if gains[k] > _WORTH:
                best_of_family.setdefault(offered[k].family, int(k))
        finalists = list(best_of_family.values())[:count]
        scores = []
        for k in finalists:
            score = self._score(model, posterior, offered[k], columns[k])
            if score.gain > MARGIN:
                score = self._refine(model, posterior, score)
            scores.append(score)
        return sorted(scores, key=lambda score: -score.gain)

    def _score(
        self,
        model: Hypotheses,
        posterior: Posterior,
        explanation: Explanation,
        columns: Sequence[Array | None],
    ) -> Score:
        """Return the score of an explanation added to a model, with noise estimated anew."""
        width = len(explanation.spread)
        no_torque = np.zeros((len(model.right_sides), width))
        added = [no_torque if column is None else column for column in columns]
        wider = model.with_columns(added)
        result = wider.posterior(posterior.noise)
        gain = (
            result.log_evidence
            - posterior.log_evidence
            - float(np.log(explanation.choices))
        )
        scaled = result.values[-width:]
        covariance = result.covariance[-width:, -width:]
        sureness = float(np.sqrt(scaled @ np.linalg.solve(covariance, scaled)))
        errors = explanation.spread * np.sqrt(np.diag(covariance))
        return Score(
            explanation,
            gain,
            explanation.spread * scaled,
            errors,
            sureness,
            wider,
            result,
        )

    def _refine(self, model: Hypotheses, posterior: Posterior, score: Score) -> Score:
        """Return the best score of an explanation and of its ``nearby`` ones, searched uphill."""
        best = score
        while nearby := best.explanation.nearby():
            columns = transform_columns(model, nearby)
            # With the noise of the best score: with the model's, all gains are nearly equal.
            quieter = model.at_noise(best.posterior.noise)
            k = int(np.argmax(screen_gains(model, quieter, columns)))
            candidate = self._score(model, posterior, nearby[k], columns[k])
            if candidate.gain <= best.gain:
                break
            best = candidate
        return best

    def is_reportable(self, score: Score) -> bool:
        """Return whether an explanation is significant and worth a finding.

        It is, as a fault of the whole log, or if it explains ``LEAST_SHARE`` of the torque.
        """
        explanation = score.explanation
        if score.sureness < SURE or not score.is_possible:
            return False
        is_of_log = explanation.joint is None and explanation.level is not Level.NOTE
        return is_of_log or self.torque_share(score) > LEAST_SHARE

    def is_harmful(self, score: Score, previous: Posterior) -> bool:
        """Return whether a result without this explanation (``previous``) would be wrong."""
        explanation = score.explanation
        is_large = bool(abs(score.values[0]) >= explanation.harmful_from)
        if is_large or explanation.level is Level.REFUSE:
            return True
        return self.torque_share(score) > HARMFUL_SHARE or self.moves_link(
            score, previous
        )

    def torque_share(self, score: Score) -> float:
        """Return the standard deviation of an explanation's torque, as a share of all torque."""
        torque = np.linalg.norm(np.std(score.torque, axis=0))
        return float(torque / np.linalg.norm(rms(self.log.torque)))

    def moves_link(self, score: Score, previous: Posterior) -> bool:
        """Return whether an explanation moves the last link by ``MATTERS`` standard errors."""
        moved = score.posterior.values[:10] - previous.values[:10]
        errors = np.sqrt(np.diag(previous.covariance)[:10])
        return bool(np.any(np.abs(moved) > MATTERS * errors))


def misfit_by_joint(log: LogRows, posterior: Posterior) -> Array:
    """Return the unexplained torque (n,) of each joint, as a share of its typical torque.

    That is the residual without white noise. White noise is the residual in the upper half of the
    frequencies, in which links make little torque.
    """
    squares = posterior.residual**2
    slow = np.zeros(squares.shape[1])
    for window in log.windows:
        spectrum = squares[window]
        white = len(spectrum) * np.mean(spectrum[len(spectrum) // 2 :], axis=0)
        slow += np.maximum(np.sum(spectrum, axis=0) - white, 0.0)
    counts = np.maximum(np.sum(log.used, axis=0), 1)
    return np.asarray(np.sqrt(slow / counts) / log.typical_torque)


def misfit(log: LogRows, posterior: Posterior) -> float:
    """Return the unexplained torque of all joints together, as a share of all torque."""
    slow = misfit_by_joint(log, posterior) * log.typical_torque
    return float(np.linalg.norm(slow) / np.linalg.norm(rms(log.torque)))


def transform_columns(
    model: Hypotheses, offered: Sequence[Explanation]
) -> list[list[Array | None]]:
    """Return, per explanation and joint, its transformed columns (K, e) in prior units.

    None stands for a joint that an explanation does not act on.
    """
    transformed: list[list[Array | None]] = [[None] * len(model.rows) for _ in offered]
    for joint in range(len(model.rows)):
        of_joint = {
            k: explanation.of_joint(joint) for k, explanation in enumerate(offered)
        }
        columns = {k: column for k, column in of_joint.items() if column is not None}
        if not columns:
            continue
        ends = np.cumsum([column.shape[1] for column in columns.values()])[:-1]
        stacked = model.transform.of_joint(joint, np.hstack([*columns.values()]))
        for k, block in zip(columns, np.split(stacked, ends, axis=1)):
            transformed[k][joint] = block
    return transformed


def screen_gains(
    model: Hypotheses, posterior: Posterior, columns: Sequence[Sequence[Array | None]]
) -> Array:
    """Return the gain of each explanation in log marginal likelihood at fixed noise [nats].

    With E the columns of the explanation, A those of the model, r the residual and C the posterior
    covariance, in units of noise and prior, the gain is 1/2 v' (1 + M)^-1 v - 1/2 log |1 + M|,
    M = E'E - E'A C A'E and v = E'r. ``columns`` are those of ``transform_columns``.
    """
    widths = [
        next(c.shape[1] for c in of_joints if c is not None) for of_joints in columns
    ]
    ends = np.cumsum([0, *widths])
    crossed = np.zeros((len(posterior.values), ends[-1]))
    pull = np.zeros(ends[-1])
    squares = [np.eye(width) for width in widths]
    for joint in range(len(model.rows)):
        indices, rows = model.equations(joint)
        all_columns = {k: of_joints[joint] for k, of_joints in enumerate(columns)}
        of_joint = {k: block for k, block in all_columns.items() if block is not None}
        if not of_joint:
            continue
        at = np.concatenate([np.arange(ends[k], ends[k + 1]) for k in of_joint])
        weight = 1.0 / posterior.noise[:, joint, None]
        stacked = np.hstack([*of_joint.values()])
        crossed[np.ix_(indices, at)] += (rows * weight).T @ stacked
        pull[at] += posterior.residual[:, joint] @ (stacked * weight)
        for k, block in of_joint.items():
            squares[k] += block.T @ (block * weight)
    solved = posterior.covariance @ crossed
    gains = []
    for k, square in enumerate(squares):
        of_explanation = slice(ends[k], ends[k + 1])
        inside = square - crossed[:, of_explanation].T @ solved[:, of_explanation]
        best = np.linalg.solve(inside, pull[of_explanation])
        gains.append(
            0.5 * (float(pull[of_explanation] @ best) - np.linalg.slogdet(inside)[1])
        )
    return np.array(gains)


def findings(contest: Contest, divided: Array) -> list[Finding]:
    """Return the findings of a contest; none where the log fits its model.

    Mistaken columns are considered first, then unexplained torque, implausible links and too many
    causes, and last explanations. The first of these kinds that applies is returned alone.

    Args:
        divided: (n,) torque scales by which the torques were divided already.
    """
    rounds = contest.rounds()
    undone = contest.corrections(divided, rounds[0][0] if rounds else None)
    odd_unit = odd_unit_finding(contest.log)
    if odd_unit is not None and not (undone and undone[0].name == "order"):
        return [odd_unit]
    best_gain = rounds[0][0].gain if rounds else 0.0
    # An explanation of the correction's check is one aspect of that fault and does not compete.
    if rounds and undone and undone[0].name == rounds[0][0].explanation.name:
        best_gain = 0.0
    if undone and undone[0].gain > max(RELABELLED_MARGIN, best_gain - TIE):
        winner = undone[0]
        text = winner.text
        if misfit(winner.log, winner.posterior) > UNEXPLAINED:
            text = f"this looks like the model of another arm; if it is not, {text}"
        return [Finding(winner.name, winner.level, text)]
    named = name_causes(contest, rounds)
    last = rounds[-1][0].posterior if rounds else contest.posterior
    if misfit(contest.log, last) > UNEXPLAINED:
        return [unexplained_torque(contest, last)]
    if not contest.is_plausible(last):
        return [implausible_links(contest, last)]
    if len(named) > MOST_NAMES:
        return [too_many_causes(contest, named)]
    # Explanations after the first ``MOST_NAMES`` only fit their residuals.
    return name_causes(contest, rounds[:MOST_NAMES])


def name_causes(contest: Contest, rounds: Sequence[Sequence[Score]]) -> list[Finding]:
    """Return a finding per round of ``Contest.rounds`` whose winner is reportable and new."""
    named: list[Finding] = []
    previous = contest.posterior
    already: set[tuple[str, int | None]] = set()
    for ranked in rounds:
        clear = [score for score in ranked if contest.is_reportable(score)]
        clear = [score for score in clear if score.explanation.subject not in already]
        if any(score is ranked[0] for score in clear):
            already |= {score.explanation.subject for score in clear}
            best: dict[str, Score] = {}
            for score in clear:
                best.setdefault(score.explanation.name, score)
            harmful = [
                score for score in best.values() if contest.is_harmful(score, previous)
            ]
            named.append(_finding([*best.values()], harmful))
        previous = ranked[0].posterior
    return named


def _finding(scores: Sequence[Score], harmful: Sequence[Score]) -> Finding:
    """Return one finding for explanations that tie, the winner first.

    Args:
        harmful: the scores without which a result would be wrong; their levels set the finding's.
    """
    texts = dict.fromkeys(score.text for score in scores)
    levels = {score.explanation.level for score in harmful}
    order = (Level.REFUSE, Level.WARN, Level.NOTE)
    level = next((level for level in order if level in levels), Level.NOTE)
    return Finding(scores[0].explanation.name, level, "; or ".join(texts))


def unexplained_torque(contest: Contest, posterior: Posterior) -> Finding:
    """Return the finding that torque is unexplained: its share, its worst joints and its time."""
    log = contest.log
    by_joint = misfit_by_joint(log, posterior)
    share = misfit(log, posterior)
    worst = np.argsort(-by_joint * log.typical_torque)[:3]
    listed = ", ".join(
        f"{log.robot.joint_names[j]} {percent(float(by_joint[j]))}" for j in worst
    )
    text = (
        f"{percent(share)} of the torque is explained by nothing that is looked for ({listed} of "
        f"its own{stretch_of_misfit(contest, posterior)}): is the model of this arm, with what is "
        "fixed to its links, and did it carry the same all the time with nothing touching it?"
    )
    return Finding("model" if share > OTHER_ARM else "unexplained", Level.WARN, text)


def stretch_of_misfit(contest: Contest, posterior: Posterior) -> str:
    """Return a phrase on the stretch of time with ``CONCENTRATED`` of the residual; else ""."""
    residual = (
        contest.base.transform.inverse(posterior.residual) / contest.log.typical_torque
    )
    squares = np.sum(residual**2, axis=1)
    stretches = np.array_split(np.arange(len(squares)), STRETCHES)
    sums = [float(np.sum(squares[rows])) for rows in stretches]
    worst = int(np.argmax(sums))
    if sums[worst] < CONCENTRATED * sum(sums):
        return ""
    time = contest.log.motion.time[stretches[worst]]
    return f", most of it from {time[0]:.3g} s to {time[-1]:.3g} s"


def too_many_causes(contest: Contest, named: Sequence[Finding]) -> Finding:
    """Return the finding that a log needs more explanations at once than are likely."""
    share = percent(misfit(contest.log, contest.posterior))
    count = len(named)
    names = ", ".join(cause.name for cause in named)
    text = (
        f"{share} of the torque is explained by no single cause: it would take {count} at once "
        f"({names}); is the model of this arm, with what is fixed to its links?"
    )
    return Finding("unexplained", Level.WARN, text)


def implausible_links(contest: Contest, posterior: Posterior) -> Finding:
    """Return the finding that the estimated links are implausible for this arm."""
    mass, error = contest.last_mass(posterior)
    arm = contest.log.robot.mass
    differences = np.sqrt(contest.strain(posterior) / TYPICAL_STRAIN)
    text = (
        f"to fit this log, the terminal link would have {with_error(mass, error, 'kg')} on an arm "
        f"of {arm:.3g} kg, and the other links {differences:.1f} times the usual "
        "differences from the model: is the model of this arm, and its base mounted as the model "
        "says? Where torques are currents of unknown scale, weigh a known mass with robot-sysid "
        "payload --known-mass and pass its file as --torque-scale"
    )
    return Finding("model", Level.WARN, text)
