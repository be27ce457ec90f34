"""Writing what was identified into a model: a payload, or all links of the arm.

Each model is compiled again and compared before it counts: the written numbers are there, nothing
else has changed, and it moves as the identification predicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robot_sysid.errors import ExportError
from robot_sysid.mjcf.changes import (
    ActuatorChange,
    BodyChange,
    JointChange,
    ModelChange,
    WeldedBody,
)
from robot_sysid.mjcf.compiler_settings import bound_inertia
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.updated_model import changed_model_text
from robot_sysid.mjcf.write_back import EXACT, Tolerance, plan_write_back
from robot_sysid.model.chain import body_label
from robot_sysid.model.compilation import CompiledModel
from robot_sysid.model.flange import place_in_carrier
from robot_sysid.model.inertia import subtree_bodies
from robot_sysid.model.links import link_bodies
from robot_sysid.output.verification import (
    compiled_again,
    reads_fullinertia_exactly,
    require_links_reproduction,
    require_reproduction,
    verify_written_model,
)
from robot_sysid.output.welded_check import require_one_more_body
from robot_sysid.records import Array, Flange, InertialParameters, Motion, RobotModel, SubtreeBody
from robot_sysid.records.atomic_files import WholeFiles

_MOMENTS = [4, 7, 9]


@dataclass(frozen=True)
class ModelTarget:
    """Where a model is written to, and what it is checked with.

    Attributes:
        files: takes the drafts.
        path: the file to write.
        checkpoints: motion on which the model must reproduce the predicted torque.
        rmse: of the identification [N m], for the comments.
        mesh_dir: the user's mesh folder, if any.
    """

    files: WholeFiles
    path: Path
    checkpoints: Motion
    rmse: float
    mesh_dir: Path | None = None


def write_link(
    robot: RobotModel,
    link: InertialParameters,
    target: ModelTarget,
    errors: Array | None = None,
    joints: Sequence[JointChange] = (),
) -> tuple[str, ...]:
    """Write a model with a new composite terminal link; arguments as in ``write_payload``.

    Args:
        joints: new friction of chain joints; where the file cannot hold it, a note says so.
    """
    words = f"friction of {', '.join(change.label for change in joints)}" if joints else None
    change = _terminal_change(robot, link.theta, moment_tolerance(robot, errors), words)
    try:
        return _write(robot, ModelChange((change,), target.rmse, tuple(joints)), target, link.theta)
    except ExportError as error:
        if not joints:
            raise
        notes = write_link(robot, link, target, errors)
        return (*notes, f"the written model keeps its own friction: {error}")


def write_payload(
    robot: RobotModel,
    payload: InertialParameters,
    flange: Flange,
    target: ModelTarget,
    link: InertialParameters | None = None,
    as_body: str | None = None,
    errors: Array | None = None,
) -> tuple[str, ...]:
    """Write a model with a payload: merged into the terminal link, or as a welded body of its own.

    Args:
        robot: the arm as loaded.
        payload: in the flange frame.
        flange: that frame.
        target: where to.
        link: the composite terminal link WITHOUT the payload, in the terminal body's frame; None
            keeps the model's own.
        as_body: name of the new body; None merges the payload into the terminal link.
        errors: (10,) standard errors of what goes into the terminal link, which say how far its
            moments of inertia may be inflated where the file cannot hold them.

    Returns:
        Notes, one sentence each.

    Raises:
        ExportError: the model cannot hold it; the draft is withdrawn.
    """
    own = robot.prior.theta if link is None else link.theta
    added = flange.from_flange(payload.theta)
    tolerance = moment_tolerance(robot, errors)
    words = f"a payload of {payload.mass:.4g} kg"
    if as_body is None:
        change = _terminal_change(robot, own + added, tolerance, f"with {words} in it")
        return _write(robot, ModelChange((change,), target.rmse), target, own + added)
    rotation, translation = place_in_carrier(robot, flange)
    carrier = body_label(robot.mj_model, flange.carrier)
    nothing = SubtreeBody(0, as_body, np.zeros(10), True)
    theta = plan_write_back(payload.theta, [nothing]).theta
    body = WeldedBody(as_body, carrier, rotation, translation, theta, f"{words} at {flange.name}")
    kept = () if link is None else (_terminal_change(robot, own, tolerance, "without the payload"),)
    return _write(robot, ModelChange(kept, target.rmse, (), body), target, own + added)


def write_links(
    robot: RobotModel,
    thetas: Array,
    target: ModelTarget,
    joints: Sequence[JointChange] = (),
    errors: Array | None = None,
) -> tuple[str, ...]:
    """Write a model with new inertia for every link of the arm, and new numbers for its joints.

    Args:
        robot: the arm as loaded.
        thetas: (n, 10) links as in ``robot.links``: the body of each chain joint with all that
            hangs on it apart from what a later chain joint moves, in that body's frame. Rows of
            links without mass are zero.
        target: where to.
        joints: new armature, damping and friction of chain joints.
        errors: (n, 10) standard errors of ``thetas``, see ``write_payload``.

    Returns:
        Notes, one sentence each.

    Raises:
        ExportError: the model cannot hold it; the draft is withdrawn.
    """
    joints, notes = _that_fit(robot, joints)
    bodies = [link.body_id for link in robot.links]
    changes, held = [], np.array(thetas, dtype=float)
    for k, link in enumerate(robot.links):
        parts = link_bodies(robot.mj_model, robot.reference_qpos, link.body_id, bodies[k + 1 :])
        if not link.has_mass and not np.any(thetas[k]):
            continue
        if not parts:
            raise ExportError(
                f"joint {robot.joint_names[k]} moves no link of its own, because a later joint "
                f"moves body '{link.body_name}' too; its parameters belong to that joint's link"
            )
        tolerance = moment_tolerance(robot, None if errors is None else errors[k])
        plan = plan_write_back(thetas[k], parts, tolerance)
        held[k] = plan.written(thetas[k])
        words = _joint_words(robot, link.body_id, joints)
        changes.append(BodyChange(link.body_name, link.body_id, plan, words))
    change = ModelChange(tuple(changes), target.rmse, joints)
    return notes + _write(robot, change, target, held)


def write_joints(
    robot: RobotModel,
    joints: Sequence[JointChange],
    actuators: Sequence[ActuatorChange],
    target: ModelTarget,
) -> tuple[str, ...]:
    """Write a model with new numbers for its joints and servos; errors as in ``write_links``."""
    fitting, notes = _that_fit(robot, joints)
    change = ModelChange((), target.rmse, fitting, None, tuple(actuators))
    thetas = np.array([link.theta for link in robot.links])
    return notes + _write(robot, change, target, thetas)


def moment_tolerance(robot: RobotModel, errors: Array | None) -> Tolerance:
    """Return how far moments of inertia may be inflated: within their standard errors (10,)."""
    if errors is None:
        return EXACT
    finite = [float(error) for error in np.asarray(errors)[_MOMENTS] if np.isfinite(error)]
    return Tolerance(bound_inertia(read_document(robot.path)), min(finite, default=0.0))


def _terminal_change(
    robot: RobotModel, composite: Array, tolerance: Tolerance, words: str | None = None
) -> BodyChange:
    bodies = subtree_bodies(robot.mj_model, robot.reference_qpos, robot.body_id)
    plan = plan_write_back(composite, bodies, tolerance)
    return BodyChange(robot.body_name, robot.body_id, plan, words)


def _that_fit(
    robot: RobotModel, joints: Sequence[JointChange]
) -> tuple[tuple[JointChange, ...], tuple[str, ...]]:
    """Return the changes that the kind of file can hold, and a note on what it cannot."""
    if robot.kind != "urdf" or all(change.armature is None for change in joints):
        return tuple(joints), ()
    left = ", ".join(
        f"{change.armature:.3g} at {change.label}" for change in joints if change.armature
    )
    note = f"a URDF cannot hold rotor inertia, so the written model lacks it ({left} kg m^2)"
    return tuple(replace(change, armature=None) for change in joints), (note,)


def _joint_words(robot: RobotModel, body: int, joints: Sequence[JointChange]) -> str | None:
    """Return what is written into the joints of a body, for its comment."""
    own = [n for n, link in zip(robot.joint_names, robot.links) if link.body_id == body]
    written = [(change.label, change.words or ", ".join(change.numbers)) for change in joints]
    words = [f"{what} of joint '{name}'" for name, what in written if name in own and what]
    return "; ".join(words) or None


def _write(
    robot: RobotModel, change: ModelChange, target: ModelTarget, composite: Array
) -> tuple[str, ...]:
    """Write the draft, compile it and compare; withdraw it where it fails."""
    try:
        compiled = _verified(robot, change, target)
        _require_motion(robot, change, target, composite, compiled)
    except BaseException:
        target.files.withdraw(target.path)
        raise
    return tuple(body.plan.note for body in change.bodies if body.plan.note)


def _require_motion(
    robot: RobotModel,
    change: ModelChange,
    target: ModelTarget,
    expected: Array,
    compiled: CompiledModel,
) -> None:
    """Compare torques: of all links (n, 10), or of the composite terminal link (10,)."""
    model, path = compiled.mj_model, target.path
    if expected.ndim == 2:
        require_links_reproduction(robot, expected, model, target.checkpoints, path)
        return
    for body in change.bodies:
        expected = body.plan.written(expected)
    require_reproduction(robot, expected, model, target.checkpoints, path)


def _verified(robot: RobotModel, change: ModelChange, target: ModelTarget) -> CompiledModel:
    """Return the written model, compiled, once it is the original with the change alone."""
    thetas = [body.plan.theta for body in change.bodies]
    thetas += [change.welded.theta] if change.welded is not None else []
    principal = not all(reads_fullinertia_exactly(theta) for theta in thetas)
    folder = target.path.absolute().parent

    def draft(what: ModelChange) -> Path:
        text = changed_model_text(robot.path, what, folder, target.mesh_dir, principal)
        target.files.withdraw(target.path)
        return target.files.write(target.path, text)

    bodies = {body.body_id: body.plan for body in change.bodies}
    without = draft(replace(change, welded=None))
    new = change.joints, change.actuators
    compiled = verify_written_model(robot.mj_model, without, bodies, *new)
    if change.welded is None:
        return compiled
    written = compiled_again(draft(change))
    require_one_more_body(compiled.mj_model, written.mj_model, change.welded)
    return written
