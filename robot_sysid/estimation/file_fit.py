"""What a model file is given: bodies, friction, rotors and gravity, fitted as a file holds them.

What a file cannot hold (torque scales, encoder zeros, a delay, friction that grows with the load)
is left out of the model of the torque, but for sensor offsets that the recordings show. A part is
written where the held-out error of all that is written together says so.
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
from robot_sysid.model.tendons import CAN_HOLD_ROTORS
from robot_sysid.records import Array, RobotModel, Validation

# Rounds of a fit that starts at one with the same rows.
_ROUNDS = 2


@dataclass(frozen=True)
class FileFit:
    """The best file for some recordings.

    Attributes:
        fit: its parameters.
        before, after: held-out error of the model as it was and of the file, each joint's sensor
            offset taken out.
        errors: how far off its parameters may be.
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
    kept: tuple[str, ...],
    made: Fit,
    pull: Array | None = None,
    carried: Array | None = None,
) -> FileFit:
    """Return the file that predicts held-out torques best.

    Motors that turn several joints are fixed tendons, which only an MJCF has.

    Args:
        options: how far the arm's links may be off.
        kept: parts that stay as they are.
        made: the estimate, to begin with; rotors are its own.
        pull: see ``errors.fit_errors``.
        carried: the payload (10,) of loaded recordings.
    """
    robot = fitter.columns.robot
    stays = options.torques != "chain" or {FILE_FRICTION, FILE_ROTORS} <= {*kept}
    motors = () if stays or not CAN_HOLD_ROTORS else made.choice.couplings
    question = Question(
        options, in_file=True, file_kind=robot.kind, kept_parts=kept, carried=carried
    )
    if not motors or robot.kind == "mjcf":
        return _fit_kind(fitter, question, motors, made, pull)
    best = _fit_kind(fitter, replace(question, file_kind="mjcf"), motors, made, pull)
    return replace(best, beside=_fit_kind(fitter, question, (), made, pull))


def _fit_kind(
    fitter: Fitter, question: Question, motors: tuple[Coupling, ...], made: Fit, pull: Array | None
) -> FileFit:
    """Return the best file of one kind, with some motors that turn several joints in it."""
    robot, kept = fitter.columns.robot, question.kept_parts
    rotors = select_rotors(made) if _holds_rotors(question) else {}
    friction = _friction(robot, question, rotors, IN_FILE)
    choice = Choice(friction, motors, rotors=rotors)
    # What a file cannot hold is the model's again.
    known, beyond = made.values.copy(), ("scale", "drift", "zero", "load")
    for name, place in fitter.columns.place.items():
        if name.partition("[")[0] in beyond or "[" not in name:
            known[place] = fitter.columns.prior[place]
    point = replace(fitter.columns.start(), values=known, in_file=True)
    before = _as_it_was(fitter, question, choice, point)
    fit = fitter.fit(question, choice, point, rounds=1)
    judge = held_out(fit)
    choice = replace(choice, friction=_polynomials(judge, fit, question, choice))
    scales = predictive_link_scales(judge, fit, question, choice)
    choice = replace(choice, link_scales=scales)
    choice = select_offsets(fit, question, choice)
    asked, after, rounds = question, fit.next_point, _ROUNDS
    if FILE_GRAVITY not in kept and fit.unknowns.settle:
        level = replace(question, kept_parts=(*kept, FILE_GRAVITY))
        turned, straight = (score_of(judge, fit, each, choice) for each in (question, level))
        if not is_clearly_lower(turned, straight):
            asked, after, rounds = level, point, 1
    del judge, fit  # what it squares takes as much memory as the rows
    fit = replace(fitter.fit(asked, choice, after, rounds), question=question)
    judge = held_out(fit, fit.unknowns)
    found = judge.validation(judge.of(fit))
    del judge
    return FileFit(fit, before, found, fit_errors(fit, (), pull))


def _holds_rotors(question: Question) -> bool:
    """Tell whether a file gets rotors; the last joint's torque alone cannot tell its own."""
    kept = FILE_ROTORS in question.kept_parts or question.options.torques == "terminal"
    return not kept and question.file_kind != "urdf"


def _friction(
    robot: RobotModel, question: Question, rotors: Mapping[str, float], name: str
) -> tuple[FrictionModel, ...]:
    """Return each joint's terms that a file can hold and that are sought, rotors of some joints
    being known, beside a sensor's offset.
    """
    gone: set[str] = set()
    if FILE_FRICTION in question.kept_parts:
        gone |= {"coulomb", "viscous", "quadratic", "cubic"}
    joints = rotors if _holds_rotors(question) else robot.joint_names
    known = {("armature", joint) for joint in joints}
    given = friction_model(name).terms
    return tuple(
        FrictionModel(tuple(t for t in given if t not in gone and (t, joint) not in known))
        for joint in robot.joint_names
    )


def _as_it_was(fitter: Fitter, question: Question, choice: Choice, point: Point) -> Validation:
    """Return the held-out error of the model as it is, with sensor offsets of its own.

    The point of the rows has the model's gravity; nothing else of it counts.
    """
    columns = fitter.columns
    data, _ = fitter.around(point)
    sought = build_unknowns(columns, question, choice, data.torque, data.nonzero)
    offsets = [columns.place[f"offset[{joint}]"] for joint in columns.joints]
    kept = np.array([place for place in offsets if data.nonzero[place]], dtype=np.int64)
    held = columns.prior.copy()
    if question.carried is not None:
        held[columns.at(PAYLOAD_NAMES)] = question.carried
    only = Unknowns(columns.names, kept, held, (), sought.lower, sought.upper, {})
    judge = HeldOut(data, np.ones(len(columns.joints)))
    return judge.validation(judge.squared_errors(only))


def holds_polynomial(robot: RobotModel, joint: int, file_kind: str) -> bool:
    """Tell whether a file can hold nonlinear damping of a joint whose model has none."""
    own = getattr(robot.mj_model, "dof_dampingpoly", None)
    return file_kind == "mjcf" and own is not None and not np.any(own[robot.dof_index[joint]])


def _polynomials(
    judge: HeldOut, fit: Fit, question: Question, choice: Choice
) -> tuple[FrictionModel, ...]:
    """Give nonlinear damping to the joints whose held-out torques it predicts clearly better."""
    robot, found = fit.columns.robot, list(choice.friction)
    if FILE_FRICTION in question.kept_parts:
        return choice.friction
    wider = _friction(robot, question, choice.rotors, WITH_POLYNOMIAL)
    tried = choice, replace(choice, friction=wider)
    squared = [squared_errors(judge, fit.columns, question, each) for each in tried]
    for place, joint in enumerate(fit.columns.rows_of):
        better = is_clearly_lower(squared[1][:, place], squared[0][:, place])
        if better and holds_polynomial(robot, joint, question.file_kind):
            found[joint] = wider[joint]
    return tuple(found)
