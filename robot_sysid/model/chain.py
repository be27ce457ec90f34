"""The joints of an arm: which is its last one, which joints carry it, their limits and friction.

The joints form a tree. A serial run is a path without branches; the arm is the longest serial run
of hinge and slide joints, and its last joint is the terminal one. Runs that branch off behind it
are fingers, and joints in line with it that are called like the jaw of a gripper are jaws; both are
held still. Where two runs could both be the arm, the user decides.

A model lets a base on wheels drive with two slide joints and a hinge. They carry the arm, but no
motor torque is measured at them and no trajectory should drive them; so they stay where they are.

A motor that turns several joints is a fixed tendon over them. MuJoCo lets it have rotor inertia
(``armature``), ``damping`` and dry friction (``frictionloss``), which follow its speed
sum_j coef_j qd_j and act on each joint times coef_j.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import AmbiguousJointError, ModelError
from robot_sysid.mjcf.urdf import free_joint_error
from robot_sysid.model.actuators import (
    driven_joints,
    tendon_coefficients,
    torque_limits,
)
from robot_sysid.records import Array, JointFriction, Limits
from robot_sysid.records.option_fields import PerJoint, joint_values
from robot_sysid.wording import option_name, option_setting

RIVAL_SHARE = 0.6
"""Share of the arm's joints from which another run of joints could be the arm: a head of two or
three joints beside a seven-joint arm is none, a run of five may be one."""
LEAST_MASS = 1e-3
"""Mass below which what a joint moves is no part of an arm [kg]: a gram."""
MOST_PLAY = 0.1
"""Widest range of a joint that is the play of gears [rad or m]: makers of small servos state 0.009
to 0.017 rad, and worn ones have three times as much."""
PARALLEL = 0.999
"""Least cosine between axes that are one."""
# Part of the name of a gripper's joint.
_JAW_JOINT = re.compile(r"grip|finger|jaw|claw|knuckle|pinch", re.IGNORECASE)
# Part of the name of a gripper's moving body.
_JAW_BODY = re.compile(r"finger|jaw|claw|knuckle", re.IGNORECASE)
# Part of the name of a joint that may turn a whole gripper.
_WRIST_JOINT = re.compile(r"wrist|roll|rot|yaw|pitch|tilt|turn|swivel", re.IGNORECASE)
# MuJoCo's type of a hinge joint.
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
# MuJoCo's type of a slide joint.
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
# MuJoCo's type of a joint that lets a body fly.
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
# Part of the errors on joints of other types.
_ONLY_THESE = "only hinge and slide joints can be identified"


def joint_label(mj_model: Any, joint: int) -> str:
    """Return the name of the joint with this id, or "#id" where it has none."""
    return mj_model.joint(joint).name or f"#{joint}"


def body_label(mj_model: Any, body: int) -> str:
    """Return the name of the body with this id, or "#id" where it has none."""
    return mj_model.body(body).name or f"#{body}"


def is_hinge_or_slide(mj_model: Any, joint: int) -> bool:
    """Return whether a joint has one degree of freedom."""
    return mj_model.jnt_type[joint] in (_HINGE, _SLIDE)


def chain_to(
    mj_model: Any, joint: int, first: int | None = None, fix_base: bool = False
) -> tuple[int, ...]:
    """Return the ids of all joints from the world to ``joint``, that one included.

    Args:
        mj_model: the compiled model.
        joint: id of the last one.
        first: id of the first one, where those before it stand still; None for all.
        fix_base: whether the base that a free joint carries stands still, with all before it.

    Raises:
        ModelError: there is a ball or free joint among them, or the first one does not carry the
            last.
    """
    chain = tuple(_towards_world(mj_model, joint))[::-1]
    if first is not None:
        if first not in chain:
            setting = option_setting("first_joint", joint_label(mj_model, first))
            listed = ", ".join(joint_label(mj_model, each) for each in chain)
            raise ModelError(
                f"{setting}: it does not carry joint {joint_label(mj_model, joint)}; these do: "
                f"{listed}"
            )
        chain = chain[chain.index(first) :]
    free = [each for each in chain if mj_model.jnt_type[each] == _FREE]
    if fix_base and free:
        chain = chain[chain.index(free[-1]) + 1 :]
    for link_joint in chain:
        if is_hinge_or_slide(mj_model, link_joint):
            continue
        label = joint_label(mj_model, link_joint)
        if link_joint in free:
            raise free_joint_error(label)
        raise ModelError(
            f"ball joint {label} is part of the chain to joint {joint_label(mj_model, joint)}; "
            f"{_ONLY_THESE}, so weld it or replace it"
        )
    return chain


def joints_before(mj_model: Any, joint: int) -> list[int]:
    """Return the ids of the joints between the world and a joint, from the world outwards."""
    return [*_towards_world(mj_model, joint)][:0:-1]


def _parent_joints(mj_model: Any) -> list[int]:
    """Return the id of the next joint towards the world of each joint (njnt,); -1 for none."""
    dofs = mj_model.dof_parentid[mj_model.jnt_dofadr]
    return np.where(dofs < 0, -1, mj_model.dof_jntid[dofs]).tolist()


def _towards_world(mj_model: Any, joint: int) -> Iterator[int]:
    """Yield the id of a joint, then those of all joints between it and the world."""
    parents = _parent_joints(mj_model)
    while joint >= 0:
        yield joint
        joint = parents[joint]


Run = tuple[int, ...]
"""Ids of joints on a path without branches, from the base outwards."""


def serial_runs(mj_model: Any) -> list[Run]:
    """Return all maximal serial runs of hinge and slide joints, by the ids of their joints.

    A joint continues the run of its parent, the next joint towards the world, where it is the only
    joint with this parent; otherwise it begins a run.
    """
    parents = _parent_joints(mj_model)
    # Last joint of a run to the run. A joint's id is higher than its parent's.
    runs: dict[int, Run] = {}
    for joint, parent in enumerate(parents):
        if is_hinge_or_slide(mj_model, joint):
            is_only_child = parents.count(parent) == 1
            run = runs.pop(parent, ()) if is_only_child else ()
            runs[joint] = (*run, joint)
    return sorted(runs.values())


def _runs_without_jaws(mj_model: Any) -> list[Run]:
    """Return the serial runs without the joints at their ends that are called like jaws.

    Runs that consist of jaws are left out; where all of them do, all are returned as they are. A
    joint whose name also says that it turns the whole gripper, such as "gripper_roll", stays.
    """
    all_runs = serial_runs(mj_model)
    runs = []
    for run in all_runs:
        end = len(run)
        while end and _looks_like_jaw(mj_model, run[end - 1]):
            if _WRIST_JOINT.search(joint_label(mj_model, run[end - 1])):
                break
            end -= 1
        if end:
            runs.append(run[:end])
    return runs or all_runs


def _looks_like_jaw(mj_model: Any, joint: int) -> bool:
    """Return whether a joint (id) or the body that it moves is called like a gripper's jaw."""
    body = body_label(mj_model, int(mj_model.jnt_bodyid[joint]))
    is_jaw_joint = _JAW_JOINT.search(joint_label(mj_model, joint))
    return bool(is_jaw_joint or _JAW_BODY.search(body))


