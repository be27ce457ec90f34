"""Is the written model the original one with nothing changed but what was identified?

Both files are compiled and every field of the compiled models is compared. What may differ is
listed here, each entry with its reason. Then the written model has to take the torques that the
identification predicts.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.kinematics import ArmDynamics
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.errors import ExportError, InputError
from robot_sysid.mjcf.inertial import mjcf_inertial
from robot_sysid.mjcf.write_back import (
    JOINT_NUMBERS,
    ActuatorChange,
    JointChange,
    ModelChange,
    WeldedBody,
)
from robot_sysid.model.chain import body_label, joint_label
from robot_sysid.model.compilation import CompiledModel, captured_warnings, compile_model
from robot_sysid.model.inertia import body_theta
from robot_sysid.records import Array, Motion, RobotModel

TOLERANCE = 1e-9
"""Largest relative deviation of the compiled inertia from what was asked for."""
ACCURATE = 1e-12
"""Deviation below which MuJoCo's principal axes count as accurate; 4.0.0 stays below 1e-13."""

# What was written, and whether body frame and inertial frame coincide. Compared row by row: only
# the changed bodies may differ.
_WRITTEN = {"body_mass", "body_inertia", "body_ipos", "body_iquat", "body_sameframe"}
_WRITTEN_JOINT = {f"dof_{name}" for name in (*JOINT_NUMBERS, "dampingpoly")}
_WRITTEN_SPRING = ("jnt_stiffness", "qpos_spring")
_DELAY, _LINEAR = ("actuator_delay", "actuator_history"), 1
_WRITTEN_ACTUATOR = ("actuator_gainprm", "actuator_biasprm", *_DELAY)
# What MuJoCo computes from masses and inertias when it compiles.
DERIVED = {
    *("body_subtreemass", "body_invweight0", "dof_M0", "dof_invweight0", "dof_length"),
    *("tendon_invweight0", "actuator_acc0"),
    # Room for what actuators and sensors remember; how much that is is compared.
    *("nhistory", "actuator_historyadr", "sensor_historyadr"),
    # Found by simulating the actuator's movement, so masses enter.
    "actuator_lengthrange",
    # Whether a body's inertia is diagonal in its joint's axes, or a geom or site coincides with its
    # body's inertial frame: shortcuts for the engine.
    *("body_simple", "dof_simplenum", "geom_sameframe", "site_sameframe"),
    # Camera and light positions relative to the subtree's centre of mass.
    *("cam_poscom0", "light_poscom0"),
    # Collision bounding boxes are kept in the inertial frame of their body.
    *("bvh_aabb", "bvh_child", "bvh_depth", "bvh_nodeid"),
    # Scene size and mean mass, for drawing and for scaling contacts.
    *("stat.center", "stat.extent", "stat.meaninertia", "stat.meanmass", "stat.meansize"),
}
# Where asset files are, and the sizes that follow from the length of these names.
PATHS = {
    *("paths", "npaths", "nbuffer"),
    *("mesh_pathadr", "skin_pathadr", "hfield_pathadr", "tex_pathadr"),
}
_SPRINGDAMPER = (
    "a joint's springdamper computes it from the inertia: give that joint stiffness and damping "
    "instead to get a model"
)
_ADVICE = {
    "dof_damping": _SPRINGDAMPER,
    "jnt_stiffness": _SPRINGDAMPER,
    "dof_dampingpoly": "write a joint's nonlinear damping into the joint instead of its class",
}
_NUMBERS = (int, float, bytes, np.ndarray)


def verify_written_model(original: Any, written: Path, change: ModelChange) -> CompiledModel:
    """Compile a written model, compare it with the original, and return it; no welded body yet.

    Raises:
        ExportError: it does not load, something else changed, or a number is not what was asked
            for; names the field.
    """
    compiled = compiled_again(written)
    found = compiled.mj_model
    bodies = {body.body_id: body.plan for body in change.bodies}
    lumped = {body.body_id for plan in bodies.values() for body in plan.lumped}
    dofs = {joint: _dof(original, joint) for joint in change.joints}
    servos = [servo.actuator for servo in change.actuators]
    springs = [dof for joint, dof in dofs.items() if joint.spring is not None]
    changed = {*bodies, *lumped}
    turned = change.gravity is not None
    require_same_model(original, found, changed, dofs.values(), servos, springs, turned)
    for body, plan in bodies.items():
        require_theta(found, body, plan.theta, plan.theta)
        for other in plan.lumped:
            require_theta(found, other.body_id, np.zeros(10), plan.theta)
    for joint, dof in dofs.items():
        _require_numbers(original, found, joint, dof)
        _require_polynomial(original, found, joint, dof)
        _require_spring(found, joint, dof)
    for servo in change.actuators:
        _require_gains(found, servo)
        _require_delay(original, found, servo)
    gravity, asked = found.opt.gravity, change.gravity
    if asked is not None and not np.allclose(gravity, asked, rtol=0.0, atol=TOLERANCE):
        raise ExportError(
            f"in the written model, gravity is {gravity.tolist()} instead of {list(asked)}; no "
            "model was written"
        )
    return compiled


