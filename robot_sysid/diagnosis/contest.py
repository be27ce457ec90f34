"""What is wrong with a log or its model: a cause is named when it explains.

The fit of a log is judged as it stands. Where it does not fit, discrete mistakes (``relabelling``)
are tried first. Then effects (``causes``) are offered to the fit; the likeliest joins it where it
gains ``CLEAR`` nats, and the others are offered again. A cause is named where

(a) the fit with all that is found leaves no more unexplained than right logs do;
(b) no column that is independent of it contradicts it;
(c) its value is ``SURE`` of its own errors, and of a size that exists;
(d) it changes what was asked, or else it is a note.

Otherwise the log does not fit: how much is unexplained, at which joints, and what is missing there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.diagnosis import Finding
from robot_sysid.diagnosis.causes import (
    INERTIAL,
    WEIGHT,
    Explanation,
    explanations,
    typical_torque,
)
from robot_sysid.diagnosis.relabelling import (
    LARGER,
    SMALLER,
    Correction,
    clear_factor,
    common_scale,
    discrete,
    model_torque,
    odd_unit,
    own_scales,
    typical_ratio,
)
from robot_sysid.dynamics.friction import COULOMB, OFFSET, VISCOUS
from robot_sysid.estimate.contacts import LITTLE
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Effect, Offer, Offers
from robot_sysid.estimate.questions import PER_CENT
from robot_sysid.estimate.rows import Rows
from robot_sysid.estimate.terms import (
    LAST_LINK,
    LINKS,
    PAYLOAD_NAMES,
    Point,
    Term,
    independent,
)
from robot_sysid.estimate.trust import UNEXPLAINED
from robot_sysid.records import Array
from robot_sysid.records.levels import CLEAR, INTERVAL, SURE
from robot_sysid.records.messages import Level, percent, torque_unit, with_error
from robot_sysid.records.parameters import Parameter
from robot_sysid.spatial import PARAMETER_NAMES
from robot_sysid.wording import option_name

TIE = 6.0
"""Difference in gain within which two explanations count as equally likely [nats]."""
LIKE_GRAVITY = ("force", "gravity", "tilt", "payload-step")
"""Checks whose causes may stand for gravity in another direction."""
RELABELLED = ("sign", "order", "angle-unit", "zero", "tilt")
"""Checks of discrete mistakes."""
SCALES = ("torque-scale", "torque-unit")
"""Checks of torque scales."""
SHAPES = ("force", "contact", "crosstalk")
"""Checks whose causes at one joint are torque of any shape."""
EXACT = 0.001
"""Error of filtering in dry friction, as a share of the joint's torque."""
OF_LINKS = (
    "torque-scale",
    "torque-unit",
    "model",
    "tilt",
    "gravity",
    "force",
    "order",
    "zero",
)
"""Checks that an experiment on single joints says nothing of."""
CAUSE = "explanation"
"""Cause of the term of an explanation that has joined a fit."""
RIGHT_MODEL = "check that the model is of this arm, with all that is fixed to its links"
MEASURED = "record the measured joint torque"


