"""Which joint is the arm's last one, which joints carry it, and what each of them may do.

The joints form a tree. A serial run is a path without branches; the arm is the longest serial run
of hinge and slide joints, and its last joint is the terminal one. What branches off behind it are
fingers. Where two runs could both be the arm, or the last joint looks like a jaw, the user decides.

A model lets a base on wheels drive with two slide joints and a hinge. They carry the arm, but no
motor torque is measured at them and no trajectory should drive them; so they stay where they are.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.errors import AmbiguousJointError, ModelError
from robot_sysid.records import Array, JointFriction, JointLimits
from robot_sysid.records.option_fields import PerJoint, joint_values

_JAW_JOINT = re.compile(r"grip|finger|jaw|claw|knuckle|pinch", re.IGNORECASE)
_JAW_BODY = re.compile(r"finger|jaw|claw|knuckle", re.IGNORECASE)
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_AT_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_ONLY_THESE = "only hinge and slide joints can be identified"
RIVAL_SHARE = 0.6
"""A run beside the longest one that has at least this share of its joints may be an arm too: a head
of two or three joints beside a seven-joint arm is none, an arm of five is."""


def joint_label(mj_model: Any, joint: int) -> str:
    """Return the joint's name, or "#id" where it has none."""
    return (
        mujoco.mj_id2name(mj_model, int(mujoco.mjtObj.mjOBJ_JOINT), joint)
        or f"#{joint}"
    )


def body_label(mj_model: Any, body: int) -> str:
    """Return the body's name, or "#id" where it has none."""
    return (
        mujoco.mj_id2name(mj_model, int(mujoco.mjtObj.mjOBJ_BODY), body) or f"#{body}"
    )


def is_hinge_or_slide(mj_model: Any, joint: int) -> bool:
    """Tell whether a joint has one degree of freedom."""
    return int(mj_model.jnt_type[joint]) in (_HINGE, _SLIDE)


def chain_to(mj_model: Any, joint: int) -> tuple[int, ...]:
    """Return the ids of all joints from the world to ``joint``, that one included; ModelError where
    there is a ball or free joint among them.
    """
    chain = tuple(_towards_world(mj_model, joint))[::-1]
    for member in chain:
        if not is_hinge_or_slide(mj_model, member):
            kind = (
                mujoco.mjtJoint(int(mj_model.jnt_type[member]))
                .name[len("mjJNT_") :]
                .lower()
            )
            raise ModelError(
                f"{kind} joint {joint_label(mj_model, member)} is part of the chain to joint "
                f"{joint_label(mj_model, joint)}; {_ONLY_THESE}, so weld it or replace it"
            )
    return chain


def _parent(mj_model: Any, joint: int) -> int | None:
    """Return the next joint towards the world, or None."""
    dof = int(mj_model.dof_parentid[mj_model.jnt_dofadr[joint]])
    return None if dof < 0 else int(mj_model.dof_jntid[dof])


def _towards_world(mj_model: Any, joint: int | None) -> Iterator[int]:
    """Yield a joint and all between it and the world."""
    while joint is not None:
        yield joint
        joint = _parent(mj_model, joint)


Run = tuple[int, ...]
"""Joints on a path without branches, from the base outwards."""


def serial_runs(mj_model: Any) -> list[Run]:
    """Return all maximal serial runs of hinge and slide joints."""
    parents = [_parent(mj_model, joint) for joint in range(mj_model.njnt)]
    # By their last joints. A joint comes after those that carry it; a run goes on where it is the
    # only one behind the last.
    runs: dict[int | None, Run] = {}
    for joint, parent in enumerate(parents):
        if is_hinge_or_slide(mj_model, joint):
            before = runs.pop(parent, ()) if parents.count(parent) == 1 else ()
            runs[joint] = (*before, joint)
    return sorted(runs.values())


def find_terminal_joint(mj_model: Any) -> int:
    """Return the id of the arm's last joint; AmbiguousJointError where several could be meant."""
    runs = serial_runs(mj_model)
    if not runs:
        raise ModelError(
            "the model has no hinge or slide joints, so there is no arm to identify"
        )
    carriers = {run: set(_towards_world(mj_model, run[0])) - {run[0]} for run in runs}
    longest = max(map(len, runs))
    tops = [run for run in runs if len(run) == longest]
    arm = next(
        run for run in tops if not any(other[-1] in carriers[run] for other in tops)
    )
    beside = [
        r
        for r in runs
        if r != arm and not {arm[-1], r[-1]} & (carriers[arm] | carriers[r])
    ]
    rivals = [arm, *(run for run in beside if len(run) >= RIVAL_SHARE * longest)]
    if len(rivals) > 1:
        # Their ends, and what all of them hang on.
        trunks = [
            run for run in runs if all(run[-1] in carriers[rival] for rival in rivals)
        ]
        ends = [run[-1] for run in [*trunks, *rivals]]
        raise _doubt(
            mj_model, f"{len(rivals)} serial chains of joints could be the arm", ends
        )
    _require_end(mj_model, arm)
    return arm[-1]


