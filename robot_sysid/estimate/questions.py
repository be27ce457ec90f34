"""Questions as lists of terms: what each asks of the data, with all priors in one place.

Shapes: n joints of the chain, J joints with equations; a body has ten inertial parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass, replace

import numpy as np

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import BEND, OFFSET, TERMS
from robot_sysid.estimate.links import (
    AS_STATED,
    EXPECTED,
    LinkScales,
    OddNumber,
    last_link_scale,
    link_factor,
    reference_links,
)
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.terms import (
    DELAY,
    DRIFT,
    FURTHER_FRICTION,
    LAST_LINK,
    LINKS,
    OFFSET_DRIFT,
    PAYLOAD,
    PAYLOAD_NAMES,
    SCALE_DRIFT,
    SCALES,
    TILT,
    ZERO_DRIFT,
    ZEROS,
    ArmTerms,
    Prior,
    Term,
    independent,
)
from robot_sysid.model.mistakes import Mistake, mistake_shifts, without_mistakes
from robot_sysid.records import Array
from robot_sysid.records.option_fields import joint_values
from robot_sysid.spatial import N_INERTIAL, PARAMETER_NAMES
from robot_sysid.wording import option_name

LEAST_DRY = 0.02
"""Least dry friction assumed before a fit, as a share of the joint's root mean square torque."""
NEGLIGIBLE = 1e-3
"""Share of a joint's root mean square torque that counts as nothing: dry friction after a fit, or
an error."""
PER_CENT = 0.01
"""One per cent."""
WIDE = 1e3
"""Standard deviation of a number of which nothing is known, in its usual size."""
# How far off each cause may be where it is wrong.
_WRONG_SIZES = {
    SCALES: PER_CENT * usual_errors.WRONG_SCALE,
    ZEROS: 1e-3 * usual_errors.WRONG_ZERO,
    TILT: np.radians(usual_errors.WRONG_GRAVITY),
    DELAY: 1e-3 * usual_errors.WRONG_DELAY,
}


@dataclass(frozen=True)
class Question:
    """What is asked of recordings, under which assumptions.

    Attributes:
        options: prior uncertainties of the arm, and the other options of the estimate.
        loaded: whether some recordings carry a payload, whose parameters are estimated.
        drifts: whether to estimate a drift of friction from the first to the last recording.
        changed: of two sides that are compared, names of the drifts and of the payload's
            parameters that may have changed by more than usual; None where no sides are compared.
        same_day: whether the sides are of one day, with the gears as warm.
        differing: of an arm that is compared with its model, names of the parameters that may
            differ from it by more than usual; None where no model is compared.
        known_mass: mass of the payload [kg], from which torque scales are estimated; or None.
        link_scales: factors on the stated uncertainty of all links but the terminal one.
        mistakes: of the model in its links, without which these are estimated.
        doubtful: mistakes that it may have: links may be off by as much as by these.
        odd_number: number of the model that is far more off than the others, and has an error as
            large as itself; None for none.
        common_scale: how far all torque scales may be off together, as a share, by what the data
            says of all masses; zero for what the options say.
        odd_zeros: names of the zeros of joints that are far more off than usual.
        dry: (J,) dry friction [N m] that sizes the priors of unknown friction terms; None for the
            model's.
        is_first: whether it comes before any fit, which tells dry friction that fades with speed
            from Coulomb friction.
        usual_offsets: whether offsets of torque sensors are as small as they usually are. What is
            wrong with a log is looked for without that: an offset may be.
    """

    options: EstimationOptions
    loaded: bool = False
    drifts: bool = False
    changed: tuple[str, ...] | None = None
    same_day: bool = False
    differing: tuple[str, ...] | None = None
    known_mass: float | None = None
    link_scales: LinkScales = AS_STATED
    mistakes: tuple[Mistake, ...] = ()
    doubtful: tuple[Mistake, ...] = ()
    odd_number: OddNumber | None = None
    common_scale: float = 0.0
    odd_zeros: tuple[str, ...] = ()
    dry: tuple[float, ...] | None = None
    is_first: bool = False
    usual_offsets: bool = False

    @property
    def friction(self) -> tuple[str, ...]:
        """Friction terms of every joint that are estimated without a prior."""
        return self.options.friction

    @property
    def asks_common_scale(self) -> bool:
        """Whether the data says how far all torque scales may be off together.

        Not where sensors are known, nor where only differences of logs count.
        """
        is_known = self.options.priors.scale is not None
        is_compared = self.changed is not None or self.differing is not None
        return not (is_known or is_compared or self.loaded)


