"""Motions that are slow, or at rest: starts, and resting poses for payloads.

A new motion starts at rest as the model has it, or where the motors can hold the arm.

At rest a payload's torque is linear in [m, hx, hy, hz]. Out of many poses within the limits those
are picked one by one that make det(sum_k Y_k^T Y_k) largest (a greedy D-optimal design; Pukelsheim,
"Optimal Design of Experiments", 2006, ch. 12). Each is then approached from below and from above,
in all joints at once, so that dry friction holds the arm once from either side.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.motion.limit_check import first_contact, keeps_limits
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.motion.trajectories import LineTrajectory, straight_way
from robot_sysid.records import Array
from robot_sysid.records.messages import torque_unit
from robot_sysid.trajectory import TORQUE_MARGIN

N_POSES = 3000
"""Number of random poses tried as a start."""
CREEP = 1e-3
"""Speed at which there is dry friction and hardly anything else [rad/s or m/s]."""
MOST_STARTS = 50
"""Largest number of poses to which the straight line is checked, until one is free."""

MOST_POSES = 12
"""Number of resting poses of a motion."""
DWELL = 1.5
"""Duration of each rest [s]."""
FEWEST_POSES = 5
"""Poses that identify a payload's mass and centre of mass, with something left to check them by."""
APPROACH = 0.05
"""Distance in every joint from which a pose is approached [rad or m]."""
GENTLE = 0.6
"""Speed that no joint exceeds between poses, however fast it could be [rad/s or m/s]."""
UNSURE_SHARE = 0.5
"""Share of the torque limits that weighing uses: the arm may need twice what its model says."""
CANDIDATES = 3000
"""Number of random poses among which the informative ones are selected."""
_TINY = 1e-6
"""Information before the first pose is selected, times the unit matrix: the information of a single
pose is singular, so that its determinant alone could not be compared."""

SHARE = 0.8
"""Share of the limits of speed and acceleration that a motion between poses uses."""
PEAK_SPEED = 140.0 / 64.0
"""Largest derivative of ``smooth_step``."""
PEAK_ACCELERATION = 7.52
"""Largest second derivative of ``smooth_step``."""
_MOST_SMALLER = 8
"""How often a motion that breaks a limit is made slower: to 6 %."""
_SMALLER = 0.7
"""By which factor a motion is made slower each time."""


def startable(problem: ExcitationProblem) -> ExcitationProblem:
    """Return the problem with a start where the arm touches nothing and its motors can hold it.

    The start is the model's pose if possible, else a pose near it, which a note then states.

    Raises:
        InputError: no pose is free of collisions and held; names the bodies or the joint.
    """
    collisions = problem.obstacles.collisions
    share = _torque_share(problem, problem.rest[None])[0]
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
    # A pose that is held and touches nothing, if possible with a free straight line there.
    poses = _held_poses(problem)[:MOST_STARTS]
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
    """Return the problem with half of the torque limits and speed limits of at most 0.6 rad/s or
    m/s.

    Acceleration limits are smaller by the same factor as speed limits, as slower sinusoids of the
    same frequencies need no more.
    """
    limits = problem.limits
    velocity = np.minimum(limits.velocity, GENTLE)
    acceleration = limits.acceleration * velocity / limits.velocity
    torque = UNSURE_SHARE * limits.torque
    slow = replace(limits, velocity=velocity, acceleration=acceleration, torque=torque)
    return replace(problem, limits=slow)


def contact_on_the_way(problem: ExcitationProblem, start: Array) -> str | None:
    """Return the names of two bodies that come too near each other on the straight line in joint
    space from the model's pose to ``start`` (n,); None where none do.
    """
    contact = first_contact(problem, straight_way(problem.robot.reference, start))
    return None if contact is None else contact.label


def _torque_share(problem: ExcitationProblem, poses: Array) -> Array:
    """Return the largest share (N, n) of each joint's torque limit that holding poses (N, n), or
    moving through them either way at the speed ``CREEP``, takes.
    """
    torque = [problem.torque_at(poses, speed) for speed in (0.0, CREEP, -CREEP)]
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
    anywhere = rng.uniform(lower, upper, (N_POSES, problem.n_joints))
    nearness = np.linspace(1.0 / N_POSES, 1.0, N_POSES)[:, None]
    poses = problem.rest + nearness * (anywhere - problem.rest)
    poses = poses[_is_feasible(problem, poses)]
    distance = np.max(np.abs(poses - problem.rest) / (upper - lower), axis=1)
    return np.asarray(poses[np.argsort(distance)])


