"""What a fit says of its log by itself: how large torques are, whether friction drives, whether the
links are those of an arm. No fault is looked for; these are what faults are judged by.

Throughout, J is the number of joints with equations.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import COULOMB, OFFSET, VISCOUS
from robot_sysid.estimate.contacts import LITTLE
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.terms import (
    FURTHER_FRICTION,
    LAST_LINK,
    LINKS,
    PAYLOAD,
    ArmTerms,
    Term,
)
from robot_sysid.faults.columns import INERTIAL, WEIGHT
from robot_sysid.records import Array
from robot_sysid.records.levels import ALARMING
from robot_sysid.records.usual_errors import (
    LEFT_OF_ALL,
    LEFT_OF_FRICTION,
    LEFT_OF_TORQUE,
)

SMALLER = 1.0 / 3.0
"""Torque scale below which all joints' torques are in another unit, whatever the links: arms whose
links are off as usual, one of them by twice as much, measure more of the weight."""
LARGER = 5.0
"""Torque scale above which they are: the heaviest tool that an arm may carry, which its model
lacks, makes at least one joint's weight less than so many times as large."""
LEAST_TYPICAL = 0.02
"""Least torque of a joint that shares are taken of, as a share of the strongest joint's: a wrist
that makes less shows mostly noise."""
LEAST_LOADED = 0.1
"""Torque by the model's links, as a share of that of the most loaded joint, above which a joint is
loaded: below it friction is as large as what the links make."""
LEAST_WEIGHED = 0.25
"""Torque by the links' weight, as a share of that of the joint that carries most, above which it
says how much weight there is: a wrist's is the last link's, and what hangs on it."""
MOST_OF_ARM = 0.6
"""Largest mass of a last link with all on it, as a share of the arm's without it."""
MOST_TOOL = 0.3
"""Largest mass of what the model lacks at the last link, as a share of the arm's."""
LINKS_DEVIATIONS = 4.0
"""Standard deviations of chi-square beyond its mean from which links are not the model's: no log of
the right model is there."""
SIBLING_MASSES = 7.25
"""Factor on the stated uncertainty of masses, as the log shows it, above which the model is of
another arm. Siblings reach about as much, and so may a right arm with one link that is far off. No
torque tells these apart, but models of other arms leave a clear share of it unexplained."""
SIBLING_CENTRES = 5.7
"""The same of centres of mass: right arms reach much less, other arms more."""
LAST_LINKS = (LAST_LINK, PAYLOAD)
"""Keys of what is free where links are compared with the model's: the last one, whatever hangs on
it."""
PLAIN_FRICTION = (COULOMB.name, VISCOUS.name, OFFSET.name)
"""Keys of the friction of any joint, and of the offset of its sensor."""
EXACT = 0.001
"""Error of filtering in dry friction, as a share of the joint's torque."""
MOST_AT_ONCE = 1.5
"""Joints that move at an instant, in the mean, below which a log is of single joints."""


def typical_torque(fitted: Fit) -> Array:
    """Return the root mean square torque (J,), at least 2 % of the largest [N m]."""
    torque = fitted.sums.rms_torque
    return np.maximum(torque, LEAST_TYPICAL * np.max(torque))


def weighing(fitted: Fit, values: Sequence[float] | Array) -> Array:
    """Return values (p + 1,) of what weighs: masses and first moments; all others are zero.

    Without gravity, inertias weigh as well.
    """
    count = 4 if fitted.arm.has_gravity else 10
    kept = {name for names in fitted.arm.links.values() for name in names[:count]}
    own = [v if n in kept else 0.0 for n, v in zip(fitted.sums.names, values)]
    return np.array([*own, 0.0])


def weight_ratios(fitted: Fit) -> Array:
    """Return how many times the model's the torque (W,) is that links make, as they were found.

    Of joints that weight loads: the last link, whatever hangs on it, makes a part of each.
    """
    sums = fitted.sums
    torque, _, is_loaded = model_torque(fitted)
    found = weighing(fitted, fitted.equations.full(fitted.free))
    squares = np.maximum(sums.squares_of(found, sums.totals), 1e-24)
    largest = np.max(torque[is_loaded], initial=0.0)
    is_weighed = is_loaded & (torque > LEAST_WEIGHED * largest)
    return np.asarray((np.sqrt(squares / sums.row_counts) / torque)[is_weighed])


