"""Verification of a written model: it differs from the original in the identified numbers alone.

Both files are compiled and every field of the compiled models is compared, but for those listed
here, each with its reason. The written model must then take the torques that the identification
predicts. A new body or tendon makes other fields of a model: such a file is compared without them,
and with them by its torques.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    BeyondRigidBodies,
    LinkDynamics,
)
from robot_sysid.errors import ExportError, InputError
from robot_sysid.mjcf.updated_model import ElementChange, ModelChange
from robot_sysid.model.bodies import body_theta, inertia_about_com
from robot_sysid.model.chain import body_label, joint_label
from robot_sysid.model.compilation import compile_model
from robot_sysid.model.dry_friction import COULOMB_OF_MOTOR, SPRING_NUMBERS
from robot_sysid.records import Array, InertialParameters, Motion, RobotModel

CHECKPOINTS = 400
"""Number of samples of the motion at which the torques of a written model are compared with the
predicted ones."""
TOLERANCE = 1e-9
"""Largest relative deviation of a compiled number from the written one, and of a torque relative to
its joint's largest: MuJoCo's transformation to principal axes and back leaves up to 1e-10."""

# Inertial fields of a body, and whether its frame and its inertial frame coincide: compared row by
# row, because only the changed bodies may differ.
BODY_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_sameframe")
# Fields of a body that rounding of its inertia may change: principal moments and axes.
_AXES_FIELDS = ("body_inertia", "body_iquat", "body_sameframe")
# What MuJoCo computes from masses and inertias when it compiles.
DERIVED = {
    "body_subtreemass",
    "body_invweight0",
    "dof_M0",
    "dof_invweight0",
    "dof_length",
    "tendon_invweight0",
    "actuator_acc0",
    # Sizes of the memory of actuators and sensors, which follow from compared fields.
    "nhistory",
    "actuator_historyadr",
    "sensor_historyadr",
    # Found by simulating the actuator's movement, so masses enter.
    "actuator_lengthrange",
    # Joints and tendons have the rotors and damping of their actuators.
    "actuator_armature",
    "actuator_damping",
    "actuator_dampingpoly",
    "jnt_actuatorid",
    "tendon_actuatorid",
    # Places and numbers of states, which motors with bristles and springs that yield have; what has
    # them is compared itself, and those of keyframes stay as their text.
    "nplastic",
    "jnt_plasticadr",
    "tendon_plasticadr",
    "na",
    "actuator_actadr",
    "key_act",
    "key_plastic",
    # Whether a body's inertia is diagonal in its joint's axes, or a geom or site coincides with its
    # body's inertial frame: shortcuts for the engine.
    "body_simple",
    "dof_simplenum",
    "geom_sameframe",
    "site_sameframe",
    # Camera and light positions relative to the subtree's centre of mass.
    "cam_poscom0",
    "light_poscom0",
    # Collision bounding boxes are kept in the inertial frame of their body.
    "bvh_aabb",
    "bvh_child",
    "bvh_depth",
    "bvh_nodeid",
    # Scene size and mean mass, for drawing and for scaling contacts.
    "stat.center",
    "stat.extent",
    "stat.meaninertia",
    "stat.meanmass",
    "stat.meansize",
}
# Paths of asset files, and the sizes that follow from the length of these names. The signature is a
# hash of sizes and types, which are compared themselves; MuJoCo loses it when it pickles.
PATHS = {
    "paths",
    "npaths",
    "nbuffer",
    "mesh_pathadr",
    "skin_pathadr",
    "hfield_pathadr",
    "tex_pathadr",
    "signature",
}
_GAIN_ADVICE = "give the actuator kp and kv of its own"
# Field that MuJoCo may compute otherwise to what to do.
_ADVICE = {
    "dof_damping": "a joint's springdamper computes it from the inertia: give that joint "
    "stiffness and damping instead to get a model",
    "dof_dampingpoly": "state nonlinear damping at the joint itself",
    "actuator_gainprm": _GAIN_ADVICE,
    "actuator_biasprm": _GAIN_ADVICE,
}
# What to do about any other field, and about the inertia of a body.
_SETTINGS_ADVICE = (
    "of the compiler settings, settotalmass, boundmass, boundinertia and fusestatic change "
    "inertias: remove them"
)
FIRMNESS = "solimpfriction"
"""Attribute of a joint that says how firmly dry friction holds it."""
_NUMERIC_TYPES = (int, float, bytes, np.ndarray)


def changed_copy(original: Any, change: ModelChange) -> Any:
    """Return a compiled model with the changed numbers of joints, actuators, tendons and gravity.

    A position actuator (servo) of stiffness k and damping d makes the force k u - k q - d qd of
    command u: MuJoCo keeps it as the gain (k) and the bias (0, -k, -d).

    Args:
        original: compiled model, which stays as it is.
        change: the difference that is wanted; bodies and new tendons are left out.
    """
    expected = copy.copy(original)
    labels = [joint_label(original, joint) for joint in range(original.njnt)]
    for element in change.elements:
        row = element.owner
        owner = element.kind
        if "kp" in element.numbers:
            kp = element.numbers["kp"]
            # A PID controller keeps its gain in the bias alone.
            if original.actuator_gainprm[row, 0] != 0.0:
                expected.actuator_gainprm[row, 0] = kp
            bias = (0.0, -kp, -element.numbers.get("kv", 0.0))
            expected.actuator_biasprm[row, :3] = bias
        if "forcerange" in element.numbers:
            largest = element.numbers["forcerange"]
            expected.actuator_forcelimited[row] = 1
            expected.actuator_forcerange[row] = (-largest, largest)
        if owner == "actuator" and "frictionloss" in element.numbers:
            friction = slice(COULOMB_OF_MOTOR, COULOMB_OF_MOTOR + 3)
            expected.actuator_biasprm[row, friction] = 0.0
        if owner == "joint":
            joint = labels.index(element.owner)
            if "actuatorfrcrange" in element.numbers:
                largest = element.numbers["actuatorfrcrange"]
                expected.jnt_actfrcrange[joint] = (-largest, largest)
            if "springyield" in element.numbers:
                # It has no stiffness already, see ``model.dry_friction``.
                expected.jnt_springyield[joint] = 0.0
            owner = "dof"
            row = original.jnt_dofadr[joint]
            if FIRMNESS in element.numbers:
                expected.dof_solimp[row, :2] = element.numbers[FIRMNESS]
        if owner in ("dof", "tendon") and row is not None:
            for name in _moving_numbers(element):
                getattr(expected, f"{owner}_{name}")[row] = element.numbers[name]
            if element.further is not None:
                getattr(expected, f"{owner}_dampingpoly")[row] = element.further
    if change.gravity is not None:
        expected.opt.gravity = change.gravity
    return expected


def _moving_numbers(element: ElementChange) -> list[str]:
    """Return which numbers of a joint or tendon MuJoCo keeps with those of its motion."""
    is_joint = element.kind == "joint"
    elsewhere = (*SPRING_NUMBERS, FIRMNESS, "actuatorfrcrange")
    return [n for n in element.numbers if not (is_joint and n in elsewhere)]


def compiled_file(written: Path) -> Any:
    """Return the ``MjModel`` of a written file; ExportError where it does not load."""
    try:
        return compile_model(written).mj_model
    except InputError as error:
        raise ExportError(f"the written model cannot be loaded: {error}") from None


def require_change(original: Any, changed: Any, change: ModelChange) -> None:
    """Raise ExportError unless a compiled model is the original one with a change made.

    Args:
        original: compiled model.
        changed: compiled model.
        change: the difference that is wanted, without new bodies and tendons.
    """
    expected = changed_copy(original, change)
    # Damping from a dampratio is computed from the inertia that the actuator moves.
    is_computed = np.ones(len(original.actuator_biasprm), dtype=bool)
    for element in change.elements:
        if "kp" in element.numbers:
            is_computed[element.owner] = False
    damping = changed.actuator_biasprm[: len(is_computed), 2]
    expected.actuator_biasprm[is_computed, 2] = damping[is_computed]
    require_same_model(expected, changed, {body.body_id for body in change.bodies})
    for body in change.bodies:
        has_mass = np.any(body.theta)
        scale_theta = body.theta if has_mass else body_theta(original, body.body_id)
        require_theta(changed, body.body_id, body.theta, scale_theta)


def require_same_model(
    original: Any, other: Any, changed_bodies: Collection[int] = ()
) -> None:
    """Raise ExportError if two compiled models differ in a field by more than rounding.

    The message names the first such field. Fields of ``DERIVED`` and ``PATHS`` may differ.

    Args:
        original, other: compiled models.
        changed_bodies: ids of bodies whose inertia may differ.
    """
    other_fields = dict(compiled_fields(other))
    equal_bodies = set(_bodies_of_equal_inertia(original, other))
    for name, value in compiled_fields(original):
        if name in DERIVED | PATHS:
            continue
        rows = set(changed_bodies) if name in BODY_FIELDS else set()
        if name in _AXES_FIELDS:
            rows |= equal_bodies
        if not _is_same(value, other_fields.get(name), rows):
            raise ExportError(
                f"the written model has another {name} than it should have; "
                f"{_ADVICE.get(name, _SETTINGS_ADVICE)}"
            )


def _bodies_of_equal_inertia(original: Any, other: Any) -> Iterator[int]:
    """Yield the ids of bodies whose inertia is the same in two compiled models but for rounding.

    Rounding turns principal axes, of equal moments by any angle.
    """
    for body in range(min(original.nbody, other.nbody)):
        inertia = inertia_about_com(original, body)
        difference = inertia_about_com(other, body) - inertia
        if np.max(np.abs(difference)) <= TOLERANCE * np.max(np.abs(inertia)):
            yield body


def require_theta(
    mj_model: Any, body_id: int, theta: Array, scale_theta: Array
) -> None:
    """Raise ExportError unless a compiled body has the parameters theta (10,).

    Args:
        mj_model: compiled model.
        body_id: id of the body in it.
        theta: (10,) wanted inertial parameters; all zero for a body that has been emptied.
        scale_theta: (10,) inertial parameters of a body, from whose mass and size follow the scales
            that deviations are relative to; SI units for a frame without mass.
    """
    scale = np.ones(len(theta))
    if scale_theta[0] > 0.0:
        scale = InertialParameters(scale_theta).scale
    actual = body_theta(mj_model, body_id)
    deviation = np.max(np.abs(actual - theta) / scale)
    if deviation <= TOLERANCE and theta[0] > 0.0:
        # The inertia about the centre of mass is small beside that about a distant origin.
        inertia = InertialParameters(theta).inertia_com
        other = InertialParameters(actual).inertia_com
        difference = np.max(np.abs(other - inertia))
        deviation = difference / np.max(np.abs(inertia))
    if not deviation <= TOLERANCE:
        raise ExportError(
            f"in the written model, body '{body_label(mj_model, body_id)}' has an inertia that is "
            f"off by {deviation:.1e} relative (allowed {TOLERANCE:.0e}); {_SETTINGS_ADVICE}"
        )


def compiled_fields(mj_model: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield name and value of every number and array of a compiled model, options included."""
    for name in dir(mj_model):
        if name.startswith("_"):
            continue
        value = getattr(mj_model, name)
        if isinstance(value, _NUMERIC_TYPES):
            yield prefix + name, value
        elif name in ("opt", "stat", "vis") or prefix == "vis.":
            yield from compiled_fields(value, f"{prefix}{name}.")


