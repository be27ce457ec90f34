"""The scale question: how many times the model's are the torques, of each joint and in common?

Torques alone do not tell a factor on all of them from one on all masses. A unit is the name of a
factor. Throughout, J is the number of joints with equations, n that of the chain's. A torque scale
is the ratio of recorded to true torque.

The scales are the terms of torque scales in the one fit, with a wide prior: a part that all joints
have in common, and one of each joint. Torques are divided by what is found, the links are fitted to
them, and the scales again beside these links, until nothing changes (Gauss-Newton on the logarithm
of the scales, with the links eliminated).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimate.fit import Fit, LeftOut, Problem
from robot_sysid.estimate.links import EXPECTED
from robot_sysid.estimate.offers import Effect, Offer, Offers
from robot_sysid.estimate.questions import arm_question
from robot_sysid.estimate.terms import SCALES, ArmTerms, Prior
from robot_sysid.faults import Finding
from robot_sysid.faults.plausibility import (
    LARGER,
    SMALLER,
    dry_friction,
    is_foreign,
    model_torque,
    weight_ratios,
)
from robot_sysid.faults.reading_search import (
    Correction,
    Evidence,
    gain_between,
    is_own,
    part_of_rows,
    refit,
)
from robot_sysid.faults.readings import Reading
from robot_sysid.model.stated import CENTRE, MASS
from robot_sysid.model.units import mass_unit
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.controllers import torque_to_record
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import INTERVAL, SURE
from robot_sysid.records.messages import Level, torque_unit, with_error
from robot_sysid.wording import option_name, with_option_names

ODD = 1.4
"""Factor on all masses, or its inverse, from which on it is refused."""
NOTED = 1.3
"""Factor, or its inverse, from which on it is named: more than links that are off as usual, one of
them by twice as much, make of right logs."""
AGREEING = 0.1
"""Logarithm of a factor by which a joint's weight may say less than the common scale does: links
that are off change each joint's by as much."""
UNITS = {
    1e3: "mN·m",
    100.0: "N·cm",
    10.197: "kgf·cm",
    8.851: "lbf·in",
    141.6: "ozf·in",
    1e-3: "kN·m",
}
"""One newton metre in other units of torque, to the unit's name."""
STATED_WEIGHT = 0.5
"""Share of the links' weight about their joints that a model has to state for a factor on it."""
NEAR_UNIT = 1.25
"""Factor between a scale and that of its unit which masses that are a little off make."""
MOST_MASSES = 5.0
"""Factor on all masses, or its inverse, above which no arm is."""
ROWS = 1000
"""Rows by which scales are found: links that are off as usual make most of their error."""
ROUNDS = 8
"""Most rounds: currents in per cent, whose scales differ by a factor of ten, take four to six."""
FOUND = 0.02
"""Relative change of a scale below which it has been found."""
UNSETTLED = 0.2
"""Relative change of a scale in the last round from which on it is none: a last link of negative
mass cancels the others' weight, whatever the scale, and it grows from round to round."""
OWN_PRIOR = 0.7
"""Prior of the logarithm of a joint's scale over the common one: wide enough for per cent of rated
torque, which differ by a factor of ten. What no torque shows stays at the common one."""
COMMON_PRIOR = 3.0
"""Prior of the logarithm of the common scale, from the ratio of torques on: it may be any."""
LEAST_RATIO = 1e-3
"""Least ratio of torques to start from, over the typical one: a column of zeros has none."""
STEP = (0.2, 5.0)
"""Least and largest factor by which a scale changes in one round."""
SURE_SCALE = 0.4
"""Relative error of a joint's scale above which it is not identified, unless it is ``SURE`` errors
from one: elbow and forearm of a TIAGo, whose torques have no unit, have 0.1 +- 0.06."""
VAGUE = 0.35
"""Relative error of the common scale from which on it has to be sure by ``SURE`` errors: a sound
iiwa14 that moved for some seconds had 11 +- 12."""
SPREAD = 0.4
"""Standard deviation of the logarithm of a joint's scale over the common one: gains of motor
currents of one arm differ by a factor of two."""
COMMON = 1.35
"""Ratio of the largest to the least scale of joints below which they have one common cause."""
ALONE = 1.2
"""Torque scale of one joint over that of the others, or its inverse, from which on it is named by
itself: links that are off as usual make half of it, as every joint carries those behind it."""
LEAST_OTHERS = 2
"""Joints with a scale that have to agree before one other joint is blamed."""
SENSOR = 1.6
"""Scale, or its inverse, above which it is no sensor's."""
OPPOSING = 0.5
"""Torque of the links with the opposite sign, as a share of a joint's torque, from which on its
sign is turned."""
LEAST_OF_LINKS = 0.03
"""Torque by the model's links, as a share of that of the most loaded joint, below which friction
makes most of a joint's torque."""
OTHER_UNIT = 10.0
"""Torque and friction of one joint over those of the others that neither links nor gears make."""
LEAST_BETTER = 0.7
"""What a joint's other unit leaves unexplained, over what is without it, that says that it is."""
WEIGHING = (
    "give the torque per ampere with {torque_constants}, or determine it with a weight: bolt on "
    "1 kg (of another mass, state it), record a motion called weight, and compare"
)
"""What to do where torques are motor currents; the command that compares follows the message."""