@dataclass(frozen=True)
class Score:
    """An explanation, and what a fit says of it.

    Attributes:
        explanation: the fault.
        offer: its values, and what it leaves.
        gain: of the offer, minus the log of ``Explanation.choices``.
        fitted: the fit that it was offered to.
        allowed: parameter to its standard error in the fit of the log, as it is printed.
    """

    explanation: Explanation
    offer: Offer
    gain: float
    fitted: Fit
    allowed: Mapping[str, float]

    @property
    def distance(self) -> float:
        """The value in its own errors; zero where it is of no size that exists."""
        return self.explanation.distance(self.offer)

    @property
    def explained(self) -> Array:
        """Torque (J,) that is left unexplained without it only, root mean square [N m]."""
        counts = np.maximum(np.sum(self.fitted.sums.counts, axis=0), 1.0)
        squares = np.maximum(self.offer.successive, 0.0) / counts
        return np.sqrt(np.maximum(self.fitted.unexplained**2 - squares, 0.0))

    @property
    def share(self) -> float:
        """The torque that it explains, as a share of all torque."""
        torque = np.linalg.norm(self.fitted.sums.rms_torque)
        return float(np.linalg.norm(self.explained) / torque)

    @property
    def is_like_gravity(self) -> bool:
        """Whether it may stand for gravity in another direction."""
        explanation = self.explanation
        is_of_arm = explanation.effect.joint is None and self.level is not Level.SAYS
        return is_of_arm and explanation.check in LIKE_GRAVITY

    @property
    def is_shape(self) -> bool:
        """Whether it is torque of a shape at one joint, which may stand for other terms."""
        explanation = self.explanation
        return explanation.check in SHAPES and explanation.effect.joint is not None

    @property
    def is_reportable(self) -> bool:
        """Whether it explains enough for a finding."""
        is_of_log = self.explanation.effect.joint is None
        is_of_log &= self.explanation.level is not Level.SAYS
        # What is as clear as this is noted however small it is.
        is_clear = self.gain > 3.0 * CLEAR
        is_harmful = self.level is not Level.SAYS
        return is_harmful or is_of_log or is_clear or self.share > 0.005

    @property
    def matters(self) -> bool:
        """Whether what was asked changes with it by more than a standard error."""
        fitted = self.fitted
        asked = PAYLOAD_NAMES if fitted.question.loaded else PARAMETER_NAMES
        errors = np.array([self.allowed[name] for name in asked])
        change = np.abs(self.offer.change[fitted.at(asked)])
        return bool(np.any(change > errors))

    @property
    def level(self) -> Level:
        """The explanation's level where an estimate that ignores it would be wrong, else SAYS."""
        if self.is_shape:
            # Other terms take less than that for theirs.
            is_harmful = self.share > 0.015
        else:
            is_harmful = self.matters or self.share > UNEXPLAINED
        return self.explanation.level if is_harmful else Level.SAYS


@dataclass(frozen=True)
class Evidence:
    """What is known of a log beside its rows.

    Attributes:
        divided: (n,) torque scales by which the torques were divided already.
        time_share: by which time is too long, by recorded velocities; None where there are none.
        torque: root mean square of each joint's.
    """

    divided: Array
    time_share: float | None = None

    def contradicts(self, score: Score) -> bool:
        """Return whether a column that is independent of an explanation contradicts it."""
        return score.explanation.check == "clock" and self.time_share == 0.0


def findings(
    fitted: Fit, evidence: Evidence, advance: Callable[[], object]
) -> tuple[list[Finding], Fit]:
    """Return what is wrong with a log or its model, and the fit of the log that is right then.

    Nothing is wrong where the log fits its model.

    Args:
        fitted: the fit of the log, with the columns of ``causes.beside``.
        evidence: what is known beside its rows.
        advance: is called after each round.
    """
    if is_computed(fitted):
        text = "the torque follows rigid-body dynamics and has no friction: it was computed, or "
        text += "commanded, not measured"
        return [Finding(Level.DOUBTS, "computed", text, MEASURED)], fitted
    if evidence.time_share and (wrong := [*wrong_time(fitted, evidence.time_share)]):
        return wrong, fitted
    is_experiment = is_of_single_joints(fitted)
    contest = Contest(fitted, evidence)
    contest.run(advance)
    may_be_turned = any(ties[0].is_like_gravity for ties in contest.rounds)
    is_fitting = fits(fitted) and not may_be_turned
    if not is_experiment and not is_fitting:
        best = correction(fitted, evidence, advance)
        if best is not None:
            corrected = Contest(best.fit, evidence, best)
            corrected.run(advance)
            is_better = corrected.gain > contest.gain or is_foreign(fitted)
            if (corrected.explains, is_better) > (contest.explains, False):
                contest = corrected
    is_relabelled = any(each.about in RELABELLED for each in contest.corrected)
    if not (is_experiment or is_relabelled or is_fitting):
        found = [*odd_unit(fitted, dry_friction(fitted)[0])]
        if found:
            return found, fitted
    if lacks_weight(fitted) and not (contest.explains and contest.corrected):
        text = "the torque has little of the links' weight: it may be external torque, left after "
        text += "a controller's model, or motor current"
        remedy = f"{MEASURED}, or give {option_name('torque_constants')} for a current"
        return [Finding(Level.REFUSES, "gravity", text, remedy)], fitted
    if not contest.explains:
        # Friction that drives a joint is a turned sign whatever the model.
        is_shown = is_relabelled and drives(fitted) and not drives(contest.first)
        found = contest.corrected if is_shown else [misfit(fitted, contest.least)]
        return found, contest.first
    # Of more than three causes that act together, the others are small.
    named = [*contest.corrected, *name_causes(contest.rounds[:3])]
    unmeasured = [each for each in named if each.about in ("computed", "torque-unit")]
    if unmeasured:
        # What is no torque of this arm, or in no known unit, shows nothing else.
        return unmeasured, contest.first
    if is_experiment:
        named = [each for each in named if each.about not in OF_LINKS]
    elif all(finding.level is Level.SAYS for finding in named):
        named += wrong_models(contest.first, contest.current, evidence)
    return named, contest.first


