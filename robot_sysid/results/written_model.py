"""Writing identified links, joints, gravity and a payload into a model.

Each written model is compiled and verified before it counts: the numbers are in it, nothing else
has changed, and it takes the torques that the identification predicts.

The arm's chain has n joints and as many links, base to terminal; theta (10,) are the parameters of
a body: mass, first moments, and the inertia about its frame's origin.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robot_sysid import __version__
from robot_sysid.dynamics.friction import (
    BEND,
    COULOMB,
    POLYNOMIAL,
    TERMS,
    VISCOUS,
    polynomial,
)
from robot_sysid.errors import ExportError, InputError
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.inertial import plan_write_back
from robot_sysid.mjcf.updated_model import (
    BodyChange,
    ElementChange,
    ModelChange,
    changed_model_text,
)
from robot_sysid.model.actuators import AT_TENDON, actuators_on, names_at_actuator
from robot_sysid.model.bodies import body_theta
from robot_sysid.model.chain import body_label
from robot_sysid.model.compilation import mjcf_of
from robot_sysid.model.dry_friction import SPRING_NUMBERS, has_lugre, yields
from robot_sysid.model.units import as_stated
from robot_sysid.parser import load_robot_model
from robot_sysid.records import ArmLink, Array, RobotModel, SubtreeBody
from robot_sysid.records.messages import with_error
from robot_sysid.records.quantities import FILE
from robot_sysid.results import verification
from robot_sysid.results.record import Identification, ModelTarget, Payload


def can_bend() -> bool:
    """Return whether the installed MuJoCo has friction that bends with speed: from 3.7 on."""
    return hasattr(mujoco.MjModel, "dof_dampingpoly")


def write_model(
    result: Identification,
    target: ModelTarget,
    as_body: str | None,
    file_kind: str,
    source: str = FILE,
) -> tuple[str, ...]:
    """Write a model with the identified numbers, and with the payload if there is one.

    Links that are the model's own to the last digit stay as they are.

    Args:
        result: result of the identification; it stays unchanged.
        target: where to write; ``target.path`` is the path of the file.
        as_body: name of a new body for the payload; None merges it into the terminal link.
        file_kind: format of the file, "mjcf" or "urdf".
        source: of the numbers of its joints, ``FILE`` or ``CURVED``.

    Returns:
        Notes for the user, one sentence each.

    Raises:
        ExportError: the model cannot hold the numbers, or the compiled draft does not have them or
            takes other torques; the draft is withdrawn.
    """
    file = result.file
    payload = result.payload
    thetas = result.thetas.copy()
    robot, target = _arm_of_kind(result.robot, file_kind, target)
    elements = []
    for index, name in enumerate(robot.joint_names):
        stated = [float(term.stated_value(robot)[index]) for term in POLYNOMIAL]
        numbers, further = _numbers_of(result, name, source, stated)
        # MuJoCo does not read a URDF's transmissions, in which others find rotors.
        if robot.kind == "urdf" and "armature" in numbers:
            rotor = {"armature": numbers.pop("armature")}
            elements.append(ElementChange("rotor", name, rotor))
        if numbers:
            elements.append(ElementChange("joint", name, numbers, further=further))
    new_bodies: tuple[BodyChange, ...] = ()
    comment = ""
    # Parameters of a payload in a body of its own, which only the torque check adds to the terminal
    # link.
    theta_beside = np.zeros(10)
    if payload is not None:
        theta = payload.flange.from_flange(payload.theta)
        mass = with_error(payload.mass, payload.errors[0], "kg")
        text = f"a payload of {mass}"
        text += "" if np.all(payload.is_determined) else ", inertia not known,"
        if as_body is not None:
            new_bodies = (_payload_body(robot, payload, as_body, text),)
            theta_beside = theta
            comment = "without the payload"
        else:
            thetas[-1] += theta
            comment = f"with {text} in it"
    bodies, written_thetas, notes = _body_changes(
        robot, result.robot.links, thetas, comment
    )
    written_thetas[-1] += theta_beside
    bodies += tuple(_other_changes(robot, result.robot, bodies))
    if robot.kind == "mjcf":
        elements += _tendon_changes(robot, result, source)
    bodies += new_bodies
    gravity = file.gravity if file else robot.gravity
    change = ModelChange(bodies, result.quality.rmse, tuple(elements), gravity)
    _write(robot, change, target, written_thetas)
    if gravity is not None and file_kind == "urdf":
        notes += (_base_note(gravity),)
    return notes


def _base_note(gravity: Array) -> str:
    """Return how a URDF's base is turned where gravity (3,) cannot be.

    The third row of the rotation of roll, pitch and no yaw, (-sin p, cos p sin r, cos p cos r), is
    the direction up in the axes of the base.
    """
    x, y, z = gravity.tolist()
    roll = math.atan2(0.0 - y, 0.0 - z)
    pitch = math.atan2(x, math.hypot(y, z))
    return (
        "MuJoCo alone reads the direction of gravity in a URDF: for other readers add a link, and "
        f'a fixed joint with <origin rpy="{roll:.4f} {pitch:.4f} 0"/> from it to the first link'
    )


def _arm_of_kind(
    robot: RobotModel, file_kind: str, target: ModelTarget
) -> tuple[RobotModel, ModelTarget]:
    """Return (the arm as its file states it, as one of an MJCF where ``file_kind`` asks for it; the
    target of that file).

    MuJoCo writes the MJCF. It has the masses of the file, which are read with the same factor.
    ExportError where it refuses.
    """
    if file_kind == robot.kind:
        return as_stated(robot), target
    try:
        path = mjcf_of(robot.path, target.mesh_dir)
        joint = robot.terminal_joint
        factor = robot.mass_scale if robot.mass_scale != 1.0 else None
        arm = load_robot_model(
            path,
            joint=joint,
            mass_scale=factor,
            gravity=robot.gravity,
            first_joint=robot.joint_names[0],
        )
        return as_stated(arm), replace(target, mesh_dir=None)
    except InputError as error:
        raise ExportError(
            f"{robot.path} cannot be written as an MJCF: {error}"
        ) from None


def write_joints(
    robot: RobotModel, elements: tuple[ElementChange, ...], target: ModelTarget
) -> None:
    """Write an MJCF with new numbers for the joints and servos of a model, found without torques.

    Args:
        robot: the arm, whose links stay as they are, but for the user's factor on all masses.
        elements: rotor inertia and friction of joints, and gains of position actuators.
        target: where to write.

    Raises:
        ExportError: the model cannot hold the numbers, or the compiled draft does not have them or
            takes other torques; the draft is withdrawn.
    """
    of_file, target = _arm_of_kind(robot, "mjcf", target)
    bodies = tuple(_other_changes(of_file, robot, ()))
    # No torque was measured, so there is no residual to state.
    change = ModelChange(bodies, 0.0, elements, robot.gravity)
    _write(of_file, change, target, robot.thetas)


def _numbers_of(
    result: Identification, owner: str, source: str, stated: Sequence[float]
) -> tuple[dict[str, float], tuple[float, float] | None]:
    """Return the written numbers of a joint or motor by their names in MJCF, and further damping.

    A bend of friction is a part of all three numbers of damping (``friction.polynomial``).

    Args:
        result: of the identification.
        owner: the joint or motor.
        source: of the rows, ``FILE`` or ``CURVED``.
        stated: the model's damping per speed squared and cubed, which stays beside a bend unless
            rows say otherwise.
    """
    rows = result.quantities
    own = {
        row.name: row.value for row in rows if (row.of, row.source) == (owner, source)
    }
    numbers = {
        TERMS[name].attribute: value
        for name, value in sorted(own.items())
        if TERMS[name].attribute and TERMS[name] not in POLYNOMIAL
    }
    kept = [own.get(term.name, of_file) for term, of_file in zip(POLYNOMIAL, stated)]
    if BEND.name not in own and kept == list(stated):
        return numbers, None
    bend = own.get(BEND.name, 0.0)
    linear, *further = polynomial(own[VISCOUS.name], bend, result.tops[owner])
    numbers[VISCOUS.attribute] = linear
    quadratic, cubic = np.add(kept, further).tolist()
    return numbers, (quadratic, cubic)


def _tendon_changes(
    robot: RobotModel, result: Identification, source: str
) -> Iterator[ElementChange]:
    """Yield the motors that turn several joints as fixed tendons of the model, or new ones."""
    for motor in result.file.motors if result.file else ():
        ratios = zip(robot.joint_names, motor.ratios.tolist())
        coefficients = {joint: ratio for joint, ratio in ratios if ratio != 0.0}
        stated = [motor.stated_value(term, robot.mj_model) for term in POLYNOMIAL]
        numbers, further = _numbers_of(result, motor.name, source, stated)
        yield ElementChange("tendon", motor.tendon, numbers, coefficients, further)


def _body_changes(
    robot: RobotModel, links: Sequence[ArmLink], thetas: Array, terminal_comment: str
) -> tuple[tuple[BodyChange, ...], Array, tuple[str, ...]]:
    """Return the changes of the bodies of all links that differ from those of the estimate's start.

    A link may consist of several bodies; the change goes to one of them, and others may be emptied
    for it (``plan_write_back``).

    Args:
        robot: the arm as its file states it.
        links: base to terminal, as the estimate began with them.
        thetas: (n, 10) parameters that the links are to have.
        terminal_comment: comment on the terminal link, or "".

    Returns:
        (changes, parameters (n, 10) of the links that they lead to, notes for the user).

    Raises:
        ExportError: a joint moves no body of its own.
    """
    # Smallest principal moment that the model's compiler leaves alone [kg m^2].
    bound = float(read_document(robot.path).compiler_setting("boundinertia") or 0.0)
    body_ids = _body_ids(robot)
    written_thetas = thetas.copy()
    started = np.array([link.theta for link in links])
    indices = np.flatnonzero(np.any(thetas != started, axis=1)).tolist()
    changes = []
    notes: list[str] = []
    for k in indices:
        link = links[k]
        if not link.bodies:
            raise ExportError(
                f"joint {robot.joint_names[k]} moves no link of its own, because a later joint "
                f"moves body '{link.body_name}' too; its parameters belong to that joint's link"
            )
        plan = plan_write_back(thetas[k], link.bodies, bound)
        # With the moments of inertia as they were inflated to be possible.
        written_thetas[k] = plan.composite
        notes += plan.notes
        comment = terminal_comment if k == len(links) - 1 else ""
        addition = "; ".join(filter(None, (comment, *plan.notes)))
        body_id = body_ids[link.body_name]
        changes.append(BodyChange(link.body_name, body_id, plan.theta, addition))
        for body in plan.emptied:
            addition = f"its inertia is in that of body '{link.body_name}'"
            changes.append(
                BodyChange(body.name, body_ids[body.name], np.zeros(10), addition)
            )
    return tuple(changes), written_thetas, tuple(notes)


def _body_ids(robot: RobotModel) -> dict[str, int]:
    """Return the name of each body of an arm's model, "#7" for a nameless one, to its MuJoCo id."""
    model = robot.mj_model
    return {body_label(model, body): body for body in range(model.nbody)}