@dataclass(frozen=True)
class TorqueScales:
    """How many times the model's the torques are.

    Attributes:
        values: (J,) scale of each joint; negative where the torque has the opposite sign.
        covariance: (J, J) of their logarithms, by noise, links as wrong as usual, and blocks.
        is_loaded: (J,) which joints links load.
        is_settled: (J,) which scales did not change any more.
        coarse: by which positions that are coarse or seldom make all columns wrong, as a share.
        weights: (W,) how many times the model's weight the links have at joints that carry most.
    """

    values: Array
    covariance: Array
    is_loaded: NDArray[np.bool_]
    is_settled: NDArray[np.bool_]
    coarse: float
    weights: Array

    @property
    def errors(self) -> Array:
        """Relative standard errors (J,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def are_sure(self) -> NDArray[np.bool_]:
        """Which scales (J,) are identified."""
        sure = self.is_settled & are_identified(self.values, self.errors)
        # The torque of the last joint is that of the last link alone, which is not known.
        sure[-1] &= self.is_loaded[-1]
        return np.asarray(sure)

    @property
    def are_of_links(self) -> bool:
        """Whether the torque of each joint that links load follows its links."""
        return bool(np.any(self.is_loaded) and np.all(self.are_sure[self.is_loaded]))

    @property
    def differ(self) -> bool:
        """Whether joints have scales of their own: clearly other ones, or turned signs."""
        if np.any(self.values[self.are_sure] < 0.0):
            return True
        known = np.log(np.abs(self.values[self.are_sure]))
        errors = self.own_errors[[np.argmin(known), np.argmax(known)]]
        clear = INTERVAL * float(np.hypot(*errors))
        return bool(np.ptp(known) >= max(np.log(COMMON), clear))

    @property
    def own_errors(self) -> Array:
        """Standard errors (S,) of the S sure ones' logarithms over their mean."""
        covariance = self.covariance[np.ix_(self.are_sure, self.are_sure)]
        apart = np.eye(len(covariance)) - 1.0 / len(covariance)
        return np.sqrt(np.diag(apart @ covariance @ apart))

    @cached_property
    def alone(self) -> tuple[int, float, float] | None:
        """(Joint, its scale over the others', relative error), where it alone is clearly off.

        The others agree, whatever they have in common: links that are off, or all torques.
        """
        size = np.log(np.abs(self.values))
        known = np.flatnonzero(self.are_sure)
        if len(known) < LEAST_OTHERS or np.any(self.values[known] < 0.0):
            return None
        weights = np.zeros(len(size))
        weights[known] = self.own_errors**-2.0
        clear: list[tuple[float, int, float, float]] = []
        for joint in np.flatnonzero(self.is_settled).tolist():
            others = known[known != joint]
            if len(others) < LEAST_OTHERS or np.ptp(size[others]) >= np.log(ALONE):
                continue
            apart = np.eye(len(size))[joint]
            apart[others] -= weights[others] / np.sum(weights[others])
            error = float(np.sqrt(apart @ self.covariance @ apart))
            ratio = float(apart @ size)
            # The largest of so many errors is no evidence.
            least = np.sqrt(SURE**2 + 2.0 * np.log(len(size)))
            is_clear = abs(ratio) >= max(np.log(ALONE), least * error)
            if is_clear and error < SURE_SCALE:
                clear.append((abs(ratio), joint, ratio, error))
        if not clear:
            return None
        _, joint, ratio, error = max(clear)
        return joint, float(np.exp(ratio)), error

    @cached_property
    def common(self) -> tuple[float, float]:
        """(Scale of all joints, its relative error): (1, infinite) where links load none.

        Of joints that links load: what others have is friction, and what their links have wrong. It
        may be clear where no joint's own is: a factor of a thousand is, to within one of two.
        """
        known = self.are_sure & self.is_loaded
        if not np.any(known):
            known = self.is_loaded & self.is_settled
        if not np.any(known):
            return 1.0, np.inf
        weights = self.errors[known] ** -2.0
        weights = weights / np.sum(weights)
        mean = float(weights @ np.log(np.abs(self.values[known])))
        variance = float(weights @ self.covariance[np.ix_(known, known)] @ weights)
        return float(np.exp(mean)), float(np.hypot(np.sqrt(variance), self.coarse))

    @property
    def agreed(self) -> float:
        """The size of the factor in which scale and weights agree, a logarithm; zero for none.

        A tool that the model lacks multiplies weights and not the scale, a link that is off scales
        and not all weights: each joint's has to say as much, or the factor is no larger than that.
        Tools add weight: of a factor below one they may hide it, where the scale alone is clear.
        """
        factor, error = self.common
        if not len(self.weights):
            return 0.0
        common = float(np.log(factor))
        least = float(np.min(np.sign(common) * np.log(self.weights))) + AGREEING
        is_vague = error >= VAGUE
        is_clear = abs(common) >= (SURE if is_vague else INTERVAL) * error
        if is_clear and common < 0.0 <= least:
            return -common
        is_shown = is_clear or (common < 0.0 and not is_vague)
        return max(0.0, min(abs(common), least)) * is_shown

    @property
    def is_odd(self) -> bool:
        """Whether there is a factor that masses which are usually off do not make."""
        return self.agreed >= np.log(NOTED)

    @property
    def known_values(self) -> Array:
        """Scales (J,): of joints whose own is not identified, the common one."""
        own = np.where(self.are_sure, np.abs(self.values), self.common[0])
        return np.asarray(np.sign(self.values) * own)


