"""Questions as lists of terms: what each asks of the data, with all priors in one place.

Shapes: n joints of the chain, J joints with equations; a body has ten inertial parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import FADING_SPEEDS
from robot_sysid.dynamics.spatial import N_INERTIAL
from robot_sysid.estimate.links import AS_STATED, LinkScales, link_factor, link_lengths
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.terms import (
    DELAY,
    DRIFT,
    FURTHER_FRICTION,
    LAST_LINK,
    LINKS,
    PAYLOAD,
    SCALE_DRIFT,
    SCALES,
    TILT,
    UNKNOWN_FRICTION,
    USUAL_FRICTION,
    ZEROS,
    ArmTerms,
    Prior,
    Term,
    independent,
)
from robot_sysid.model.bodies import reference_bodies
from robot_sysid.records import Array
from robot_sysid.records.option_fields import joint_values

CURVATURE = 5.0
"""Prior standard deviation of the term "sqrt", over dry friction times the prior ``friction``."""
FADING = 15.0
"""Prior standard deviation of each term that fades with speed, over dry friction times the prior
``friction``: a Stribeck curve of 30 % with the default of 2 %."""
LARGEST_USUAL_LOSS = 2.5
"""Largest prior standard deviation of the share of its load that a gear loses, over the prior
``friction``; reached where dry friction is large."""
LEAST_DRY = 0.02
"""Least dry friction assumed before a fit, as a share of the joint's root mean square torque."""
LEAST_FITTED_DRY = 1e-3
"""Least dry friction assumed after a fit, as a share of the joint's root mean square torque."""
LARGEST_LOSS = 0.3
"""Share of its load that a gear loses at most: one that lost half of it would lock backwards."""
DRIFTS = 0.2
"""Prior standard deviation of friction's relative drift, from the middle of the logs to an end."""
CHANGES = 0.1
"""Standard deviation of friction's relative change from one log to the next: five logs of a UR10e
differ by 2.5 standard errors of a single one."""
SCALE_DRIFTS = 0.25
"""Prior standard deviation of a torque scale's drift, from the middle of a payload's logs, or of
two runs, to an end [%]: without it, logs of a KUKA LWR4+ differ by 0.07 kg at the last link, eight
standard errors."""
LOADED_LOSS = 0.1
"""Prior standard deviation of the share of its load that a gear loses, in weighing a payload."""
FILE_TILT = float(np.radians(2.0))
"""Prior standard deviation of gravity's direction in a model file [rad]."""
USUAL_SCALE = 2.0
"""Default standard deviation of a joint's torque scale [%]."""
LOADED_SCALE = 3.0
"""Default standard deviation of a joint's torque scale where a payload is weighed [%], whose mass
depends on it alone: motor currents of a UR10e read 3 % low to 5 % high."""
PER_CENT = 0.01
"""One per cent."""
MILLI = 1e-3
"""One thousandth."""
# Share of an error that is left of what all torque scales have in common.
_LEFT = 1e-3
# Prior standard deviation of a number that is known exactly, as a share of it.
_EXACT = 1e-6


@dataclass(frozen=True)
class Question:
    """What is asked of recordings, under which assumptions.

    Attributes:
        options: prior uncertainties of the arm, and the other options of the estimate.
        loaded: whether some recordings carry a payload, whose parameters are estimated.
        drifts: whether to estimate a drift of friction from the first to the last recording.
        known_mass: mass of the payload [kg], from which torque scales are estimated; or None.
        link_scales: factors on the stated uncertainty of all links but the terminal one.
        dry: (J,) dry friction [N m] that sizes the priors of unknown friction terms; None before a
            fit.
        motors: names of the motors that turn several joints and are estimated.
    """

    options: EstimationOptions
    loaded: bool = False
    drifts: bool = False
    known_mass: float | None = None
    link_scales: LinkScales = AS_STATED
    dry: tuple[float, ...] | None = None
    motors: tuple[str, ...] = ()

    @property
    def friction(self) -> tuple[str, ...]:
        """Friction terms of every joint that are estimated without a prior."""
        return self.options.friction


def friction_columns(options: EstimationOptions) -> tuple[str, ...]:
    """Return the names of the friction terms that need columns."""
    return tuple(dict.fromkeys((*USUAL_FRICTION, *options.friction, *UNKNOWN_FRICTION)))


