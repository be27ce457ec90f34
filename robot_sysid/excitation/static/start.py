"""Where a new motion starts: at rest as the model has it, or where the motors can hold the arm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.excitation.limit_check import first_contact
from robot_sysid.excitation.problem import ExcitationProblem
from robot_sysid.excitation.static.pose_trajectory import straight_way
from robot_sysid.records import Array, Motion
from robot_sysid.trajectory import TORQUE_MARGIN

POSES, PARENTS = 1000, 50
"""Poses that are tried at a time; and how many of the lightest get others near them."""
SPREADS = (0.1, 0.05, 0.02, 0.01, 0.005)
"""How near, one after the other, as share of the joints' ranges."""
EASY_SHARE = 0.8
"""Share of the torque limits up to which moving off leaves room for a motion."""
CREEP = 1e-3
"""Speed at which there is dry friction and hardly anything else [rad/s or m/s]."""
MOST_WAYS = 50
"""Poses of which the way there is looked at, in the hope of a free one."""


def startable(problem: ExcitationProblem) -> ExcitationProblem:
    """Return the problem with a start where the arm touches nothing and its motors can hold it.

    The model's own pose where that will do, else one near it, which a note then says.

    Raises:
        InputError: no pose is free of collisions and held; says which bodies, or which joint.
    """
    collisions = problem.obstacles.at_rest.deep
    share = _needed(problem, problem.rest[None])[0]
    worst = int(np.argmax(share))
    if share[worst] < 1.0 and not collisions:
        return problem
    if collisions:
        reason = f"at rest the model is in a collision: {'; '.join(collisions)}"
        remedy = (
            "choose another start with --keyframe or in the model, or write <exclude body1= "
            "body2=> under its <contact> if these parts cannot meet"
        )
    else:
        reason = _too_heavy(problem, worst, share[worst])
        joint = problem.joint_names[worst]
        remedy = f"give --ignore-torque-limit {joint} if the joint can carry it"
    start = _pose_to_hold(problem)
    if start is None:
        tried = POSES * (1 + len(SPREADS))
        raise InputError(
            f"no trajectory is feasible: {reason}, and none of {tried} other poses within the "
            f"limits is held by all joints and touches nothing; {remedy}"
        )
    note = f"{reason}; the motion starts and ends at another pose"
    return replace(problem, rest=start, notes=(*problem.notes, note))


def contact_on_the_way(problem: ExcitationProblem, start: Array) -> str | None:
    """Say between what a clearance is not kept on the straight way from the model's pose (n,).

    Straight in joint space, to ``start`` (n,); None where the way is free.
    """
    way = straight_way(problem.robot.reference, start)
    when = first_contact(problem, way)
    if when is None:
        return None
    return problem.obstacles.closest(way.evaluate(np.array([when])).q[0]).label


def _needed(problem: ExcitationProblem, poses: Array) -> Array:
    """Return the share (N, n) of torque limits to hold poses (N, n), or to creep off either way."""
    return np.max([_torque(problem, poses, speed) for speed in (0.0, CREEP, -CREEP)], axis=0)


def _torque(problem: ExcitationProblem, poses: Array, speed: float) -> Array:
    still = np.zeros_like(poses)
    motion = Motion(np.arange(float(len(poses))), poses, still + speed, still)
    return np.asarray(np.abs(problem.torque(motion)) / problem.limits.torque)


def _too_heavy(problem: ExcitationProblem, worst: int, share: float) -> str:
    name, allowed = problem.joint_names[worst], problem.limits.torque[worst]
    unit = "N·m" if np.any(problem.chain.screws[:3, worst]) else "N"
    still = float(_torque(problem, problem.rest[None], 0.0)[0, worst])
    what = "holding still" if still >= 1.0 else "moving off against gravity and dry friction"
    return (
        f"{what} takes {(still if still >= 1.0 else share) * allowed:.3g} {unit} at joint {name}, "
        f"more than {100.0 * TORQUE_MARGIN:.0f} % of its torque limit of "
        f"{allowed / TORQUE_MARGIN:g}"
    )


def _pose_to_hold(problem: ExcitationProblem) -> Array | None:
    """Return a pose (n,) that is held and touches nothing, if possible with a free way there."""
    found = list(islice(_held(problem), MOST_WAYS))
    free = (pose for pose in found if contact_on_the_way(problem, pose) is None)
    return next(free, found[0] if found else None)


def _held(problem: ExcitationProblem) -> Iterator[Array]:
    """Yield poses (n,) that keep torque limits and clearances: easy ones first, then near ones."""
    poses, rest = _light_poses(problem), problem.rest
    share = np.max(_needed(problem, poses), axis=1)
    far = np.max(np.abs(poses - rest) / (problem.limits.upper - problem.limits.lower), axis=1)
    for k in np.lexsort((far, share > EASY_SHARE)):
        if share[k] < 1.0 and problem.obstacles.slack_at(poses[k])[0] >= 0.0:
            yield poses[k]


def _light_poses(problem: ExcitationProblem) -> Array:
    """Return poses (N, n) from near the model's to anywhere, more of them where holding is easy.

    A fixed set of random numbers, so that the start does not depend on any seed.
    """
    lower, upper, rng = problem.limits.lower, problem.limits.upper, np.random.default_rng(0)
    anywhere = rng.uniform(lower, upper, (POSES, problem.n_joints))
    nearness = np.linspace(1.0 / POSES, 1.0, POSES)[:, None]
    poses = problem.rest + nearness * (anywhere - problem.rest)
    for spread in SPREADS:
        lightest = np.argsort(np.max(_needed(problem, poses), axis=1))[:PARENTS]
        moved = rng.normal(size=(POSES, problem.n_joints)) * spread * (upper - lower)
        near = np.repeat(poses[lightest], POSES // PARENTS, axis=0) + moved
        poses = np.vstack((poses, np.clip(near, lower, upper)))
    return poses