def compiled_again(written: Path) -> CompiledModel:
    """Return a written model as it loads; ExportError where it does not."""
    try:
        return compile_model(written)
    except InputError as error:
        raise ExportError(f"the written model cannot be loaded: {error}") from None


def _dof(mj_model: Any, change: JointChange) -> int:
    labels = [joint_label(mj_model, joint) for joint in range(mj_model.njnt)]
    return int(mj_model.jnt_dofadr[labels.index(change.label)])


def _require_numbers(original: Any, written: Any, change: JointChange, dof: int) -> None:
    """Raise ExportError unless a joint has its new numbers, and its old ones beside them."""
    for name in JOINT_NUMBERS:
        asked = change.numbers.get(name, float(getattr(original, f"dof_{name}")[dof]))
        found = float(getattr(written, f"dof_{name}")[dof])
        if abs(found - asked) > TOLERANCE * abs(asked):
            raise ExportError(
                f"in the written model, joint '{change.label}' has {name} {found:.9g} instead of "
                f"{asked:.9g}; {_ADVICE.get(f'dof_{name}', 'no model was written')}"
            )


def _require_polynomial(original: Any, written: Any, change: JointChange, dof: int) -> None:
    """Raise ExportError unless a joint has its new nonlinear damping, or its old one."""
    if not hasattr(original, "dof_dampingpoly"):
        return
    asked = original.dof_dampingpoly[dof] if change.polynomial is None else change.polynomial
    found = written.dof_dampingpoly[dof]
    if not np.allclose(found, asked, rtol=TOLERANCE, atol=0.0):
        raise ExportError(
            f"in the written model, joint '{change.label}' has the nonlinear damping {found} "
            f"instead of {asked}; {_ADVICE['dof_dampingpoly']}"
        )


def _spring(mj_model: Any, dof: int) -> tuple[int, int]:
    """Return the places of a degree of freedom's stiffness and of where its spring rests."""
    joint = int(mj_model.dof_jntid[dof])
    return joint, int(mj_model.jnt_qposadr[joint])


def _require_spring(written: Any, change: JointChange, dof: int) -> None:
    """Raise ExportError unless a joint has the spring that makes its offset."""
    if change.spring is None:
        return
    values = zip((written.jnt_stiffness, written.qpos_spring), _spring(written, dof))
    found = [float(value[place]) for value, place in values]
    if not np.allclose(found, change.spring, rtol=TOLERANCE, atol=0.0):
        raise ExportError(
            f"in the written model, joint '{change.label}' has a spring of {found[0]:.9g} that "
            f"rests at {found[1]:.9g}, which is not the offset of {change.offset:.9g}; leave "
            "--write-offset off"
        )


def _require_gains(written: Any, change: ActuatorChange) -> None:
    """Raise ExportError unless a position actuator has its new gains, and nothing else."""
    kp, kv = change.stiffness, change.damping
    at = change.actuator
    found = np.array([written.actuator_gainprm[at, 0], *written.actuator_biasprm[at, :3]])
    if not np.allclose(found, [kp, 0.0, -kp, -kv], rtol=TOLERANCE, atol=0.0):
        raise ExportError(
            f"in the written model, actuator number {at} has gains {found.tolist()} "
            f"instead of kp {kp:.9g} and kv {kv:.9g}; give it kp and kv of its own"
        )


def _require_delay(original: Any, written: Any, change: ActuatorChange) -> None:
    """Raise ExportError unless an actuator acts late by what was asked for, or as before."""
    if not hasattr(original, _DELAY[0]):
        return
    asked: tuple[Any, ...] = tuple(getattr(original, name)[change.actuator] for name in _DELAY)
    if change.delay is not None:
        asked = change.delay, (change.samples, _LINEAR)
    found = tuple(getattr(written, name)[change.actuator] for name in _DELAY)
    if not all(np.allclose(*pair, rtol=TOLERANCE, atol=0.0) for pair in zip(found, asked)):
        raise ExportError(
            f"in the written model, actuator number {change.actuator} acts late by {found[0]:.9g} "
            f"s instead of {asked[0]:.9g}; give it a delay of its own, or leave --write-delay off"
        )