def jaw_in_line(mj_model: Any, terminal: int) -> int | None:
    """Return the id of the only joint behind the terminal one if it is called like a jaw."""
    children = _child_joints(mj_model, terminal)
    is_jaw = len(children) == 1 and _looks_like_jaw(mj_model, children[0])
    return children[0] if is_jaw else None


def _child_joints(mj_model: Any, joint: int) -> list[int]:
    """Return the ids of the joints whose next joint towards the world is this one."""
    parents = enumerate(_parent_joints(mj_model))
    return [child for child, parent in parents if parent == joint]


def find_terminal_joint(mj_model: Any) -> int:
    """Return the id of the last joint of the longest serial run, the arm, without its jaws.

    AmbiguousJointError where the user has to decide: a run beside the arm (not behind it, nor
    between it and the world) has ``RIVAL_SHARE`` of its joints or more, or its last joint may be
    none of the arm's. ModelError where the model has no hinge or slide joints.
    """
    runs = _runs_without_jaws(mj_model)
    if not runs:
        raise ModelError(
            "the model has no hinge or slide joints, so there is no arm to identify"
        )
    # Run to the joints between it and the world.
    carriers = {run: {*_towards_world(mj_model, run[0])} - {run[0]} for run in runs}
    longest = max(map(len, runs))
    longest_runs = [run for run in runs if len(run) == longest]
    ends = {run[-1] for run in longest_runs}
    # Of two longest runs one behind the other, the arm is the one nearer to the world.
    arm = next(run for run in longest_runs if ends.isdisjoint(carriers[run]))
    rivals = [arm]
    for run in runs:
        is_in_line = {arm[-1], run[-1]} & (carriers[arm] | carriers[run])
        if run != arm and not is_in_line and len(run) >= RIVAL_SHARE * longest:
            rivals.append(run)
    if len(rivals) > 1:
        reason = f"{len(rivals)} serial chains of joints could be the arm"
        raise _ambiguity(mj_model, reason, [run[-1] for run in rivals])
    _require_end(mj_model, arm)
    return arm[-1]


