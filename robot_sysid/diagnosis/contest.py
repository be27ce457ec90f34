"""The contest of explanations: what a log's model lacks, named by the log evidence.

The base model is what the estimate allows for. Each explanation is scored beside it with noise of
its own. The winner is named where the log is likelier by ``MARGIN`` nats; what is as likely within
``TIE`` nats is named with it, for the log cannot tell them apart. Then it joins the base model, and
the others are scored again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.diagnosis import Finding, Level
from robot_sysid.diagnosis.evidence import Hypotheses, Posterior
from robot_sysid.diagnosis.explanations import Explanation, Fitted, explanations
from robot_sysid.diagnosis.relabelling import (
    Relabelled,
    odd_unit_finding,
    undone_columns,
    undone_scales,
    undone_torques,
    usual_scale,
)
from robot_sysid.diagnosis.rows import LogRows, Prior, base_prior, log_rows, rms
from robot_sysid.dynamics.equations import link_names, other_links
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.messages import percent, with_error
from robot_sysid.signals.process import ProcessedSignals

MARGIN = 15.0
RELABELLED_MARGIN = 8.0
TIE = 6.0
"""Nats by which an explanation has to make a log likelier, and columns that are taken for others,
of which there are few; nats within which two explanations are as likely."""
LEAST_SHARE = 0.015
SURE = 3.0
"""Part of the torque that an explanation has to explain, and standard errors by which a coefficient
of it has to be off."""
MATTERS = 1.0
HARMFUL_SHARE = 0.05
"""Standard errors of the last link that an explanation moves it by, or part of the torque that it
makes, from which on a result that takes no notice of it is not right."""
MOST_NAMES = 3
"""How many explanations may come together: more are no explanation."""
UNEXPLAINED = 0.05
OTHER_ARM = 0.3
"""Parts of the torque that neither noise nor an explanation accounts for, from which on nothing is
named, and from which on the model is of another arm: right logs have 0.03 at most."""
GROSS = 0.05
GROSS_JOINT = 0.5
SMALL = 0.02
"""Parts left of the torque and of one joint's from which on relabelled columns are tried, and the
part of the torque that they may leave even where the log as it is leaves less."""
USUAL_STRAIN = 7.0
FAR = 40.0
ODD_SCALE = 1.3
"""Strain of links of usual arms, and one that none has whose model is its own; factor between usual
torque and the model's from which on scales are tried."""
STRETCHES = 8
CONCENTRATED = 0.4
"""Stretches of a log, and the part of all that is left from which on it is of one of them."""
HEAVIEST = 0.6
"""Mass of a plausible last link, as a part of the arm's."""
# Explanations that get noise of their own in the first round and later, and from which gain on.
_REFITTED = 8
_REFITTED_AGAIN = 4
_WORTH = 3.0
_MOST_ROUNDS = 5