def _require_end(mj_model: Any, arm: Run) -> None:
    """Raise where the last joint of a run may not be the arm's: a jaw, a loose tool, a ball."""
    last = arm[-1]
    joint = joint_label(mj_model, arm[-1])
    behind = [j for j in range(mj_model.njnt) if _parent(mj_model, j) == last]
    if len(behind) == 1 and not is_hinge_or_slide(mj_model, behind[0]):
        raise ModelError(
            f"ball joint {joint_label(mj_model, behind[0])} is part of the chain; {_ONLY_THESE}, "
            f"so weld it, or hold it where it is with --joint {joint}"
        )
    body = body_label(mj_model, int(mj_model.jnt_bodyid[last]))
    if len(arm) > 1 and (_JAW_JOINT.search(joint) or _JAW_BODY.search(body)):
        raise _doubt(
            mj_model,
            f"the last joint {joint} looks like the jaw of a gripper",
            arm[-2:],
        )
    driven = driven_joints(mj_model)
    with_motor = [each for each in arm if each in driven]
    if with_motor and last not in driven:
        reason = f"the last joint {joint} has no actuator, but others do"
        raise _doubt(mj_model, reason, (with_motor[-1], last))


def _doubt(mj_model: Any, reason: str, joints: Sequence[int]) -> AmbiguousJointError:
    bodies = (body_label(mj_model, int(mj_model.jnt_bodyid[joint])) for joint in joints)
    names = (joint_label(mj_model, joint) for joint in joints)
    return AmbiguousJointError(reason, list(zip(names, bodies)))


def driven_joints(mj_model: Any) -> set[int]:
    """Return the ids of joints that an actuator moves, directly, by a tendon or by a coupling."""
    joints: set[int] = set()
    for transmission, target in zip(
        mj_model.actuator_trntype, mj_model.actuator_trnid[:, 0]
    ):
        if int(transmission) in _AT_JOINT:
            joints.add(int(target))
        elif int(transmission) == int(mujoco.mjtTrn.mjTRN_TENDON):
            first = int(mj_model.tendon_adr[target])
            wraps = slice(first, first + int(mj_model.tendon_num[target]))
            of_joints = mj_model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)
            joints.update(mj_model.wrap_objid[wraps][of_joints].tolist())
    coupled = mj_model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)
    for pair in zip(mj_model.eq_obj1id[coupled], mj_model.eq_obj2id[coupled]):
        if joints.intersection(pair):
            joints.update(int(joint) for joint in pair)
    return joints


def resolve_joint(mj_model: Any, name: str) -> int:
    """Return the id of the joint called ``name`` ("#3" for a nameless one), or raise ModelError
    where there is none (lists those there are) or it cannot be terminal.
    """
    usable = [j for j in range(mj_model.njnt) if is_hinge_or_slide(mj_model, j)]
    labels = {joint_label(mj_model, j): j for j in range(mj_model.njnt)}
    if name not in labels:
        known = ", ".join(joint_label(mj_model, j) for j in usable) or "none"
        raise ModelError(f"--joint {name}: no such joint; the model has: {known}")
    joint = labels[name]
    body = mj_model.jnt_bodyid[joint]
    last = int(mj_model.body_jntadr[body] + mj_model.body_jntnum[body]) - 1
    if last != joint:
        after = joint_label(mj_model, last)
        fault = f"joint {after} moves the same body after it; choose {after}"
        raise ModelError(f"--joint {name}: {fault}")
    return joint


_BASE = 3
_LEAST_ARM = 3
"""Joints of a base (two directions and a turn), and those that must remain for the rest to be an
arm; three can show all ten parameters."""
_PERPENDICULAR = 1e-6
"""Cosine of what counts as a right angle: axes from CAD are straight to six digits."""


def arm_without_base(mj_model: Any, chain: tuple[int, ...]) -> tuple[int, ...]:
    """Return a chain (joint ids, outwards) without the joints of a mobile base at its beginning.

    Those are two slides and a hinge normal to each other, all unlimited.
    """
    first = list(chain[:_BASE])
    is_planar = sorted(mj_model.jnt_type[first]) == sorted((_SLIDE, _SLIDE, _HINGE))
    if (
        len(chain) < _BASE + _LEAST_ARM
        or not is_planar
        or np.any(mj_model.jnt_limited[first])
    ):
        return chain
    axes = data_at_pose(mj_model, mj_model.qpos0).xaxis[first]
    square = np.max(np.abs(axes @ axes.T - np.eye(_BASE))) <= _PERPENDICULAR
    return chain[_BASE:] if square else chain