def arm_question(arm: ArmTerms, question: Question, torque: Array) -> list[Term]:
    """Return the terms of an arm, with a payload where the question is of one.

    Args:
        arm: all terms.
        question: which of them are estimated, and their priors.
        torque: (J,) root mean square of each joint's torque [N m].
    """
    options = question.options
    priors = options.priors
    terms = [_last_link(arm, question)]
    if LINKS in arm.terms and priors.link > 0.0:
        terms.append(links_term(arm, question))
    changed = question.changed
    if question.loaded and (changed is None or PAYLOAD_NAMES[0] in changed):
        terms.append(_payload(arm, question))
    for name in question.friction:
        # The square-root term bends the curve of friction: only their sum has to oppose the motion.
        is_bent = name == "viscous" and "sqrt" in question.friction
        term = replace(arm.friction_of(name), is_bounded=not is_bent)
        is_compared = question.differing is not None
        if name == OFFSET.name and (is_compared or question.usual_offsets):
            usual = usual_offset(arm, torque)
            wrong = usual_errors.WRONG_OFFSET * usual
            prior = independent(_sizes(term, question, usual, wrong))
            term = replace(term, prior=prior)
        terms.append(term)
    terms += _unknown_friction(arm, question, torque)
    terms += [arm.terms[motor.name] for motor in arm.motors]
    scale = scale_spread(arm, options, question.loaded)
    if question.known_mass is not None and priors.scale is None:
        # They are what is asked for, and may be as wrong as torque constants are. A prior of
        # sensors would hold a wrist whose constant is far off near the model's, with a small error.
        scale = PER_CENT * np.full(len(scale), usual_errors.WRONG_SCALE)
    drifts = _drift_sizes(arm, question, torque)
    sizes: dict[str, Array | float] = {
        SCALES: scale,
        # Priors are in milliradians and milliseconds.
        ZEROS: zero_spread(arm, question),
        **drifts,
        TILT: np.radians(priors.gravity),
        DELAY: 1e-3 * priors.delay,
    }
    if question.differing is not None:
        for cause, wrong in _WRONG_SIZES.items():
            if cause in arm.terms:
                sizes[cause] = _sizes(arm.terms[cause], question, sizes[cause], wrong)
    for cause, size in sizes.items():
        common = common_spread(question) * (cause == SCALES)
        if cause in arm.terms and np.any(size + common > 0.0):
            prior = independent(np.full(len(arm.terms[cause].names), size))
            if common:
                prior = with_common(prior, common)
            if cause == SCALES and question.loaded and question.known_mass is None:
                prior = without_common(prior)
            terms.append(replace(arm.terms[cause], prior=prior))
    return terms


def usual_offset(arm: ArmTerms, torque: Array) -> float:
    """Return how large an offset of a torque sensor usually is [N m].

    Sensors of an arm err by a share of what the strongest joint has. An offset without a size takes
    over gravity where a joint sees it from one side: as they are used, files of real arms were then
    farther off than the models before.

    Args:
        arm: whose sensors they are.
        torque: (J,) root mean square of each joint's torque [N m].
    """
    is_alone = len(arm.joints) < arm.robot.n_joints
    share = usual_errors.OFFSET_ALONE if is_alone else usual_errors.OFFSET
    return float(share * np.max(torque))


