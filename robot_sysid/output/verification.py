"""Is the written model the original one with nothing changed but the identified inertia?

Both files are compiled and every field of the compiled models is compared. What may differ is
listed here, each entry with its reason. Then the written model has to move as the identification
predicts, torque by torque.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.kinematics import ArmDynamics, ChainKinematics
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.errors import ExportError, InputError
from robot_sysid.mjcf.changes import JOINT_NUMBERS, ActuatorChange, JointChange
from robot_sysid.mjcf.inertial import mjcf_inertial
from robot_sysid.mjcf.write_back import WriteBack
from robot_sysid.model.chain import body_label, joint_label
from robot_sysid.model.compilation import CompiledModel, captured_warnings, compile_model
from robot_sysid.model.inertia import body_theta
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.regressor import joint_torque

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


def verify_written_model(
    original: Any,
    written: Path,
    bodies: Mapping[int, WriteBack],
    joints: Sequence[JointChange] = (),
    actuators: Sequence[ActuatorChange] = (),
) -> CompiledModel:
    """Compile a written model, compare it with the original and return it.

    Args:
        original: the compiled input model.
        written: the file that was written.
        bodies: MuJoCo body id to what was to be written into that body.
        joints: what was to be written into joints.
        actuators: what was to be written into position actuators.

    Raises:
        ExportError: it does not load, something else changed, or a number is not what was asked
            for; names the field.
    """
    compiled = compiled_again(written)
    lumped = {body.body_id for plan in bodies.values() for body in plan.lumped}
    dofs = {change: _dof(original, change) for change in joints}
    servos = [change.actuator for change in actuators]
    springs = [dof for change, dof in dofs.items() if change.spring is not None]
    changed = {*bodies, *lumped}
    require_same_model(original, compiled.mj_model, changed, dofs.values(), servos, springs)
    for body, plan in bodies.items():
        require_theta(compiled.mj_model, body, plan.theta, plan.theta)
        for other in plan.lumped:
            require_theta(compiled.mj_model, other.body_id, np.zeros(10), plan.theta)
    for change, dof in dofs.items():
        _require_numbers(original, compiled.mj_model, change, dof)
        _require_polynomial(original, compiled.mj_model, change, dof)
        _require_spring(compiled.mj_model, change, dof)
    for servo in actuators:
        _require_gains(compiled.mj_model, servo)
        _require_delay(original, compiled.mj_model, servo)
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
) -> None:
    """Raise ExportError naming the first compiled field that differs and may not.

    Args:
        original, other: compiled models.
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
    for name, value in compiled_fields(original):
        if name in DERIVED or name in PATHS:
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
        mj_model: compiled model.
        body_id: MuJoCo body id.
        theta: (10,) what the body must have.
        size: (10,) a body that says what is large; deviations are relative to it.
        tolerance: largest relative deviation.
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


def torque_deviation(
    robot: RobotModel, theta: Array, written_model: Any, motion: Motion
) -> tuple[float, str]:
    """Return the largest relative torque deviation of a written model, and at which joint."""
    body = ChainKinematics(robot).evaluate(motion.q, motion.qd, motion.qdd)
    return _deviation(robot, joint_torque(body, theta), written_model, motion)


def require_reproduction(
    robot: RobotModel, theta: Array, written_model: Any, motion: Motion, path: Path
) -> None:
    """Raise ExportError where the written model moves differently than was identified.

    Args:
        robot: the arm as it was loaded.
        theta: (10,) composite terminal link that was identified.
        written_model: compiled model of the written file.
        motion: where to compare.
        path: the written file, for the message.
    """
    _require_small(*torque_deviation(robot, theta, written_model, motion), path)


def require_links_reproduction(
    robot: RobotModel, thetas: Array, written_model: Any, motion: Motion, path: Path
) -> None:
    """Raise ExportError where a model with all links written moves differently than identified.

    Args:
        robot: the arm as it was loaded.
        thetas: (n, 10) links that were identified, in their bodies' frames.
        written_model: compiled model of the written file.
        motion: where to compare.
        path: the written file, for the message.
    """
    links = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd)
    # What is no rigid body (springs, armature) is the original's, but for what is written.
    beyond = ArmDynamics(robot).beyond_rigid_bodies(motion.q, motion.qd, motion.qdd)
    both = (written_model.dof_armature, robot.mj_model.dof_armature)
    written, before = (values[robot.dof_index] for values in both)
    predicted = links.torque(thetas) + beyond + (written - before) * motion.qdd
    if hasattr(written_model, "dof_dampingpoly"):
        both = (written_model.dof_dampingpoly, robot.mj_model.dof_dampingpoly)
        quadratic, cubic = np.subtract(*(values[robot.dof_index] for values in both)).T
        predicted += quadratic * motion.qd * np.abs(motion.qd) + cubic * motion.qd**3
    written, before = (_spring_torque(robot, m, motion.q) for m in (written_model, robot.mj_model))
    predicted += written - before
    _require_small(*_deviation(robot, predicted, written_model, motion), path)


def _spring_torque(robot: RobotModel, mj_model: Any, q: Array) -> Array:
    """Return what the springs of the chain's joints take (N, n) at positions q (N, n)."""
    stiffness = mj_model.jnt_stiffness[mj_model.dof_jntid[robot.dof_index]]
    return np.asarray(stiffness * (q - mj_model.qpos_spring[robot.qpos_index]))


def _deviation(
    robot: RobotModel, predicted: Array, written_model: Any, motion: Motion
) -> tuple[float, str]:
    actual = ArmDynamics(robot, written_model).torque(motion.q, motion.qd, motion.qdd)
    peak = np.max(np.abs(predicted), axis=0)
    # A joint that carries next to nothing is judged by what its neighbours carry.
    scale = np.maximum(peak, 1e-3 * np.max(peak, initial=0.0))
    relative = np.max(np.abs(actual - predicted), axis=0) / np.where(scale > 0.0, scale, 1.0)
    worst = int(np.argmax(relative))
    return float(relative[worst]), robot.joint_names[worst]


def _require_small(deviation: float, joint: str, path: Path) -> None:
    if not deviation <= TORQUE_TOLERANCE:
        raise ExportError(
            f"{path.name} does not reproduce the identified torques: joint {joint} is off by "
            f"{deviation:.1e} relative (allowed {TORQUE_TOLERANCE:.0e}); no model was written"
        )