def are_identified(scales: Array, errors: Array) -> NDArray[np.bool_]:
    """Return which of some torque scales (J,) with relative errors (J,) the log shows."""
    is_other = np.abs(np.log(np.abs(scales))) > SURE * errors
    return np.asarray(is_other | (errors < SURE_SCALE))


def torque_scales(fitted: Fit) -> TorqueScales:
    """Return how many times the model's the torques of a log are.

    Links are off as those of arms usually are: with models that are nearly right, right arms would
    be clearly off. Signs are found beside the scales in torques of another unit, in which a turned
    one alone explains nothing.
    """
    # Columns of faults take time.
    arm = fitted.arm.of(term for term in fitted.arm.terms.values() if term.cause)
    recordings, every = part_of_rows(fitted, ROWS)
    correlation = np.maximum(fitted.correlation / every, 1.0)
    # The last link is free, whatever was asked: what hangs there is no scale.
    question = replace(fitted.question, link_scales=EXPECTED, differing=None)
    point = arm.start()
    count = len(arm.joints)
    spread = OWN_PRIOR**2 * np.eye(count) + COMMON_PRIOR**2 * np.ones((count, count))
    factor = np.asarray(np.linalg.cholesky(spread))
    torque, share, is_loaded = model_torque(fitted)
    # Whatever the scales are, the ratio of torques is near them.
    scale = fitted.sums.rms_torque / torque
    typical = float(np.median(scale[is_loaded])) or 1.0
    scale[~is_loaded] = typical
    scale = np.maximum(scale, LEAST_RATIO * typical)
    opposes = is_loaded & (share * torque < -OPPOSING * fitted.sums.rms_torque)
    scale[opposes & is_foreign(fitted)] *= -1.0
    sums = arm.sums(recordings, point)
    # Each fit begins with the noise of its like in the round before.
    noise = links_noise = None
    for _ in range(ROUNDS):
        # A scale multiplies the links as they are found with the scales so far: with the model's, a
        # last link that no other joint shows would give way to its joint's scale, round after
        # round; with those of the fit that changed the scales, both would go too far.
        scaled = sums.with_torque_times(1.0 / scale)
        terms = arm_question(arm, question, scaled.rms_torque)
        others = [term for term in terms if term.cause != SCALES]
        problem = Problem(arm, recordings, point, scaled, question)
        links = problem.fit(others, None, links_noise, correlation, possible=False)
        point = links.next_point()
        sums = arm.sums(recordings, point)
        prior = Prior(-np.log(np.abs(scale) / typical), factor)
        terms = [
            replace(term, prior=prior) if term.cause == SCALES else term
            for term in terms
        ]
        scaled = sums.with_torque_times(1.0 / scale)
        problem = Problem(arm, recordings, point, scaled, question)
        after = problem.fit(terms, None, noise, correlation, possible=False)
        at = after.at(arm.terms[SCALES].names)
        change = np.clip(1.0 + after.free[at], *STEP)
        scale = scale * change
        noise, links_noise = after.noise / change, links.noise / change
        # Scales that are not identified change from round to round, and never end.
        errors = np.sqrt(np.diag(after.inverse)[at])
        is_sure = are_identified(scale, errors)
        if np.max(np.abs(np.log(change)), where=is_sure, initial=0.0) < FOUND:
            break
    # Links that are off are the same in all blocks, and make most of the formal error; what blocks
    # say beyond that adds to it.
    alone = replace(after, left_out=LeftOut.EACH).alone[:, at]
    apart = alone - np.mean(alone, axis=0)
    jackknife = (1.0 - 1.0 / len(alone)) * apart.T @ apart
    covariance = after.inverse[np.ix_(at, at)] + jackknife
    coarse = max(each.acceleration_error for each in fitted.recordings)
    relative = covariance / np.outer(change, change)
    is_settled = np.abs(np.log(change)) < UNSETTLED
    weights = weight_ratios(fitted)
    return TorqueScales(scale, relative, is_loaded, is_settled, coarse, weights)


