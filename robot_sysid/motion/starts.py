"""Starts of motions, and the limits of slow ones.

A new motion starts at rest as the model has it, or where the motors can hold the arm.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.motion.limit_check import first_contact
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.motion.trajectories import LineTrajectory
from robot_sysid.records import Array
from robot_sysid.records.messages import torque_unit
from robot_sysid.trajectory import TORQUE_MARGIN
from robot_sysid.wording import option_name

GENTLE_SPEED = 0.6
"""Speed limit of gentle motions [rad/s or m/s]."""
HELD_SHARE = 0.9
"""Share of the torque limits up to which a pose is held: a tenth is left to accelerate."""


def with_free_start(problem: ExcitationProblem) -> ExcitationProblem:
    """Return the problem with a start where the arm touches nothing and its motors can hold it.

    The start is the model's pose if possible, else a pose near it, which a note then states.

    Raises:
        InputError: no pose is free of collisions and held; names the bodies or the joint.
    """
    collisions = problem.obstacles.collisions
    share = _torque_share(problem, problem.rest[None])[0]
    worst = np.argmax(share)
    if share[worst] < 1.0 and not collisions:
        return problem
    if collisions:
        reason = f"at rest the model is in a collision: {'; '.join(collisions)}"
        remedy = (
            f"choose another start with {option_name('keyframe')} or in the model, or write "
            "<exclude body1= body2=> under its <contact> if these parts cannot meet"
        )
    else:
        joint = problem.joint_names[worst]
        limit = problem.limits.torque[worst]
        unit = torque_unit(problem.robot.is_slide[worst])
        reason = (
            f"moving off against gravity and dry friction at joint {joint} takes "
            f"{share[worst] * limit:.3g} {unit} with the reserve for errors of the links, more "
            f"than {100.0 * TORQUE_MARGIN:.0f} % of its torque limit of {limit / TORQUE_MARGIN:g}"
        )
        remedy = (
            f"raise the torque limit of {joint} in the model if the joint can carry it"
        )
    # A pose that is held and touches nothing, if possible with a free straight line there, which
    # is checked for the nearest fifty.
    poses = _held_poses(problem)[:50]
    if not len(poses):
        raise InputError(
            f"no trajectory is feasible: {reason}, and none of many other poses within the "
            f"limits is held by all joints and touches nothing; {remedy}"
        )
    free = (pose for pose in poses if contact_on_the_way(problem, pose) is None)
    start = next(free, poses[0])
    notes = (*problem.notes, f"{reason}; the motion starts and ends at another pose")
    return replace(problem, rest=start, notes=notes)


def gentle_problem(problem: ExcitationProblem) -> ExcitationProblem:
    """Return the problem with half of the torque limits and speed limits of at most
    ``GENTLE_SPEED``.

    Acceleration limits are smaller by the same factor as speed limits, as slower sinusoids of the
    same frequencies need no more.
    """
    limits = problem.limits
    velocity = np.minimum(limits.velocity, GENTLE_SPEED)
    acceleration = limits.acceleration * velocity / limits.velocity
    # The arm may need twice what its model says.
    torque = 0.5 * limits.torque
    slow = replace(limits, velocity=velocity, acceleration=acceleration, torque=torque)
    return replace(problem, limits=slow)


def contact_on_the_way(problem: ExcitationProblem, start: Array) -> str | None:
    """Return the names of two bodies that come too near each other on the straight line in joint
    space from the model's pose to ``start`` (n,); None where none do.
    """
    contact = first_contact(problem, LineTrajectory(problem.robot.reference, start))
    return None if contact is None else contact.label


def _torque_share(problem: ExcitationProblem, poses: Array) -> Array:
    """Return the largest share (N, n) of each joint's torque limit that holding poses (N, n), or
    moving through them either way, takes.
    """
    # At a speed [rad/s or m/s] at which there is dry friction and hardly anything else.
    torque = [problem.torque_at(poses, speed) for speed in (0.0, 1e-3, -1e-3)]
    return np.max(np.abs(torque), axis=0) / problem.limits.torque


def _held_poses(problem: ExcitationProblem) -> Array:
    """Return poses (K, n) that keep torque limits and clearances, the nearest to ``problem.rest``
    first.
    """
    # Random poses from near the start to anywhere; the random numbers are fixed, so that the start
    # does not depend on any seed.
    lower = problem.limits.lower
    upper = problem.limits.upper
    rng = np.random.default_rng(0)
    count = 3000
    anywhere = rng.uniform(lower, upper, (count, problem.n_joints))
    nearness = np.linspace(1.0 / count, 1.0, count)[:, None]
    poses = problem.rest + nearness * (anywhere - problem.rest)
    is_held = np.all(_torque_share(problem, poses) < HELD_SHARE, axis=1)
    poses = poses[is_held & (problem.obstacles.slack(poses) >= 0.0)]
    distance = np.max(np.abs(poses - problem.rest) / (upper - lower), axis=1)
    return poses[np.argsort(distance)]