@dataclass(frozen=True)
class Score:
    """An explanation beside the others.

    Attributes:
        gain: by how much likelier the log is [nats].
        values, errors: (e,) its coefficients and their standard errors.
        sureness: how many standard errors the coefficients together are from nothing.
        hypotheses, posterior: the model with it.
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
        """What it is, and what to do."""
        return self.explanation.words(self.values, self.errors)

    @property
    def is_possible(self) -> bool:
        """Whether it is what its words say."""
        return self.explanation.is_possible(self.values, self.errors)

    @property
    def torque(self) -> Array:
        """Torque (K, n) that it makes, or (K, 1) at its joint [N m]."""
        made = self.explanation.columns @ self.values
        return made if made.ndim == 2 else made[:, None]


class Contest:
    """One log and its explanations.

    Args:
        signals: of the log, see ``rows.low_pass``.
        options: what the estimate allows for.

    Attributes:
        log, prior, base, posterior: equations, priors, the base model and its
            posterior.
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
        """Return the last link's mass and its standard error [kg]."""
        prior = prior or self.prior
        mass = prior.mean[0] + prior.spread[0] * posterior.values[0]
        return float(mass), float(prior.spread[0] * np.sqrt(posterior.covariance[0, 0]))

    def is_plausible(self, posterior: Posterior, prior: Prior | None = None) -> bool:
        """Return whether such links could be those of the arm."""
        arm = self.log.robot.mass
        most = max(HEAVIEST * arm, self.log.robot.prior.mass + 0.3 * arm)
        mass, error = self.last_mass(posterior, prior)
        possible = mass + 2.0 * error > 0.0 and mass - 2.0 * error < most
        return possible and self.strain(posterior, prior) < FAR

    def dry_friction(self, posterior: Posterior, prior: Prior) -> tuple[Array, Array]:
        """Return the Coulomb friction (n,) of each joint and its standard error (n,) [N m]."""
        names = [f"coulomb[{name}]" for name in self.log.robot.joint_names]
        places = self.log.columns.indices(names)
        at = np.searchsorted(prior.kept, places)
        error = prior.spread[at] * np.sqrt(np.diag(posterior.covariance)[at])
        return prior.parameters(posterior.values)[places], error

    def friction_share(self, posterior: Posterior) -> Array:
        """Return (n,) the least likely Coulomb friction, in parts of each joint's torque."""
        dry, error = self.dry_friction(posterior, self.prior)
        return np.asarray(np.maximum(np.abs(dry) - SURE * error, 0.0) / self.log.usual)

    def reverses_friction(self, mistake: Relabelled) -> bool:
        """Return whether friction that brakes a joint would drive it with a mistake undone.

        Of a joint that links hardly load, all else fits with either sign.
        """
        dry, error = self.dry_friction(self.posterior, self.prior)
        undone, undone_error = self.dry_friction(mistake.posterior, mistake.prior)
        return bool(np.any((dry > SURE * error) & (undone < -SURE * undone_error)))

    def strain(self, posterior: Posterior, prior: Prior | None = None) -> float:
        """Return the sum of squares of prior standard deviations that the other links are off by,
        with the widest of their priors.
        """
        prior = prior or self.prior
        robot = self.log.robot
        names = [
            name for link in other_links(robot) for name in link_names(robot, link)
        ]
        at = np.searchsorted(prior.kept, self.log.columns.indices(names))
        off = posterior.values[at]
        quadratic_forms = [off @ p[np.ix_(at, at)] @ off for p in prior.precisions]
        return float(min(quadratic_forms))

    def relabelled(self, divided: Array, winner: Score | None) -> list[Relabelled]:
        """Return mistakes of columns, the most likely first.

        Those that need new rows are tried where the base model does not fit, or is far from the
        model's links, and so does the best explanation.

        Args:
            divided: (n,) scale that torques were divided by already.
            winner: of the first round of explanations.
        """
        undone = undone_torques(self.log, self.signals, self.base, self.posterior)
        best = self.posterior if winner is None else winner.posterior
        by_joint = misfit_by_joint(self.log, best)
        is_gross = (
            misfit(self.log, best) > GROSS or float(np.max(by_joint)) > GROSS_JOINT
        )
        is_far = is_gross or not self.is_plausible(best)
        if is_far or abs(np.log(usual_scale(self.log))) > np.log(ODD_SCALE):
            undone += undone_scales(self.log, self.posterior, self.options, divided)
        if is_far:
            undone += undone_columns(
                self.log, self.signals, self.posterior, self.options
            )
        most = max(misfit(self.log, self.posterior), SMALL)
        fitting = [m for m in undone if misfit(m.log, m.posterior) <= most]
        plausible = [
            mistake
            for mistake in fitting
            if self.is_plausible(mistake.posterior, mistake.prior)
            and not self.reverses_friction(mistake)
        ]
        return sorted(plausible, key=lambda mistake: -mistake.gain)

    def rounds(self) -> list[list[Score]]:
        """Return, per round, the winning explanation and those that are as likely."""
        trusted = self.is_plausible(self.posterior)
        fit = Fitted(self.log, self.signals, self.prior, self.posterior, trusted)
        offered = [e for e in explanations(fit) if not self.is_sought(e)]
        columns = transform_columns(self.base, offered)
        winners: list[list[Score]] = []
        model = self.base
        posterior = self.posterior
        while len(winners) < _MOST_ROUNDS:
            count = _REFITTED if not winners else _REFITTED_AGAIN
            ranked = self._ranked(model, posterior, offered, columns, count)
            if not ranked or ranked[0].gain < MARGIN:
                break
            alike = [score for score in ranked if score.gain > ranked[0].gain - TIE]
            # Of what is as likely, that which is what its words say.
            alike.sort(key=lambda score: not score.is_possible)
            winners.append(alike)
            model = alike[0].hypotheses
            posterior = alike[0].posterior
        return winners

    def is_sought(self, explanation: Explanation) -> bool:
        """Return whether the estimate finds it itself."""
        sought = {"delay": self.options.delay, "tilt": self.options.tilt}
        return explanation.joint is None and sought.get(explanation.name) == "auto"

    def _ranked(
        self,
        model: Hypotheses,
        posterior: Posterior,
        offered: Sequence[Explanation],
        columns: Sequence[Sequence[Array | None]],
        count: int,
    ) -> list[Score]:
        penalties = np.log([explanation.choices for explanation in offered])
        gains = screen_gains(model, posterior, columns) - penalties
        best_of_family: dict[object, int] = {}
        for k in np.argsort(-gains):
            if gains[k] > _WORTH:
                best_of_family.setdefault(offered[k].family, int(k))
        finalists = list(best_of_family.values())[:count]
        scores = [
            self._score(model, posterior, offered[k], columns[k]) for k in finalists
        ]
        scores = [
            self._refined(model, posterior, score) if score.gain > MARGIN else score
            for score in scores
        ]
        return sorted(scores, key=lambda score: -score.gain)

    def _score(
        self,
        model: Hypotheses,
        posterior: Posterior,
        explanation: Explanation,
        columns: Sequence[Array | None],
    ) -> Score:
        """Return an explanation's score beside a model, with noise of its own."""
        width = len(explanation.spread)
        nothing = np.zeros((len(model.right), width))
        wider = model.with_columns(
            [nothing if column is None else column for column in columns]
        )
        after = wider.posterior(posterior.noise)
        gain = (
            after.log_evidence
            - posterior.log_evidence
            - float(np.log(explanation.choices))
        )
        scaled = after.values[-width:]
        covariance = after.covariance[-width:, -width:]
        sureness = float(np.sqrt(scaled @ np.linalg.solve(covariance, scaled)))
        errors = explanation.spread * np.sqrt(np.diag(covariance))
        return Score(
            explanation,
            gain,
            explanation.spread * scaled,
            errors,
            sureness,
            wider,
            after,
        )

    def _refined(self, model: Hypotheses, posterior: Posterior, score: Score) -> Score:
        """Return the best of the explanations near one, or that one."""
        best = score
        while nearby := best.explanation.nearby():
            columns = transform_columns(model, nearby)
            # With its own noise: beside the model's, all of them look alike.
            quieter = model.at_noise(best.posterior.noise)
            k = int(np.argmax(screen_gains(model, quieter, columns)))
            candidate = self._score(model, posterior, nearby[k], columns[k])
            if candidate.gain <= best.gain:
                break
            best = candidate
        return best

    def is_told(self, score: Score) -> bool:
        """Return whether an explanation is sure of itself, and a fault of the whole log or a fair
        part of the torque: small effects of one joint are neither.
        """
        explanation = score.explanation
        if score.sureness < SURE or not score.is_possible:
            return False
        is_of_log = explanation.joint is None and explanation.level is not Level.NOTE
        return is_of_log or self.torque_share(score) > LEAST_SHARE

    def is_harmful(self, score: Score, before: Posterior) -> bool:
        """Return whether a result that takes no notice of an explanation is not right."""
        explanation = score.explanation
        is_large = bool(abs(score.values[0]) >= explanation.harmful_from)
        if is_large or explanation.level is Level.REFUSE:
            return True
        return self.torque_share(score) > HARMFUL_SHARE or self.moves_link(
            score, before
        )

    def torque_share(self, score: Score) -> float:
        """Return the varying torque that an explanation makes, as a part of all torque."""
        made = np.linalg.norm(np.std(score.torque, axis=0))
        return float(made / np.linalg.norm(rms(self.log.torque)))

    def moves_link(self, score: Score, before: Posterior) -> bool:
        """Return whether the last link is another one with an explanation than without."""
        moved = score.posterior.values[:10] - before.values[:10]
        errors = np.sqrt(np.diag(before.covariance)[:10])
        return bool(np.any(np.abs(moved) > MATTERS * errors))


