"""Verification of a written model: it differs from the original in the identified numbers alone.

Both files are compiled and every field of the compiled models is compared, but for those listed
here, each with its reason. The written model must then take the torques that the identification
predicts. On demand, both models are simulated along logs that were not fitted.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    BeyondRigidBodies,
    LinkDynamics,
)
from robot_sysid.errors import ExportError, InputError
from robot_sysid.mjcf.inertial import mjcf_inertial
from robot_sysid.mjcf.updated_model import ModelChange, WeldedBody
from robot_sysid.model.bodies import body_theta
from robot_sysid.model.chain import body_label, joint_friction, joint_label
from robot_sysid.model.compilation import (
    CompiledModel,
    captured_warnings,
    compile_model,
)
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Measurement, Motion, RobotModel, Validation
from robot_sysid.records.data import validation_of
from robot_sysid.records.file_access import MODEL_NAMES, atomic_files, temporary_folder
from robot_sysid.results.record import (
    CLOSED,
    OPEN,
    ModelTarget,
    RolloutError,
    RolloutTest,
)
from robot_sysid.signals.process import ProcessedSignals
from robot_sysid.simulation import playback

CHECKPOINTS = 400
"""Number of samples of the motion on which a written model is compared with the prediction."""
TOLERANCE = 1e-9
"""Largest relative deviation of a compiled number from the written one: MuJoCo's transformation to
principal axes and back leaves up to 1e-10."""
AXES_TOLERANCE = 1e-12
"""Deviation below which MuJoCo's principal axes count as accurate; 4.0.0 stays below 1e-13."""

# Inertial fields of a body, and whether its frame and its inertial frame coincide: compared row by
# row, because only the changed bodies may differ.
BODY_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_sameframe")
# What MuJoCo computes from masses and inertias when it compiles.
DERIVED = {
    *["body_subtreemass", "body_invweight0", "dof_M0", "dof_invweight0", "dof_length"],
    *["tendon_invweight0", "actuator_acc0"],
    # Sizes of the memory of actuators and sensors, which follow from compared fields.
    *["nhistory", "actuator_historyadr", "sensor_historyadr"],
    # Found by simulating the actuator's movement, so masses enter.
    "actuator_lengthrange",
    # Whether a body's inertia is diagonal in its joint's axes, or a geom or site coincides with its
    # body's inertial frame: shortcuts for the engine.
    *["body_simple", "dof_simplenum", "geom_sameframe", "site_sameframe"],
    # Camera and light positions relative to the subtree's centre of mass.
    *["cam_poscom0", "light_poscom0"],
    # Collision bounding boxes are kept in the inertial frame of their body.
    *["bvh_aabb", "bvh_child", "bvh_depth", "bvh_nodeid"],
    # Scene size and mean mass, for drawing and for scaling contacts.
    *["stat.center", "stat.extent", "stat.meaninertia"],
    *["stat.meanmass", "stat.meansize"],
}
# Paths of asset files, and the sizes that follow from the length of these names. The signature is a
# hash of sizes and types, which are compared themselves; MuJoCo loses it when it pickles.
PATHS = {
    *["paths", "npaths", "nbuffer", "mesh_pathadr", "skin_pathadr", "hfield_pathadr"],
    *["tex_pathadr", "signature"],
}
_SPRINGDAMPER = (
    "a joint's springdamper computes it from the inertia: give that joint stiffness and damping "
    "instead to get a model"
)
_ADVICE = {
    "dof_damping": _SPRINGDAMPER,
    "dof_dampingpoly": "write a joint's nonlinear damping into the joint instead of its class",
}
_GAIN_ADVICE = "give the actuator kp and kv of its own"
_NUMERIC_TYPES = (int, float, bytes, np.ndarray)


class _RequiredValue(NamedTuple):
    """A value that a change requires of a compiled model.

    Attributes:
        owner: description of the joint, actuator or tendon, for messages.
        field: dotted name of the field of the compiled model.
        address: index of the value in that field.
        value: number, or row of numbers.
        advice: what to do where the compiled model has another value; ends the message.
    """

    owner: str
    field: str
    address: tuple[Any, ...]
    value: Any
    advice: str = "no model was written"

    def require(self, mj_model: Any) -> None:
        """Raise ExportError unless a compiled model has this value."""
        actual = attrgetter(self.field)(mj_model)[self.address].tolist()
        if not np.allclose(actual, self.value, rtol=TOLERANCE, atol=0.0):
            raise ExportError(
                f"in the written model, {self.owner} has {self.field} {actual} instead of "
                f"{self.value}; {self.advice}"
            )

    def write_into(self, mj_model: Any) -> None:
        """Set this value in a compiled model."""
        attrgetter(self.field)(mj_model)[self.address] = self.value


