"""Writing what was identified into a model: links, joints and gravity, and a payload on top.

Each model is compiled again and compared before it counts: the written numbers are there, nothing
else has changed, and it takes the torques that the identification predicts. With its meshes and
textures in one folder, a bundle, it can be sent to somebody.
"""

from __future__ import annotations

import itertools
import os
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robot_sysid import __version__
from robot_sysid.dynamics.inverse_dynamics import MUJOCO_VERSION
from robot_sysid.errors import ExportError, InputError, delay_signals
from robot_sysid.mjcf.assets import bundled_text, find_assets
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.inertial import WriteBack, plan_write_back, setting_number
from robot_sysid.mjcf.updated_model import (
    ActuatorChange,
    BodyChange,
    JointChange,
    ModelChange,
    TendonChange,
    WeldedBody,
    changed_model_text,
)
from robot_sysid.model.chain import body_label
from robot_sysid.model.compilation import compile_model, file_of
from robot_sysid.model.flange import place_in_carrier
from robot_sysid.model.inertia import body_theta, link_bodies
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, RobotModel, SubtreeBody
from robot_sysid.records.file_access import draft_folder, lock_folder
from robot_sysid.records.messages import Detail, with_error
from robot_sysid.results import verification
from robot_sysid.results.record import ModelFile, ModelTarget, Payload, Quantity, Result

_MOMENTS = [4, 7, 9]
_IN_MJCF = {"armature": "armature", "viscous": "damping", "coulomb": "frictionloss"}
_NOT_IN_URDF = {"rotor inertia": "armature", "nonlinear damping": "polynomial"}
_ONLY_MUJOCO = Detail(
    "the written URDF states gravity in its <mujoco> part, which MuJoCo reads and other readers "
    "ignore"
)


def write_model(
    result: Result, target: ModelTarget, as_body: str | None = None
) -> tuple[str, ...]:
    """Write a model with what was identified: what ``result.file`` holds, and the payload on top.

    Links that are the model's own to the last digit are left alone. Where there is no
    ``result.file``, a payload is written onto the model's own links, or else the terminal link
    alone. The payload gets a body of its own where that is named. Returns notes, one sentence each,
    or raises ExportError where the model cannot hold it; the draft is withdrawn.
    """
    thetas, errors = _links(result)
    robot = result.robot
    if result.model_kind != robot.kind:
        robot = _arm_as_mjcf(robot, target.mesh_dir)
        target = replace(target, mesh_dir=None)
    found = {} if result.file is None else result.file.joints
    joints, notes = _that_fit(robot, _joint_changes(robot, found))
    payload = result.payload
    welded = None
    words = ""
    beside = np.zeros(10)
    if payload is not None:
        carried = payload.flange.from_flange(payload.body.inertial.theta)
        mass = payload.body.inertial.mass
        words = f"a payload of {with_error(mass, payload.body.errors[0], 'kg')}"
        words += "" if np.all(payload.body.is_determined) else ", inertia not known,"
        if as_body is not None:
            welded = _welded(robot, payload, as_body, words)
            beside = carried
            words = "without the payload"
        else:
            thetas[-1] += carried
            errors[-1] = payload.total.errors
            words = f"with {words} in it"
    if result.model_kind == "urdf" and result.couplings:
        lacking = f"without the motor that turns with {', '.join(result.couplings)}"
        words = "; ".join(filter(None, (words, f"{lacking}, which no URDF can hold")))
    bodies, held = _body_changes(robot, thetas, errors, joints, words)
    held[-1] += beside
    tendons = () if result.file is None else tuple(_tendon_changes(robot, result.file))
    change = ModelChange(bodies, target.rmse, joints, welded, tendons=tendons)
    if result.file is not None and result.file.gravity is not None:
        x, y, z = (float(value) for value in result.file.gravity)
        change = replace(change, gravity=(x, y, z))
        notes += (_ONLY_MUJOCO,) if robot.kind == "urdf" else ()
    return notes + _write(robot, change, target, held)


def _arm_as_mjcf(robot: RobotModel, mesh_dir: Path | None) -> RobotModel:
    """Return the arm of a URDF as that of an MJCF, which MuJoCo writes with six digits of each
    number; ExportError where it cannot.
    """
    try:
        path = file_of(compile_model(robot.path, mesh_dir).mj_model)
        return load_robot_model(path, joint=robot.terminal_joint)
    except InputError as error:
        raise ExportError(
            f"{robot.path} cannot be written as an MJCF: {error}"
        ) from None


def write_joints(
    robot: RobotModel,
    joints: Sequence[JointChange],
    actuators: Sequence[ActuatorChange],
    target: ModelTarget,
) -> tuple[str, ...]:
    """Write a model with new numbers for its joints and servos; errors as in ``write_model``."""
    fitting, notes = _that_fit(robot, joints)
    change = ModelChange((), target.rmse, fitting, None, tuple(actuators))
    return notes + _write(robot, change, target, robot.thetas)


def most_inflated(errors: Array) -> float:
    """Return how far moments of inertia may be inflated: within their standard errors (10,)."""
    return min(
        (float(e) for e in np.asarray(errors)[_MOMENTS] if np.isfinite(e)), default=0.0
    )


