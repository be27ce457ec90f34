"""The model file: the fit of those terms that a file can hold, judged as a file.

Effects that a file cannot hold (torque scales, encoder zeros, a delay, friction that grows with the
load) are left out; the offsets of torque sensors stay, which the judge of a file removes, too.

Shapes: n joints of the chain, J joints with equations.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import BEND, OFFSET, POLYNOMIAL, ROTOR, TERMS
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES, turn_gravity
from robot_sysid.estimate.fit import Fit, LeftOut, settled_errors, settled_values
from robot_sysid.estimate.held_out import error_in, validation, validation_as_used
from robot_sysid.estimate.links import last_link_scale
from robot_sysid.estimate.offers import Effect, Offers
from robot_sysid.estimate.options import (
    FILE_FRICTION,
    FILE_GRAVITY,
    FILE_LINKS,
    FILE_ROTORS,
)
from robot_sysid.estimate.questions import WIDE, usual_offset
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
from robot_sysid.records import (
    Array,
    Errors,
    InertialParameters,
    ModelErrors,
    Validation,
)
from robot_sysid.records.levels import CLEAR, INTERVAL, SURE
from robot_sysid.records.parameters import keys_of
from robot_sysid.signals.process import FilteredRecording
from robot_sysid.spatial import N_INERTIAL

ROOM = 1.001
"""Room that the last link has for bodies on joints of their own, such as fingers, over what they
need: rounding of where they sit would leave none beside them."""
WORTH = 0.01
"""Least share by which friction that bends lowers the held-out torque error, to be worth a second
file. It is no test of significance, which would lose half of what bends gain on other motions: the
bend of a short log is seldom clear. On other motions it keeps what simulated arms gain whose gears
bend, and spares files of gears that do not."""


def offsets_of_model(file: Fit) -> Fit:
    """Return the fit of the given model: each joint's sensor offset alone is fitted.

    ``file`` is the fit of the model file; a payload that it carries is there.
    """
    payload = {
        name: file.by_name[name] for name in PAYLOAD_NAMES if file.question.loaded
    }
    return file.fit([file.arm.terms[OFFSET.name]], payload)


def errors_of(file: Fit, model: Fit | None = None) -> ModelErrors:
    """Return the held-out errors of the given model and of a fitted model file.

    ``model`` is the fit of the given model, where it is known already.
    """
    model = model or offsets_of_model(file)
    return ModelErrors(
        validation(model),
        validation(file),
        Errors(validation_as_used(model), validation_as_used(file)),
    )


def error_without_rotors(file: Fit) -> Validation:
    """Return the error of a file without rotors and motors, which readers of a URDF leave out."""
    arm = file.arm
    beyond = [*map(ROTOR.key_of, arm.owners)]
    for motor in arm.motors:
        beyond += keys_of(motor.parameters)
    bare = {name: arm.model.get(name, 0.0) for name in beyond}
    return validation(file.fit([arm.terms[OFFSET.name]], {**file.by_name, **bare}))


def gravity_in(file: Fit) -> Array | None:
    """Return the gravity (3,) of a fitted model file [m/s^2]; None where the file keeps its own."""
    angles = np.array([file.by_name.get(name, 0.0) for name in TILT_NAMES])
    if TILT_NAMES[0] not in file.names and not np.any(angles):
        return file.arm.robot.gravity
    return turn_gravity(file.point.gravity, angles)


def bent_owners(file: Fit) -> Iterator[str]:
    """Yield the joints and motors whose friction bends in a fitted file."""
    for parameter in file.arm.terms[BEND.name].parameters:
        if parameter.key in file.names and file.by_name[parameter.key] > 0.0:
            yield parameter.of


def straight_of(file: Fit) -> Fit:
    """Return the fit of the file that any program reads, which has no bends."""
    return file if file.line is None else file.line


def _line_of(file: Fit) -> Fit:
    """Return the fit of a file with the straight line nearest to each bend of friction.

    Links, rotors and gravity are those of the file whose friction bends, which are nearer to the
    truth than those that would make up for a line; so they are when a block is held out.
    """
    terms = [
        term
        for term, _ in file.equations.spans
        if not term.bodies and term.key not in (BEND.name, TILT)
    ]
    bends = file.arm.terms[BEND.name].names
    straight = {**file.by_name, **dict.fromkeys(bends, 0.0)}
    line = file.fit(terms, straight, file.noise)
    held = np.array([file.equations.full(values) for values in file.alone])
    held[:, file.sums.at(bends)] = 0.0
    return replace(line, left_out=LeftOut.WITH_BOUNDS, held_apart=held)


def fit_file(estimate: Fit, carried: Array | None = None, may_bend: bool = True) -> Fit:
    """Return the fit of the model file: of the terms that it holds, and of sensors' offsets.

    ``straight_of`` makes of it the file without bends of friction.

    Args:
        estimate: the fit of all terms, from which rotors are taken.
        carried: (10,) payload of loaded recordings; None without one.
        may_bend: whether friction may bend.
    """
    arm = estimate.arm
    unchanged = estimate.question.options.kept
    rotors = select_rotors(estimate, unchanged)
    payload = {} if carried is None else dict(zip(PAYLOAD_NAMES, carried.tolist()))
    held = {**payload, **rotors}
    terms = _terms(estimate, unchanged)
    bend = bend_in_file(estimate) if may_bend else None
    if bend is not None:
        terms.append(bend)
    if FILE_FRICTION not in unchanged:
        # Beside another line, a bend of the model's would fall.
        held |= without_stated_bends(estimate)
    offset = arm.terms[OFFSET.name]
    # Errors of offsets are the same whatever bodies are possible. Each fit begins with the noise of
    # the one before: beside a larger one, offsets of their usual size would be the rest of an
    # unusual one, and make it so large.
    free = estimate.fit([*terms, offset], held, estimate.noise, possible=False)
    terms.append(_known_offsets(replace(free, left_out=LeftOut.EACH)))
    if TILT in arm.terms and FILE_GRAVITY not in unchanged:
        usual = np.radians(usual_errors.GRAVITY_IN_FILE)
        tilt = replace(arm.terms[TILT], prior=independent(np.full(2, usual)))
        # Gravity is turned only where the torques clearly show it, whatever bodies are possible. A
        # base that stands further off is found before; here it is what bodies cannot take up.
        free = estimate.fit(terms, held, free.noise, possible=False)
        offer = Offers(free, free.weights).offer(Effect.of(tilt))
        if offer.gain > CLEAR and np.linalg.norm(offer.values) < INTERVAL * usual:
            terms.append(tilt)
    fitted = estimate.fit(terms, held, free.noise)
    # What is printed as held-out is the error of such files, not of fits without their bounds.
    fitted = replace(fitted, left_out=LeftOut.WITH_BOUNDS)
    if not any(bent_owners(fitted)):
        return fitted
    line = _line_of(fitted)
    curved, straight = (np.sum(file.held_out) for file in (fitted, line))
    if curved > (1.0 - WORTH) ** 2 * straight:
        return fit_file(estimate, carried, may_bend=False)
    return replace(fitted, line=line)


def bend_in_file(estimate: Fit) -> Term | None:
    """Return the term of friction that bends, of joints and motors; None where none may bend.

    A sensor behind the gears sees neither rotors nor the friction of gears: where no rotor is
    ``SURE`` errors from zero, a bend would take up other torque, and the file would be worse.
    Held-out blocks are not asked: they lose half of what bends gain on other motions.
    """
    kept = estimate.question.options.kept
    term = estimate.arm.terms[BEND.name]
    rotors = [ROTOR.key_of(owner) for owner in estimate.arm.owners]
    is_seen = any(
        estimate.by_name.get(name, 0.0) > SURE * estimate.error_of(name)
        for name in rotors
    )
    return term if is_seen and FILE_FRICTION not in kept else None


def without_stated_bends(estimate: Fit) -> dict[str, float]:
    """Return the numbers of the model's own bends, which those of the file replace: zeros."""
    arm = estimate.arm
    bends = {joint for joint, top in zip(arm.robot.joint_names, arm.stated_tops) if top}
    bends |= {motor.name for motor in arm.motors if motor.stated_top}
    return {term.key_of(owner): 0.0 for owner in bends for term in POLYNOMIAL}


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
    pairs: list[tuple[Validation, Validation]] = []
    for values in ({}, fitted.by_name):
        solved = other.fit([other.arm.terms[OFFSET.name]], values)
        error, as_used = (
            error_in(solved, offsets, solved.inverse, blocks, source)
            for offsets in (solved.values, np.zeros_like(solved.values))
        )
        pairs.append((error, as_used))
    (before, before_as_used), (after, after_as_used) = pairs
    return ModelErrors(before, after, Errors(before_as_used, after_as_used))