def _required_values(original: Any, change: ModelChange) -> Iterator[_RequiredValue]:
    """Yield the values of joints, actuators, tendons and gravity that a change requires."""
    labels = list(map(partial(joint_label, original), range(original.njnt)))
    for joint in change.joints:
        dof = int(original.jnt_dofadr[labels.index(joint.label)])
        numbers: dict[str, Any] = {**joint.numbers}
        if joint.polynomial is not None and hasattr(original, "dof_dampingpoly"):
            numbers["dampingpoly"] = joint.polynomial
        for name, value in numbers.items():
            field = f"dof_{name}"
            advice = _ADVICE.get(field, "no model was written")
            owner = f"joint '{joint.label}'"
            yield _RequiredValue(owner, field, (dof,), value, advice)
    for servo in change.actuators:
        owner = f"actuator number {servo.actuator}"
        gain_index = (servo.actuator, 0)
        bias_index = (servo.actuator, slice(3))
        bias = (0.0, -servo.stiffness, -servo.damping)
        yield _RequiredValue(
            owner, "actuator_gainprm", gain_index, servo.stiffness, _GAIN_ADVICE
        )
        yield _RequiredValue(owner, "actuator_biasprm", bias_index, bias, _GAIN_ADVICE)
    for tendon in change.tendons:
        for name, value in tendon.numbers.items():
            owner = f"tendon number {tendon.tendon}"
            yield _RequiredValue(owner, f"tendon_{name}", (tendon.tendon,), value)
    if change.gravity is not None:
        yield _RequiredValue("the world", "opt.gravity", ([0, 1, 2],), change.gravity)


def verify_written_model(
    original: Any, written: Path, change: ModelChange
) -> CompiledModel:
    """Compile a written model, compare it with the original, and return it.

    Args:
        original: compiled model.
        written: file of the written model.
        change: the difference that is wanted.

    Raises:
        ExportError: the file does not load, or the message names the field that has changed and
            should not have, or does not have the wanted value.
    """
    compiled = compiled_again(written)
    require_change(original, compiled.mj_model, change)
    return compiled


def require_change(original: Any, changed: Any, change: ModelChange) -> None:
    """Raise ExportError unless a compiled model is the original one with a change made."""
    new_body = None
    welded = change.welded
    if welded is not None:
        new_body = mujoco.mj_name2id(
            changed, int(mujoco.mjtObj.mjOBJ_BODY), welded.name
        )
        if new_body < 0 or changed.nbody != original.nbody + 1:
            name = welded.name
            raise ExportError(f"the written model has no body '{name}' of its own")
    # Body to its parameters and to those that set the scale.
    thetas: dict[int, tuple[Array, Array]] = {}
    for body_change in change.bodies:
        plan = body_change.plan
        thetas[body_change.body_id] = plan.theta, plan.theta
        for body in plan.emptied:
            thetas[body.body_id] = np.zeros(10), plan.theta
    required_values = list(_required_values(original, change))
    rows: dict[str, set[int]] = {name: set(thetas) for name in BODY_FIELDS}
    for required in required_values:
        indices = np.ravel(required.address[0]).tolist()
        rows.setdefault(required.field, set()).update(indices)
    new_tendons = sum(tendon.is_new for tendon in change.tendons)
    if changed.ntendon != original.ntendon + new_tendons:
        count = changed.ntendon
        raise ExportError(
            f"the written model has {count} tendons; no model was written"
        )
    require_same_model(original, changed, rows, new_body)
    for body_id, (theta, scale_theta) in thetas.items():
        is_behind_new = new_body is not None and body_id >= new_body
        require_theta(changed, body_id + is_behind_new, theta, scale_theta)
    for required in required_values:
        required.require(changed)
    if welded is not None and new_body is not None:
        _require_pose(changed, new_body, welded)
        require_theta(changed, new_body, welded.theta, welded.theta)


def compiled_again(written: Path) -> CompiledModel:
    """Return a written model, compiled, or raise ExportError where it cannot be loaded."""
    try:
        return compile_model(written)
    except InputError as error:
        raise ExportError(f"the written model cannot be loaded: {error}") from None


