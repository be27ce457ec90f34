"""Sentences for the user on what was identified and on what the written model holds of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import OFFSET, ROTOR
from robot_sysid.dynamics.inverse_dynamics import gravity_vector
from robot_sysid.estimate.contacts import LITTLE
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import validation
from robot_sysid.estimate.links import CENTRE, MASS, centre_off
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.options import FILE_FRICTION, FILE_LINKS
from robot_sysid.estimate.quantities import quantity
from robot_sysid.estimate.questions import PER_CENT
from robot_sysid.estimate.restricted_fit import error_without_rotors, gravity_in
from robot_sysid.estimate.rows import Sums
from robot_sysid.estimate.terms import (
    FRICTION,
    FURTHER_FRICTION,
    MOTORS,
    PAYLOAD,
    SCALES,
    TILT,
    ZEROS,
    ArmTerms,
    Term,
)
from robot_sysid.estimate.trust import rotor_biases, wrong_moment
from robot_sysid.expected.other_motions import OtherMotions
from robot_sysid.model.mistakes import Mistake, MistakeKind
from robot_sysid.records import Array, InertialParameters, RobotModel
from robot_sysid.records.file_access import MODEL_NAMES
from robot_sysid.records.levels import INTERVAL, SURE, UNEXPLAINED
from robot_sysid.records.messages import Detail, Level, Remark, percent, with_error
from robot_sysid.records.quantities import (
    BodyEstimate,
    FrictionCurve,
    Quantity,
    principal_moments,
)
from robot_sysid.results.reasons import unexplained_torque
from robot_sysid.results.record import ModelFile, needs_mjcf
from robot_sysid.wording import option_setting

COARSE = 0.2
"""Expected error of accelerations, over them, from which it is said."""
WELL_EXPLAINED = 0.035
"""Largest share of the torque that is unexplained and is not said: logs of right models leave
less."""
UNSHOWN = 0.08
"""Error of a joint's torque scale by the log alone, from which on it is said: a factor of 1.25 is
three of these errors, and smaller ones are not seen."""
LEAST_ZERO = 1e-3
"""Encoder zero up to which a note is not worth it, even if it is significant [rad or m]."""


def link_notes(fitted: Fit) -> Iterator[str]:
    """Yield sentences on coarse positions, the bodies of the last link, and unexplained torque."""
    error = max(recording.acceleration_error for recording in fitted.recordings)
    if error > COARSE:
        yield from _coarse_notes(fitted, error)
    robot = fitted.arm.robot
    bodies = [body.name for body in robot.bodies if body.theta[0] > 0.0]
    if len(bodies) > 1:
        yield Detail(
            f"the numbers of {robot.body_name} are those of {' + '.join(bodies)} together"
        )
    if WELL_EXPLAINED < fitted.unexplained_share <= UNEXPLAINED:
        yield unexplained_torque(fitted)


def _coarse_notes(fitted: Fit, error: float) -> Iterator[str]:
    """Yield a sentence on rotors that noise of accelerations makes clearly too small.

    ``error`` is the expected one of accelerations, over them. Motion above the cut-off, which
    accelerations and torques both lose, makes no rotor smaller.
    """
    phrases = []
    most = []
    for rotor, bias, own in rotor_biases(fitted):
        if -bias > fitted.by_name[rotor.key]:
            most.append(rotor.of)
        elif -bias > own:
            phrases.append(
                f"by about {-bias:.2g} ± {own:.2g} {rotor.unit} at {rotor.of}"
            )
    if most:
        phrases.append(f"by more than a half at {', '.join(most)}")
    if phrases:
        yield (
            f"the positions are too coarse for accelerations (expected error {percent(error)}): "
            f"rotor inertia comes out too small, {', '.join(phrases)}, which no "
            "other ± has in it; inertias of links likewise"
        )


def file_notes(fitted: Fit, file: Fit, rows: Sequence[Quantity]) -> Iterator[str]:
    """Yield sentences on what a fitted model file, of these rows, leaves out."""
    robot = fitted.arm.robot
    # Of joints without torque, the log says it.
    has_torque = np.any([each.has_torque for each in fitted.recordings], axis=0)
    powered = itertools.compress(robot.joint_names, has_torque)
    written = {row.of for row in rows}
    unseen = [joint for joint in powered if joint not in written]
    if unseen and FILE_FRICTION not in fitted.question.options.kept:
        yield (
            f"these logs move {', '.join(unseen)} too slowly: friction and rotor inertia are not "
            "identifiable there, the model's values are kept"
        )
    yield from _offset_notes(file)
    if robot.kind == "urdf" and needs_mjcf(rows, fitted.arm.motors):
        tests = validation(file), error_without_rotors(file)
        shares = [percent(test.relative_error or 0.0) for test in tests]
        lacking = "no rotor inertia"
        if fitted.arm.motors:
            lacking += " and no motors that turn several joints"
        yield (
            f"{MODEL_NAMES['urdf']} holds {lacking}: its torque error in motion is {shares[1]}, "
            f"that of {MODEL_NAMES['mjcf']} {shares[0]}"
        )


def scale_notes(scales: Mapping[str, float]) -> Iterator[str]:
    """Yield a sentence on torques that may be off by factors that no log shows."""
    if scales:
        usual = percent(PER_CENT * usual_errors.SCALE)
        listed = ", ".join(f"{scales[owner]:.2f} ({owner})" for owner in scales)
        yield Detail(
            "these logs do not show a torque that reads too much or too little by a factor of up "
            f"to {listed}: masses, friction and rotor inertia are as right as the torques, which "
            f"their ± take to be right to {usual} each"
        )


def curve_notes(file: ModelFile, curves: Sequence[FrictionCurve]) -> Iterator[str]:
    """Yield sentences on friction that bends: what each file has of it, and how far it is known."""
    speeds = ", ".join(f"{c.of} {c.known_to:.2g} {c.speed_unit}" for c in curves)
    assert file.curved is not None
    shares = [percent(f.after.relative_error or 0.0) for f in (file, file.curved)]
    yield Detail(
        f"friction of {', '.join(c.of for c in curves)} bends with speed: {MODEL_NAMES['mjcf']} "
        f"has the straight line nearest to it ({shares[0]} torque error on held-out data, torque "
        f"offsets aside), the curve itself makes {shares[1]}"
    )
    yield Detail(f"friction is known up to the highest speeds of the logs: {speeds}")


def _offset_notes(file: Fit) -> Iterator[str]:
    """Yield a sentence on torque offsets that are larger than a fitted file's held-out error."""
    squares = 0.0
    phrases = []
    for row, parameter in enumerate(file.arm.terms[OFFSET.name].parameters):
        if parameter.key in file.names:
            offset, error = quantity(file, parameter.key)
            if abs(offset) > SURE * error:
                squares += offset**2 * np.sum(file.sums.counts[:, row])
                phrases.append(f"{parameter.of} {offset:.2g} {parameter.unit}")
    squared = squares / np.sum(file.sums.squared_torque)
    share = validation(file).relative_error or 0.0
    if squared > max(LITTLE, share) ** 2:
        yield Detail(
            f"no model file holds an offset of a torque sensor ({', '.join(phrases)}), or friction "
            "that is larger in one direction: counted as errors, they make the torque error of the "
            f"written file on held-out data {percent(np.sqrt(squared + share**2))}"
        )