def _require_end(mj_model: Any, arm: Run) -> None:
    """Raise AmbiguousJointError where the last joint of a run (joint ids) may not be the arm's.

    It may be the jaw of a gripper, or a joint without a motor. ModelError where a ball joint is
    behind it.
    """
    last = arm[-1]
    joint = joint_label(mj_model, last)
    children = _child_joints(mj_model, last)
    if len(children) == 1 and not is_hinge_or_slide(mj_model, children[0]):
        raise ModelError(
            f"ball joint {joint_label(mj_model, children[0])} is part of the chain; {_ONLY_THESE}, "
            f"so weld it, or hold it where it is with {option_setting('joint', joint)}"
        )
    if len(arm) > 1 and _looks_like_jaw(mj_model, last):
        reason = f"the last joint {joint} looks like the jaw of a gripper"
        raise _ambiguity(mj_model, reason, arm[-2:])
    driven = driven_joints(mj_model)
    driven_of_arm = [j for j in arm if j in driven]
    if driven_of_arm and last not in driven:
        reason = f"the last joint {joint} has no actuator, but others do"
        raise _ambiguity(mj_model, reason, (driven_of_arm[-1], last))


def _ambiguity(
    mj_model: Any, reason: str, joints: Sequence[int]
) -> AmbiguousJointError:
    """Return the error that lists the joints (ids) which could be the terminal one."""
    candidates = []
    for joint in joints:
        body = int(mj_model.jnt_bodyid[joint])
        candidates.append((joint_label(mj_model, joint), body_label(mj_model, body)))
    return AmbiguousJointError(reason, candidates)


def resolve_joint(mj_model: Any, name: str, key: str = "joint") -> int:
    """Return the id of the joint called ``name`` ("#3" for a nameless one).

    ModelError, which names the option with this key, where there is none, which lists the hinges
    and slides there are, or where a later joint moves the same body.
    """
    matches = []
    usable = []
    for joint in range(mj_model.njnt):
        label = joint_label(mj_model, joint)
        if label == name:
            matches.append(joint)
        if is_hinge_or_slide(mj_model, joint):
            usable.append(label)
    setting = option_setting(key, name)
    if not matches:
        listed = ", ".join(usable) or "none"
        raise ModelError(f"{setting}: no such joint; the model has: {listed}")
    # A model may call a joint "#3" though the nameless joint 3 is before it.
    joint = matches[-1]
    if key != "joint":
        return joint
    body = mj_model.jnt_bodyid[joint]
    last = int(mj_model.body_jntadr[body] + mj_model.body_jntnum[body]) - 1
    if last != joint:
        label = joint_label(mj_model, last)
        fault = f"joint {label} moves the same body after it"
        raise ModelError(f"{setting}: {fault}; choose {label}")
    return joint


def refuse_play(mj_model: Any) -> None:
    """Raise ModelError where joints are the play of others, by their ids.

    Such a joint is in one body with another one, about the same axis and without a motor, and
    turns by next to nothing: a model for policies has one for each motor with cheap gears.
    """
    driven = driven_joints(mj_model)
    found = [
        joint_label(mj_model, joint)
        for joint in range(1, mj_model.njnt)
        if is_hinge_or_slide(mj_model, joint)
        and mj_model.jnt_bodyid[joint] == mj_model.jnt_bodyid[joint - 1]
        and mj_model.jnt_type[joint] == mj_model.jnt_type[joint - 1]
        and abs(mj_model.jnt_axis[joint] @ mj_model.jnt_axis[joint - 1]) > PARALLEL
        and mj_model.jnt_limited[joint]
        and np.ptp(mj_model.jnt_range[joint]) < MOST_PLAY
        and joint not in driven
    ]
    if found:
        raise ModelError(
            f"{', '.join(found)}: the model has a joint for the play of its gears, beside the one "
            "that the motor turns; no encoder reads it, so no log has it. Remove these <joint> "
            "elements from a copy of the model and take that; how wide the dead zone of each servo "
            "is comes from positions and goals"
        )