class ScaleCorrections:
    """The torque scales of a log, and what they put right; each is made once, when it is asked for.

    Args:
        fitted: the fit of the log.
        evidence: what is known beside its rows.
    """

    def __init__(self, fitted: Fit, evidence: Evidence) -> None:
        self.fitted = fitted
        self.evidence = evidence

    @cached_property
    def scales(self) -> TorqueScales:
        """How many times the model's the torques are."""
        return torque_scales(self.fitted)

    @cached_property
    def _offers(self) -> Offers:
        """The fit as it is, which takes no time beside finding the scales."""
        return Offers(self.fitted, self.fitted.weights)

    def _offer(self, scaled: tuple[str, ...], prior: float) -> Offer:
        """Return what the fit says of one scale of some joints, by the names of theirs.

        It has a wide prior beside the narrow ones of the fit.
        """
        return self._offers.offer(Effect(scaled, np.full((len(scaled), 1), prior)))

    @property
    def may_be_odd(self) -> bool:
        """Whether the links' weights, and the fit, let all torques be off by a factor.

        The weights may agree with one (``TorqueScales.agreed``), and so may what the fit says.
        """
        weights = np.log(weight_ratios(self.fitted))
        if not len(weights):
            return False
        is_more = float(np.min(weights)) + AGREEING >= np.log(NOTED)
        is_less = float(np.max(weights)) <= AGREEING
        common = self._offer(self.fitted.arm.terms[SCALES].names, COMMON_PRIOR)
        change = float(common.values[0])
        return (is_more and change > AGREEING) or (is_less and change < -AGREEING)

    @property
    def may_be_alone(self) -> bool:
        """Whether a factor on the torque of one joint is clear in the fit as it is."""
        names = self.fitted.arm.terms[SCALES].names
        return any(self._offer((name,), OWN_PRIOR).distance >= SURE for name in names)

    @cached_property
    def common(self) -> Correction:
        """The correction of torques by one scale, which masses that are off make as well."""
        fitted = self.fitted
        factor, error = self.scales.common
        factors = np.full(len(self.scales.values), 1.0 / factor)
        reading = torque_reading(fitted.arm, factors)
        after = refit(fitted, reading)
        finding = common_finding(fitted.arm.robot, factor, error, self.evidence)
        is_small = finding.is_common_factor and self.scales.agreed < np.log(ODD)
        if is_small:
            finding = replace(finding, level=Level.SAYS)
        return Correction((finding,), gain_between(fitted, after, reading), after)

    @cached_property
    def alone(self) -> Correction | None:
        """The correction of the torque of one joint, where it alone is off; else None."""
        fitted = self.fitted
        alone = self.scales.alone if self.may_be_alone else None
        if alone is None:
            return None
        joint, scale, error = alone
        # Where all torques are in another unit, as of currents, each motor has a constant.
        others = self.scales.values[joint] / scale
        if abs(np.log(others)) > np.log(SENSOR):
            return None
        factors = np.ones(len(self.scales.values))
        factors[joint] = 1.0 / scale
        reading = torque_reading(fitted.arm, factors)
        after = refit(fitted, reading)
        if not is_own(fitted, after, reading):
            return None
        # Every joint was tried, and the scale fits the data instead of being one.
        penalty = np.log(len(factors) * max(SPREAD / error, 1.0))
        gain = gain_between(fitted, after, reading) - penalty
        finding = alone_finding(fitted, joint, scale, error, self.evidence)
        return Correction((finding,), float(gain), after)

    @cached_property
    def own(self) -> Correction | None:
        """The correction of torques by scales of one per joint; None where joints have no such."""
        fitted, scales = self.fitted, self.scales
        if self.alone is not None or not (scales.are_of_links and scales.differ):
            return None
        values = scales.known_values
        reading = torque_reading(fitted.arm, 1.0 / values)
        after = refit(fitted, reading)
        # Loss for scales that fit the data instead of being one: the prior's volume over that left.
        penalty = np.sum(np.log(SPREAD / scales.own_errors))
        sure = np.flatnonzero(scales.are_sure)
        finding = own_finding(fitted, scales, sure, self.evidence)
        gain = gain_between(fitted, after, reading) - penalty
        return Correction((finding,), float(gain), after)

    def each(self) -> Iterator[Correction]:
        """Yield the corrections by one scale of all joints, where it is odd, and by their own."""
        if self.scales.is_odd:
            yield self.common
        if self.own is not None:
            yield self.own


