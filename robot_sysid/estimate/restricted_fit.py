"""The model file: the fit of those terms that a file can hold, judged as a file.

Effects that a file cannot hold (torque scales, encoder zeros, a delay, friction that grows with the
load) are left out; the offsets of torque sensors stay, which the judge of a file removes, too.

Shapes: n joints of the chain, J joints with equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import ROTOR, TERMS
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES, turn_gravity
from robot_sysid.estimate.fit import Fit, LeftOut
from robot_sysid.estimate.held_out import error_in, validation
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.options import (
    FILE_FRICTION,
    FILE_GRAVITY,
    FILE_LINKS,
    FILE_ROTORS,
)
from robot_sysid.estimate.questions import WIDE
from robot_sysid.estimate.terms import (
    LAST_LINK,
    LINKS,
    MOTORS,
    PAYLOAD,
    PAYLOAD_NAMES,
    TILT,
    Term,
    independent,
)
from robot_sysid.records import Array, InertialParameters, Validation
from robot_sysid.records.levels import CLEAR, INTERVAL, SURE
from robot_sysid.records.parameters import keys_of
from robot_sysid.results.record import ModelErrors, ModelFile
from robot_sysid.signals.process import FilteredRecording
from robot_sysid.spatial import N_INERTIAL


def error_before(file: Fit) -> Validation:
    """Return the held-out error of the given model, each joint's sensor offset fitted.

    ``file`` is the fit of the model file; a payload that it carries is there.
    """
    payload = {
        name: file.by_name[name] for name in PAYLOAD_NAMES if file.question.loaded
    }
    return validation(file.fit([file.arm.terms["offset"]], payload))


def error_without_rotors(file: Fit) -> Validation:
    """Return the error of a file without rotors and motors, which readers of a URDF leave out."""
    arm = file.arm
    beyond = [*map(ROTOR.key_of, arm.owners)]
    for motor in arm.motors:
        beyond += keys_of(motor.parameters)
    bare = {name: arm.model.get(name, 0.0) for name in beyond}
    return validation(file.fit([arm.terms["offset"]], {**file.by_name, **bare}))


def gravity_in(file: Fit) -> Array | None:
    """Return the gravity (3,) of a fitted model file [m/s^2]; None where the file keeps its own."""
    if TILT_NAMES[0] not in file.names:
        return file.arm.robot.gravity
    angles = file.values[file.at(TILT_NAMES)]
    return turn_gravity(file.point.gravity, angles)


def model_file(file: Fit, others: Sequence[ModelErrors] = ()) -> ModelFile:
    """Return what is said of a fitted model file, with its errors on other logs."""
    return ModelFile(
        error_before(file),
        validation(file),
        tuple(others),
        gravity_in(file),
        file.question.options.kept,
        file.arm.motors,
    )


def fit_file(estimate: Fit, carried: Array | None = None) -> Fit:
    """Return the fit of the model file: of the terms that it holds, and of sensors' offsets.

    Args:
        estimate: the fit of all terms, from which rotors are taken.
        carried: (10,) payload of loaded recordings; None without one.
    """
    arm = estimate.arm
    unchanged = estimate.question.options.kept
    rotors = select_rotors(estimate, unchanged)
    payload = {} if carried is None else dict(zip(PAYLOAD_NAMES, carried.tolist()))
    held = {**payload, **rotors}
    terms = _terms(estimate, unchanged)
    offset = arm.terms["offset"]
    # Errors of offsets are the same whatever bodies are possible.
    free = estimate.fit([*terms, offset], held, possible=False)
    terms.append(_known_offsets(replace(free, left_out=LeftOut.EACH)))
    if TILT in arm.terms and FILE_GRAVITY not in unchanged:
        prior = independent(np.full(2, np.radians(usual_errors.GRAVITY_IN_FILE)))
        tilt = replace(arm.terms[TILT], prior=prior)
        # Gravity is turned only where the torques clearly show it, whatever bodies are possible.
        free = estimate.fit(terms, held, possible=False)
        if Offers(free, free.weights).offer(Effect.of(tilt)).gain > CLEAR:
            terms.append(tilt)
    fitted = estimate.fit(terms, held)
    # What is printed as held-out is the error of such files, not of fits without their bounds.
    return replace(fitted, left_out=LeftOut.WITH_BOUNDS)


def errors_on(
    fitted: Fit, recordings: Sequence[FilteredRecording], source: str
) -> ModelErrors:
    """Return the errors of the given model and of the file on a log that was not fitted.

    The offset of each joint's sensor is that of this log.

    Args:
        fitted: the fit of the file.
        recordings: stretches of the other log.
        source: its name.
    """
    other = fitted.of(fitted.arm.sums(recordings, fitted.point))
    blocks = other.sums.blocks
    errors = []
    for values in ({}, fitted.by_name):
        solved = other.fit([other.arm.terms["offset"]], values)
        errors.append(error_in(solved, solved.values, solved.inverse, blocks, source))
    return ModelErrors(*errors)


def _known_offsets(fitted: Fit) -> Term:
    """Return the term of sensors' offsets with a prior of those that are not significant.

    In a small motion an offset and the weight of links make the same torque, so that noise alone
    would move weight into offsets. Sensors of an arm are alike: where none is ``SURE`` errors
    from zero, all are held at zero; where one is, the others are known to ``usual_errors.OFFSET``.
    """
    term = fitted.arm.terms["offset"]
    torque = fitted.sums.rms_torque
    is_clear = [
        abs(fitted.by_name[name]) > SURE * fitted.error_of(name) for name in term.names
    ]
    known = usual_errors.OFFSET * torque * np.any(is_clear)
    return replace(term, prior=independent(np.where(is_clear, WIDE * torque, known)))


def _terms(estimate: Fit, unchanged: Sequence[str]) -> list[Term]:
    """Return the terms that a file holds, but for rotors and gravity's tilt."""
    arm = estimate.arm
    left_out = {"armature", TILT, PAYLOAD}
    if FILE_FRICTION in unchanged:
        left_out |= {*TERMS, *(motor.name for motor in arm.motors)}
    if FILE_LINKS in unchanged or estimate.question.options.priors.link <= 0.0:
        left_out.add(LINKS)
    terms = []
    for key, term in arm.terms.items():
        if key in left_out or not (term.bodies or term.parameters[0].attribute):
            continue
        if term.bodies:
            term = _near(estimate, term)
        if key == LAST_LINK:
            hanging = [each.theta for each in arm.robot.bodies if not each.welded]
            term = replace(term, least=np.sum([np.zeros(N_INERTIAL), *hanging], axis=0))
        elif term.cause == MOTORS:
            # Rotors are selected apart.
            term = term.only([0, 1])
        terms.append(term)
    return terms