def _drift_sizes(
    arm: ArmTerms, question: Question, torque: Array
) -> dict[str, Array | float]:
    """Return how far each drift may be from the middle of the recordings to an end.

    Of two sides that are compared, all drift as they usually do, but those that may have changed.
    """
    friction = usual_errors.FRICTION_DRIFT
    scale = PER_CENT * usual_errors.SCALE_DRIFT
    if question.changed is None:
        return {DRIFT: friction * question.drifts, SCALE_DRIFT: scale * question.loaded}
    of_friction = usual_errors.FRICTION_CHANGE
    if question.same_day:
        of_friction = usual_errors.FRICTION_IN_A_DAY
    # Sensors err by a share of what the strongest joint has, whatever their own joint carries.
    of_sensor = scale * np.max(torque)
    usual: dict[str, Array | float] = {
        DRIFT: 0.5 * of_friction,
        SCALE_DRIFT: of_sensor / np.maximum(torque, 1e-9),
        ZERO_DRIFT: 1e-3 * usual_errors.ZERO_DRIFT,
        OFFSET_DRIFT: np.full(len(torque), of_sensor),
    }
    largest = {DRIFT: friction, SCALE_DRIFT: usual_errors.LARGEST_DRIFT * scale}
    sizes: dict[str, Array | float] = {}
    for cause, size in usual.items():
        if cause not in arm.terms:
            continue
        is_changed = np.isin(arm.terms[cause].names, question.changed)
        changed = largest.get(cause, usual_errors.LARGEST_DRIFT * size)
        sizes[cause] = np.where(is_changed, np.maximum(changed, size), size)
    return sizes


def _sizes(term: Term, question: Question, usual: Array | float, wrong: float) -> Array:
    """Return how far each parameter (k,) of a term may be off: as usual, or by more."""
    is_differing = np.isin(term.names, question.differing or ())
    return np.where(is_differing, np.maximum(wrong, usual), usual)


def _last_link(arm: ArmTerms, question: Question) -> Term:
    """Return the term of the last link, which is free unless it is compared with the model.

    Then it is as far off as links usually are, or as the others are found to be. Where bodies of
    the links' geometry stand for all, it is as far off as nothing known of it allows: free, it took
    up what links before it have wrong, and weighed less than nothing.
    """
    term = arm.terms[LAST_LINK]
    differing = question.differing
    if differing is None or PARAMETER_NAMES[0] in differing:
        if not arm.robot.lacks_masses:
            return term
        spread = last_link_scale(arm.robot)
        return replace(term, prior=Prior(term.reference, np.diag(spread)))
    return replace(term, prior=Prior(term.reference, usual_last_link(arm, question)))


def usual_last_link(arm: ArmTerms, question: Question) -> Array:
    """Return the Cholesky factor (10, 10) of how far off a model's last link is.

    As links usually are, or as the others are found to be.
    """
    scales = np.maximum(astuple(question.link_scales), astuple(EXPECTED))
    share = PER_CENT * max(question.options.priors.link, usual_errors.LINK)
    last = [arm.robot.n_joints - 1]
    return link_factor(arm.robot, last, share, LinkScales(*scales.tolist()))


def common_spread(question: Question) -> float:
    """Return the prior standard deviation of what all torque scales have in common, a share."""
    stated = PER_CENT * question.options.priors.common_scale
    return float(np.hypot(stated, question.common_scale))


def with_common(prior: Prior, common: float) -> Prior:
    """Return the prior of torque scales with an error that all of them share."""
    covariance = prior.factor @ prior.factor.T + common**2
    # A prior needs an inverse, also of scales that are known beside it.
    covariance += (NEGLIGIBLE * common) ** 2 * np.eye(len(covariance))
    return Prior(prior.mean, np.asarray(np.linalg.cholesky(covariance)))