def unshown_scales(fitted: Fit, rows: Sequence[Quantity]) -> dict[str, float]:
    """Return what has a torque to the factor by which that may be off without the logs showing it.

    Friction and rotor inertia are nearly all of the torque of some joints, and take a factor on it
    up. One on all torques is one on all masses.

    Args:
        fitted: the fit of all terms.
        rows: numbers of the written model, whose joints are asked for.
    """
    question = fitted.question
    written = {row.of for row in rows}
    scales = fitted.arm.terms[SCALES]
    wrong = PER_CENT * usual_errors.WRONG_SCALE
    is_asked = SCALES in {term.cause for term in fitted.equations.terms}
    is_stated = question.options.priors.scale is not None
    # The errors of a payload have those of the torques in them.
    if question.loaded or is_stated or not is_asked:
        return {}
    groups = {"all joints together": scales.names}
    for parameter in scales.parameters:
        if parameter.of in written:
            groups[parameter.of] = (parameter.key,)
    offers = Offers(fitted)
    factors = {}
    for owner, names in groups.items():
        offer = offers.offer(Effect(names, np.full((len(names), 1), wrong)))
        error = float(offer.errors[0])
        if error > UNSHOWN:
            factors[owner] = 1.0 + INTERVAL * error
    return factors


def result_notes(fitted: Fit, file: Fit | None) -> Iterator[str]:
    """Yield sentences for the user on friction, motors, encoder zeros and gravity."""
    left_out = fitted.question.options.left_out_terms
    if left_out:
        yield f"not estimated, as the friction model is given without: {', '.join(left_out)}"
    for motor in fitted.arm.motors:
        if motor.tendon is None:
            yield Detail(
                f"a motor turns with {motor.name}: the torques give clear evidence of it"
            )
    for parameter in fitted.arm.terms[ZEROS].parameters:
        if parameter.key not in fitted.names:
            continue
        zero, error = quantity(fitted, parameter.key)
        if abs(zero) > max(SURE * error, LEAST_ZERO):
            yield (
                f"the log reads {parameter.of} {1e3 * zero:.1f} ± {1e3 * error:.1g} "
                f"m{parameter.unit} too large; the links are those of the true positions"
            )
    gravity = None if file is None else gravity_in(file)
    level = gravity_vector(fitted.arm.robot)
    if gravity is not None and np.any(gravity != level):
        sine = np.linalg.norm(np.cross(level, gravity))
        angle = math.degrees(math.atan2(sine, level @ gravity))
        yield (
            f"gravity in the written model is turned by {angle:.2f} degrees, because the base is "
            f"tilted or encoder zeros are off ({option_setting('keep', 'gravity')} leaves it "
            "alone)"
        )


