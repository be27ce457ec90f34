"""Fit of a model file: bodies, friction, rotors and gravity, in the terms that a file can hold.

Effects that a file cannot hold (torque scales, encoder zeros, a delay, friction that grows with the
load) are left out of the model of the torque; only sensor offsets that the recordings clearly show
stay in it. Optional terms are written where they lower the held-out error of the whole file.

Shapes: the chain has n joints, "joints" are those with equations, p parameters (``Columns.names``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.equations import names_of, split_name
from robot_sysid.dynamics.friction import Coupling, FrictionModel, friction_model
from robot_sysid.estimation.answer import Answer
from robot_sysid.estimation.choices import IN_FILE, posterior_of
from robot_sysid.estimation.columns import PAYLOAD_NAMES, Point
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.fit import Fit, Fitter
from robot_sysid.estimation.held_out import HeldOut, held_out, is_clearly_lower
from robot_sysid.estimation.question import (
    FILE_FRICTION,
    FILE_GRAVITY,
    FILE_ROTORS,
    Choice,
    EstimationOptions,
    Question,
)
from robot_sysid.estimation.unknowns import Unknowns
from robot_sysid.records import Array, RobotModel, Validation

# Largest number of linearisations of the final fit, which starts at the result of a first one.
_ROUNDS = 2


def fit_file(
    fitter: Fitter,
    options: EstimationOptions,
    unchanged_parts: tuple[str, ...],
    estimate: Fit,
    carried: Array | None = None,
) -> Answer:
    """Return the fit of the model file that predicts held-out torques best.

    A URDF can hold neither rotor inertia nor motors that turn several joints, which are fixed
    tendons. For a URDF of an arm that has either, the answer is the fit of an MJCF, and its own
    ``file`` that of the URDF beside it, without them.

    Args:
        fitter: fits the recordings; its cached rows are replaced.
        options: prior uncertainty of the arm's links, and which torques to use.
        unchanged_parts: names of the parts of the file that stay as they are, such as
            ``FILE_FRICTION``.
        estimate: a fit of all effects, at which the search starts; rotors and the uncertainty of
            links are taken from it.
        carried: the payload (10,) of loaded recordings; None without one.
    """
    robot = fitter.columns.robot
    motors = estimate.choice.couplings
    if FILE_FRICTION in unchanged_parts:
        # A new tendon would hold nothing.
        motors = tuple(motor for motor in motors if motor.tendon is not None)
    keeps_motors = {FILE_FRICTION, FILE_ROTORS}.issubset(unchanged_parts)
    if options.torques != "chain" or keeps_motors:
        motors = ()
    question = Question(
        options,
        in_file=True,
        file_kind=robot.kind,
        unchanged_parts=unchanged_parts,
        carried=carried,
    )
    mjcf_question = replace(question, file_kind="mjcf")
    # A URDF states no rotor inertia: one that differs from the model's is not zero.
    has_rotors = _holds_rotors(mjcf_question) and any(select_rotors(estimate).values())
    if robot.kind == "mjcf" or not (motors or has_rotors):
        return _fit_kind(fitter, question, motors, estimate)
    best = _fit_kind(fitter, mjcf_question, motors, estimate)
    urdf = _fit_kind(fitter, question, (), estimate)
    return replace(best, file=urdf)


def _fit_kind(
    fitter: Fitter, question: Question, motors: tuple[Coupling, ...], estimate: Fit
) -> Answer:
    """Return the best file of the kind ``question.file_kind``, "mjcf" or "urdf".

    A first linearisation selects offsets and whether gravity is turned; a second fit of the
    selected parameters is the answer.

    Args:
        fitter: fits the recordings; its cached rows are replaced.
        question: what the file may hold and what stays as it is.
        motors: motors that turn several joints, which the file holds.
        estimate: a fit of all effects.
    """
    columns = fitter.columns
    rotors = select_rotors(estimate) if _holds_rotors(question) else {}
    friction = _friction_terms(columns.robot, question, rotors)
    scales = estimate.choice.link_scales
    choice = Choice(friction, motors, scales, rotors=rotors)
    # Parameters that a file cannot hold go back to the model's values.
    values = estimate.values.copy()
    prefixes = ("scale", "drift", "zero", "load")
    for name, index in columns.index.items():
        term, owner = split_name(name)
        if not owner or term in prefixes:
            values[index] = columns.model_values[index]
    point = replace(columns.start(), values=values, in_file=True)
    model_validation = _validate_model(fitter, question, choice, point)

    fit = fitter.fit(question, choice, point, rounds=1)
    judge = held_out(fit)
    choice = select_offsets(fit, question, choice)

    # Gravity, the only increment in a file, is turned only where that clearly predicts better.
    final_question = question
    start = fit.next_point
    rounds = _ROUNDS
    if FILE_GRAVITY not in question.unchanged_parts and fit.unknowns.increments:
        with_gravity = (*question.unchanged_parts, FILE_GRAVITY)
        level = replace(question, unchanged_parts=with_gravity)
        tilted_score = judge.score(fit.evidence.unknowns(columns, question, choice))
        level_score = judge.score(fit.evidence.unknowns(columns, level, choice))
        if not is_clearly_lower(tilted_score, level_score):
            final_question = level
            start = point
            rounds = 1

    # Gram matrices and rows go before others are made: each takes most of the memory.
    del judge, fit
    fit = fitter.fit(final_question, choice, start, rounds)
    # Results list the parts that the caller asked to keep; gravity that is right is not one.
    fit = replace(fit, question=question)
    judge = held_out(fit, fit.unknowns)
    validation = judge.validation(judge.consistent_squared_errors(fit.unknowns))
    del judge
    file_errors = fit_errors(fit)
    return Answer(fit, file_errors, validation, model_validation=model_validation)


def _holds_rotors(question: Question) -> bool:
    """Tell whether the file gets estimated rotor inertia.

    It does not where rotors stay as they are, in a URDF, and with torques of the terminal joint
    alone, which do not identify the joint's rotor.
    """
    is_kept = (
        FILE_ROTORS in question.unchanged_parts
        or question.options.torques == "terminal"
    )
    return not is_kept and question.file_kind != "urdf"


def _friction_terms(
    robot: RobotModel, question: Question, rotors: Mapping[str, float]
) -> tuple[FrictionModel, ...]:
    """Return the friction terms (n,) to estimate for a file, by chain joint.

    Terms of parts of the file that stay as they are, and rotors of known inertia, are left out.

    Args:
        robot: the arm.
        question: what the file may hold and what stays as it is.
        rotors: joint, or motor that turns several joints, to its known rotor inertia [kg m^2].
    """
    unchanged_terms = set[str]()
    if FILE_FRICTION in question.unchanged_parts:
        unchanged_terms = {"coulomb", "viscous"}
    has_rotors = _holds_rotors(question)
    models = []
    for joint in robot.joint_names:
        excluded = set(unchanged_terms)
        if joint in rotors or not has_rotors:
            excluded.add("armature")
        terms = [term for term in friction_model(IN_FILE).terms if term not in excluded]
        models.append(FrictionModel(tuple(terms)))
    return tuple(models)


def _validate_model(
    fitter: Fitter, question: Question, choice: Choice, point: Point
) -> Validation:
    """Return the held-out error of the given model, with fitted sensor offsets.

    Only offsets are fitted, one per joint. They do not depend on each other, so that the weights of
    the joints are arbitrary.

    Args:
        fitter: gives the recordings' equations.
        question: may contain a payload that the arm carries.
        choice: selects the unknowns of the file, from which only bounds are taken.
        point: has the model's gravity; its other values make no difference.
    """
    columns = fitter.columns
    data, _ = fitter.around(point)
    unknowns = data.unknowns(columns, question, choice)
    indices = columns.indices(names_of("offset", columns.joints))
    # Without the offsets of joints that have no rows.
    indices = indices[data.nonzero[indices]]
    held = columns.model_values.copy()
    if question.carried is not None:
        held[columns.indices(PAYLOAD_NAMES)] = question.carried
    offset_unknowns = Unknowns(
        columns.names, indices, held, (), unknowns.lower, unknowns.upper, {}
    )
    judge = HeldOut(data, noise=np.ones(len(columns.joints)))
    return judge.validation(judge.squared_errors(offset_unknowns))


CLEAR_OFFSET = 3.0
"""Least distance of a sensor's offset from zero, and of a rotor from the model's rotor, in standard
errors, at which it is significant."""
OFFSET = 0.01
"""Prior standard deviation of offsets that are not significant where other joints have significant
ones, as a share of the joint's torque: offsets of a KUKA LWR4+ are not known better."""


