"""Which joint is the arm's last one, and which joints carry it.

The joints form a tree. A serial run is a path without branches; the arm is the longest serial run
of hinge and slide joints, and its last joint is the terminal one. What branches off behind it are
fingers. Where two runs could both be the arm, or the last joint looks like a jaw, the user decides.

A model lets a base on wheels drive with two slide joints and a hinge. They carry the arm, but no
motor torque is measured at them and no trajectory should drive them; so they stay where they are.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from robot_sysid.errors import AmbiguousJointError, ModelError

_JAW_JOINT = re.compile(r"grip|finger|jaw|claw|knuckle|pinch", re.IGNORECASE)
_JAW_BODY = re.compile(r"finger|jaw|claw|knuckle", re.IGNORECASE)
RIVAL_SHARE = 0.6
"""A run beside the longest one that has at least this share of its joints may be an arm too."""


def joint_label(mj_model: Any, joint: int) -> str:
    """Return the joint's name, or "#id" where it has none."""
    return _label(mj_model, mujoco.mjtObj.mjOBJ_JOINT, joint)


def body_label(mj_model: Any, body: int) -> str:
    """Return the body's name, or "#id" where it has none."""
    return _label(mj_model, mujoco.mjtObj.mjOBJ_BODY, body)


def _label(mj_model: Any, kind: Any, index: int) -> str:
    return mujoco.mj_id2name(mj_model, int(kind), index) or f"#{index}"


def is_hinge_or_slide(mj_model: Any, joint: int) -> bool:
    """Tell whether a joint has one degree of freedom."""
    kind = int(mj_model.jnt_type[joint])
    return kind in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclass(frozen=True)
class SerialRun:
    """A path of joints without branches.

    Attributes:
        joints: joint ids from the base outwards.
        ancestors: ids of all joints between the world and this run.
    """

    joints: tuple[int, ...]
    ancestors: frozenset[int]

    def is_behind(self, other: SerialRun) -> bool:
        """Tell whether this run hangs on the other one."""
        return other.joints[-1] in self.ancestors


def parent_joint(mj_model: Any, joint: int) -> int | None:
    """Return the next joint towards the world, or None."""
    body = int(mj_model.jnt_bodyid[joint])
    if joint > int(mj_model.body_jntadr[body]):
        return joint - 1
    return last_joint_of(mj_model, int(mj_model.body_parentid[body]))


def last_joint_of(mj_model: Any, body: int) -> int | None:
    """Return the joint that moves a body: its own last one or that of its nearest ancestor."""
    while body > 0:
        count = int(mj_model.body_jntnum[body])
        if count:
            return int(mj_model.body_jntadr[body]) + count - 1
        body = int(mj_model.body_parentid[body])
    return None


def chain_to(mj_model: Any, joint: int) -> tuple[int, ...]:
    """Return the ids of all joints from the world to ``joint``, that one included.

    Raises:
        ModelError: there is a ball or free joint among them.
    """
    chain = tuple(_towards_world(mj_model, joint))[::-1]
    for member in chain:
        if not is_hinge_or_slide(mj_model, member):
            kind = mujoco.mjtJoint(int(mj_model.jnt_type[member])).name[len("mjJNT_") :].lower()
            raise ModelError(
                f"{kind} joint {joint_label(mj_model, member)} is part of the chain to joint "
                f"{joint_label(mj_model, joint)}; only hinge and slide joints can be identified, "
                "so weld it or replace it in the model"
            )
    return chain


def _towards_world(mj_model: Any, joint: int | None) -> Iterator[int]:
    """Yield a joint and all between it and the world."""
    while joint is not None:
        yield joint
        joint = parent_joint(mj_model, joint)