def _other_changes(
    robot: RobotModel, started: RobotModel, changed: Sequence[BodyChange]
) -> Iterator[BodyChange]:
    """Yield changes of bodies that were not identified and yet are not those of the file.

    They are of the user's factor, such as fingers, or of the links' geometry.

    Args:
        robot: the arm as its file states it.
        started: the arm as the estimate began with it.
        changed: changes of the bodies that were identified.
    """
    if started.stated is None:
        return
    body_ids = _body_ids(robot)
    labels = {change.label for change in changed}
    of_file = as_stated(started).mj_model
    for body in range(1, started.mj_model.nbody):
        label = body_label(started.mj_model, body)
        theta = body_theta(started.mj_model, body)
        is_other = np.any(theta != body_theta(of_file, body))
        if is_other and label not in labels:
            yield BodyChange(label, body_ids[label], theta)


def _payload_body(
    robot: RobotModel, payload: Payload, name: str, text: str
) -> BodyChange:
    """Return a new body for a payload, in the flange frame, fixed to the terminal body.

    Args:
        robot: the arm.
        payload: its parameters are in the flange frame.
        name: name of the new body.
        text: describes the payload in a comment of the file.
    """
    flange = payload.flange
    empty_body = SubtreeBody(body_id=0, name=name, theta=np.zeros(10), welded=True)
    theta = plan_write_back(payload.theta, [empty_body]).theta
    comment = f"{text} at {flange.name}"
    return BodyChange(name, robot.body_id, theta, comment, flange)