def without_common(prior: Prior) -> Prior:
    """Return the prior of torque scales without the error that all of them share.

    No torque tells it from a heavier arm that carries a heavier payload: left in, the prior of the
    links decides about it. It is added to the payload's error (``Fit.scale_errors``).
    """
    size = len(prior.mean)
    # A thousandth of it is left, as a prior needs an inverse.
    apart = np.eye(size) - (1.0 - 1e-3) / size
    return Prior(prior.mean, prior.factor @ apart)


def _payload(arm: ArmTerms, question: Question) -> Term:
    """Return the term of the payload, whose mass may be known."""
    term = arm.terms[PAYLOAD]
    if question.known_mass is None:
        return term
    is_mass = np.eye(N_INERTIAL)[0]
    deviations = question.known_mass * np.where(is_mass, 1e-6, WIDE)
    return replace(term, prior=independent(deviations, question.known_mass * is_mass))


def links_term(arm: ArmTerms, question: Question) -> Term:
    """Return the term of all links but the last, with the model's bodies as prior.

    Of links in which the model has a mistake, they are the bodies without it.
    """
    term = arm.terms[LINKS]
    robot = without_mistakes(arm.robot, question.mistakes)
    reference = reference_links(robot, arm.others)
    share = PER_CENT * question.options.priors.link
    further = mistake_shifts(robot, arm.others, question.doubtful)
    factor = link_factor(
        robot, arm.others, share, question.link_scales, question.odd_number, further
    )
    return replace(term, reference=reference, prior=Prior(reference, factor))


def _unknown_friction(
    arm: ArmTerms, question: Question, torque: Array
) -> Iterator[Term]:
    """Yield the friction terms that the joints' friction models lack, with their priors.

    Their sizes follow from a joint's dry friction, times the prior ``friction``.
    """
    share = PER_CENT * question.options.priors.friction
    friction = question.friction
    if share == 0.0 or not friction:
        return
    if question.dry is None:
        of_model = arm.robot.friction.coulomb[arm.indices]
        dry = np.maximum(of_model, LEAST_DRY * torque)
    else:
        dry = np.maximum(question.dry, NEGLIGIBLE * torque)
    # A gear that loses much of its load has much dry friction without load, too.
    loss = np.clip(
        dry / np.maximum(torque, 1e-9), share, usual_errors.LARGEST_USUAL_LOSS * share
    )
    if question.loaded:
        loss = np.full_like(dry, max(share, usual_errors.LOADED_LOSS))
    sizes = {"load": loss}
    for name, term in TERMS.items():
        if not (question.is_first and term.is_dry_torque):
            sizes.setdefault(name, term.prior * share * dry)
    # A motor that turns several joints has friction like theirs.
    turned = [motor.ratios[arm.indices] != 0.0 for motor in arm.motors]
    sizes[BEND.name] = np.append(
        sizes[BEND.name], [np.max(sizes[BEND.name][joints]) for joints in turned]
    )
    for name, deviations in sizes.items():
        if TERMS[name].prior and name not in friction:
            yield replace(
                arm.friction_of(name),
                cause=FURTHER_FRICTION,
                prior=independent(deviations),
                is_bounded=False,
            )


def zero_spread(arm: ArmTerms, question: Question) -> Array:
    """Return the prior standard deviation (J,) of each joint's zero [rad]."""
    usual = question.options.priors.zero
    names = arm.terms[ZEROS].names if ZEROS in arm.terms else ()
    is_odd = np.isin(names, question.odd_zeros)
    return 1e-3 * np.where(is_odd, max(usual, usual_errors.WRONG_ZERO), usual)


def scale_spread(arm: ArmTerms, options: EstimationOptions, loaded: bool) -> Array:
    """Return the prior standard deviation (J,) of each joint's torque scale, 0.02 for 2 %."""
    percent = options.priors.scale
    if percent is None:
        percent = usual_errors.LOADED_SCALE if loaded else usual_errors.SCALE
    scale = joint_values(
        percent, arm.robot.n_joints, f"scale of {option_name('priors')}"
    )
    return PER_CENT * scale[arm.indices]