def model_torque(fitted: Fit) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return (root mean square torque (J,) of the model [N m], share (J,), loaded (J,)).

    It is that of the links' masses and first moments, as inertias may be placeholders, and of
    inertias as well where there is no gravity. The share is that of it in the measured torque, by a
    regression. Loaded are hinges whose links make more than ``LEAST_LOADED`` of the torque of the
    most loaded one: the force of a slide is in another unit, and exceeds the torques of an arm that
    it carries.
    """
    arm = fitted.arm
    sums = fitted.sums
    model = weighing(fitted, [arm.model.get(name, 0.0) for name in sums.names])
    squares = np.maximum(sums.squares_of(model, sums.totals), 1e-24)
    pairs = zip(sums.columns, sums.totals)
    products = np.array([model[at] @ total[:, -1] for at, total in pairs])
    torque = np.sqrt(squares / sums.row_counts)
    is_slide = arm.robot.is_slide[arm.indices]
    is_compared = ~is_slide | np.all(is_slide)
    is_loaded = is_compared & (torque > LEAST_LOADED * np.max(torque[is_compared]))
    return torque, products / squares, is_loaded


def typical_ratio(fitted: Fit) -> float:
    """Return the median ratio of measured torque to the model's at joints that links load."""
    torque, _, is_loaded = model_torque(fitted)
    ratio = fitted.sums.rms_torque / torque
    return float(np.median(ratio[is_loaded])) if np.any(is_loaded) else 1.0


def is_foreign(fitted: Fit) -> bool:
    """Return whether torques are so small or large that no links, nor a tool, make them."""
    return not SMALLER < typical_ratio(fitted) < LARGER


def dry_friction(fitted: Fit) -> tuple[Array, Array]:
    """Return Coulomb friction (J,) without its bound and its standard error [N m].

    That of a joint that stands still is zero, its error infinite.
    """
    values, inverse = fitted.unbounded_solution
    known = dict(zip(fitted.names, zip(values, np.diag(inverse))))
    names = map(COULOMB.key_of, fitted.arm.joints)
    dry, variance = np.transpose([known.get(name, (0.0, np.inf)) for name in names])
    return dry, np.sqrt(np.maximum(variance, 0.0))


def structural(fitted: Fit) -> Array:
    """Return the torque (J,) that the terms of a real arm leave at each joint [N m].

    It is no noise: it is there in every block of time alike, and no number of rows makes it less.
    So what explains no more is no evidence, however many nats it gains.
    """
    torque = fitted.sums.rms_torque
    dry, _ = dry_friction(fitted)
    friction = np.minimum(np.abs(dry), torque)
    least = LEFT_OF_ALL * np.sqrt(np.mean(torque**2))
    own = np.maximum(LEFT_OF_TORQUE * torque, LEFT_OF_FRICTION * friction)
    return np.maximum(own, least)


def friction_share(fitted: Fit) -> tuple[float, float, float]:
    """Return (share of the torque that is friction, its error, its distance from none).

    The share is how many times the friction is that makes, dry and viscous alike, as much torque as
    there is at each joint; the distance is that of all joints' friction from none, in standard
    deviations of chi-square beyond its mean. It is friction without what a fit allows for beside
    it: that may have any part of it where there is any, but not where there is none.
    """
    torque = typical_torque(fitted)
    terms = [t for t in fitted.equations.terms if t.cause != FURTHER_FRICTION]
    plain = fitted.refit(terms)
    spans = [
        span
        for term, span in plain.equations.spans
        if term.key in (COULOMB.name, VISCOUS.name)
    ]
    at = np.concatenate(spans)
    values, inverse = plain.unbounded_solution
    squares = plain.sums.squares[:, plain.equations.index[at]]
    own = np.argmax(squares, axis=0)
    sizes = np.sqrt(np.max(squares, axis=0) / plain.sums.row_counts[own])
    usual = torque[own] / np.maximum(sizes, 1e-300)
    precision = np.linalg.inv(
        inverse[np.ix_(at, at)] / np.outer(usual, usual) + EXACT**2 * np.eye(len(at))
    )
    friction = values[at] / usual
    variance = 1.0 / float(np.sum(precision))
    share = variance * float(np.sum(precision @ friction))
    count = len(at)
    distance = (friction @ precision @ friction - count) / np.sqrt(2.0 * count)
    return share, float(np.sqrt(variance)), float(distance)