def arm_without_base(mj_model: Any, chain: tuple[int, ...]) -> tuple[int, ...]:
    """Return a chain (joint ids, outwards) without the joints of a mobile base at its beginning.

    Those are two slides and a hinge, which are unlimited or begin with a slide that moves nothing
    of mass, as none of a gantry does; as many joints must remain for an arm.
    """
    base = list(chain[:3])
    is_planar = sorted(mj_model.jnt_type[base]) == sorted((_SLIDE, _SLIDE, _HINGE))
    is_limited = np.any(mj_model.jnt_limited[base])
    is_virtual = _moves_nothing(mj_model, base[0]) and not _moves_nothing(
        mj_model, chain[-1]
    )
    is_base = len(chain) >= 6 and is_planar and (not is_limited or is_virtual)
    return chain[3:] if is_base else chain


def _moves_nothing(mj_model: Any, joint: int) -> bool:
    """Return whether what a joint moves, up to the next ones, has next to no mass."""
    body = mj_model.jnt_bodyid[joint]
    is_own = mj_model.body_weldid == mj_model.body_weldid[body]
    return bool(np.sum(mj_model.body_mass[is_own]) < LEAST_MASS)


DEFAULT_SLIDE_VELOCITY = 0.25
"""Speed limit of slide joints [m/s]: the one that ISO 10218-1 calls reduced."""


def joint_limits(
    mj_model: Any,
    joints: tuple[int, ...],
    max_velocity: PerJoint,
    model_velocities: Sequence[float | None],
) -> Limits:
    """Return the limits of joints.

    Args:
        mj_model: the compiled model.
        joints: ids of the n joints.
        max_velocity: speed limit of hinges, one number or one per joint [rad/s]; slides have at
            most DEFAULT_SLIDE_VELOCITY [m/s].
        model_velocities: (n,) speed limits that the model file states [rad/s or m/s], None for
            none; the lower of both counts.
    """
    index = np.array(joints)
    has_range = mj_model.jnt_limited[index].astype(bool)
    is_slide = mj_model.jnt_type[index] == _SLIDE
    limits = joint_values(max_velocity, len(joints), option_name("max_velocity"))
    limits[is_slide] = np.minimum(DEFAULT_SLIDE_VELOCITY, limits[is_slide])
    return Limits(
        lower=np.where(has_range, mj_model.jnt_range[index, 0], -np.inf),
        upper=np.where(has_range, mj_model.jnt_range[index, 1], np.inf),
        velocity=np.fmin(limits, np.array(model_velocities, dtype=float)),
        torque=torque_limits(mj_model, joints),
    )


def shared_motors(mj_model: Any, dofs: NDArray[np.int64]) -> dict[int, Array]:
    """Return the fixed tendons over two or more joints of a chain, and over no other joint.

    Args:
        mj_model: the compiled model.
        dofs: (n,) addresses of the chain's joints in qvel.

    Returns:
        Tendon id to the tendon's speed per speed of each joint (n,).
    """
    motors = {}
    for tendon in range(mj_model.ntendon):
        coefficients = tendon_coefficients(mj_model, tendon)
        ratios = coefficients[dofs]
        n_joints = np.count_nonzero(coefficients)
        if n_joints > 1 and np.count_nonzero(ratios) == n_joints:
            motors[tendon] = ratios
    return motors


def joint_friction(mj_model: Any, dofs: NDArray[np.int64]) -> JointFriction:
    """Return the friction of a chain whose joints have these addresses (n,) in qvel."""
    motors = shared_motors(mj_model, dofs)
    # (m, n) for m shared motors, of which there may be none.
    ratios = np.array(list(motors.values())).reshape(-1, len(dofs))
    torques = mj_model.tendon_frictionloss[list(motors)][:, None] * ratios
    # Motors without dry friction are left out.
    return JointFriction(
        mj_model.dof_frictionloss[dofs],
        mj_model.dof_damping[dofs],
        torques[np.any(torques, axis=1)],
    )