def _links(result: Result) -> tuple[Array, Array]:
    """Return what the links get without the payload and its standard errors, both (n, 10)."""
    if result.file is not None:
        return result.file.thetas.copy(), result.file.errors.copy()
    thetas = result.robot.thetas
    errors = np.full(thetas.shape, np.inf)
    if result.payload is not None:
        return thetas, errors
    thetas[-1] = result.estimate.inertial.theta
    if result.estimate.standard_errors is not None:
        errors[-1] = result.estimate.standard_errors[:10]
    return thetas, errors


def _joint_changes(
    robot: RobotModel, joints: Mapping[str, Mapping[str, Quantity]]
) -> tuple[JointChange, ...]:
    own = dict(zip(robot.joint_names, robot.friction.viscous.tolist()))
    changes = []
    for joint in filter(joints.__contains__, robot.joint_names):
        terms = joints[joint]
        values = {term: figure.value for term, figure in terms.items()}
        polynomial = None
        if "quadratic" in values or "cubic" in values:
            polynomial = values.get("quadratic", 0.0), values.get("cubic", 0.0)
            # One attribute holds all three numbers, so that the one that stays is written again.
            values.setdefault("viscous", own[joint])
        numbers = {name: values.get(term) for term, name in _IN_MJCF.items()}
        words = _words_of(terms)
        changes.append(
            JointChange(joint, **numbers, polynomial=polynomial, words=words)
        )
    return tuple(changes)


def _words_of(terms: Mapping[str, Quantity]) -> str:
    """Return what a comment says of some terms of friction."""
    return ", ".join(
        f"{_IN_MJCF.get(term, f'{term} damping')} {figure.value:.4g}"
        + (f" ± {figure.error:.2g}" if np.isfinite(figure.error) else "")
        for term, figure in terms.items()
    )


def _tendon_changes(robot: RobotModel, file: ModelFile) -> Iterator[TendonChange]:
    """Yield the motors that turn several joints, as tendons."""
    following = itertools.count(robot.mj_model.ntendon)
    for motor in file.motors:
        terms = file.joints.get(motor.name, {})
        ratios = zip(robot.joint_names, motor.ratios.tolist())
        yield TendonChange(
            tendon=next(following) if motor.tendon is None else motor.tendon,
            is_new=motor.tendon is None,
            coefficients={joint: ratio for joint, ratio in ratios if ratio != 0.0},
            numbers={_IN_MJCF[term]: figure.value for term, figure in terms.items()},
            words=_words_of(terms),
        )


def _that_fit(
    robot: RobotModel, joints: Sequence[JointChange]
) -> tuple[tuple[JointChange, ...], tuple[str, ...]]:
    """Return the changes that the kind of file can hold, and a note on what it cannot."""
    if robot.kind != "urdf":
        return tuple(joints), ()
    lost = [
        what
        for what, name in _NOT_IN_URDF.items()
        if any(np.any(getattr(change, name) or 0.0) for change in joints)
    ]
    kept = (replace(each, armature=None, polynomial=None, words="") for each in joints)
    note = f"a URDF cannot hold {' or '.join(lost)}, so the written model lacks it"
    return tuple(kept), (note,) if lost else ()


def _body_changes(
    robot: RobotModel,
    thetas: Array,
    errors: Array,
    joints: Sequence[JointChange],
    addition: str,
) -> tuple[tuple[BodyChange, ...], Array]:
    """Return (what the bodies get, the links (n, 10) as they are then)."""
    bodies = [link.body_id for link in robot.links]
    changes: list[BodyChange] = []
    bound = setting_number(read_document(robot.path), "boundinertia")
    held = np.array(thetas, dtype=float)
    written = [
        k for k, link in enumerate(robot.links) if np.any(thetas[k] != link.theta)
    ]
    words = _joint_words(robot, written, joints)
    words[len(bodies) - 1][:0] = [addition] if addition else []
    for k in written:
        link = robot.links[k]
        parts = link_bodies(
            robot.mj_model, robot.reference_qpos, link.body_id, bodies[k + 1 :]
        )
        if not parts:
            raise ExportError(
                f"joint {robot.joint_names[k]} moves no link of its own, because a later joint "
                f"moves body '{link.body_name}' too; its parameters belong to that joint's link"
            )
        plan = plan_write_back(thetas[k], parts, bound, most_inflated(errors[k]))
        held[k] = plan.written_composite(thetas[k])
        changes.append(
            BodyChange(link.body_name, link.body_id, plan, "; ".join(words[k]) or None)
        )
        scaled = f"mass and inertia {plan.scale:.4g} of the model's, for want of room in its link"
        for part in plan.lightened:
            rest = WriteBack(plan.scale * body_theta(robot.mj_model, part.body_id))
            changes.append(BodyChange(part.name, part.body_id, rest, scaled))
    return tuple(changes), held