def torque_scale(scales: Array, error: float = 0.0) -> tuple[str, str]:
    """Return the option that divides torques by scales (n,), one number where they are alike.

    ``error``: relative standard error of what they have in common.
    """
    texts = [f"{value:.4g}" for value in scales]
    listed = ",".join(texts if len({*texts}) > 1 else texts[:1])
    return "--torque-scale", f"{listed}{stated_error(error)}"


def stated_error(error: float) -> str:
    """Return the error of factors as the options of factors take it, "" for none."""
    # Two digits, without an exponent.
    return f"+-{float(f'{100.0 * error:.2g}'):g}%" if error else ""


def units_near(
    factor: float, relative_error: float, errors: float = INTERVAL
) -> list[float]:
    """Return the sizes of the units (keys of ``UNITS``) that a factor on all torques may be of.

    Masses that are a little off stand between the factor and that of its unit, beside the factor's
    own error.

    Args:
        factor: on all torques.
        relative_error: of the factor.
        errors: how many of them it may be off.
    """
    margin = max(np.log(NEAR_UNIT), errors * relative_error)
    return [size for size in UNITS if abs(np.log(factor / size)) < margin]


def common_finding(
    robot: RobotModel, factor: float, relative_error: float, evidence: Evidence
) -> Finding:
    """Return the finding on torques that are a factor times those of the model's masses.

    Where there may be an arm with all masses so many times as large, the user decides.
    """
    is_far = abs(np.log(factor)) > np.log(MOST_MASSES)
    if factor < 1.0 and is_far and relative_error > VAGUE:
        return little_weight(robot)
    number = with_error(factor, factor * relative_error)
    text = f"the torques are {number} times those of the model's masses, at all joints alike"
    is_unit = mass_unit(robot, factor) != 1.0
    units = units_near(factor, relative_error)
    # Counts of a driver may be near a unit by chance, which only masses that no arm has rule out.
    others = units if is_unit else units_near(factor, relative_error, SURE)
    is_told = len(units) == len(others) == 1
    unit_text = ""
    options: tuple[tuple[str, str], ...]
    options = (torque_scale(factor * evidence.divided, relative_error),)
    if is_told:
        unit_text = f" (as in {UNITS[units[0]]})"
        options = (torque_scale(units[0] * evidence.divided),)
    name = FaultName.TORQUE_UNIT
    command = ""
    # A factor that is hardly known makes a file that is as far off: only a weight tells it.
    if is_unit and (is_told or relative_error < VAGUE):
        remedy = f"they are in another unit{unit_text}: divide them"
    elif not is_told and is_far:
        ways = [torque_scale(size * evidence.divided)[1] for size in others]
        listed = " or ".join(
            f"{UNITS[size]} ({option_name('torque_scale', way)})"
            for size, way in zip(others, ways)
        )
        text += ": they may be motor currents or counts"
        text += f", or {listed}, which the ± does not tell apart" if others else ""
        remedy = with_option_names(WEIGHING)
        # The known mass says how far off each joint's is.
        options = (torque_scale(factor * evidence.divided),)
        command = "payload"
    elif unstated := unstated_weight(robot):
        return weight_of_geometry(text, unstated)
    else:
        name = FaultName.TORQUE_SCALE
        masses = f"{factor * robot.mass_scale:.4g}{stated_error(relative_error)}"
        options = (("--mass-scale", masses), *options)
        masses, torques = (
            option_name(name, way[1])
            for name, way in zip(("mass_scale", "torque_scale"), options)
        )
        remedy = (
            "torques cannot tell what is wrong by that much, the masses or the torques: if the "
            f"torques are N·m, multiply the masses ({masses}); if the model is right{unit_text}, "
            f"divide the torques ({torques})"
        )
    # Where the user has to choose between masses and torques, two logs of one arm share it.
    is_common = name is FaultName.TORQUE_SCALE
    return Finding(
        Level.REFUSES, name, text, remedy, options, command, is_common_factor=is_common
    )