def _write(
    robot: RobotModel, change: ModelChange, target: ModelTarget, thetas: Array
) -> None:
    """Write the text of a changed model as a draft file, and verify the draft.

    The draft is compiled, compared with the original model, a new body or tendon left out, and its
    torques are compared with those of the links' parameters. Inertias are written as principal
    moments before MuJoCo 3.14, which finds the axes of full matrices to six digits.

    Args:
        robot: the arm with the original model.
        change: the difference that is written.
        target: where to write.
        thetas: (n, 10) inertial parameters of the links that the compiled draft must have, judged
            by its torques at ``target.checkpoints``.

    Raises:
        ExportError: the draft does not load, differs in more than ``change``, or takes other
            torques. The draft is withdrawn on this and on any other exception.
    """
    release = tuple(map(int, mujoco.__version__.split(".")[:2]))
    stated = tuple(_without_springs(robot, each) for each in change.elements)
    elements = (*stated, *_emptied_actuators(robot, change))
    change = replace(change, principal=release < (3, 14), elements=elements)
    old_bodies = tuple(body for body in change.bodies if body.flange is None)
    old = tuple(element for element in elements if element.owner is not None)
    without_new = replace(change, bodies=old_bodies, elements=old)
    path = target.path
    try:
        written_model = _compiled_draft(robot.path, without_new, target)
        verification.require_change(robot.mj_model, written_model, without_new)
        if len(old_bodies) < len(change.bodies) or len(old) < len(elements):
            written_model = _compiled_draft(robot.path, change, target)
        verification.require_reproduction(
            robot, thetas, change, written_model, target.checkpoints, path
        )
    except BaseException:
        target.files.withdraw(path)
        raise