def require_same_model(
    original: Any,
    other: Any,
    changed_rows: Mapping[str, Collection[int]],
    new_body: int | None = None,
) -> None:
    """Raise ExportError naming the first field of two compiled models that differs and may not.

    Args:
        original: compiled model.
        other: compiled model; it may have further tendons, behind those of the original.
        changed_rows: name of a field to the rows that may differ.
        new_body: id of the one body that only the other model has, or None.
    """
    other_fields = dict(compiled_fields(other))
    ignored = DERIVED | PATHS
    ignored_prefixes: tuple[str, ...] = ()
    if other.ntendon > original.ntendon:
        ignored |= {"ntendon", "nwrap", "nJten", *_NAME_FIELDS}
        ignored_prefixes = ("name_",)
        for name, value in compiled_fields(original):
            if name.startswith(("tendon_", "ten_", "wrap_")):
                other_fields[name] = other_fields[name][: len(value)]
    if new_body is not None:
        ignored |= _BODY_COUNT_FIELDS
        ignored_prefixes = ("name_", "B_")
    for name, value in compiled_fields(original):
        if name in ignored or name.startswith(ignored_prefixes):
            continue
        rows = changed_rows.get(name, ())
        if not _is_same(name, value, other_fields.get(name), rows, new_body):
            raise ExportError(
                f"the written model differs from the original in {name}, which should not have "
                f"changed; {_ADVICE.get(name, 'no model was written')}"
            )


def require_theta(
    mj_model: Any,
    body_id: int,
    theta: Array,
    scale_theta: Array,
    tolerance: float = TOLERANCE,
) -> None:
    """Raise ExportError unless a compiled body has the parameters theta (10,).

    The tolerance is relative to the scale of a body with parameters scale_theta (10,).
    """
    mass, _, inertia = spatial.com_from_theta(scale_theta)
    length = spatial.characteristic_length(scale_theta)
    scale = spatial.parameter_scale(mass, length)
    actual = body_theta(mj_model, body_id)
    deviation = float(np.max(np.abs(actual - theta) / scale))
    if np.any(theta):
        # The inertia about the centre of mass is small beside that about a distant origin.
        actual_inertia = spatial.com_from_theta(actual)[2]
        difference = np.max(np.abs(actual_inertia - inertia))
        deviation = max(deviation, float(difference / np.max(np.abs(inertia))))
    if not deviation <= tolerance:
        raise ExportError(
            f"in the written model, body '{body_label(mj_model, body_id)}' has an inertia that is "
            f"off by {deviation:.1e} relative (allowed {tolerance:.0e}); no model was written"
        )


def reads_fullinertia_exactly(theta: Array) -> bool:
    """Return whether the installed MuJoCo compiles a ``fullinertia`` of theta (10,) accurately.

    Versions before 3.14 find principal axes to six digits only; for these, principal moments are
    written instead.
    """
    text = (
        f"<mujoco><worldbody><body>{mjcf_inertial(theta)}</body></worldbody></mujoco>"
    )
    try:
        with captured_warnings():
            probe = mujoco.MjModel.from_xml_string(text)
        require_theta(probe, 1, theta, theta, AXES_TOLERANCE)
    except (ExportError, ValueError):
        return False
    return True


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


def _is_same(
    name: str,
    original: Any,
    other: Any,
    changed_rows: Collection[int],
    new_body: int | None,
) -> bool:
    """Return whether a field of two compiled models is the same, but for rows that may differ.

    Where the other model has a new body, body ids from it on are larger by one.
    """
    if not isinstance(original, np.ndarray) or not isinstance(other, np.ndarray):
        return bool(original == other)
    if new_body is not None and name.startswith("body_"):
        other = np.delete(other, new_body, axis=0)
    if original.shape != other.shape:
        return False
    is_float = original.dtype.kind == "f"
    if new_body is not None and not is_float:
        is_shifted = (other == original + 1) & (original >= new_body)
        other = np.where(is_shifted, original, other)
    if changed_rows:
        rows = np.setdiff1d(np.arange(len(original)), list(changed_rows))
        original = original[rows]
        other = other[rows]
    if name == "actuator_biasprm":
        # Damping from a dampratio is computed from the inertia the actuator moves.
        original = np.delete(original, 2, axis=1)
        other = np.delete(other, 2, axis=1)
    return bool(np.array_equal(original, other, equal_nan=is_float))