def is_of_single_joints(fitted: Fit) -> bool:
    """Return whether joints are driven one at a time, as people measure their friction.

    Such an experiment hardly shows links, nor what is wrong with their torques as a whole.
    """
    used = [recording.used[:, fitted.arm.indices] for recording in fitted.recordings]
    counts = np.sum(np.concatenate(used), axis=1)
    return bool(np.mean(counts[counts > 0]) < 1.5) if np.any(counts) else False


def fits(fitted: Fit) -> bool:
    """Return whether a log fits its model so well that its columns are right."""
    touched = any(recording.touched for recording in fitted.recordings)
    return bool(
        fitted.unexplained_share < LITTLE
        and not is_foreign(fitted)
        and is_plausible(fitted)
        and not drives(fitted)
        and not touched
    )


def drives(fitted: Fit) -> bool:
    """Return whether friction drives a joint: a turned sign, whatever the model."""
    dry, error = dry_friction(fitted)
    return bool(np.any(dry < -SURE * error))


def correction(
    fitted: Fit, evidence: Evidence, advance: Callable[[], object]
) -> Correction | None:
    """Return the best correction of a log that does not fit; None where none puts it right."""
    before = fitted.unexplained_share
    is_unit = is_foreign(fitted)

    def is_right(tried: Correction) -> bool:
        """Return whether a correction leaves clearly less, in an arm that may exist."""
        after = tried.fit.unexplained_share
        is_less = after < 0.7 * before or after < LITTLE < before
        is_turned_back = drives(fitted) and not drives(tried.fit)
        # Links fit torques in another unit, if they may be off by as much.
        is_clear = is_unit or (tried.gain > CLEAR and (is_less or is_turned_back))
        return is_clear and is_plausible(tried.fit) and not is_odd(tried.fit)

    tried = [
        *common_scale(fitted, evidence.divided),
        *own_scales(fitted, evidence.divided),
        *discrete(fitted, fits, advance),
    ]
    return max(filter(is_right, tried), key=lambda each: each.gain, default=None)


def is_foreign(fitted: Fit) -> bool:
    """Return whether torques are so small or large that no links, nor a tool, make them."""
    return not SMALLER < typical_ratio(fitted) < LARGER