def _near(estimate: Fit, term: Term) -> Term:
    """Return a term of bodies with the identified numbers and their errors as its prior.

    A file lacks terms, and its bodies would take up their torque. Errors of single parameters leave
    to the torques the combinations that they show, and hold the numbers by which one reads them:
    other runs of a KUKA are predicted up to 8 % better than without it. Masses stay as they are:
    what torques show is left to first moments and inertias.
    """
    at = estimate.at(term.names)
    values = estimate.values[at]
    bodies = map(InertialParameters, values.reshape(-1, N_INERTIAL))
    wide = np.concatenate([WIDE * body.scale for body in bodies])
    errors = np.minimum(estimate.errors[at], wide) / INTERVAL
    # Conic solvers are slow where they are known exactly.
    errors[::N_INERTIAL] *= 1e-3
    return replace(term, prior=independent(errors, values))


def select_rotors(estimate: Fit, unchanged: Sequence[str]) -> dict[str, float]:
    """Return the name of each joint's and motor's rotor to its inertia in a file [kg m^2].

    It is the estimate of all terms where that is expected to predict better than the model's rotor,
    from sqrt(2) standard errors on (Akaike, "A new look at the statistical model identification",
    IEEE Transactions on Automatic Control 19(6), 1974). One that is fitted beside a file's few
    terms would take up the torque of friction that a file lacks.

    Tendons have rotor inertia since MuJoCo 3.2.7 only. So that of a motor goes to the joints which
    it turns, unless the model's tendon has some.
    """
    arm = estimate.arm
    robot = arm.robot
    if FILE_ROTORS in unchanged or len(arm.joints) < robot.n_joints:
        return {}
    rotors = {}
    for owner in arm.owners:
        name = ROTOR.key_of(owner)
        of_model = arm.model.get(name, 0.0)
        value = estimate.by_name.get(name, of_model)
        is_better = (value - of_model) ** 2 > 2.0 * estimate.error_of(name) ** 2
        rotors[name] = value if is_better else of_model
    names = [*map(ROTOR.key_of, robot.joint_names)]
    for motor in arm.motors:
        name = ROTOR.key_of(motor.name)
        if arm.model.get(name, 0.0) > 0.0:
            continue
        for index in np.flatnonzero(motor.ratios):
            rotors[names[index]] += motor.ratios[index] ** 2 * rotors[name]
        rotors[name] = 0.0
    return rotors