def require_same_model(
    original: Any,
    other: Any,
    changed: Collection[int],
    dofs: Collection[int] = (),
    actuators: Collection[int] = (),
    springs: Collection[int] = (),
    gravity: bool = False,
) -> None:
    """Raise ExportError naming the first compiled field that differs and may not.

    Args:
        changed: ids of the bodies whose inertia may differ.
        dofs: the degrees of freedom whose armature, damping and friction may differ.
        actuators: ids of those whose gains may differ.
        springs: the degrees of freedom whose springs may differ.
    """
    theirs = dict(compiled_fields(other))
    rows = {**dict.fromkeys(_WRITTEN, changed), **dict.fromkeys(_WRITTEN_JOINT, dofs)}
    rows.update(dict.fromkeys(_WRITTEN_ACTUATOR, actuators))
    places = zip(*(_spring(original, dof) for dof in springs))
    rows.update(zip(_WRITTEN_SPRING, places))
    skipped = DERIVED | PATHS | ({"opt.gravity"} if gravity else set())
    for name, value in compiled_fields(original):
        if name in skipped:
            continue
        if name not in theirs or not _same(name, value, theirs[name], rows.get(name, ())):
            raise ExportError(
                f"the written model differs from the original in {name}, which should not have "
                f"changed; {_ADVICE.get(name, 'no model was written')}"
            )


def require_theta(
    mj_model: Any, body_id: int, theta: Array, size: Array, tolerance: float = TOLERANCE
) -> None:
    """Raise ExportError unless a compiled body has the parameters theta (10,).

    Args:
        size: (10,) a body that says what is large; deviations are relative to it.
    """
    mass, com, inertia = spatial.com_from_theta(size)
    scale = spatial.parameter_scale(mass, spatial.characteristic_length(size))
    deviation = float(np.max(np.abs(body_theta(mj_model, body_id) - theta) / scale))
    if np.any(theta):
        # The inertia about the centre of mass is small beside that about a distant origin.
        compiled = spatial.com_from_theta(body_theta(mj_model, body_id))[2]
        about_com = float(np.max(np.abs(compiled - inertia)) / np.max(np.abs(inertia)))
        deviation = max(deviation, about_com)
    if not deviation <= tolerance:
        raise ExportError(
            f"in the written model, body '{body_label(mj_model, body_id)}' has an inertia that is "
            f"off by {deviation:.1e} relative (allowed {tolerance:.0e}); no model was written"
        )


def reads_fullinertia_exactly(theta: Array) -> bool:
    """Tell whether the installed MuJoCo finds the axes of theta's full inertia accurately.

    Versions before 3.14 stop at six digits; then principal moments have to be written instead.
    """
    text = f"<mujoco><worldbody><body>{mjcf_inertial(theta)}</body></worldbody></mujoco>"
    try:
        with captured_warnings():
            probe = mujoco.MjModel.from_xml_string(text)
        require_theta(probe, 1, theta, theta, ACCURATE)
    except (ExportError, ValueError):
        return False
    return True


def compiled_fields(mj_model: Any) -> Iterator[tuple[str, Any]]:
    """Yield every number and array of a compiled model with its name, options included."""
    yield from _numbers(mj_model, "")
    yield from _numbers(mj_model.opt, "opt.")
    yield from _numbers(mj_model.stat, "stat.")
    for part in _public(mj_model.vis):
        yield from _numbers(getattr(mj_model.vis, part), f"vis.{part}.")