def serial_runs(mj_model: Any) -> list[SerialRun]:
    """Return all maximal serial runs of hinge and slide joints."""
    parents = [parent_joint(mj_model, joint) for joint in range(mj_model.njnt)]
    children: dict[int | None, list[int]] = {}
    for joint, parent in enumerate(parents):
        children.setdefault(parent, []).append(joint)
    runs = []
    for joint, parent in enumerate(parents):
        if not is_hinge_or_slide(mj_model, joint) or _continues(mj_model, parent, children):
            continue
        run = [joint]
        while _continues(mj_model, run[-1], children):
            run.append(children[run[-1]][0])
        runs.append(SerialRun(tuple(run), frozenset(_towards_world(mj_model, parent))))
    return runs


def _continues(mj_model: Any, joint: int | None, children: dict[int | None, list[int]]) -> bool:
    """Tell whether a run goes on behind ``joint``: exactly one joint follows, of the right kind."""
    if joint is None or not is_hinge_or_slide(mj_model, joint):
        return False
    following = children.get(joint, [])
    return len(following) == 1 and is_hinge_or_slide(mj_model, following[0])


def find_terminal_joint(mj_model: Any) -> int:
    """Return the id of the arm's last joint.

    Raises:
        ModelError: the model has no hinge or slide joint.
        AmbiguousJointError: several joints could be meant.
    """
    runs = serial_runs(mj_model)
    if not runs:
        raise ModelError("the model has no hinge or slide joints, so there is no arm to identify")
    longest = max(len(run.joints) for run in runs)
    tops = [run for run in runs if len(run.joints) == longest]
    arm = next(run for run in tops if not any(run.is_behind(other) for other in tops))
    rivals = [run for run in runs if _is_rival(run, arm)]
    if rivals:
        raise _two_arms(mj_model, runs, [arm, *rivals])
    _require_no_ball(mj_model, arm)
    _require_no_jaw(mj_model, arm)
    _require_drive(mj_model, arm)
    return arm.joints[-1]


def _is_rival(run: SerialRun, arm: SerialRun) -> bool:
    """Tell whether a run beside the arm is long enough to be an arm itself."""
    beside = run is not arm and not run.is_behind(arm) and not arm.is_behind(run)
    return beside and len(run.joints) >= RIVAL_SHARE * len(arm.joints)


def _two_arms(mj_model: Any, runs: list[SerialRun], rivals: list[SerialRun]) -> AmbiguousJointError:
    """Return the error that lists the rivals' ends, and what all of them hang on."""
    trunks = [run for run in runs if all(rival.is_behind(run) for rival in rivals)]
    ends = [run.joints[-1] for run in [*trunks, *rivals]]
    reason = f"{len(rivals)} serial chains of joints could be the arm"
    return AmbiguousJointError(reason, _candidates(mj_model, ends))


def _require_no_ball(mj_model: Any, arm: SerialRun) -> None:
    last = arm.joints[-1]
    behind = [j for j in range(mj_model.njnt) if parent_joint(mj_model, j) == last]
    if len(behind) == 1 and not is_hinge_or_slide(mj_model, behind[0]):
        raise ModelError(
            f"ball joint {joint_label(mj_model, behind[0])} is part of the chain; only hinge and "
            "slide joints can be identified, so weld it, or hold it where it is with --joint "
            f"{joint_label(mj_model, last)}"
        )


def _require_no_jaw(mj_model: Any, arm: SerialRun) -> None:
    last = arm.joints[-1]
    joint = joint_label(mj_model, last)
    body = body_label(mj_model, int(mj_model.jnt_bodyid[last]))
    if len(arm.joints) > 1 and (_JAW_JOINT.search(joint) or _JAW_BODY.search(body)):
        raise AmbiguousJointError(
            f"the last joint {joint} looks like the jaw of a gripper",
            _candidates(mj_model, list(arm.joints[-2:])),
        )


def _require_drive(mj_model: Any, arm: SerialRun) -> None:
    """Ask where motors drive the arm but not its last joint: a hose, a pendulum, a loose tool."""
    driven = driven_joints(mj_model)
    with_motor = [joint for joint in arm.joints if joint in driven]
    last = arm.joints[-1]
    if with_motor and last not in driven:
        raise AmbiguousJointError(
            f"the last joint {joint_label(mj_model, last)} has no actuator, but others do",
            _candidates(mj_model, [with_motor[-1], last]),
        )