def _is_same(original: Any, other: Any, changed_rows: Collection[int]) -> bool:
    """Return whether a field of two compiled models is the same, but for rows that may differ.

    Args:
        original: number or array in the original model.
        other: number or array in the other model.
        changed_rows: rows of the arrays that may differ.
    """
    if not isinstance(original, np.ndarray) or not isinstance(other, np.ndarray):
        return bool(original == other)
    if original.shape != other.shape:
        return False
    if changed_rows:
        rows = np.setdiff1d(np.arange(len(original)), list(changed_rows))
        original = original[rows]
        other = other[rows]
    # Nearly all fields are equal, which is faster to see than whether they are close.
    if np.array_equal(original, other):
        return True
    if original.dtype.kind != "f":
        return False
    return np.allclose(original, other, rtol=TOLERANCE, atol=0.0, equal_nan=True)


def require_reproduction(
    robot: RobotModel,
    thetas: Array,
    change: ModelChange,
    written: Any,
    motion: Motion,
    path: Path,
) -> None:
    """Raise ExportError where a written model takes other torques than the identification predicts.

    Args:
        robot: the arm with the original model.
        thetas: (n, 10) identified parameters of the links, in their bodies' frames.
        change: identified numbers of joints, tendons and gravity.
        written: the compiled written model.
        motion: motion of S samples, at which the torques are compared.
        path: path of the written model, for the message.
    """
    expected = replace(robot, mj_model=changed_copy(robot.mj_model, change))
    new_tendons = [element for element in change.elements if element.owner is None]
    samples = motion.q, motion.qd, motion.qdd
    # What is no rigid body (springs, armature) does not depend on the links' inertia.
    predicted = LinkDynamics(expected).motion(*samples).torque(thetas)
    predicted += BeyondRigidBodies(expected).torque(*samples)
    for tendon in new_tendons:
        ratios = np.array([tendon.coefficients.get(n, 0.0) for n in robot.joint_names])
        speed = motion.qd @ ratios
        force = tendon.numbers.get("armature", 0.0) * (motion.qdd @ ratios)
        force += tendon.numbers.get("damping", 0.0) * speed
        quadratic, cubic = tendon.further or (0.0, 0.0)
        force += quadratic * speed * np.abs(speed) + cubic * speed**3
        predicted += np.outer(force, ratios)
    del expected  # its meshes take memory that the written model's dynamics needs
    actual = ArmDynamics(robot, written).torque(*samples)
    peak = np.max(np.abs(predicted), axis=0)
    # A joint's deviation is relative to a thousandth of the arm's largest torque at least.
    scale = np.maximum(peak, 1e-3 * np.max(peak, initial=0.0))
    deviation = np.max(np.abs(actual - predicted), axis=0)
    relative = deviation / np.where(scale > 0.0, scale, 1.0)
    worst = np.argmax(relative)
    if not relative[worst] <= TOLERANCE:
        raise ExportError(
            f"{path.name} does not reproduce the identified torques: joint "
            f"{robot.joint_names[worst]} is off by {relative[worst]:.1e} relative (allowed "
            f"{TOLERANCE:.0e})"
        )