def unstated_weight(robot: RobotModel) -> str:
    """Return what of most of the links' weight a model does not state; "" where it states that.

    Weight about joints is mass times distance. Bodies of the links' geometry have it where the
    model has placeholders, and may be twice as far from their joints as these.
    """
    if all(MASS in link.placeholders for link in robot.links):
        return "masses"
    weights = np.array([np.linalg.norm(link.reference[1:4]) for link in robot.links])
    is_stated = [not {MASS, CENTRE} & {*link.placeholders} for link in robot.links]
    is_most = np.sum(weights[is_stated]) > STATED_WEIGHT * np.sum(weights)
    return "" if is_most or not np.any(weights) else "centres of mass"


def weight_of_geometry(text: str, unstated: str) -> Finding:
    """Return the finding on a factor between torques and a weight that a model does not state.

    Only the torques are known then, and the links, each with an error as large as itself, follow
    them. A factor on either would make one of them wrong.

    Args:
        text: on the factor.
        unstated: as from ``unstated_weight``.
    """
    return Finding(
        Level.SAYS,
        FaultName.TORQUE_SCALE,
        f"{text}; the model does not state the {unstated} of most links, which are as heavy about "
        "their joints as the torques say, and these are taken to be N·m",
        "compare the result with a mass that is known, of the arm or of a weight on its flange",
        is_common_factor=True,
    )


def little_weight(robot: RobotModel) -> Finding:
    """Return the finding that torques are small and have little of the links' weight, if any.

    A factor that is as uncertain as it is large is not known from none.
    """
    return Finding(
        Level.REFUSES,
        FaultName.GRAVITY,
        "the torque has little of the links' weight: it may be external torque, left after a "
        "controller's model, or motor current",
        torque_to_record(robot),
    )