def arm_question(arm: ArmTerms, question: Question, torque: Array) -> list[Term]:
    """Return the terms of an arm, with a payload where the question is of one.

    Args:
        arm: all terms.
        question: which of them are estimated, and their priors.
        torque: (J,) root mean square of each joint's torque [N m].
    """
    options = question.options
    priors = options.priors
    terms = [replace(arm.terms[LAST_LINK])]
    if LINKS in arm.terms and priors.link > 0.0:
        terms.append(links_term(arm, question))
    if question.loaded:
        terms.append(_payload(arm, question))
    for name in question.friction:
        upper = LARGEST_LOSS if name == "load" else np.inf
        term = replace(arm.terms[name], upper=upper)
        # The square-root term bends the curve of friction: only their sum has to oppose the motion.
        if name == "viscous" and "sqrt" in question.friction:
            term = replace(term, lower=-np.inf)
        terms.append(term)
    terms += _unknown_friction(arm, question, torque)
    terms += [arm.terms[name] for name in question.motors]
    scale = scale_spread(arm, options, question.loaded)
    sizes = {
        SCALES: scale,
        ZEROS: np.full(arm.robot.n_joints, MILLI * priors.zero),
        DRIFT: np.full(len(arm.joints), DRIFTS if question.drifts else 0.0),
        SCALE_DRIFT: np.full(
            len(arm.joints), PER_CENT * SCALE_DRIFTS * question.loaded
        ),
        TILT: np.full(2, np.radians(priors.gravity)),
        DELAY: np.full(1, MILLI * priors.delay),
    }
    for cause, deviations in sizes.items():
        if cause in arm.terms and np.any(deviations > 0.0):
            prior = independent(deviations)
            if cause == SCALES and question.loaded and question.known_mass is None:
                prior = without_common(prior)
            terms.append(replace(arm.terms[cause], prior=prior))
    return terms


def without_common(prior: Prior) -> Prior:
    """Return the prior of torque scales without the error that all of them share.

    No torque tells it from a heavier arm that carries a heavier payload: left in, the prior of the
    links decides about it. It is added to the payload's error (``Fit.scale_errors``).
    """
    size = len(prior.mean)
    apart = np.eye(size) - (1.0 - _LEFT) / size
    return Prior(prior.mean, prior.factor @ apart)


def _payload(arm: ArmTerms, question: Question) -> Term:
    """Return the term of the payload, whose mass may be known."""
    term = arm.terms[PAYLOAD]
    if question.known_mass is None:
        return term
    wide = np.full(N_INERTIAL, 1e3 * question.known_mass)
    wide[0] = _EXACT * question.known_mass
    mean = np.zeros(N_INERTIAL)
    mean[0] = question.known_mass
    return replace(term, prior=Prior(mean, np.diag(wide)))


def links_term(arm: ArmTerms, question: Question) -> Term:
    """Return the term of all links but the last, with the model's bodies as prior.

    A placeholder of the model counts as a reference body with an error as large as itself.
    """
    robot = arm.robot
    reference = reference_bodies(robot)
    links = list(arm.others)
    thetas = np.array([reference[robot.links[link].body_name] for link in links])
    lengths = np.array(link_lengths(robot, links))
    stated = is_stated(arm)
    share = PER_CENT * question.options.priors.link
    size = N_INERTIAL * len(links)
    factor = np.zeros((size, size))
    rows = np.arange(size).reshape(-1, N_INERTIAL)
    groups = [([k], 1.0, AS_STATED) for k in np.flatnonzero(~stated).tolist()]
    if np.any(stated):
        groups.append((np.flatnonzero(stated).tolist(), share, question.link_scales))
    for numbers, deviation, scales in groups:
        at = rows[numbers].ravel()
        factor[np.ix_(at, at)] = link_factor(
            thetas[numbers], deviation, lengths[numbers], scales
        )
    return replace(arm.terms[LINKS], prior=Prior(thetas.ravel(), factor))


def is_stated(arm: ArmTerms) -> NDArray[np.bool_]:
    """Return which of the links before the last the model states, not with a placeholder."""
    robot = arm.robot
    reference = reference_bodies(robot)
    stated = [
        reference[robot.links[link].body_name] is robot.links[link].theta
        for link in arm.others
    ]
    return np.array(stated, dtype=bool)


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
        dry = np.maximum(question.dry, LEAST_FITTED_DRY * torque)
    # A gear that loses much of its load has much dry friction without load, too.
    loss = np.clip(dry / np.maximum(torque, 1e-9), share, LARGEST_USUAL_LOSS * share)
    if question.loaded:
        loss = np.full_like(dry, max(share, LOADED_LOSS))
    sizes = {"load": loss, "sqrt": CURVATURE * share * dry}
    if question.dry is not None:
        sizes |= dict.fromkeys(FADING_SPEEDS, FADING * share * dry)
    for name, deviations in sizes.items():
        if name not in friction:
            term = replace(arm.terms[name], cause=FURTHER_FRICTION, lower=-np.inf)
            prior = independent(deviations)
            yield replace(term, prior=prior, reference=None)


def scale_spread(arm: ArmTerms, options: EstimationOptions, loaded: bool) -> Array:
    """Return the prior standard deviation (J,) of each joint's torque scale, 0.02 for 2 %."""
    percent = options.priors.scale
    if percent is None:
        percent = LOADED_SCALE if loaded else USUAL_SCALE
    scale = joint_values(percent, arm.robot.n_joints, "scale of --priors")
    return PER_CENT * scale[arm.indices]