def _known_offsets(fitted: Fit) -> Term:
    """Return the term of sensors' offsets with a prior of their size.

    In a small motion an offset and the weight of links make the same torque, so that noise alone
    would move weight into offsets. Sensors of an arm are alike: where none is ``SURE`` errors
    from zero, all are held at zero; where one is, it is as large as offsets usually are, and the
    others are known to ``usual_errors.OFFSET`` of their joint's own torque.
    """
    term = fitted.arm.terms[OFFSET.name]
    torque = fitted.sums.rms_torque
    is_clear = [
        abs(fitted.by_name[name]) > SURE * fitted.error_of(name) for name in term.names
    ]
    known = usual_errors.OFFSET * torque * np.any(is_clear)
    usual = usual_offset(fitted.arm, torque)
    return replace(term, prior=independent(np.where(is_clear, usual, known)))


def _terms(estimate: Fit, unchanged: Sequence[str]) -> list[Term]:
    """Return the terms that a file holds, but for rotors and gravity's tilt."""
    arm = estimate.arm
    # Polynomials stay as the model states them, or give way to bends.
    left_out = {ROTOR.name, TILT, PAYLOAD, *(term.name for term in POLYNOMIAL)}
    if FILE_FRICTION in unchanged:
        left_out |= {*TERMS, *(motor.name for motor in arm.motors)}
    if FILE_LINKS in unchanged or estimate.question.options.priors.link <= 0.0:
        left_out.add(LINKS)
    terms = []
    settled = settled_values(estimate)
    for key, term in arm.terms.items():
        if key in left_out or not (term.bodies or term.parameters[0].attribute):
            continue
        if term.bodies:
            term = _near(estimate, term, settled)
        if key == LAST_LINK:
            hanging = [each.theta for each in arm.robot.bodies if not each.welded]
            least = ROOM * np.sum([np.zeros(N_INERTIAL), *hanging], axis=0)
            term = replace(term, least=least)
        elif term.cause == MOTORS:
            # Rotors are selected apart.
            term = term.only([0, 1])
        terms.append(term)
    return terms


