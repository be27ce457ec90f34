"""Is the written model the original one with nothing changed but what was identified?

Both files are compiled and every field of the compiled models is compared. What may differ is
listed here, each entry with its reason. Then the written model has to take the torques that the
identification predicts.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics, BeyondRigidBodies
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.errors import ExportError, InputError
from robot_sysid.mjcf.inertial import mjcf_inertial
from robot_sysid.mjcf.updated_model import ModelChange, WeldedBody
from robot_sysid.model.chain import body_label, joint_friction, joint_label
from robot_sysid.model.compilation import (
    CompiledModel,
    captured_warnings,
    compile_model,
)
from robot_sysid.model.inertia import body_theta
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
"""On how many samples of the motion a written model is compared with the prediction."""

TOLERANCE = 1e-9
"""Largest relative deviation of the compiled inertia from what was asked for: MuJoCo's own way to
principal axes and back leaves up to 1e-10."""
ACCURATE = 1e-12
"""Deviation below which MuJoCo's principal axes count as accurate; 4.0.0 stays below 1e-13."""

# What is written of a body, and whether its frame and its inertial frame coincide. Compared row by
# row: only the changed bodies may differ.
BODY_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_sameframe")
# What MuJoCo computes from masses and inertias when it compiles.
DERIVED = {
    "body_subtreemass",
    "body_invweight0",
    "dof_M0",
    "dof_invweight0",
    "dof_length",
    "tendon_invweight0",
    "actuator_acc0",
    # Room for what actuators and sensors remember; how much that is is compared.
    "nhistory",
    "actuator_historyadr",
    "sensor_historyadr",
    # Found by simulating the actuator's movement, so masses enter.
    "actuator_lengthrange",
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
# Where asset files are, and the sizes that follow from the length of these names.
PATHS = {
    "paths",
    "npaths",
    "nbuffer",
    "mesh_pathadr",
    "skin_pathadr",
    "hfield_pathadr",
    "tex_pathadr",
    # A hash of sizes and kinds, which are compared themselves; MuJoCo loses it when it pickles.
    "signature",
}
_SPRINGDAMPER = (
    "a joint's springdamper computes it from the inertia: give that joint stiffness and damping "
    "instead to get a model"
)
_ADVICE = {
    "dof_damping": _SPRINGDAMPER,
    "dof_dampingpoly": "write a joint's nonlinear damping into the joint instead of its class",
}
_OWN_GAINS = "give the actuator kp and kv of its own"
_NUMBERS = (int, float, bytes, np.ndarray)


class _Asked(NamedTuple):
    """A number or a row that a change asks for: the compiled field, the place in it, the value."""

    owner: str
    field: str
    at: tuple[Any, ...]
    value: Any
    advice: str = "no model was written"

    def require(self, mj_model: Any) -> None:
        """Raise ExportError unless it stands in a compiled model."""
        found = attrgetter(self.field)(mj_model)[self.at].tolist()
        if not np.allclose(found, self.value, rtol=TOLERANCE, atol=0.0):
            what = f"{self.owner} has {self.field} {found} instead of {self.value}"
            raise ExportError(f"in the written model, {what}; {self.advice}")

    def put(self, mj_model: Any) -> None:
        """Write it into a compiled model."""
        attrgetter(self.field)(mj_model)[self.at] = self.value


def _asked(original: Any, change: ModelChange) -> Iterator[_Asked]:
    labels = [joint_label(original, joint) for joint in range(original.njnt)]
    for joint in change.joints:
        at = (int(original.jnt_dofadr[labels.index(joint.label)]),)
        numbers: dict[str, Any] = {
            f"dof_{name}": value for name, value in joint.numbers.items()
        }
        if joint.polynomial is not None and hasattr(original, "dof_dampingpoly"):
            numbers["dof_dampingpoly"] = joint.polynomial
        for field, value in numbers.items():
            advice = _ADVICE.get(field, "no model was written")
            yield _Asked(f"joint '{joint.label}'", field, at, value, advice)
    for servo in change.actuators:
        at = (servo.actuator,)
        owner = f"actuator number {servo.actuator}"
        yield _Asked(owner, "actuator_gainprm", (*at, 0), servo.stiffness, _OWN_GAINS)
        bias = (0.0, -servo.stiffness, -servo.damping)
        yield _Asked(owner, "actuator_biasprm", (*at, slice(3)), bias, _OWN_GAINS)
    for tendon in change.tendons:
        for name, value in tendon.numbers.items():
            owner = f"tendon number {tendon.tendon}"
            yield _Asked(owner, f"tendon_{name}", (tendon.tendon,), value)
    if change.gravity is not None:
        yield _Asked("the world", "opt.gravity", ([0, 1, 2],), change.gravity)


def verify_written_model(
    original: Any, written: Path, change: ModelChange
) -> CompiledModel:
    """Compile a written model, compare it with the original, and return it; ExportError names the
    field if something else changed, or is not what was asked for, or says that it does not load.
    """
    compiled = compiled_again(written)
    require_change(original, compiled.mj_model, change)
    return compiled


def require_change(original: Any, found: Any, change: ModelChange) -> None:
    """Raise ExportError unless a compiled model is the original one with a change made."""
    new = None
    welded = change.welded
    if welded is not None:
        new = mujoco.mj_name2id(found, int(mujoco.mjtObj.mjOBJ_BODY), welded.name)
        if new < 0 or found.nbody != original.nbody + 1:
            raise ExportError(
                f"the written model has no body '{welded.name}' of its own"
            )
    thetas = {
        body: (theta, plan.theta)
        for own, plan in ((change.body_id, change.plan) for change in change.bodies)
        for body, theta in (
            (own, plan.theta),
            *((b.body_id, np.zeros(10)) for b in plan.emptied),
        )
    }
    asked = list(_asked(original, change))
    rows: dict[str, set[int]] = {name: set(thetas) for name in BODY_FIELDS}
    for each in asked:
        rows.setdefault(each.field, set()).update(np.ravel(each.at[0]).tolist())
    added = sum(tendon.is_new for tendon in change.tendons)
    if found.ntendon != original.ntendon + added:
        raise ExportError(
            f"the written model has {found.ntendon} tendons; no model was written"
        )
    require_same_model(original, found, rows, new)
    for body, (theta, size) in thetas.items():
        require_theta(found, body + (new is not None and body >= new), theta, size)
    for each in asked:
        each.require(found)
    if welded is not None and new is not None:
        _require_place(found, new, welded)
        require_theta(found, new, welded.theta, welded.theta)


def compiled_again(written: Path) -> CompiledModel:
    """Return a written model as it loads; ExportError where it does not."""
    try:
        return compile_model(written)
    except InputError as error:
        raise ExportError(f"the written model cannot be loaded: {error}") from None


def require_same_model(
    original: Any,
    other: Any,
    changed: Mapping[str, Collection[int]],
    new: int | None = None,
) -> None:
    """Raise ExportError naming the first compiled field that differs and may not, but for rows of
    ``changed`` fields, and for the one body, if any, that the other model has more, by its id, and
    tendons that it has more, behind the others.
    """
    theirs = dict(compiled_fields(other))
    skipped = DERIVED | PATHS
    if other.ntendon > original.ntendon:
        skipped |= {
            "ntendon",
            "nwrap",
            "nJten",
            *_NAMES,
            *(n for n in theirs if n[:5] == "name_"),
        }
        for name, value in compiled_fields(original):
            if name.startswith(("tendon_", "ten_", "wrap_")):
                theirs[name] = theirs[name][: len(value)]
    if new is not None:
        skipped |= _BOOKKEEPING | {
            name for name in theirs if name.startswith(_OF_NAMES)
        }
    for name, value in compiled_fields(original):
        if name in skipped:
            continue
        if not _same(name, value, theirs.get(name), changed.get(name, ()), new):
            raise ExportError(
                f"the written model differs from the original in {name}, which should not have "
                f"changed; {_ADVICE.get(name, 'no model was written')}"
            )


def require_theta(
    mj_model: Any, body_id: int, theta: Array, size: Array, tolerance: float = TOLERANCE
) -> None:
    """Raise ExportError unless a compiled body has the parameters theta (10,); deviations are
    relative to a body (10,) that says what is large.
    """
    mass, _, inertia = spatial.com_from_theta(size)
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
    text = (
        f"<mujoco><worldbody><body>{mjcf_inertial(theta)}</body></worldbody></mujoco>"
    )
    try:
        with captured_warnings():
            probe = mujoco.MjModel.from_xml_string(text)
        require_theta(probe, 1, theta, theta, ACCURATE)
    except (ExportError, ValueError):
        return False
    return True


def compiled_fields(mj_model: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every number and array of a compiled model with its name, options included."""
    for name in (name for name in dir(mj_model) if not name.startswith("_")):
        value = getattr(mj_model, name)
        if isinstance(value, _NUMBERS):
            yield prefix + name, value
        elif name in ("opt", "stat", "vis") or prefix == "vis.":
            yield from compiled_fields(value, f"{prefix}{name}.")


def _same(
    name: str, ours: Any, theirs: Any, changed: Collection[int], new: int | None
) -> bool:
    if not isinstance(ours, np.ndarray) or not isinstance(theirs, np.ndarray):
        return bool(ours == theirs)
    if new is not None and name.startswith("body_"):
        theirs = np.delete(theirs, new, axis=0)
    if ours.shape != theirs.shape:
        return False
    if new is not None and ours.dtype.kind != "f":
        # What comes after the new body has a number that is larger by one.
        theirs = np.where((theirs == ours + 1) & (ours >= new), ours, theirs)
    if changed:
        keep = [i for i in range(len(ours)) if i not in changed]
        ours = ours[keep]
        theirs = theirs[keep]
    if name == "actuator_biasprm":
        # Damping from a dampratio is computed from the inertia the actuator moves.
        ours = np.delete(ours, 2, axis=1)
        theirs = np.delete(theirs, 2, axis=1)
    return bool(np.array_equal(ours, theirs, equal_nan=ours.dtype.kind == "f"))


TORQUE_TOLERANCE = 1e-9
"""Largest deviation of a written model's torque, relative to the joint's largest torque; beside
``TOLERANCE`` of the inertia that makes it."""
_LEAST_SHARE = 1e-3
"""Share of the largest torque by which a joint that carries next to nothing is judged."""


def require_reproduction(
    robot: RobotModel,
    thetas: Array,
    change: ModelChange,
    written: Any,
    motion: Motion,
    path: Path,
) -> None:
    """Raise ExportError where a written model takes other torques than those of the links (n, 10)
    that were identified, in their bodies' frames.
    """
    asked = replace(robot, mj_model=copy.copy(robot.mj_model))
    present = [tendon for tendon in change.tendons if not tendon.is_new]
    for each in _asked(robot.mj_model, replace(change, tendons=tuple(present))):
        each.put(asked.mj_model)
    samples = motion.q, motion.qd, motion.qdd
    # What is no rigid body (springs, armature) does not depend on the links' inertia.
    predicted = LinkDynamics(asked).motion(*samples).torque(thetas)
    predicted += BeyondRigidBodies(asked).torque(*samples)
    for tendon in change.tendons:
        if tendon.is_new:
            ratios = np.array(
                [tendon.coefficients.get(name, 0.0) for name in robot.joint_names]
            )
            pull = tendon.numbers.get("armature", 0.0) * (motion.qdd @ ratios)
            pull += tendon.numbers.get("damping", 0.0) * (motion.qd @ ratios)
            predicted += np.outer(pull, ratios)
    del asked  # with its meshes
    actual = ArmDynamics(robot, written).torque(*samples)
    peak = np.max(np.abs(predicted), axis=0)
    scale = np.maximum(peak, _LEAST_SHARE * np.max(peak, initial=0.0))
    relative = np.max(np.abs(actual - predicted), axis=0) / np.where(
        scale > 0.0, scale, 1.0
    )
    worst = int(np.argmax(relative))
    if not relative[worst] <= TORQUE_TOLERANCE:
        raise ExportError(
            f"{path.name} does not reproduce the identified torques: joint "
            f"{robot.joint_names[worst]} is off by {relative[worst]:.1e} relative (allowed "
            f"{TORQUE_TOLERANCE:.0e}); no model was written"
        )


PLACE = 1e-12
"""Largest deviation of the new body's place [m] and axes: some roundings of a quaternion."""
_NAMES = ("nnames", "nnames_map", "names", "names_map")
# Names and their places, and tables that list each body or number the pairs of them.
_BOOKKEEPING = {
    "nbody",
    "nB",
    *_NAMES,
    "tree_bodynum",
    "exclude_signature",
    "pair_signature",
}
_OF_NAMES = ("name_", "B_")


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


HORIZONS = (0.1, 0.3, 1.0, 3.0)
"""Lengths of time over which the models are played [s]."""
HELD_OUT_SHARE = 0.2
LAST_FIFTH = "the last fifth of every log, which was not fitted for it"
"""Part of each log, its end, that is not fitted: the fifth that cross-validation leaves out too."""
SERVO_WORDS = (
    f"measured torques and a critically damped servo of {playback.TRACKING_RATE:g} Hz towards the "
    "measured motion"
)


def play(
    robot: RobotModel,
    signals: Sequence[ProcessedSignals],
    write: Callable[[ModelTarget], object],
    mesh_dir: Path | None,
    since: Callable[[ProcessedSignals], float] = lambda log: -np.inf,
    held_out: str = "the validation log",
) -> RolloutTest:
    """Play logs with the model before and with the one that ``write`` writes, read from its file;
    return the figures, or why there are none.

    A log is played ``since`` some time on [s], ``split_time`` where the rest was fitted; what is
    ``held_out`` so is told in words.
    """
    try:
        pieces = [
            p for log in signals for p in playback.low_passed_pieces(log, since(log))
        ]
        checkpoints = signals[0].motion(signals[0].spread_indices(CHECKPOINTS))
        with temporary_folder() as folder:
            path = folder / MODEL_NAMES["mjcf"]  # what is in it tells its kind
            with atomic_files() as files:
                write(ModelTarget(files, path, checkpoints, 0.0, mesh_dir))
            after = load_robot_model(path, joint=robot.terminal_joint)
        return compare(robot, after, pieces, held_out)
    except (ExportError, InputError) as error:
        return RolloutTest(robot.joint_names, "held-out pieces", "", (), (str(error),))


def rollout_refusal(test: RolloutTest | None, accepted: Collection[str]) -> str | None:
    """Return why a model that was played must not be written, or None."""
    if test is None or test.is_better or "rollout" in accepted:
        return None
    worse = f"nothing could be played on held-out pieces ({'; '.join(test.notes)})"
    if test.score is not None:
        worse = "played on held-out pieces, the new model is not better than the old one (errors "
        worse += f"{test.score:.2f} times those before)"
    return f"no model was written: {worse}; to write it all the same: --accept rollout"


def compare(
    before: RobotModel, after: RobotModel, pieces: Sequence[Measurement], held_out: str
) -> RolloutTest:
    """Play two models of an arm on the same pieces."""
    errors = []
    notes = []
    servo = playback.tracking_servo((before, after), pieces) if pieces else None
    for horizon in HORIZONS:
        windows = playback.window_starts(pieces, horizon)
        if not windows:
            notes.append(f"no held-out piece is as long as {horizon:g} s")
            continue
        for loop, own in ((OPEN, None), (CLOSED, servo)):
            old, new = (
                playback.rollout_error(robot, windows, horizon, own)
                for robot in (before, after)
            )
            away = (old[1], new[1])
            errors.append(
                RolloutError(loop, horizon, len(windows), old[0], new[0], away)
            )
    notes += [
        f"{e.loop}, {e.horizon:g} s: {e.diverged[0]} of {e.windows} windows run away with the "
        f"model before, {e.diverged[1]} with the new one"
        for e in errors
        if any(e.diverged)
    ]
    return RolloutTest(
        before.joint_names, held_out, SERVO_WORDS, tuple(errors), tuple(notes)
    )


def split_time(signals: ProcessedSignals | Measurement) -> float:
    """Return from when on a log is held out [s]."""
    start = float(signals.time[0])
    end = float(signals.time[-1])
    return end - HELD_OUT_SHARE * (end - start)


def fitted_rows(signals: ProcessedSignals) -> NDArray[np.bool_]:
    """Return which decimated rows (K,) share no sample with what is held out."""
    reach = signals.low_pass.half_width / signals.rate
    return np.asarray(signals.decimated_time() < split_time(signals) - 2.0 * reach)


def torque_error(
    model: Path | Any, robot: RobotModel, signals: ProcessedSignals, source: str
) -> Validation:
    """Return the torque error of a model file, with each joint's sensor offset beside it alone.

    The model's inverse dynamics holds its links, gravity, rotor inertia, springs and all damping;
    its dry friction is Coulomb's. It passes the same low-pass as the measured torque. Of what is
    left, each joint's mean is taken out. The chain's joints have the robot's places in the model;
    InputError where its file cannot be loaded.
    """
    compiled = compile_model(model).mj_model if isinstance(model, Path) else model
    dynamics = ArmDynamics(robot, compiled)
    friction = joint_friction(compiled, robot.dof_index)

    def smooth(motion: Motion) -> tuple[Array]:
        return (
            dynamics.torque(motion.q, motion.qd, motion.qdd)
            + friction.viscous * motion.qd,
        )

    (predicted,) = signals.filter_columns(smooth, smooth=True)
    predicted += signals.low_pass.decimate(friction.dry(signals.qd))
    tau = signals.low_pass.decimate(signals.tau)
    usable = signals.usable()
    residual = np.where(usable, tau - predicted, 0.0)
    counts = np.count_nonzero(usable, axis=0)
    residual = np.where(
        usable, residual - np.sum(residual, axis=0) / np.maximum(counts, 1), 0.0
    )
    sizes = np.sum(np.where(usable, tau, 0.0) ** 2, axis=0)
    return validation_of(
        robot.joint_names, np.sum(residual**2, axis=0), sizes, counts, source
    )