def torque_reading(arm: ArmTerms, factors: Array) -> Reading:
    """Return the reading in which torques (J,) are multiplied by factors."""
    torque = np.ones(arm.robot.n_joints)
    torque[arm.indices] = factors
    return Reading.with_torque_times(torque)


def alone_finding(
    fitted: Fit, joint: int, scale: float, error: float, evidence: Evidence
) -> Finding:
    """Return the finding on the torque of one joint that is a factor times what it should be.

    Links are the same for all joints before them, so that they cannot be what is wrong.
    """
    name = fitted.arm.joints[joint]
    number = with_error(scale, scale * error)
    values = np.ones(fitted.arm.robot.n_joints)
    values[fitted.arm.indices[joint]] = scale
    return Finding(
        Level.DOUBTS if abs(np.log(scale)) <= np.log(SENSOR) else Level.REFUSES,
        FaultName.TORQUE_SCALE,
        f"torque of joint {name} reads {number} times what those of the other joints say",
        "check the joint's torque constant, gear ratio or sensor, or divide its torque",
        (torque_scale(values * evidence.divided),),
    )


def own_finding(
    fitted: Fit, scales: TorqueScales, sure: NDArray[np.int64], evidence: Evidence
) -> Finding:
    """Return the finding on torque scales, of which those with indices ``sure`` are found.

    A scale is negative where the torque has the opposite sign of the model's.
    """
    names = fitted.arm.joints
    scale = scales.known_values
    known = np.abs(scale[sure])
    listed = ", ".join(f"{names[k]} {scale[k]:.3g}" for k in sure)
    is_sensor = np.max(np.abs(np.log(known))) <= np.log(SENSOR)
    # No links, and no tool that an arm may carry, make all torques that small or large.
    is_unit = np.all(known < SMALLER) or np.all(known > LARGER)
    opposite = ", ".join(compress(names, scale < 0.0))
    signs = f"of {opposite} with the opposite sign; " if opposite else ""
    return Finding(
        Level.DOUBTS if is_sensor else Level.REFUSES,
        FaultName.TORQUE_UNIT if is_unit else FaultName.TORQUE_SCALE,
        f"torque reads {np.median(known):.3g} times what the model takes ({listed}): {signs}a "
        "factor of its own for every joint, as motor currents or per cent of rated torque have, or "
        "all masses of the model are wrong",
        with_option_names(WEIGHING),
        # The known mass says how far off they are, as of a common factor of currents.
        (torque_scale(np.abs(scale) * evidence.divided),),
        "payload",
        torque_reading(fitted.arm, np.sign(scale)).columns if opposite else None,
    )


def odd_unit(fitted: Fit) -> Iterator[Finding]:
    """Yield the finding that one joint's torque has another unit than that of the other joints.

    Dry friction counts beside the torque: links hardly load some joints, but no joint has so much
    more friction than the others. Joints that stood still show neither.
    """
    moved = np.flatnonzero(np.any(fitted.sums.counts, axis=0))
    if len(moved) < 3:
        return
    torque = model_torque(fitted)[0][moved]
    least = LEAST_OF_LINKS * np.max(torque)
    ratio = fitted.sums.rms_torque[moved] / np.maximum(torque, least)
    most = int(np.argmax(ratio))
    factor = ratio[most] / max(np.median(np.delete(ratio, most)), 1e-9)
    dry = dry_friction(fitted)[0][moved]
    friction = dry[most] / max(np.median(np.delete(dry, most)), 1e-9)
    if min(factor, friction) > OTHER_UNIT:
        joint = int(moved[most])
        scales = np.ones(fitted.arm.robot.n_joints)
        scales[fitted.arm.indices[joint]] = 1e-3
        after = refit(fitted, Reading.with_torque_times(scales)).unexplained_share
        if after > LEAST_BETTER * fitted.unexplained_share:
            return
        name = fitted.arm.joints[joint]
        unit = torque_unit(name in fitted.arm.robot.slides)
        text = f"torque of joint {name} alone reads {factor:.2g} times too much, or more: as in "
        text += f"m{unit}"
        columns = option_name("columns", "FILE")
        remedy = f"put it right with {columns}: torque.{name} = 0.001 * TITLE"
        yield Finding(Level.REFUSES, FaultName.TORQUE_SCALE, text, remedy)