def terms_of(arm: ArmTerms, keys: Sequence[str]) -> list[Term]:
    """Return the terms of an arm with some keys, of those that it has."""
    return [arm.terms[key] for key in keys if key in arm.terms]


def model_misfit(fitted: Fit, beside: Sequence[Term]) -> float:
    """Return the share of all torque that is left where all links but the last are the model's.

    The last one is free, and so are the terms ``beside`` it. What has no term is the model's.
    """
    terms = [*terms_of(fitted.arm, LAST_LINKS), *beside]
    return fitted.refit(terms).residual_share


def fits(fitted: Fit) -> bool:
    """Return whether a log fits its model so well that its columns are right."""
    touched = any(recording.touched for recording in fitted.recordings)
    return bool(
        fitted.unexplained_share < LITTLE
        and not is_foreign(fitted)
        and is_plausible(fitted)
        and not touched
    )


def driven(fitted: Fit) -> NDArray[np.bool_]:
    """Return which joints (J,) friction drives near standstill, which real friction never does."""
    dry, error = dry_friction(fitted)
    return np.asarray(dry < -ALARMING * error)


def drives(fitted: Fit) -> bool:
    """Return whether friction drives a joint: a turned sign, whatever the model."""
    return bool(np.any(driven(fitted)))


def last_mass(fitted: Fit) -> tuple[float, float]:
    """Return the last link's mass and its standard error [kg]."""
    return fitted.free[fitted.names.index("m")], fitted.error_of("m")


def is_plausible(fitted: Fit) -> bool:
    """Return whether the last link's mass is that of a link, and the others are near the model's.

    The mass has to lie, within ``ALARMING`` standard errors, between zero and the larger of two
    limits: ``MOST_OF_ARM`` of the arm's mass, and the model's mass plus ``MOST_TOOL`` of the arm's.
    """
    robot = fitted.arm.robot
    largest = max(MOST_OF_ARM * robot.mass, robot.prior.mass + MOST_TOOL * robot.mass)
    mass, error = last_mass(fitted)
    is_possible = -ALARMING * error < mass < largest + ALARMING * error
    for term, span in fitted.equations.spans:
        if term.cause == LINKS and term.prior is not None:
            values = np.append(fitted.free[span], -1.0)
            count = len(term.names)
            largest = count + LINKS_DEVIATIONS * np.sqrt(2.0 * count)
            is_possible &= np.sum((term.prior.rows @ values) ** 2) < largest
    return bool(is_possible)


def is_of_single_joints(fitted: Fit) -> bool:
    """Return whether joints are driven one at a time, as people measure their friction.

    Such an experiment hardly shows links, nor what is wrong with their torques as a whole.
    """
    is_used = np.concatenate([recording.is_used for recording in fitted.recordings])
    counts = np.sum(is_used[:, fitted.arm.indices], axis=1)
    return bool(np.mean(counts[counts > 0]) < MOST_AT_ONCE)


def is_sibling(fitted: Fit) -> bool:
    """Return whether links differ from the model as those of another arm do."""
    scales = fitted.question.link_scales
    is_off = scales.mass > SIBLING_MASSES
    return is_off or scales.centre_of_mass > SIBLING_CENTRES


def regression(fitted: Fit, joint: int) -> dict[str, float]:
    """Return what a joint's torque has of the model's weight, its inertia, friction and offset."""
    sums = fitted.sums
    own = (term.key_of(sums.joints[joint]) for term in (COULOMB, VISCOUS, OFFSET))
    names = [sums.names[column] for column in sums.columns[joint][:-1]]
    at = [names.index(name) for name in (WEIGHT, INERTIAL, *own) if name in names]
    total = sums.totals[joint]
    values, *_ = np.linalg.lstsq(total[np.ix_(at, at)], total[at, -1], rcond=1e-12)
    return {names[k]: value for k, value in zip(at, values.tolist())}