def _numbers(holder: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name in _public(holder):
        value = getattr(holder, name)
        if isinstance(value, _NUMBERS):
            yield prefix + name, value


def _public(holder: Any) -> list[str]:
    return [name for name in dir(holder) if not name.startswith("_")]


def _same(name: str, ours: Any, theirs: Any, changed: Collection[int]) -> bool:
    if not isinstance(ours, np.ndarray):
        return bool(ours == theirs)
    if ours.shape != theirs.shape:
        return False
    if changed:
        keep = [i for i in range(len(ours)) if i not in changed]
        ours, theirs = ours[keep], theirs[keep]
    if name == "actuator_biasprm":
        # Damping from a dampratio is computed from the inertia the actuator moves.
        ours, theirs = np.delete(ours, 2, axis=1), np.delete(theirs, 2, axis=1)
    return bool(np.array_equal(ours, theirs, equal_nan=ours.dtype.kind == "f"))


TORQUE_TOLERANCE = 1e-9
"""Largest deviation of a written model's torque, relative to the joint's largest torque."""


def require_reproduction(
    robot: RobotModel,
    thetas: Array,
    change: ModelChange,
    written_model: Any,
    motion: Motion,
    path: Path,
) -> None:
    """Raise ExportError where a written model takes other torques than were identified.

    Args:
        thetas: (n, 10) links that were identified, in their bodies' frames.
    """
    asked = replace(robot, mj_model=_as_asked(robot.mj_model, change))
    samples = motion.q, motion.qd, motion.qdd
    # What is no rigid body (springs, armature) does not depend on the links' inertia.
    predicted = LinkDynamics(asked).motion(*samples).torque(thetas)
    predicted += ArmDynamics(asked).beyond_rigid_bodies(*samples)
    actual = ArmDynamics(robot, written_model).torque(*samples)
    peak = np.max(np.abs(predicted), axis=0)
    # A joint that carries next to nothing is judged by what its neighbours carry.
    scale = np.maximum(peak, 1e-3 * np.max(peak, initial=0.0))
    relative = np.max(np.abs(actual - predicted), axis=0) / np.where(scale > 0.0, scale, 1.0)
    worst = int(np.argmax(relative))
    if not relative[worst] <= TORQUE_TOLERANCE:
        raise ExportError(
            f"{path.name} does not reproduce the identified torques: joint "
            f"{robot.joint_names[worst]} is off by {relative[worst]:.1e} relative (allowed "
            f"{TORQUE_TOLERANCE:.0e}); no model was written"
        )


def _as_asked(original: Any, change: ModelChange) -> Any:
    """Return a copy of the original model with joints and gravity as they should be written."""
    model = copy.copy(original)
    for joint in change.joints:
        dof = _dof(original, joint)
        if joint.armature is not None:
            model.dof_armature[dof] = joint.armature
        if joint.polynomial is not None and hasattr(model, "dof_dampingpoly"):
            model.dof_dampingpoly[dof] = joint.polynomial
        if joint.spring is not None:
            at, rest = _spring(original, dof)
            model.jnt_stiffness[at], model.qpos_spring[rest] = joint.spring
    if change.gravity is not None:
        model.opt.gravity[:] = change.gravity
    return model


PLACE = 1e-12
"""Largest deviation of the new body's place [m] and axes."""
# Names and their places, and tables that list each body or number the pairs of them.
_BOOKKEEPING = {
    *("nbody", "nB", "nnames", "nnames_map", "names", "names_map", "signature"),
    *("tree_bodynum", "exclude_signature", "pair_signature"),
}
_OF_NAMES = ("name_", "B_")


def require_one_more_body(without: Any, written: Any, body: WeldedBody) -> None:
    """Raise ExportError unless a model has one welded body more, and is the same beside it."""
    new = mujoco.mj_name2id(written, int(mujoco.mjtObj.mjOBJ_BODY), body.name)
    if new < 0 or written.nbody != without.nbody + 1:
        raise ExportError(f"the written model has no body '{body.name}' of its own")
    theirs = dict(compiled_fields(written))
    for name, value in compiled_fields(without):
        skipped = name in DERIVED | PATHS | _BOOKKEEPING or name.startswith(_OF_NAMES)
        if not skipped and not _is_same(value, theirs.get(name), new, without.nbody):
            raise ExportError(
                f"the new body '{body.name}' changes {name} of the model; no model was written"
            )
    _require_place(written, new, body)
    require_theta(written, new, body.theta, body.theta)


def _is_same(ours: Any, theirs: Any, new: int, bodies: int) -> bool:
    """Tell whether a field is the same beside the row of body ``new`` and the numbers after it."""
    if not isinstance(ours, np.ndarray) or not isinstance(theirs, np.ndarray):
        return bool(ours == theirs)
    if ours.shape != theirs.shape and ours.shape[:1] == (bodies,):
        theirs = np.delete(theirs, new, axis=0)
    if ours.shape != theirs.shape:
        return False
    if ours.dtype.kind == "f":
        return bool(np.array_equal(ours, theirs, equal_nan=True))
    return bool(np.all((theirs == ours) | ((theirs == ours + 1) & (ours >= new))))


def _require_place(written: Any, new: int, body: WeldedBody) -> None:
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, written.body_quat[new])
    off = np.max(np.abs(axes.reshape(3, 3) - body.rotation))
    off = max(off, np.max(np.abs(written.body_pos[new] - body.translation)))
    parent = body_label(written, int(written.body_parentid[new]))
    if parent != body.carrier or written.body_jntnum[new] or not off <= PLACE:
        raise ExportError(
            f"in the written model, body '{body.name}' is not fixed to '{body.carrier}' where it "
            "should be; no model was written"
        )