class Contest:
    """A fit, and the explanations that join it one after the other.

    Args:
        fitted: the fit of a log, with the columns of ``causes.beside``.
        evidence: what is known beside its rows.
        correction: that was made of the log; None for none.

    Attributes:
        first: the fit without explanations.
        current: that with all that have joined it.
        corrected: what the correction says.
        rounds: those that won, each with those that tie with it.
        least: what a single cause leaves unexplained, as a share of all torque.
        gain: of all that was found, in log likelihood [nats].
    """

    def __init__(
        self, fitted: Fit, evidence: Evidence, correction: Correction | None = None
    ) -> None:
        self.first = self.current = fitted
        self.corrected: list[Finding] = []
        self.rounds: list[list[Score]] = []
        self.least = fitted.unexplained_share
        self.gain = 0.0
        if correction is not None:
            self.corrected += correction.findings
            self.gain = correction.gain
        self._evidence = evidence
        self._effects: list[Effect] = []

    @property
    def explains(self) -> bool:
        """Whether no more is left unexplained than right logs leave."""
        return self.current.unexplained_share < UNEXPLAINED

    def run(self, advance: Callable[[], object]) -> None:
        """Let explanations join the fit as long as they gain clearly."""
        allowed = dict(zip(self.first.names, self.first.errors))
        # Largest number of causes that act together.
        most_rounds = 5
        while len(self.rounds) < most_rounds:
            advance()
            scores = self.ranked(allowed)
            if any(each.about in SCALES for each in self.corrected):
                # Joints whose scales no torque shows keep their share of the others'.
                scores = [s for s in scores if s.explanation.check not in SCALES]
            if not scores or scores[0].gain < CLEAR:
                break
            if self._takes_scales(scores[0]):
                continue
            ties = [score for score in scores if score.gain > scores[0].gain - TIE]
            # Of equally likely ones, a sure one with a single value joins the fit.
            ties.sort(key=lambda s: (s.distance < SURE, len(s.offer.values) > 1))
            if ties[0].distance < SURE:
                break
            self.join(ties[0])
            self.rounds.append(ties)
            self.gain += ties[0].gain
            if len(self.rounds) == 1:
                self.least = min(self.least, self.current.unexplained_share)

    def _takes_scales(self, score: Score) -> bool:
        """Return whether more than one joint has a torque scale of its own, and correct them."""
        if score.explanation.check not in SCALES or self.corrected or self.rounds:
            return False
        for each in own_scales(self.first, self._evidence.divided):
            if each.gain > score.gain + TIE and is_plausible(each.fit):
                self.first = self.current = each.fit
                self.corrected += each.findings
                self.gain = each.gain
        return bool(self.corrected)

    def ranked(self, allowed: Mapping[str, float]) -> list[Score]:
        """Return the likeliest explanations that are possible, the largest gain first.

        ``allowed`` are the standard errors of the parameters, by name.

        Of those of one check and joint that differ in a setting, the best one counts. A fault
        makes noise slow, and hides in it: explanations are compared as if it were white, and
        the likeliest weighed with the noise that they leave.
        """
        fitted = self.current
        white = Offers(fitted)
        best: dict[object, tuple[float, Explanation]] = {}
        for explanation in explanations(fitted):
            offer = white.offer(explanation.effect)
            gain = offer.gain - np.log(explanation.choices)
            family = (*explanation.subject, len(offer.values))
            if gain > best.get(family, (0.5 * CLEAR,))[0]:
                best[family] = gain, explanation
        scores = []
        rounding = EXACT**2 * np.sum(fitted.sums.squared_torque)
        is_loaded = fitted.question.loaded
        likeliest = sorted(best.values(), key=lambda pair: -pair[0])
        # To weigh one takes much longer than to offer it.
        for _, explanation in likeliest[:8]:
            offer = white.offer(explanation.effect)
            total, slow = white.slow_gain(offer)
            # Links that a joint's own shape relieves are no evidence for it. Nor is what all
            # logs share evidence for what differs between empty and loaded ones.
            score = Score(explanation, offer, offer.gain, fitted, allowed)
            relief = 0.0 if score.is_shape or is_loaded else 0.5 * offer.relief
            # Of all joints together, no more torque may be left over than without it.
            is_less = np.sum(offer.squares) < np.sum(white.squares) + rounding
            # At least a half of what a cause explains is not noise.
            if is_less and slow + relief > max(0.5 * (total + relief), CLEAR):
                score = self.weighed(score, white)
                if score.distance > INTERVAL and not self._evidence.contradicts(score):
                    scores.append(score)
        return sorted(scores, key=lambda score: -score.gain)

    def weighed(self, score: Score, offers: Offers) -> Score:
        """Return a score with the noise that its explanation leaves.

        The instant at which a load changes is found first, to a row.
        """
        explanation = score.explanation
        if explanation.check == "payload-step":
            return self._located(score)
        offer = offers.weigh(explanation.effect)
        gain = offer.gain - np.log(explanation.choices)
        gain -= 0.5 * offer.relief * self.current.question.loaded
        return replace(score, offer=offer, gain=float(gain))

    def join(self, score: Score) -> None:
        """Add an explanation to the fit."""
        self.current = score.fitted
        self._effects.append(score.explanation.effect)
        terms = self.current.equations.terms
        self.current = rebuilt(self.current, terms, [score.explanation.effect])

    def _located(self, score: Score) -> Score:
        """Return the score of a change of load at the instant that fits best."""
        fitted = self.current
        instant, log = instant_of(fitted, score)
        last = fitted.arm.terms[LAST_LINK]
        names = tuple(f"{name} from {instant:.4f} s" for name in last.names)

        def columns(rows: Rows, point: Point) -> Array:
            """Return the torque (m, J, 10) of the last link's parameters after the instant."""
            key = "after", instant
            after = rows.low_passed(key, lambda m: (m.time >= instant).astype(float))
            is_own = rows.recording.name == log
            return last.columns(rows, point) * (after * is_own)[:, None, None]

        arm = fitted.arm.beside([Term("", tuple(map(Parameter, names)), columns)])
        sums = arm.sums(fitted.recordings, fitted.point)
        terms = [t for t in fitted.equations.terms if t.cause != CAUSE]
        wider = rebuilt(replace(fitted, arm=arm, sums=sums), terms, self._effects)
        explanation = score.explanation
        explanation = replace(
            explanation,
            effect=Effect(names, explanation.effect.factor),
            text=explanation.text.replace("{instant}", f"{instant:.3g} s"),
        )
        offer = Offers(wider).weigh(explanation.effect)
        gain = offer.gain - np.log(len(sums.logs))
        return Score(explanation, offer, float(gain), wider, score.allowed)