def _near(estimate: Fit, term: Term, settled: Mapping[str, float]) -> Term:
    """Return a term of bodies with the identified numbers and their errors as its prior.

    A file lacks terms, and its bodies would take up their torque. Errors of single parameters leave
    to the torques the combinations that they show, and hold the numbers by which one reads them:
    other runs of the arm are predicted better than without it. Masses stay as they are: what
    torques show is left to first moments and inertias. The numbers are ``settled_values``.
    """
    at = estimate.at(term.names)
    values = np.array([settled[name] for name in term.names])
    bodies = map(InertialParameters, values.reshape(-1, N_INERTIAL))
    wide = np.concatenate([WIDE * body.scale for body in bodies])
    if term.key == LAST_LINK:
        wide = last_link_scale(estimate.arm.robot)
    errors = np.minimum(estimate.errors[at], wide) / INTERVAL
    # Conic solvers are slow where they are known exactly.
    errors[::N_INERTIAL] *= 1e-3
    return replace(term, prior=independent(errors, values))


def select_rotors(estimate: Fit, unchanged: Sequence[str]) -> dict[str, float]:
    """Return the name of each joint's and motor's rotor to its inertia in a file [kg m^2].

    It is the estimate of all terms where that is expected to predict better than the model's rotor,
    from sqrt(2) standard errors on (Akaike, "A new look at the statistical model identification",
    IEEE Transactions on Automatic Control 19(6), 1974). Errors are ``settled_errors``: beside a
    last link of any inertia, no rotor would be known in a log of one joint after the other, and the
    file would have neither of the two. One that is fitted beside a file's few
    terms would take up the torque of friction that a file lacks.

    Tendons have rotor inertia since MuJoCo 3.2.7 only. So that of a motor goes to the joints which
    it turns, unless the model's tendon has some.
    """
    arm = estimate.arm
    robot = arm.robot
    if FILE_ROTORS in unchanged or len(arm.joints) < robot.n_joints:
        return {}
    known = settled_errors(estimate)
    rotors = {}
    for owner in arm.owners:
        name = ROTOR.key_of(owner)
        of_model = arm.model.get(name, 0.0)
        value = estimate.by_name.get(name, of_model)
        is_better = (value - of_model) ** 2 > 2.0 * known.get(name, np.inf) ** 2
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