def _is_feasible(problem: ExcitationProblem, poses: Array) -> NDArray[np.bool_]:
    """Return for each of N poses (N, n) whether the arm keeps all clearances in it, and can hold it
    and move off within the torque limits, with a tenth of them left to accelerate (N,).
    """
    slack, _ = problem.obstacles.slack(poses)
    return np.all(_torque_share(problem, poses) < 0.9, axis=1) & (slack >= 0.0)


def design_poses(
    problem: ExcitationProblem, rng: np.random.Generator
) -> LineTrajectory:
    """Return a motion through informative poses, so slow that it keeps all limits.

    Where even the slowest one breaks a limit, that one is returned.

    Args:
        problem: the arm and its limits.
        rng: draws the poses among which the informative ones are selected.

    Raises:
        InputError: fewer than ``FEWEST_POSES`` poses can be reached within the limits.
    """
    # Random poses that leave room to approach them from both sides.
    lower = problem.limits.lower + 2.0 * APPROACH
    upper = problem.limits.upper - 2.0 * APPROACH
    lower = np.minimum(lower, problem.rest)
    upper = np.maximum(upper, problem.rest)
    poses = lower + rng.uniform(size=(CANDIDATES, problem.n_joints)) * (upper - lower)
    for side in (-APPROACH, 0.0, APPROACH):
        poses = poses[_is_feasible(problem, poses + side)]
    selected = []
    if len(poses):
        rows = _gravity_rows(problem, poses)
        selected = _select_poses(problem, poses, rows)
    if len(selected) < FEWEST_POSES:
        raise InputError(
            f"only {len(selected)} of {len(poses)} poses within the limits can be reached in "
            f"straight lines, --static needs {FEWEST_POSES}; widen --workspace or the limits"
        )
    # To below each pose, to rest in it, to above it, to rest in it again, and back to the start.
    points = [problem.rest]
    dwells = [0.0]
    for pose in selected:
        points += [pose - APPROACH, pose, pose + APPROACH, pose]
        dwells += [0.0, DWELL, 0.0, DWELL]
    points.append(problem.rest)
    dwells.append(0.0)
    lines = np.abs(np.diff(points, axis=0))
    share = SHARE
    for _ in range(_MOST_SMALLER):
        velocity = np.minimum(share * problem.limits.velocity, share / SHARE * GENTLE)
        acceleration = share * problem.limits.acceleration
        by_speed = PEAK_SPEED * lines / velocity
        by_acceleration = np.sqrt(PEAK_ACCELERATION * lines / acceleration)
        moves = np.max((by_speed, by_acceleration), axis=(0, 2))
        plan = LineTrajectory(np.array(points), moves, np.array(dwells))
        if keeps_limits(problem, plan):
            break
        share *= _SMALLER
    return plan


def _gravity_rows(problem: ExcitationProblem, poses: Array) -> Array:
    """Return the torques (K, n, 4) per unit of [m, hx, hy, hz] of a payload in poses (K, n), over
    the standard deviation of their noise; zero for joints whose torque is not used.

    The unit of the mass is 1 kg, that of a first moment 1 kg times a length of the last link.
    """
    zeros = np.zeros_like(poses)
    motion = problem.dynamics.motion(poses, zeros, zeros)
    columns = motion.columns((problem.n_joints - 1,))
    length = problem.scale[1] / problem.scale[0]
    sigma = np.full(problem.n_joints, np.inf)
    sigma[list(problem.rows)] = problem.sigma
    return columns[:, :, :4] / sigma[:, None] * np.array([1.0, length, length, length])


def _select_poses(problem: ExcitationProblem, poses: Array, rows: Array) -> list[Array]:
    """Return up to ``MOST_POSES`` informative poses (n,) in the order of visiting; straight lines
    between them, and back to the start, are free.

    Each next pose makes the determinant of the information largest; one that no free line leads to
    is passed over.

    Args:
        problem: the arm and its obstacles.
        poses: (K, n) to select from [rad or m].
        rows: (K, n, 4) of these poses, as ``_gravity_rows`` returns them.
    """
    information = _TINY * np.eye(4)
    is_left = np.ones(len(poses), dtype=bool)
    selected: list[Array] = []
    position = problem.rest
    normal = np.einsum("kja,kjb->kab", rows, rows)
    while len(selected) < MOST_POSES and np.any(is_left):
        determinants = np.linalg.slogdet(information + normal)[1]
        best = int(np.argmax(np.where(is_left, determinants, -np.inf)))
        is_left[best] = False
        if first_contact(problem, straight_way(position, poses[best])) is None:
            selected.append(poses[best])
            information = information + normal[best]
            position = poses[best]
    while selected and first_contact(problem, straight_way(selected[-1], problem.rest)):
        selected.pop()
    return selected