def rebuilt(fitted: Fit, terms: Sequence[Term], effects: Sequence[Effect]) -> Fit:
    """Return the fit of terms, and of effects whose columns join the sums of a fit."""
    sums = fitted.sums
    terms = [*terms]
    for effect in effects:
        size = effect.factor.shape[1]
        names = tuple(f"cause {len(sums.names)} {k}" for k in range(size))
        at = sums.at(effect.names)
        sums = sums.with_columns(names, at, effect.factor, effect.joint, effect.shares)
        prior = independent(np.ones(size))
        terms.append(Term(CAUSE, tuple(map(Parameter, names)), in_sums_alone, prior))
    return replace(fitted, sums=sums).refit(terms)


def in_sums_alone(rows: Rows, point: Point) -> Array:
    """Raise an error: columns of a cause that has joined a fit stand in its sums alone."""
    raise NotImplementedError


def instant_of(fitted: Fit, score: Score) -> tuple[float, str]:
    """Return (instant at which a load changed, log): that which explains the residuals best.

    Residuals without the load count before it, those with it from then on.
    """
    shares = score.offer.effect.shares
    assert shares is not None
    log = fitted.sums.logs[int(np.argmax(shares))]
    recordings = tuple(each for each in fitted.recordings if each.name == log)
    values = fitted.free + score.offer.change
    loaded = values.copy()
    loaded[fitted.at(PARAMETER_NAMES)] += score.offer.values
    of_log = replace(fitted, recordings=recordings)
    before, after = (replace(of_log, values=v).residuals for v in (values, loaded))
    better = np.nansum((before**2 - after**2) / fitted.noise**2, axis=1)
    gains = np.cumsum(better[::-1])[::-1]
    time = np.concatenate([recording.motion.time for recording in recordings])
    return float(time[np.argmax(gains)]), log


def name_causes(rounds: Sequence[Sequence[Score]]) -> list[Finding]:
    """Return a finding for each round whose winner is reportable and has a new subject.

    Those that tie with the winner and are reportable, too, are named in its finding, the best one
    of each check. The finding has the check of the winner, and the most severe level of all.
    """
    named: list[Finding] = []
    known: set[object] = set()
    for scores in rounds:
        best: dict[str, Score] = {}
        for score in scores:
            if score.is_reportable and score.explanation.subject not in known:
                best.setdefault(score.explanation.check, score)
        winner = scores[0].explanation
        if best.get(winner.check) is not scores[0]:
            continue
        known |= {score.explanation.subject for score in scores}
        descriptions = [
            score.explanation.describe(score.offer) for score in best.values()
        ]
        texts, remedies = map(dict.fromkeys, zip(*descriptions))
        level = min((score.level for score in best.values()), key=[*Level].index)
        remedy = ", or ".join(filter(None, remedies))
        named.append(Finding(level, winner.check, "; or ".join(texts), remedy))
    return named