def misfit_by_joint(log: LogRows, posterior: Posterior) -> Array:
    """Return (n,) torque that neither the model nor white noise makes, in parts of each joint's
    usual torque.

    White noise is what is left in the upper half of the frequencies, in which links say little.
    """
    squares = posterior.residual**2
    slow = np.zeros(squares.shape[1])
    for window in log.windows:
        spectrum = squares[window]
        white = len(spectrum) * np.mean(spectrum[len(spectrum) // 2 :], axis=0)
        slow += np.maximum(np.sum(spectrum, axis=0) - white, 0.0)
    counts = np.maximum(np.sum(log.used, axis=0), 1)
    return np.asarray(np.sqrt(slow / counts) / log.usual)


def misfit(log: LogRows, posterior: Posterior) -> float:
    """Return the same of all joints, as a part of all torque."""
    slow = misfit_by_joint(log, posterior) * log.usual
    return float(np.linalg.norm(slow) / np.linalg.norm(rms(log.torque)))


def transform_columns(
    model: Hypotheses, offered: Sequence[Explanation]
) -> list[list[Array | None]]:
    """Return per explanation and joint its columns (K, e), transformed, in units of its prior."""
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
    """Return by how much likelier each explanation makes the log, with the noise as it is [nats].

    With E its columns, r the residual and C the posterior covariance, in units of noise and prior,
    that is 1/2 v' (1 + M)^-1 v - 1/2 log |1 + M|, M = E'E - E'A C A'E and v = E'r.
    """
    widths = [
        next(c.shape[1] for c in of_joints if c is not None) for of_joints in columns
    ]
    ends = np.cumsum([0, *widths])
    crossed = np.zeros((len(posterior.values), ends[-1]))
    pull = np.zeros(ends[-1])
    squares = [np.eye(width) for width in widths]
    for joint in range(len(model.rows)):
        places, rows = model.equations(joint)
        all_columns = {k: of_joints[joint] for k, of_joints in enumerate(columns)}
        of_joint = {k: block for k, block in all_columns.items() if block is not None}
        if not of_joint:
            continue
        at = np.concatenate([np.arange(ends[k], ends[k + 1]) for k in of_joint])
        weight = 1.0 / posterior.noise[:, joint, None]
        stacked = np.hstack([*of_joint.values()])
        crossed[np.ix_(places, at)] += (rows * weight).T @ stacked
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
    """Return what is wrong with a log, by its contest; nothing of a right log.

    Columns that are taken for others come first, then explanations, and last what no explanation
    is made for: torque that is left, and links or causes that no arm has.

    Args:
        divided: (n,) scale that torques were divided by already.
    """
    rounds = contest.rounds()
    undone = contest.relabelled(divided, rounds[0][0] if rounds else None)
    odd_unit = odd_unit_finding(contest.log)
    if odd_unit is not None and not (undone and undone[0].name == "order"):
        return [odd_unit]
    best_gain = rounds[0][0].gain if rounds else 0.0
    # An explanation of the same name is a part of the same fault, or one joint's: no rival of it.
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
    # What comes after so many that are too small to tell is what they leave, no cause.
    return name_causes(contest, rounds[:MOST_NAMES])


def name_causes(contest: Contest, rounds: Sequence[Sequence[Score]]) -> list[Finding]:
    """Return a finding per round whose winner is to be told, each explanation once."""
    named: list[Finding] = []
    before = contest.posterior
    already: set[tuple[str, int | None]] = set()
    for ranked in rounds:
        clear = [score for score in ranked if contest.is_told(score)]
        clear = [score for score in clear if score.explanation.subject not in already]
        if any(score is ranked[0] for score in clear):
            already |= {score.explanation.subject for score in clear}
            best: dict[str, Score] = {}
            for score in clear:
                best.setdefault(score.explanation.name, score)
            harmful = [
                score for score in best.values() if contest.is_harmful(score, before)
            ]
            named.append(_finding([*best.values()], harmful))
        before = ranked[0].posterior
    return named


def _finding(scores: Sequence[Score], harmful: Sequence[Score]) -> Finding:
    """Return the finding of explanations that are as likely, the first of which won."""
    texts = dict.fromkeys(score.text for score in scores)
    levels = {score.explanation.level for score in harmful}
    order = (Level.REFUSE, Level.WARN, Level.NOTE)
    level = next((level for level in order if level in levels), Level.NOTE)
    return Finding(scores[0].explanation.name, level, "; or ".join(texts))


def unexplained_torque(contest: Contest, posterior: Posterior) -> Finding:
    """Return how much of the torque nothing explains, at which joints and when."""
    log = contest.log
    by_joint = misfit_by_joint(log, posterior)
    share = misfit(log, posterior)
    worst = np.argsort(-by_joint * log.usual)[:3]
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
    """Return in which stretch of the log much more than elsewhere is left; "" where in none."""
    residual = contest.base.transform.undone(posterior.residual) / contest.log.usual
    squares = np.sum(residual**2, axis=1)
    stretches = np.array_split(np.arange(len(squares)), STRETCHES)
    sums = [float(np.sum(squares[rows])) for rows in stretches]
    worst = int(np.argmax(sums))
    if sums[worst] < CONCENTRATED * sum(sums):
        return ""
    time = contest.log.motion.time[stretches[worst]]
    return f", most of it from {time[0]:.3g} s to {time[-1]:.3g} s"


def too_many_causes(contest: Contest, named: Sequence[Finding]) -> Finding:
    """Return that it takes more causes at once to explain a log than are likely."""
    share = percent(misfit(contest.log, contest.posterior))
    count = len(named)
    names = ", ".join(cause.name for cause in named)
    text = (
        f"{share} of the torque is explained by no single cause: it would take {count} at once "
        f"({names}); is the model of this arm, with what is fixed to its links?"
    )
    return Finding("unexplained", Level.WARN, text)


def implausible_links(contest: Contest, posterior: Posterior) -> Finding:
    """Return that links are none that this arm can have."""
    mass, error = contest.last_mass(posterior)
    arm = contest.log.robot.mass
    differences = np.sqrt(contest.strain(posterior) / USUAL_STRAIN)
    text = (
        f"to fit this log, the terminal link would have {with_error(mass, error, 'kg')} on an arm "
        f"of {arm:.3g} kg, and the other links {differences:.1f} times the usual "
        "differences from the model: is the model of this arm, and its base mounted as the model "
        "says? Where torques are currents of unknown scale, weigh a known mass with robot-sysid "
        "payload --known-mass and pass its file as --torque-scale"
    )
    return Finding("model", Level.WARN, text)