DEFAULT_SLIDE_VELOCITY = 0.25
"""Speed limit of slide joints [m/s]: the one that ISO 10218-1 calls reduced."""


def joint_limits(
    mj_model: Any,
    joints: tuple[int, ...],
    max_velocity: PerJoint,
    stated: Sequence[float | None],
) -> JointLimits:
    """Return the limits of some joints: ``max_velocity`` [rad/s] is for hinges, one number or one
    per joint; ``stated`` what the model file says of each joint's speed, or None.
    """
    index = np.array(joints)
    limited = mj_model.jnt_limited[index].astype(bool)
    slide = mj_model.jnt_type[index] == _SLIDE
    asked = joint_values(max_velocity, len(joints), "--max-velocity")
    usual = np.where(slide, np.minimum(DEFAULT_SLIDE_VELOCITY, asked), asked)
    return JointLimits(
        lower=np.where(limited, mj_model.jnt_range[index, 0], -np.inf),
        upper=np.where(limited, mj_model.jnt_range[index, 1], np.inf),
        velocity=np.fmin(usual, np.array(stated, dtype=float)),
        torque=np.array([_torque_limit(mj_model, joint) for joint in joints]),
    )


def _torque_limit(mj_model: Any, joint: int) -> float:
    """Return the symmetric torque limit of a joint: its own, or what all actuators on it can give
    together; infinite where the model names none.
    """
    limited = mj_model.jnt_actfrclimited[joint]
    own = _symmetric(mj_model.jnt_actfrcrange[joint]) if limited else np.inf
    limits = [
        abs(float(mj_model.actuator_gear[a, 0])) * _force_limit(mj_model, a)
        for a in actuators_on(mj_model, joint)
    ]
    return min(own, sum(limits) if limits else np.inf)


def actuators_on(mj_model: Any, joint: int) -> list[int]:
    """Return the ids of the actuators that pull at a joint directly."""
    direct = np.isin(mj_model.actuator_trntype, _AT_JOINT)
    return [
        int(a)
        for a in np.flatnonzero(direct & (mj_model.actuator_trnid[:, 0] == joint))
    ]


def _force_limit(mj_model: Any, actuator: int) -> float:
    """Return the largest force of one actuator: its forcerange, or a motor's gain x ctrlrange."""
    if mj_model.actuator_forcelimited[actuator]:
        return _symmetric(mj_model.actuator_forcerange[actuator])
    fixed = int(mj_model.actuator_gaintype[actuator]) == int(
        mujoco.mjtGain.mjGAIN_FIXED
    )
    pure = int(mj_model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_NONE)
    if mj_model.actuator_ctrllimited[actuator] and fixed and pure:
        gain = abs(float(mj_model.actuator_gainprm[actuator, 0]))
        return gain * _symmetric(mj_model.actuator_ctrlrange[actuator])
    return np.inf


def _symmetric(bounds: Array) -> float:
    """Return the largest magnitude allowed in both directions; a 0 bound means no limit."""
    value = float(min(-bounds[0], bounds[1]))
    return value if value > 0.0 else np.inf


CAN_HOLD_ROTORS = hasattr(mujoco.MjModel, "tendon_armature")
"""Whether tendons have rotor inertia: since MuJoCo 3.2.7."""


def shared_motors(mj_model: Any, dofs: NDArray[np.int64]) -> dict[int, Array]:
    """Return tendon id to its speed per joint speed (n,), of each fixed tendon over two or more
    joints of a chain with these addresses (n,) in qvel, and over no other joint.
    """
    ratios = {}
    for tendon in range(mj_model.ntendon):
        first = int(mj_model.tendon_adr[tendon])
        wraps = slice(first, first + int(mj_model.tendon_num[tendon]))
        coefficients = np.zeros(mj_model.nv)
        if np.all(mj_model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)):
            joints = mj_model.wrap_objid[wraps]
            np.add.at(
                coefficients, mj_model.jnt_dofadr[joints], mj_model.wrap_prm[wraps]
            )
        of_chain = coefficients[dofs]
        if np.count_nonzero(of_chain) == np.count_nonzero(coefficients) > 1:
            ratios[tendon] = of_chain
    return ratios


def joint_friction(mj_model: Any, dofs: NDArray[np.int64]) -> JointFriction:
    """Return the friction of a chain whose joints have these addresses (n,) in qvel."""
    motors = shared_motors(mj_model, dofs)
    shared = [
        float(mj_model.tendon_frictionloss[k]) * ratios for k, ratios in motors.items()
    ]
    return JointFriction(
        mj_model.dof_frictionloss[dofs],
        mj_model.dof_damping[dofs],
        np.array([torque for torque in shared if np.any(torque)]).reshape(
            -1, len(dofs)
        ),
    )