TORQUE_TOLERANCE = 1e-9
"""Largest deviation of a written model's torque, relative to the joint's largest torque."""
_MIN_TORQUE_SHARE = 1e-3
"""Share of the arm's largest torque that scales the deviation of a joint that carries less."""


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
        motion: on which the torques are compared.
        path: of the written model, for the message.
    """
    expected = replace(robot, mj_model=copy.copy(robot.mj_model))
    old_tendons = tuple(tendon for tendon in change.tendons if not tendon.is_new)
    new_tendons = [tendon for tendon in change.tendons if tendon.is_new]
    for required in _required_values(
        robot.mj_model, replace(change, tendons=old_tendons)
    ):
        required.write_into(expected.mj_model)
    samples = motion.q, motion.qd, motion.qdd
    # What is no rigid body (springs, armature) does not depend on the links' inertia.
    predicted = LinkDynamics(expected).motion(*samples).torque(thetas)
    predicted += BeyondRigidBodies(expected).torque(*samples)
    for tendon in new_tendons:
        coefficients = [tendon.coefficients.get(n, 0.0) for n in robot.joint_names]
        ratios = np.array(coefficients)
        force = tendon.numbers.get("armature", 0.0) * (motion.qdd @ ratios)
        force += tendon.numbers.get("damping", 0.0) * (motion.qd @ ratios)
        predicted += np.outer(force, ratios)
    del expected  # its meshes take memory that the written model's dynamics needs
    actual = ArmDynamics(robot, written).torque(*samples)
    peak = np.max(np.abs(predicted), axis=0)
    scale = np.maximum(peak, _MIN_TORQUE_SHARE * np.max(peak, initial=0.0))
    deviation = np.max(np.abs(actual - predicted), axis=0)
    relative = deviation / np.where(scale > 0.0, scale, 1.0)
    worst = int(np.argmax(relative))
    if not relative[worst] <= TORQUE_TOLERANCE:
        raise ExportError(
            f"{path.name} does not reproduce the identified torques: joint "
            f"{robot.joint_names[worst]} is off by {relative[worst]:.1e} relative (allowed "
            f"{TORQUE_TOLERANCE:.0e}); no model was written"
        )


POSE_TOLERANCE = 1e-12
"""Largest deviation of a new body's origin [m] and axes: a few rounding errors of a quaternion."""
_NAME_FIELDS = ("nnames", "nnames_map", "names", "names_map")
"""Fields that hold the names of all elements."""
# Fields that list each body or number the pairs of them.
_BODY_COUNT_FIELDS = {
    *_NAME_FIELDS,
    *["nbody", "nB", "tree_bodynum", "exclude_signature", "pair_signature"],
}