def wrong_links(
    links: Iterable[BodyEstimate], file: ModelFile, odd: Mapping[str, str]
) -> Iterator[Remark]:
    """Yield a doubt on each link of the model of which the recordings contradict a number.

    Args:
        links: estimates of links before the last.
        file: the written model, which keeps the link or has it corrected.
        odd: name of a link to the kind of its number that is far more off than the others.
    """
    is_kept = FILE_LINKS in file.kept
    remedy = f"the written model has it {'as it was' if is_kept else 'corrected'}"
    for link in links:
        wrong = [*_moment_off(link)]
        if link.name in odd and link.prior is not None:
            wrong = [f"its {OFF_BY_KIND[odd[link.name]](link, link.prior)}"]
        if wrong:
            text = f"{link.name} of the model is probably wrong: {'; '.join(wrong)}"
            yield Remark(Level.DOUBTS, link.name, text, remedy)


def _moment_off(link: BodyEstimate) -> Iterator[str]:
    """Yield how far the first moment of a link is off its prior, where it is."""
    wrong = wrong_moment(link)
    if wrong is not None:
        yield (
            "its mass times the distance of its centre of mass is "
            f"{with_error(wrong.moment, wrong.error, 'kg·m')}, in the model {wrong.expected:.3g}, "
            "and torques show no more than that product"
        )


def _mass_off(link: BodyEstimate, prior: InertialParameters) -> str:
    """Return how far the mass of a link is off its prior."""
    mass = with_error(link.mass, link.errors[0], "kg")
    return f"mass is {mass}, in the model {prior.mass:.3g}, and counts as not known"


def _centre_off(link: BodyEstimate, prior: InertialParameters) -> str:
    """Return how far the centre of mass of a link is off its prior."""
    off = centre_off(link.theta, link.covariance, prior.com)
    distance = with_error(1e3 * off.distance, 1e3 * off.error, "mm")
    return (
        f"centre of mass is {distance} from where the model has it, and counts as not known, with "
        "its inertia"
    )


OFF_BY_KIND = {MASS: _mass_off, CENTRE: _centre_off}
"""How far a number of a link is off its prior, by the number's kind."""