def select_offsets(fit: Fit, question: Question, choice: Choice) -> Choice:
    """Return the choice with the priors of torque sensors' offsets that are not significant.

    In a small motion an offset and the weight of links make the same torque, so that noise alone
    would move weight into offsets: offsets that are not significant become zero, the least
    significant first. Sensors of an arm are alike: where one offset is significant, the others get
    a prior standard deviation ``OFFSET``; where none is, all are held at zero.

    Args:
        fit: a fit of the file.
        question: what the file may hold and what stays as it is.
        choice: friction and priors so far.
    """
    deviations = dict(zip(fit.columns.robot.joint_names, OFFSET * fit.evidence.torque))
    unknowns = fit.evidence.unknowns(fit.columns, question, choice)
    zero_joints = list(choice.offsets)
    names = unknowns.estimated_names
    free = []
    for joint in fit.columns.joints:
        if joint not in zero_joints and f"offset[{joint}]" in names:
            free.append(joint)
    offsets, covariance = posterior_of(fit, unknowns, names_of("offset", free))
    while free:
        significance = np.abs(offsets) / np.sqrt(np.diag(covariance))
        index = int(np.argmin(significance))
        if significance[index] > CLEAR_OFFSET:
            priors = {joint: deviations[joint] for joint in zero_joints}
            return replace(choice, offsets=priors)
        # Set this offset to zero and condition the other offsets on that.
        gain = covariance[:, index] / covariance[index, index]
        others = np.arange(len(free)) != index
        offsets = (offsets - gain * offsets[index])[others]
        covariance = (covariance - np.outer(gain, covariance[index]))[others][:, others]
        zero_joints.append(free.pop(index))
    return replace(choice, offsets=dict.fromkeys(zero_joints, 0.0))


