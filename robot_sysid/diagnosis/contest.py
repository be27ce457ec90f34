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

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from robot_sysid.diagnosis import Finding
from robot_sysid.diagnosis.causes import (
    CLOCK,
    INERTIAL,
    TIME,
    WEIGHT,
    Explanation,
    Score,
    asked,
    explanations,
    scored,
    typical_torque,
)
from robot_sysid.diagnosis.relabelling import (
    SMALLER,
    Correction,
    Evidence,
    clear_factor,
    common_scale,
    discrete,
    drives,
    dry_friction,
    fits,
    is_foreign,
    is_plausible,
    last_mass,
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
from robot_sysid.estimate.terms import LAST_LINK, Point, Term, independent
from robot_sysid.records import Array
from robot_sysid.records.levels import CLEAR, INTERVAL, SURE, UNEXPLAINED
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
RIGHT_MODEL = "check that the model is of this arm, with all that is fixed to its links"
MEASURED = "record the measured joint torque"


def findings(fitted: Fit, evidence: Evidence) -> tuple[list[Finding], Fit]:
    """Return what is wrong with a log or its model, and the fit of the log that is right then.

    Nothing is wrong where the log fits its model.

    Args:
        fitted: the fit of the log, with the columns of ``causes.beside``.
        evidence: what is known beside its rows.
    """
    found = [*computed(fitted), *wrong_time(fitted, evidence)]
    if found:
        return found[:1], fitted
    is_experiment = is_of_single_joints(fitted)
    contest = Contest(Correction((), 0.0, fitted), evidence)
    is_fitting = fits(fitted) and not any(map(is_like_gravity, contest.winners))
    # Links that may be off hide much of a direction that was stated the wrong way round.
    is_fitting &= fitted.arm.robot.gravity is None
    # An arm that is compared with its model has played the motion: its columns are those of its
    # motors, and a sign or an order would pass for what has happened to it.
    is_of_model = fitted.question.differing is not None
    if not (is_experiment or is_fitting or is_of_model):
        best = sorted(corrections(fitted, evidence), key=lambda c: -c.gain)
        # Whatever explains torques in another unit, they are not right as they are.
        is_unit = is_foreign(fitted)
        contests = [*(Contest(each, evidence) for each in best[:1]), contest]
        contest = max(contests, key=lambda c: (c.explains, is_unit or c.gain))
    right = contest.start.fit
    named = [*contest.start.findings]
    is_relabelled = any(each.about in RELABELLED for each in named)
    if not (is_experiment or is_relabelled or is_fitting):
        found += odd_unit(fitted)
    if not (contest.explains and named):
        found += lost_weight(fitted)
    if found:
        return found[:1], fitted
    if not contest.explains:
        # Friction that drives a joint is a turned sign whatever the model, and nothing else.
        is_sign = {each.about for each in named} == {"sign"}
        is_shown = is_sign and drives(fitted) and not drives(right)
        return named if is_shown else [misfit(fitted, contest.least)], right
    # Of more than three causes that act together, the others are small.
    named += name_causes(contest.rounds[:3])
    unmeasured = [each for each in named if each.about in ("computed", "torque-unit")]
    if unmeasured:
        # What is no torque of this arm, or in no known unit, shows nothing else.
        return unmeasured, right
    if is_experiment:
        return [each for each in named if each.about not in OF_LINKS], right
    if all(finding.level is Level.SAYS for finding in named):
        named += wrong_models(right, contest.current, evidence)
    return named, right


def is_like_gravity(score: Score) -> bool:
    """Return whether an explanation may stand for gravity in another direction."""
    is_of_arm = score.explanation.effect.joint is None
    is_harmful = score.level is not Level.SAYS
    return is_of_arm and is_harmful and score.explanation.check in LIKE_GRAVITY


def is_of_single_joints(fitted: Fit) -> bool:
    """Return whether joints are driven one at a time, as people measure their friction.

    Such an experiment hardly shows links, nor what is wrong with their torques as a whole.
    """
    used = np.concatenate([recording.used for recording in fitted.recordings])
    counts = np.sum(used[:, fitted.arm.indices], axis=1)
    return bool(np.mean(counts[counts > 0]) < 1.5) if np.any(counts) else False


def corrections(fitted: Fit, evidence: Evidence) -> Iterator[Correction]:
    """Yield corrections of a log that leave clearly less, in an arm that may exist."""
    before = fitted.unexplained_share
    makers = common_scale, own_scales, discrete
    for tried in chain.from_iterable(make(fitted, evidence) for make in makers):
        after = tried.fit.unexplained_share
        is_less = after < 0.7 * before or after < LITTLE < before
        is_turned_back = drives(fitted) and not drives(tried.fit)
        is_clear = tried.gain > CLEAR and (is_less or is_turned_back)
        # Links fit torques in another unit, if they may be off by as much.
        is_right = is_clear or is_foreign(fitted)
        if is_right and is_plausible(tried.fit) and not is_odd(tried.fit):
            yield tried


class Contest:
    """A fit, and the explanations that join it one after the other, as long as they gain clearly.

    Args:
        start: the log as it was corrected; a correction without findings for the log as it is. Its
            fit has the columns of ``causes.beside``.
        evidence: what is known beside its rows.

    Attributes:
        start: the log without explanations.
        current: the fit with all that have joined it.
        rounds: those that won, each with those that tie with it.
        least: what a single cause leaves unexplained, as a share of all torque.
    """

    def __init__(self, start: Correction, evidence: Evidence) -> None:
        self.start = start
        self.current = start.fit
        self.rounds: list[list[Score]] = []
        self.least = start.fit.unexplained_share
        self._evidence = evidence
        self._errors = start.fit.errors[start.fit.at(asked(start.fit))]
        # Largest number of causes that act together.
        most_rounds = 5
        while len(self.rounds) < most_rounds:
            evidence.advance()
            if not self._is_joined(self._ranked()):
                break

    @property
    def winners(self) -> list[Score]:
        """Explanations that have joined the fit."""
        return [ties[0] for ties in self.rounds]

    @property
    def gain(self) -> float:
        """Gain of all that was found, in log likelihood [nats]."""
        return self.start.gain + sum(score.gain for score in self.winners)

    @property
    def explains(self) -> bool:
        """Whether no more is left unexplained than right logs leave."""
        return self.current.unexplained_share < UNEXPLAINED

    def _is_joined(self, scores: list[Score]) -> bool:
        """Let the likeliest explanation join the fit, or several torque scales correct it.

        Return whether something clearly gains.
        """
        if any(each.about in SCALES for each in self.start.findings):
            # Joints whose scales no torque shows keep their share of the others'.
            scores = [s for s in scores if s.explanation.check not in SCALES]
        if not scores or scores[0].gain < CLEAR:
            return False
        likeliest = scores[0]
        is_as_it_was = not (self.start.findings or self.rounds)
        if likeliest.explanation.check in SCALES and is_as_it_was:
            for each in own_scales(self.current, self._evidence):
                if each.gain > likeliest.gain + TIE and is_plausible(each.fit):
                    self.start = each
                    self.current = each.fit
                    return True
        ties = [score for score in scores if score.gain > likeliest.gain - TIE]
        # Of equally likely ones, a sure one with a single value joins the fit.
        ties.sort(key=lambda s: (s.distance < SURE, len(s.offer.values) > 1))
        winner = ties[0]
        if winner.distance < SURE:
            return False
        self.current = joined(winner.fitted, [winner.explanation.effect])
        if not self.rounds:
            self.least = min(self.least, self.current.unexplained_share)
        self.rounds.append(ties)
        return True

    def _ranked(self) -> list[Score]:
        """Return the likeliest explanations that are possible, the largest gain first.

        Of those of one check and joint that differ in a setting, the best one counts. A fault
        makes noise slow, and hides in it: explanations are compared as if it were white, and
        the likeliest weighed with the noise that they leave.
        """
        fitted = self.current
        white = Offers(fitted)
        best: dict[object, tuple[float, Explanation, Offer]] = {}
        for explanation in explanations(fitted):
            offer = white.offer(explanation.effect)
            gain = offer.gain - np.log(explanation.choices)
            family = (*explanation.subject, len(offer.values))
            if gain > best.get(family, (0.5 * CLEAR,))[0]:
                best[family] = gain, explanation, offer
        scores = []
        rounding = EXACT**2 * np.sum(fitted.sums.squared_torque)
        is_loaded = fitted.question.loaded
        likeliest = sorted(best.values(), key=lambda each: -each[0])
        # To weigh one takes much longer than to offer it.
        for _, explanation, offer in likeliest[:8]:
            total, slow = white.slow_gain(offer)
            # Links that a joint's own shape relieves are no evidence for it. Nor is what all
            # logs share evidence for what differs between empty and loaded ones.
            is_evidence = not (explanation.is_shape or is_loaded)
            relief = 0.5 * offer.relief * is_evidence
            # Of all joints together, no more torque may be left over than without it.
            is_less = np.sum(offer.squares) < np.sum(white.squares) + rounding
            # At least a half of what a cause explains is not noise.
            if is_less and slow + relief > max(0.5 * (total + relief), CLEAR):
                score = self._weighed(explanation, offer, white)
                # Recorded velocities may contradict it.
                is_clock = explanation.check == "clock"
                is_contradicted = is_clock and self._evidence.time_share == 0.0
                if score.distance > INTERVAL and not is_contradicted:
                    scores.append(score)
        return sorted(scores, key=lambda score: -score.gain)

    def _weighed(self, explanation: Explanation, offer: Offer, white: Offers) -> Score:
        """Return the score of an explanation with the noise that it leaves.

        The instant at which a load changes is found first, to a row.
        """
        relief = 0.5 * self.current.question.loaded
        if explanation.check == "payload-step":
            explanation, fitted = self._located(explanation, offer)
            white = Offers(fitted)
            relief = 0.0
        offer = white.weigh(explanation.effect)
        gain = offer.gain - np.log(explanation.choices) - relief * offer.relief
        return scored(explanation, offer, float(gain), white.fitted, self._errors)

    def _located(
        self, explanation: Explanation, offer: Offer
    ) -> tuple[Explanation, Fit]:
        """Return a change of load at the instant that fits best, and a fit with its columns."""
        fitted = self.current
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
        effects = [winner.explanation.effect for winner in self.winners]
        explanation = replace(
            explanation,
            effect=Effect(names, explanation.effect.factor),
            text=explanation.text.replace("{instant}", f"{instant:.3g} s"),
        )
        return explanation, joined(wider, effects)


def joined(fitted: Fit, effects: Sequence[Effect]) -> Fit:
    """Return the fit of its terms that have columns in its sums, and of effects that join them."""
    sums = fitted.sums
    terms = [t for t in fitted.equations.terms if t.names[0] in sums.names]
    for effect in effects:
        size = effect.factor.shape[1]
        names = tuple(f"cause {len(sums.names)} {k}" for k in range(size))
        at = sums.at(effect.names)
        sums = sums.with_columns(names, at, effect.factor, effect.joint, effect.shares)
        prior = independent(np.ones(size))
        terms.append(Term("", tuple(map(Parameter, names)), in_sums_alone, prior))
    return replace(fitted, sums=sums).refit(terms)


def in_sums_alone(rows: Rows, point: Point) -> Array:
    """Raise an error: columns of a cause that has joined a fit stand in its sums alone."""
    raise NotImplementedError


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


def name_causes(rounds: Sequence[Sequence[Score]]) -> Iterator[Finding]:
    """Yield a finding for each round whose winner is reportable and has a new subject.

    Those that tie with the winner and are reportable, too, are named in its finding, the best one
    of each check. The finding has the check of the winner, and the most severe level of all.
    """
    known: set[object] = set()
    for scores in rounds:
        best: dict[str, Score] = {}
        for score in scores:
            if score.is_reportable and score.explanation.subject not in known:
                best.setdefault(score.explanation.check, score)
        check = scores[0].explanation.check
        if best.get(check) is scores[0]:
            known |= {score.explanation.subject for score in scores}
            level = min((score.level for score in best.values()), key=[*Level].index)
            text = "; or ".join(dict.fromkeys(score.text for score in best.values()))
            remedies = dict.fromkeys(score.remedy for score in best.values())
            yield Finding(level, check, text, ", or ".join(filter(None, remedies)))


def wrong_time(fitted: Fit, evidence: Evidence) -> Iterator[Finding]:
    """Yield the finding that time is too long or too short, by recorded velocities.

    Nothing is yielded where torques rather say that time is right.
    """
    share = evidence.time_share
    value = TIME * Offers(fitted).weigh(CLOCK).values[0] if share else 0.0
    if share and abs(value - share) <= abs(value):
        way = "long" if share > 0.0 else "short"
        yield Finding(
            Level.REFUSES,
            "clock",
            f"time in the log is {percent(abs(share))} too {way}, by the recorded velocities",
            "record the controller's own time stamps, or scale these with a line in "
            f"{option_name('columns', 'FILE')}: time = {1.0 / (1.0 + share):.3g} * TITLE",
        )


def wrong_models(fitted: Fit, current: Fit, evidence: Evidence) -> Iterator[Finding]:
    """Yield what is wrong as a whole, where no cause is named that forbids an estimate.

    Args:
        fitted: the fit of the log.
        current: that with all that is named.
        evidence: what is known beside its rows.
    """
    robot = fitted.arm.robot
    # A cause that was found may explain it.
    is_off = clear_factor(current) is not None
    scaled = [*common_scale(fitted, evidence)] if is_off else []
    if scaled and scaled[0].fit.unexplained_share < UNEXPLAINED:
        yield from scaled[0].findings
    elif not is_plausible(current):
        yield Finding(
            # What an empty log has wrong as well does not matter to a payload.
            Level.SAYS if fitted.question.loaded else Level.DOUBTS,
            "model",
            "to fit this log, the terminal link would have "
            f"{with_error(*last_mass(current), 'kg')} on an arm of {robot.mass:.3g} kg, or other "
            "links would be far from the model's",
            f"{RIGHT_MODEL}, and its base mounted as the model says",
        )
    elif is_odd(fitted):
        scales = fitted.question.link_scales
        share = PER_CENT * fitted.question.options.priors.link
        yield Finding(
            Level.SAYS,
            "model",
            f"the links differ from the model by {percent(scales.mass * share)} of their masses, "
            f"and by {percent(scales.centre_of_mass * share)} of their size in their centres of "
            "mass: it may be the model of a sibling of this arm; the standard errors of links "
            "before the last may be too small",
            RIGHT_MODEL,
        )


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
    joints = fitted.arm.joints
    share = fitted.unexplained_share
    own = fitted.unexplained / typical_torque(fitted)
    worst = np.argsort(-fitted.unexplained)[:3].tolist()
    listed = ", ".join(f"{joints[k]} ({percent(own[k])} of its own)" for k in worst)
    texts = [
        f"the torques do not fit this model: {percent(share)} unexplained, mostly at {listed}"
    ]
    if least < share:
        texts.append(f"the nearest single cause leaves {percent(least)}")
    texts += [missing(fitted, joint) for joint in worst]
    # What leaves so much is another arm.
    check = "model" if share > 0.3 else "unexplained"
    remedy = f"{RIGHT_MODEL}, and that it carried the same load all the time, with no contact"
    return Finding(Level.DOUBTS, check, "; ".join(texts), remedy)


def missing(fitted: Fit, joint: int) -> str:
    """Return what a joint's torque has of the model's weight and inertia, by a regression."""
    name = fitted.arm.joints[joint]
    found = regression(fitted, joint)
    unit = torque_unit(name in fitted.arm.robot.slides)
    parts = [
        f"{percent(found[column])} of the model's {column}"
        for column in (WEIGHT, INERTIAL)
        if column in found
    ]
    coulomb = COULOMB.key_of(name)
    if coulomb in found:
        parts.append(f"friction of {found[coulomb]:.2g} {unit}")
    return f"{name} has {', '.join(parts)}"


def regression(fitted: Fit, joint: int) -> dict[str, float]:
    """Return what a joint's torque has of the model's weight, its inertia, friction and offset."""
    sums = fitted.sums
    own = (term.key_of(sums.joints[joint]) for term in (COULOMB, VISCOUS, OFFSET))
    names = [sums.names[column] for column in sums.columns[joint][:-1]]
    at = [names.index(name) for name in (WEIGHT, INERTIAL, *own) if name in names]
    total = sums.totals[joint]
    values, *_ = np.linalg.lstsq(total[np.ix_(at, at)], total[at, -1], rcond=1e-12)
    return {names[k]: value for k, value in zip(at, values.tolist())}


def lost_weight(fitted: Fit) -> Iterator[Finding]:
    """Yield the finding that torques are small, without weight at the joint that carries most."""
    torque, *_ = model_torque(fitted)
    share = regression(fitted, int(np.argmax(torque))).get(WEIGHT, 1.0)
    is_small = fitted.arm.has_gravity and typical_ratio(fitted) < SMALLER
    # With less of it, torque is external, or less a controller's model.
    if is_small and abs(share) < 0.1:
        yield Finding(
            Level.REFUSES,
            "gravity",
            "the torque has little of the links' weight: it may be external torque, left after a "
            "controller's model, or motor current",
            f"{MEASURED}, or give {option_name('torque_constants')} for a current",
        )


def computed(fitted: Fit) -> Iterator[Finding]:
    """Yield the finding that the torque was computed from a model: no joint has friction.

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
    if size > 0.0 and known < 2.0 * EXACT and distance < limit:
        text = "the torque follows rigid-body dynamics and has no friction: it was computed, or "
        text += "commanded, not measured"
        yield Finding(Level.DOUBTS, "computed", text, MEASURED)