def driven_joints(mj_model: Any) -> set[int]:
    """Return the ids of joints that an actuator moves, directly, by a tendon or by a coupling."""
    kind = mujoco.mjtTrn
    joints: set[int] = set()
    for transmission, target in zip(mj_model.actuator_trntype, mj_model.actuator_trnid[:, 0]):
        if int(transmission) in (int(kind.mjTRN_JOINT), int(kind.mjTRN_JOINTINPARENT)):
            joints.add(int(target))
        elif int(transmission) == int(kind.mjTRN_TENDON):
            joints.update(_joints_of_tendon(mj_model, int(target)))
    coupled = mj_model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)
    for pair in zip(mj_model.eq_obj1id[coupled], mj_model.eq_obj2id[coupled]):
        if joints.intersection(pair):
            joints.update(int(joint) for joint in pair)
    return joints


def _joints_of_tendon(mj_model: Any, tendon: int) -> list[int]:
    first, count = int(mj_model.tendon_adr[tendon]), int(mj_model.tendon_num[tendon])
    wraps = slice(first, first + count)
    of_joints = mj_model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)
    return [int(joint) for joint in mj_model.wrap_objid[wraps][of_joints]]


def _candidates(mj_model: Any, joints: list[int]) -> list[tuple[str, str]]:
    return [
        (joint_label(mj_model, j), body_label(mj_model, int(mj_model.jnt_bodyid[j])))
        for j in joints
    ]


def resolve_joint(mj_model: Any, name: str) -> int:
    """Return the id of the joint called ``name`` ("#3" for a nameless one).

    Raises:
        ModelError: there is no such joint (lists those there are), or it cannot be terminal.
    """
    usable = [j for j in range(mj_model.njnt) if is_hinge_or_slide(mj_model, j)]
    labels = {joint_label(mj_model, j): j for j in range(mj_model.njnt)}
    if name not in labels:
        known = ", ".join(joint_label(mj_model, j) for j in usable) or "none"
        raise ModelError(f"--joint {name}: no such joint; the model has: {known}")
    joint = labels[name]
    last = last_joint_of(mj_model, int(mj_model.jnt_bodyid[joint]))
    if last is not None and last != joint:
        raise ModelError(
            f"--joint {name}: joint {joint_label(mj_model, last)} moves the same body after it; "
            f"choose {joint_label(mj_model, last)}"
        )
    return joint


N_JOINTS = 3
"""Two directions and a turn."""
LEAST_ARM = 3
"""Joints that must remain for the rest to be an arm; three can show all ten parameters."""
_PERPENDICULAR = 1e-6


def arm_without_base(mj_model: Any, chain: tuple[int, ...]) -> tuple[int, ...]:
    """Return a chain of joint ids without the joints of a mobile base at its beginning.

    Args:
        mj_model: compiled model.
        chain: joint ids from the world outwards.
    """
    if len(chain) < N_JOINTS + LEAST_ARM or not _is_planar_base(mj_model, chain[:N_JOINTS]):
        return chain
    return chain[N_JOINTS:]


def _is_planar_base(mj_model: Any, joints: tuple[int, ...]) -> bool:
    """Tell whether three joints are two slides and a hinge normal to both, all unlimited."""
    ids = list(joints)
    kinds = mj_model.jnt_type[ids]
    slides = kinds == int(mujoco.mjtJoint.mjJNT_SLIDE)
    hinges = kinds == int(mujoco.mjtJoint.mjJNT_HINGE)
    if np.any(mj_model.jnt_limited[ids]) or np.sum(slides) != 2 or np.sum(hinges) != 1:
        return False
    data = mujoco.MjData(mj_model)
    mujoco.mj_kinematics(mj_model, data)
    axes = data.xaxis[ids]
    return bool(np.max(np.abs(axes @ axes.T - np.eye(N_JOINTS))) <= _PERPENDICULAR)