def select_rotors(fit: Fit) -> dict[str, float]:
    """Return joint, or motor that turns several joints, to its rotor inertia in a file [kg m^2].

    This is the estimate of a fit with all friction terms where it differs significantly from the
    model's rotor, else the model's rotor. A file lacks most of these friction terms: a rotor that
    is fitted together with the file's few terms would take up their torque in slow motion.

    Tendons have rotor inertia since MuJoCo 3.2.7 only. So that of a motor goes to the joints which
    it turns, unless the model's tendon has some: a TX40's file is off by 4.17 % then, not 4.11 %.
    """
    columns = fit.columns
    unknowns = fit.evidence.unknowns(columns, fit.question, fit.choice)
    motors = [motor.name for motor in fit.choice.couplings]
    owners = []
    names = []
    for owner in (*columns.robot.joint_names, *motors):
        name = f"armature[{owner}]"
        if name in unknowns.estimated_names:
            owners.append(owner)
            names.append(name)
    if not names:
        return {}
    rotors, covariance = posterior_of(fit, unknowns, names)
    indices = columns.indices(names)
    error = np.sqrt(np.diag(covariance))
    is_clear = np.abs(rotors - columns.model_values[indices]) > CLEAR_OFFSET * error
    values = np.where(is_clear, fit.values[indices], columns.model_values[indices])
    rotors_by_owner = dict(zip(owners, values.tolist()))
    for motor in fit.choice.couplings:
        if columns.model_values[columns.index[f"armature[{motor.name}]"]] > 0.0:
            continue
        rotor = rotors_by_owner.get(motor.name, 0.0)
        rotors_by_owner[motor.name] = 0.0
        for index in np.flatnonzero(motor.ratios):
            joint = columns.robot.joint_names[index]
            of_joint = rotors_by_owner.get(joint, fit.value(f"armature[{joint}]"))
            rotors_by_owner[joint] = of_joint + motor.ratios[index] ** 2 * rotor
    return rotors_by_owner