def _require_pose(written: Any, new_body: int, body: WeldedBody) -> None:
    """Raise ExportError unless a compiled body is fixed to its carrier at the wanted pose."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, written.body_quat[new_body])
    axes_deviation = np.max(np.abs(axes.reshape(3, 3) - body.rotation))
    origin_deviation = np.max(np.abs(written.body_pos[new_body] - body.translation))
    is_at_pose = max(axes_deviation, origin_deviation) <= POSE_TOLERANCE
    parent = body_label(written, int(written.body_parentid[new_body]))
    if parent != body.carrier or written.body_jntnum[new_body] or not is_at_pose:
        raise ExportError(
            f"in the written model, body '{body.name}' is not fixed to '{body.carrier}' where it "
            "should be; no model was written"
        )


HORIZONS = (0.1, 0.3, 1.0, 3.0)
"""Durations over which the models are simulated [s]."""
HELD_OUT_SHARE = 0.2
"""Share of each log, its end, that is held out; cross-validation leaves out as much."""
LAST_FIFTH = "the last fifth of every log, which was not fitted for it"
"""Description of the pieces that ``HELD_OUT_SHARE`` holds out."""
SERVO_DESCRIPTION = (
    f"measured torques and a critically damped servo of {playback.TRACKING_RATE:g} Hz towards the "
    "measured motion"
)


def play(
    robot: RobotModel,
    signals: Sequence[ProcessedSignals],
    write: Callable[[ModelTarget], object],
    mesh_dir: Path | None,
    start_time: Callable[[ProcessedSignals], float] = lambda log: -np.inf,
    held_out: str = "the validation log",
) -> RolloutTest:
    """Simulate the original model and a written one along logs, and return their position errors.

    Args:
        robot: the arm with the original model.
        signals: the processed logs.
        write: writes the model; it goes to a temporary folder and is loaded from there.
        mesh_dir: the user's mesh folder, or None.
        start_time: returns the time of a log [s] from which on it is held out.
        held_out: description of the held-out pieces.

    Returns:
        The errors; without any, and with a note, where the model cannot be written or simulated.
    """
    try:
        pieces: list[Measurement] = []
        for log in signals:
            pieces += playback.low_passed_pieces(log, start_time(log))
        checkpoints = signals[0].motion(signals[0].spread_indices(CHECKPOINTS))
        with temporary_folder() as folder:
            # Its content and not this name tells the format.
            path = folder / MODEL_NAMES["mjcf"]
            with atomic_files() as files:
                write(ModelTarget(files, path, checkpoints, 0.0, mesh_dir))
            new_robot = load_robot_model(path, joint=robot.terminal_joint)
        return compare(robot, new_robot, pieces, held_out)
    except (ExportError, InputError) as error:
        return RolloutTest(robot.joint_names, "held-out pieces", "", (), (str(error),))


def rollout_refusal(test: RolloutTest | None, accepted: Collection[str]) -> str | None:
    """Return why a simulated model must not be written, or None where it may.

    None, too, where there was no test, or "rollout" is among the findings that the user accepts.
    """
    if test is None or test.is_better or "rollout" in accepted:
        return None
    reason = f"nothing could be played on held-out pieces ({'; '.join(test.notes)})"
    if test.score is not None:
        reason = (
            "played on held-out pieces, the new model is not better than the old one (errors "
            f"{test.score:.2f} times those before)"
        )
    return f"no model was written: {reason}; to write it all the same: --accept rollout"


def compare(
    old_robot: RobotModel,
    new_robot: RobotModel,
    pieces: Sequence[Measurement],
    held_out: str,
) -> RolloutTest:
    """Simulate two models of an arm along recorded pieces, and return their position errors.

    ``held_out`` describes the pieces.
    """
    errors = []
    notes = []
    divergence_notes = []
    robots = (old_robot, new_robot)
    servo = playback.tracking_servo(robots, pieces) if pieces else None
    for horizon in HORIZONS:
        windows = playback.window_starts(pieces, horizon)
        if not windows:
            notes.append(f"no held-out piece is as long as {horizon:g} s")
            continue
        for loop, loop_servo in ((OPEN, None), (CLOSED, servo)):
            old_errors, old_diverged = playback.rollout_error(
                old_robot, windows, horizon, loop_servo
            )
            new_errors, new_diverged = playback.rollout_error(
                new_robot, windows, horizon, loop_servo
            )
            diverged = (old_diverged, new_diverged)
            errors.append(
                RolloutError(
                    loop, horizon, len(windows), old_errors, new_errors, diverged
                )
            )
            if any(diverged):
                divergence_notes.append(
                    f"{loop}, {horizon:g} s: {old_diverged} of {len(windows)} windows run away "
                    f"with the model before, {new_diverged} with the new one"
                )
    return RolloutTest(
        old_robot.joint_names,
        held_out,
        SERVO_DESCRIPTION,
        tuple(errors),
        (*notes, *divergence_notes),
    )


def split_time(signals: ProcessedSignals | Measurement) -> float:
    """Return the time from which on the last fifth of a log is held out [s]."""
    start = float(signals.time[0])
    end = float(signals.time[-1])
    return end - HELD_OUT_SHARE * (end - start)


def fitted_rows(signals: ProcessedSignals) -> NDArray[np.bool_]:
    """Return which decimated rows (K,) use no sample of the held-out last fifth."""
    reach = signals.low_pass.half_width / signals.rate
    return np.asarray(signals.decimated_time() < split_time(signals) - 2.0 * reach)


def torque_error(
    model: Path | Any, robot: RobotModel, signals: ProcessedSignals, source: str
) -> Validation:
    """Return the torque error of a model file on a log, up to one sensor offset per joint.

    ``ArmDynamics`` has no linear damping of joints; it is added as viscous friction. Dry friction
    is Coulomb's. The prediction passes the same low-pass as the measured torque, and the mean
    residual of each joint is subtracted.

    Args:
        model: path, or a compiled model whose chain joints have the robot's addresses.
        robot: the arm.
        signals: the processed log.
        source: description of the log.

    Raises:
        InputError: the file cannot be loaded.
    """
    compiled = compile_model(model).mj_model if isinstance(model, Path) else model
    dynamics = ArmDynamics(robot, compiled)
    friction = joint_friction(compiled, robot.dof_index)

    def smooth_torque(motion: Motion) -> tuple[Array]:
        rigid = dynamics.torque(motion.q, motion.qd, motion.qdd)
        return (rigid + friction.viscous * motion.qd,)

    (predicted,) = signals.filter_columns(smooth_torque, smooth=True)
    predicted += signals.low_pass.decimate(friction.dry(signals.qd))
    tau = signals.low_pass.decimate(signals.tau)
    usable = signals.usable()
    counts = np.count_nonzero(usable, axis=0)
    residual = np.where(usable, tau - predicted, 0.0)
    offset = np.sum(residual, axis=0) / np.maximum(counts, 1)
    residual = np.where(usable, residual - offset, 0.0)
    squared_errors = np.sum(residual**2, axis=0)
    squared_torques = np.sum(np.where(usable, tau, 0.0) ** 2, axis=0)
    return validation_of(
        robot.joint_names, squared_errors, squared_torques, counts, source
    )
