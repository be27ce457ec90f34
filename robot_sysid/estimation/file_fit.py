"""Fit of a model file: bodies, friction, rotors and gravity, in the terms that a file can hold.

Effects that a file cannot hold (torque scales, encoder zeros, a delay, friction that grows with the
load) are left out of the model of the torque; only sensor offsets that the recordings clearly show
stay in it. Optional terms are written where they lower the held-out error of the whole file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics.friction import Coupling, FrictionModel, friction_model
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.choices import (
    IN_FILE,
    WITH_POLYNOMIAL,
    HeldOut,
    held_out,
    is_clearly_lower,
    predictive_link_scales,
    score_of,
    select_offsets,
    select_rotors,
    squared_errors,
)
from robot_sysid.estimation.columns import PAYLOAD_NAMES, Point
from robot_sysid.estimation.errors import FitErrors, fit_errors
from robot_sysid.estimation.fit import Fit, Fitter
from robot_sysid.estimation.unknowns import (
    FILE_FRICTION,
    FILE_GRAVITY,
    FILE_ROTORS,
    Choice,
    Question,
    Unknowns,
    build_unknowns,
)
from robot_sysid.model.chain import CAN_HOLD_ROTORS
from robot_sysid.records import Array, RobotModel, Validation

# Linearisations of the fit that begins where a first one ended.
_ROUNDS = 2


@dataclass(frozen=True)
class FileFit:
    """The best file for some recordings.

    Attributes:
        fit: its parameters.
        before, after: held-out error of the model as it was and of the file, each joint's sensor
            offset subtracted.
        errors: of its parameters.
        beside: the best URDF, where the model is one and this file is an MJCF.
    """

    fit: Fit
    before: Validation
    after: Validation
    errors: FitErrors
    beside: FileFit | None = None


def fit_file(
    fitter: Fitter,
    options: EstimationOptions,
    kept_parts: tuple[str, ...],
    estimate: Fit,
    pull: Array | None = None,
    carried: Array | None = None,
) -> FileFit:
    """Return the file that predicts held-out torques best.

    Motors that turn several joints are fixed tendons, which only an MJCF has.

    Args:
        options: prior uncertainty of the arm's links.
        kept_parts: parts of the file that stay as they are.
        estimate: a fit of all effects; the search begins at it, and rotors are taken from it.
        pull: see ``errors.fit_errors``.
        carried: the payload (10,) of loaded recordings.
    """
    robot = fitter.columns.robot
    keeps_motors = options.torques != "chain" or {FILE_FRICTION, FILE_ROTORS} <= {
        *kept_parts
    }
    motors = () if keeps_motors or not CAN_HOLD_ROTORS else estimate.choice.couplings
    question = Question(
        options,
        in_file=True,
        file_kind=robot.kind,
        kept_parts=kept_parts,
        carried=carried,
    )
    if not motors or robot.kind == "mjcf":
        return _fit_kind(fitter, question, motors, estimate, pull)
    best = _fit_kind(
        fitter, replace(question, file_kind="mjcf"), motors, estimate, pull
    )
    return replace(best, beside=_fit_kind(fitter, question, (), estimate, pull))


def _fit_kind(
    fitter: Fitter,
    question: Question,
    motors: tuple[Coupling, ...],
    estimate: Fit,
    pull: Array | None,
) -> FileFit:
    """Return the best file of one kind, which holds these motors that turn several joints."""
    robot = fitter.columns.robot
    rotors = select_rotors(estimate) if _holds_rotors(question) else {}
    friction = _friction(robot, question, rotors, IN_FILE)
    choice = Choice(friction, motors, rotors=rotors)
    # Parameters that a file cannot hold go back to the model's values.
    values = estimate.values.copy()
    prefixes = ("scale", "drift", "zero", "load")
    for name, index in fitter.columns.place.items():
        if name.partition("[")[0] in prefixes or "[" not in name:
            values[index] = fitter.columns.prior[index]
    point = replace(fitter.columns.start(), values=values, in_file=True)
    before = _validate_model(fitter, question, choice, point)
    fit = fitter.fit(question, choice, point, rounds=1)
    judge = held_out(fit)
    choice = replace(choice, friction=_polynomials(judge, fit, question, choice))
    scales = predictive_link_scales(judge, fit, question, choice)
    choice = replace(choice, link_scales=scales)
    choice = select_offsets(fit, question, choice)
    final_question = question
    start = fit.next_point
    rounds = _ROUNDS
    if FILE_GRAVITY not in question.kept_parts and fit.unknowns.settle:
        level = replace(question, kept_parts=(*question.kept_parts, FILE_GRAVITY))
        tilted_score = score_of(judge, fit, question, choice)
        if not is_clearly_lower(tilted_score, score_of(judge, fit, level, choice)):
            final_question = level
            start = point
            rounds = 1
    del judge, fit  # its Gram matrices take as much memory as the rows
    fit = replace(fitter.fit(final_question, choice, start, rounds), question=question)
    judge = held_out(fit, fit.unknowns)
    validation = judge.validation(judge.of(fit))
    del judge
    return FileFit(fit, before, validation, fit_errors(fit, (), pull))


def _holds_rotors(question: Question) -> bool:
    """Tell whether to write rotors; torques of the last joint alone do not identify its rotor."""
    is_kept = (
        FILE_ROTORS in question.kept_parts or question.options.torques == "terminal"
    )
    return not is_kept and question.file_kind != "urdf"


def _friction(
    robot: RobotModel, question: Question, rotors: Mapping[str, float], name: str
) -> tuple[FrictionModel, ...]:
    """Return each joint's terms of a named friction model that are unknown in a file.

    Kept parts are left out, and the rotors of joints whose inertia is known (``rotors``).
    """
    excluded: set[str] = set()
    if FILE_FRICTION in question.kept_parts:
        excluded |= {"coulomb", "viscous", "quadratic", "cubic"}
    joints = rotors if _holds_rotors(question) else robot.joint_names
    with_rotor = {("armature", joint) for joint in joints}
    terms = friction_model(name).terms
    return tuple(
        FrictionModel(
            tuple(
                t for t in terms if t not in excluded and (t, joint) not in with_rotor
            )
        )
        for joint in robot.joint_names
    )


def _validate_model(
    fitter: Fitter, question: Question, choice: Choice, point: Point
) -> Validation:
    """Return the held-out error of the model as it is, beside fitted sensor offsets.

    The point has the model's gravity; all its other values make no difference here.
    """
    columns = fitter.columns
    data, _ = fitter.around(point)
    unknowns = build_unknowns(columns, question, choice, data.torque, data.nonzero)
    offsets = [columns.place[f"offset[{joint}]"] for joint in columns.joints]
    indices = np.array(
        [index for index in offsets if data.nonzero[index]], dtype=np.int64
    )
    held = columns.prior.copy()
    if question.carried is not None:
        held[columns.at(PAYLOAD_NAMES)] = question.carried
    offset_unknowns = Unknowns(
        columns.names, indices, held, (), unknowns.lower, unknowns.upper, {}
    )
    judge = HeldOut(data, np.ones(len(columns.joints)))
    return judge.validation(judge.squared_errors(offset_unknowns))


def holds_polynomial(robot: RobotModel, joint: int, file_kind: str) -> bool:
    """Tell whether a file can hold nonlinear damping of a joint whose model has none."""
    damping = getattr(robot.mj_model, "dof_dampingpoly", None)
    return (
        file_kind == "mjcf"
        and damping is not None
        and not np.any(damping[robot.dof_index[joint]])
    )


def _polynomials(
    judge: HeldOut, fit: Fit, question: Question, choice: Choice
) -> tuple[FrictionModel, ...]:
    """Return friction with nonlinear damping at joints whose held-out error it clearly lowers."""
    if FILE_FRICTION in question.kept_parts:
        return choice.friction
    with_polynomial = _friction(
        fit.columns.robot, question, choice.rotors, WITH_POLYNOMIAL
    )
    columns = fit.columns
    errors = squared_errors(judge, columns, question, choice)
    trial = replace(choice, friction=with_polynomial)
    trial_errors = squared_errors(judge, columns, question, trial)
    friction = list(choice.friction)
    for row, joint in enumerate(columns.rows_of):
        is_better = is_clearly_lower(trial_errors[:, row], errors[:, row])
        if is_better and holds_polynomial(columns.robot, joint, question.file_kind):
            friction[joint] = with_polynomial[joint]
    return tuple(friction)