def mistake_words(robot: RobotModel, mistake: Mistake) -> str:
    """Return what a mistake in the links of a model is, with their names."""
    names = [robot.links[number].body_name for number in mistake.links]
    if mistake.kind is MistakeKind.EXCHANGED:
        return f"the numbers of {' and '.join(names)} are exchanged"
    (name,) = names
    if mistake.kind is MistakeKind.ABOUT_ORIGIN:
        point = "the origin of its body, not about its centre of mass"
        return f"the inertia of {name} is about {point}"
    is_mirrored = mistake.kind is MistakeKind.MIRRORED
    way = "has the wrong sign" if is_mirrored else "is in a frame that is turned"
    stated = _millimetres(robot.links[mistake.links[0]].theta)
    (body,) = mistake.bodies
    return f"the centre of mass of {name}, {stated}, {way}: it is near {_millimetres(body)}"


def _millimetres(theta: Array) -> str:
    """Return the centre of mass of a body (10,) in millimetres."""
    centre = ", ".join(f"{1e3 * each:.0f}" for each in theta[1:4] / theta[0])
    return f"({centre}) mm"


def unknown_inertia(payload: BodyEstimate) -> str:
    """Return why the inertia of a payload is not identified."""
    moments, errors = principal_moments(payload)
    if not np.all(np.isfinite(errors)):
        return "the payload's inertia is not identifiable from these torques"
    listed = ", ".join(map(with_error, moments.tolist(), errors.tolist()))
    return (
        f"the payload's principal moments of inertia, {listed} kg·m², do not differ significantly "
        "from zero"
    )


def other_motion_notes(motions: OtherMotions) -> Iterator[str]:
    """Yield sentences on where the error to expect on other motions does not hold."""
    fitted = motions.fitted
    if motions.still:
        yield Detail(
            f"{', '.join(motions.still)} stood still, or had no torque: the error on other motions "
            "takes friction and rotors there to be like those of the other joints, for what a "
            "joint carries and is built for"
        )
    names = fitted.arm.robot.joint_names
    is_moved = [name not in motions.still for name in names]
    joints = [*itertools.compress(names, motions.faster & is_moved)]
    if joints:
        listed = "all joints" if len(joints) == len(names) else ", ".join(joints)
        yield Detail(
            f"the logs are slow for {listed}: friction at twice their speed and more is not "
            "measured, so that the error to expect on other motions is less certain than that of "
            "faster logs"
        )
    offsets = fitted.arm.terms[OFFSET.name].parameters
    clear = [
        f"{each.of} {fitted.by_name[each.key]:.2g} {each.unit}"
        for each in offsets
        if abs(fitted.by_name[each.key]) > SURE * fitted.error_of(each.key)
    ]
    if clear:
        yield Detail(
            f"offsets of torque are taken to be the sensors' ({', '.join(clear)}): if a cable "
            "or a spring makes them, no number here knows how they change with the position"
        )
    yield Detail(
        "the error on other motions is of this arm as it was: after a change of its friction, "
        "or of another arm of its type, files were up to 3.4 times as far off"
    )


def part_names(arm: ArmTerms, sums: Sums) -> list[str]:
    """Return what each parameter (p,) of made-up motions is a part of, in words."""
    words: dict[str, str] = {}
    for term in arm.terms.values():
        words.update(_term_parts(term))
    for link, names in arm.links.items():
        body = arm.robot.links[link].body_name
        words.update(dict.fromkeys(names[:4], f"mass and centre of {body}"))
        words.update(dict.fromkeys(names[4:], f"inertia of {body}"))
    return [words[name] for name in sums.names]


def _term_parts(term: Term) -> Iterator[tuple[str, str]]:
    """Yield the name of each parameter of a term and what it is a part of, in words."""
    shared = {TILT: "direction of gravity", PAYLOAD: "payload"}.get(term.cause)
    of_sensor = {SCALES: "torque scale of ", ZEROS: "encoder zero of "}.get(term.cause)
    for parameter in term.parameters:
        kind = of_sensor or f"{term.cause} of "
        if term.cause in (FRICTION, FURTHER_FRICTION, MOTORS):
            others = {ROTOR.name: "rotor of ", OFFSET.name: "torque offset of "}
            kind = others.get(parameter.name, "friction of ")
        yield parameter.key, shared or f"{kind}{parameter.of}"