def _compiled_draft(source: Path, change: ModelChange, target: ModelTarget) -> Any:
    """Write a changed model file as the target's draft, and return its ``MjModel``."""
    folder = target.path.absolute().parent
    text = changed_model_text(source, change, folder, target.mesh_dir)
    return verification.compiled_file(target.files.write(target.path, text))


def _emptied_actuators(
    robot: RobotModel, change: ModelChange
) -> Iterator[ElementChange]:
    """Yield changes that take rotors and friction from actuators whose joint or tendon gets them.

    Since MuJoCo 3.7 a file may state rotors and damping at either, since MuJoCo 4 dry friction; an
    identification knows their sum.
    """
    model = robot.mj_model
    for element in change.elements:
        actuators = []
        if element.kind == "joint":
            dof = robot.dof_index[robot.joint_names.index(element.owner)]
            actuators = actuators_on(model, model.dof_jntid[dof])
        elif element.kind == "tendon" and element.owner is not None:
            actuators = actuators_on(model, element.owner, AT_TENDON)
        for actuator in actuators:
            stated = names_at_actuator(model, actuator)
            stated |= {COULOMB.attribute} if has_lugre(model)[actuator] else set()
            emptied = stated & {*element.numbers}
            if emptied:
                numbers = dict.fromkeys(sorted(emptied), 0.0)
                yield ElementChange("actuator", actuator, numbers)


def _without_springs(robot: RobotModel, element: ElementChange) -> ElementChange:
    """Return a change of a joint or tendon that takes its spring, too, if that is dry friction."""
    model = robot.mj_model
    if COULOMB.attribute not in element.numbers or element.owner is None:
        return element
    if element.kind == "joint":
        dof = robot.dof_index[robot.joint_names.index(element.owner)]
        is_friction = yields(model, "jnt", int(model.dof_jntid[dof]))
    else:
        is_friction = element.kind == "tendon" and yields(
            model, "tendon", element.owner
        )
    if not is_friction:
        return element
    nothing = dict.fromkeys(SPRING_NUMBERS, 0.0)
    return replace(element, numbers={**element.numbers, **nothing})


def versions() -> dict[str, str]:
    """Return the versions of this package, MuJoCo, numpy and Python, on which results depend."""
    return {
        "robot_sysid": __version__,
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def spec_of(model: Path) -> Any:
    """Return the ``mujoco.MjSpec`` of a model file, which reads its meshes when it is compiled.

    Raises ExportError where MuJoCo is older than 3.2.
    """
    if not hasattr(mujoco, "MjSpec"):
        raise ExportError(
            f"a spec needs MuJoCo 3.2 or later, not {mujoco.__version__}; use save()"
        )
    return mujoco.MjSpec.from_file(str(model))