def wrong_time(fitted: Fit, share: float) -> Iterator[Finding]:
    """Yield the finding that time is too long by a share, by recorded velocities.

    Nothing is yielded where torques rather say that time is right.
    """
    (clock,) = (
        each
        for each in explanations(fitted)
        if each.check == "clock" and each.effect.shares is None
    )
    value = 0.5 * Offers(fitted).weigh(clock.effect).values[0]
    if abs(value - share) > abs(value):
        return
    way = "long" if share > 0.0 else "short"
    text = f"time in the log is {percent(abs(share))} too {way}, by the recorded velocities"
    remedy = "record the controller's own time stamps, or scale these with a line in "
    remedy += (
        f"{option_name('columns', 'FILE')}: time = {1.0 / (1.0 + share):.3g} * TITLE"
    )
    yield Finding(Level.REFUSES, "clock", text, remedy)


def wrong_models(fitted: Fit, current: Fit, evidence: Evidence) -> Iterator[Finding]:
    """Yield what is wrong as a whole, where no cause is named that forbids an estimate.

    Args:
        fitted: the fit of the log.
        current: that with all that is named.
        evidence: what is known beside its rows.
    """
    # A cause that was found may explain it.
    is_off = clear_factor(current) is not None
    for each in common_scale(fitted, evidence.divided) if is_off else ():
        if each.fit.unexplained_share < UNEXPLAINED:
            yield from each.findings
            return
    robot = fitted.arm.robot
    if not is_plausible(current):
        text = (
            f"to fit this log, the terminal link would have {with_error(*last_mass(current), 'kg')}"
            f" on an arm of {robot.mass:.3g} kg, or other links would be far from the model's"
        )
        remedy = f"{RIGHT_MODEL}, and its base mounted as the model says"
        # What an empty log has wrong as well does not matter to a payload.
        level = Level.SAYS if fitted.question.loaded else Level.DOUBTS
        yield Finding(level, "model", text, remedy)
        return
    if is_odd(fitted):
        scales = fitted.question.link_scales
        share = PER_CENT * fitted.question.options.priors.link
        text = (
            f"the links differ from the model by {percent(scales.mass * share)} of their masses, "
            f"and by {percent(scales.centre_of_mass * share)} of their size in their centres of "
            "mass: it may be the model of a sibling of this arm; the standard errors "
            "of links before the last may be too small"
        )
        level = Level.DOUBTS if current.unexplained_share > PER_CENT else Level.SAYS
        yield Finding(level, "model", text, RIGHT_MODEL)


def is_odd(fitted: Fit) -> bool:
    """Return whether links differ from the model as those of another arm do."""
    # Factors on the stated uncertainty, as the log shows it. Masses of siblings reach 6.1 to 7.7,
    # but one right arm in forty with a link that is 40 % off 8.0: no torque tells these apart, but
    # models of other arms leave more than 1 % of it unexplained. Centres of mass of right arms
    # reach 2.2, of another arm 5.8 to 6.5.
    scales = fitted.question.link_scales
    return scales.mass > 7.25 or scales.centre_of_mass > 5.7


def misfit(fitted: Fit, least: float) -> Finding:
    """Return the finding that a log does not fit its model, and what is missing at which joints.

    Args:
        fitted: the fit of the log.
        least: what the nearest single cause leaves unexplained, as a share of all torque.
    """
    typical = typical_torque(fitted)
    worst = np.argsort(-fitted.unexplained)[:3].tolist()
    share = fitted.unexplained_share
    joints = [fitted.arm.joints[k] for k in worst]
    shares = [percent(float(fitted.unexplained[k] / typical[k])) for k in worst]
    listed = ", ".join(
        f"{name} ({part} of its own)" for name, part in zip(joints, shares)
    )
    text = f"the torques do not fit this model: {percent(share)} unexplained, mostly at {listed}"
    if least < share:
        text += f"; the nearest single cause leaves {percent(least)}"
    for k in worst:
        text += f"; {missing(fitted, k)}"
    # What leaves so much is another arm.
    check = "model" if share > 0.3 else "unexplained"
    remedy = f"{RIGHT_MODEL}, and that it carried the same load all the time, with no contact"
    return Finding(Level.DOUBTS, check, text, remedy)