def _joint_words(
    robot: RobotModel, written: Sequence[int], joints: Sequence[JointChange]
) -> list[list[str]]:
    """Return what each link's comment says of joints; the last one's of those without any."""
    place = {robot.links[k].body_id: k for k in written}
    body = {name: link.body_id for name, link in zip(robot.joint_names, robot.links)}
    words: list[list[str]] = [[] for _ in robot.links]
    for change in joints:
        what = change.words or ", ".join(change.numbers)
        if what and change.label in body:
            words[place.get(body[change.label], -1)].append(
                f"{what} of joint '{change.label}'"
            )
    return words


def _welded(robot: RobotModel, payload: Payload, name: str, words: str) -> WeldedBody:
    flange = payload.flange
    rotation, translation = place_in_carrier(robot, flange)
    carrier = body_label(robot.mj_model, flange.carrier)
    nothing = SubtreeBody(0, name, np.zeros(10), True)
    theta = plan_write_back(payload.body.inertial.theta, [nothing]).theta
    return WeldedBody(
        name, carrier, rotation, translation, theta, f"{words} at {flange.name}"
    )


def _write(
    robot: RobotModel, change: ModelChange, target: ModelTarget, thetas: Array
) -> tuple[str, ...]:
    """Write the draft and compare it, compiled, with links (n, 10); withdraw it where it fails."""
    welded = change.welded
    written = [body.plan.theta for body in change.bodies]
    written += [] if welded is None else [welded.theta]
    exact = all(map(verification.reads_fullinertia_exactly, written))
    change = replace(change, principal=not exact)
    text = changed_model_text(
        robot.path, change, target.path.absolute().parent, target.mesh_dir
    )
    try:
        draft = target.files.write(target.path, text)
        compiled = verification.verify_written_model(
            robot.mj_model, draft, change
        ).mj_model
        motion = target.checkpoints
        path = target.path
        verification.require_reproduction(robot, thetas, change, compiled, motion, path)
    except BaseException:
        target.files.withdraw(target.path)
        raise
    plans = [body.plan for body in change.bodies]
    return tuple(
        p.note if p.emptied or p.lightened else Detail(p.note) for p in plans if p.note
    )


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {
        "robot_sysid": __version__,
        "mujoco": MUJOCO_VERSION,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


BUNDLE_NAME = "bundle"
ASSETS = "assets"
"""Folder in the output folder, and the folder in it that meshes and textures go to."""


def write_bundle(model: Path, folder: Path) -> Path:
    """Copy a written model and all files it refers to into its output folder's bundle, in place of
    an earlier one, and load it from there; returns the model in the bundle.

    Raises:
        ExportError: it refers to another model, or the copy does not load as the same model.
        InputError: a file cannot be copied, or another run has the folder.
    """
    place = folder / BUNDLE_NAME
    try:
        with (
            lock_folder(folder),
            draft_folder(place) as draft,
            draft_folder(place) as earlier,
        ):
            text, names = _bundled(model, f"{ASSETS}/")
            (draft / ASSETS).mkdir()
            for source, name in names.items():
                shutil.copyfile(source, draft / name)
            (draft / model.name).write_bytes(text)
            again = verification.compiled_again(draft / model.name).mj_model
            verification.require_same_model(compile_model(model).mj_model, again, {})
            _put_in_place(draft, place, earlier / BUNDLE_NAME)
    except OSError as error:
        raise InputError(
            f"--bundle: cannot write {place}: {error.strerror or error}"
        ) from None
    return place / model.name


def _put_in_place(draft: Path, place: Path, earlier: Path) -> None:
    """Move a finished folder to its place, and what stands there out of the way."""
    with delay_signals():
        if os.path.lexists(place):
            os.replace(place, earlier)
        os.replace(draft, place)


def model_in_memory(model: Path) -> Any:
    """Return a model and all files it refers to as a ``mujoco.MjSpec`` that needs no files, or
    raise ExportError where it refers to another model, or this MuJoCo is older than 3.2.
    """
    if not hasattr(mujoco, "MjSpec"):
        raise ExportError(
            f"a spec needs MuJoCo 3.2 or later, not {mujoco.__version__}; use save()"
        )
    text, names = _bundled(model, "")
    assets = {name: path.read_bytes() for path, name in names.items()}
    return mujoco.MjSpec.from_string(text.decode("utf-8"), assets=assets)


def _bundled(model: Path, folder: str) -> tuple[bytes, dict[Path, str]]:
    """Return (the text of a model that stands beside its assets, file to its name there)."""
    document = read_document(model)
    assets = find_assets(document)
    if any(asset.node.tag == "model" for asset in assets):
        raise ExportError(
            "--bundle: the model attaches other model files (<model file=...>), which a bundle "
            "cannot hold; send the folders as they are"
        )
    names: dict[Path, str] = {}
    for path in dict.fromkeys(asset.path for asset in assets if asset.path is not None):
        # Two files never get one name, not even on a disk that knows no capital letters.
        taken = {other.lower() for other in names.values()}
        number = 1
        name = path.name
        while f"{folder}{name}".lower() in taken:
            number += 1
            name = f"{path.stem}_{number}{path.suffix}"
        names[path] = f"{folder}{name}"
    return bundled_text(document, names), names