def missing(fitted: Fit, joint: int) -> str:
    """Return what a joint's torque has of the model's weight and inertia, by a regression."""
    name = fitted.arm.joints[joint]
    found = regression(fitted, joint)
    parts = [
        f"{percent(found[n])} of the model's {word}"
        for n, word in ((WEIGHT, "weight"), (INERTIAL, "inertia"))
        if n in found
    ]
    unit = torque_unit(name in fitted.arm.robot.slides)
    coulomb = COULOMB.key_of(name)
    if coulomb in found:
        parts.append(f"friction of {found[coulomb]:.2g} {unit}")
    return f"{name} has {', '.join(parts)}"


def regression(fitted: Fit, joint: int) -> dict[str, float]:
    """Return what a joint's torque has of the model's weight, its inertia, friction and offset."""
    sums = fitted.sums
    own = (term.key_of(sums.joints[joint]) for term in (COULOMB, VISCOUS, OFFSET))
    names = [sums.names[column] for column in sums.columns[joint][:-1]]
    shown = [name for name in (WEIGHT, INERTIAL, *own) if name in names]
    at = [names.index(name) for name in shown]
    total = sums.totals[joint]
    values, *_ = np.linalg.lstsq(total[np.ix_(at, at)], total[at, -1], rcond=1e-12)
    return dict(zip(shown, values.tolist()))


def lacks_weight(fitted: Fit) -> bool:
    """Return whether torques are small, and have no weight at the joint that carries most."""
    torque, *_ = model_torque(fitted)
    share = regression(fitted, int(np.argmax(torque))).get(WEIGHT, 1.0)
    is_small = fitted.arm.has_gravity and typical_ratio(fitted) < SMALLER
    # With less of it, torque is external, or less a controller's model.
    return is_small and abs(share) < 0.1


def dry_friction(fitted: Fit) -> tuple[Array, Array]:
    """Return Coulomb friction (J,) without its bound and its standard error [N m].

    That of a joint that stands still is zero, its error infinite.
    """
    names = np.array([COULOMB.key_of(joint) for joint in fitted.arm.joints])
    is_shown = np.isin(names, fitted.names)
    at = fitted.at(names[is_shown].tolist())
    dry = np.zeros(len(names))
    error = dry + np.inf
    values, inverse = fitted.unbounded
    dry[is_shown] = values[at]
    error[is_shown] = np.sqrt(np.maximum(np.diag(inverse)[at], 0.0))
    return dry, error


def is_computed(fitted: Fit) -> bool:
    """Return whether the torque was computed from a model: no joint has friction.

    It has to be so well known that friction of a real arm would show.
    """
    torque = typical_torque(fitted)
    dry, error = dry_friction(fitted)
    *_, is_loaded = model_torque(fitted)
    size = float(np.linalg.norm(torque[is_loaded]))
    known = np.linalg.norm(error[is_loaded]) / max(size, 1e-300)
    distance = np.sum((dry / np.hypot(error, EXACT * torque)) ** 2)
    limit = len(dry) + 3.0 * np.sqrt(2.0 * len(dry))
    # With a larger error, none can be told.
    return bool(size > 0.0 and known < 2.0 * EXACT and distance < limit)


def last_mass(fitted: Fit) -> tuple[float, float]:
    """Return the last link's mass and its standard error [kg]."""
    return fitted.free[fitted.names.index("m")], fitted.error_of("m")


def is_plausible(fitted: Fit) -> bool:
    """Return whether the last link's mass is that of a link, and the others are near the model's.

    The mass has to lie, within ``SURE`` standard errors, between zero and the larger of two limits:
    60 % of the arm's mass, and the model's mass plus 30 % of the arm's.
    """
    robot = fitted.arm.robot
    largest = max(0.6 * robot.mass, robot.prior.mass + 0.3 * robot.mass)
    mass, error = last_mass(fitted)
    is_possible = -SURE * error < mass < largest + SURE * error
    for term, span in fitted.equations.spans:
        if term.cause == LINKS and term.prior is not None:
            values = np.append(fitted.free[span], -1.0)
            count = len(term.names)
            # Four deviations of chi-square beyond its mean: no log of the right model is there.
            largest = count + 4.0 * np.sqrt(2.0 * count)
            is_possible &= np.sum((term.prior.rows @ values) ** 2) < largest
    return bool(is_possible)
