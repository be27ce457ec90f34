"""Poses that tell most about a payload's mass and centre of mass, approached from both sides.

At rest the payload's torque is linear in [m, hx, hy, hz]. Out of many poses within the limits those
are picked one by one that make det(sum_k Y_k^T Y_k) largest (a greedy D-optimal design; Pukelsheim,
"Optimal Design of Experiments", 2006, ch. 12). Each is then approached from below and from above,
in all joints at once, so that dry friction holds the arm once from either side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.kinematics import ChainKinematics
from robot_sysid.errors import InputError
from robot_sysid.excitation.limit_check import keeps_limits
from robot_sysid.excitation.problem import ExcitationProblem
from robot_sysid.excitation.static.options import FEWEST_POSES, PoseOptions
from robot_sysid.excitation.static.pose_trajectory import (
    PEAK_ACCELERATION,
    PEAK_SPEED,
    PoseTrajectory,
)
from robot_sysid.excitation.trajectory_files import SlowedTrajectory
from robot_sysid.records import Array, Motion, MotionPlan, RobotModel
from robot_sysid.regressor import joint_regressor

APPROACH = 0.05
"""From how far a pose is approached [rad or m]."""
GENTLE = 0.6
"""Speed that no joint exceeds, however fast it could be [rad/s or m/s]."""
SHORTEST_MOVE, RESERVE = 0.6, 1.05
"""Shortest way between two points [s], and how much longer than needed each takes."""
CANDIDATES, PLACES_ON_A_WAY = 3000, 24
_MOST_SLOWER, _SLOWER = 12, 1.25
_TINY = 1e-6


def design_poses(
    robot: RobotModel, problem: ExcitationProblem, options: PoseOptions, rng: np.random.Generator
) -> PoseTrajectory:
    """Return a motion through informative poses that keeps all limits.

    Args:
        robot: the arm.
        problem: its limits and what it must not touch.
        options: how many poses, and how long each rest lasts.
        rng: source of randomness.

    Raises:
        InputError: there are too few poses that can be reached.
    """
    candidates = _reachable(problem, _candidates(problem, rng))
    rows = _gravity_rows(robot, problem, candidates)
    chosen = _chosen(problem, candidates, rows, options.poses)
    if len(chosen) < FEWEST_POSES:
        raise InputError(
            f"only {len(chosen)} of {len(candidates)} poses within the limits can be reached in "
            f"straight lines, --static needs {FEWEST_POSES}; widen --workspace or the limits"
        )
    slower = 1.0
    for _ in range(_MOST_SLOWER):
        plan = _through(problem, chosen, options.dwell, slower)
        if keeps_limits(problem, plan):
            return plan
        slower *= _SLOWER
    return plan


def _candidates(problem: ExcitationProblem, rng: np.random.Generator) -> Array:
    """Return random poses (K, n) that leave room to approach them from both sides."""
    lower, upper = problem.limits.lower + 2.0 * APPROACH, problem.limits.upper - 2.0 * APPROACH
    lower, upper = np.minimum(lower, problem.rest), np.maximum(upper, problem.rest)
    share = rng.uniform(size=(CANDIDATES, problem.n_joints))
    return lower + share * (upper - lower)


def _reachable(problem: ExcitationProblem, poses: Array) -> Array:
    """Return the poses at which, and on both sides of which, nothing is touched or overloaded."""
    fits = np.ones(len(poses), dtype=bool)
    for side in (-APPROACH, 0.0, APPROACH):
        at = poses + side
        still = np.zeros_like(at)
        torque = problem.torque(Motion(np.arange(float(len(at))), at, still, still))
        fits &= np.all(np.abs(torque) <= problem.limits.torque, axis=1)
        fits &= np.asarray(problem.obstacles.slack(at).value) >= 0.0
    return poses[fits]


def _gravity_rows(robot: RobotModel, problem: ExcitationProblem, poses: Array) -> Array:
    """Return (K, n, 4) torques per [m, hx, hy, hz] of a payload at rest, scaled by noise."""
    still = np.zeros_like(poses)
    motion = ChainKinematics(robot).evaluate(poses, still, still)
    every = joint_regressor(motion, range(problem.n_joints)).transpose(1, 0, 2)
    length = problem.scale[1] / problem.scale[0]
    sigma = np.full(problem.n_joints, np.inf)
    sigma[list(problem.rows)] = problem.sigma
    return every[:, :, :4] / sigma[:, None] * np.array([1.0, length, length, length])


def _chosen(problem: ExcitationProblem, poses: Array, rows: Array, count: int) -> list[Array]:
    """Return poses in the order of visiting, each next to the one before by a free way."""
    information = _TINY * np.eye(4)
    left = np.ones(len(poses), dtype=bool)
    picked: list[Array] = []
    here = problem.rest
    normal = np.einsum("kja,kjb->kab", rows, rows)
    while len(picked) < count and np.any(left):
        gain = np.where(left, np.linalg.slogdet(information + normal)[1], -np.inf)
        best = int(np.argmax(gain))
        left[best] = False
        if _is_free(problem, here, poses[best]):
            picked.append(poses[best])
            information = information + normal[best]
            here = poses[best]
    while picked and not _is_free(problem, picked[-1], problem.rest):
        picked.pop()
    return picked


def _is_free(problem: ExcitationProblem, start: Array, end: Array) -> bool:
    """Tell whether the ways to both sides of a pose keep the clearances."""
    share = np.linspace(0.0, 1.0, PLACES_ON_A_WAY)[:, None]
    way = start + share * (end - APPROACH - start)
    around = end + np.linspace(-APPROACH, APPROACH, 3)[:, None]
    slack = problem.obstacles.slack(np.concatenate((way, around))).value
    return bool(np.min(slack) >= 0.0)


def _through(
    problem: ExcitationProblem, poses: list[Array], dwell: float, slower: float
) -> PoseTrajectory:
    """Return the motion: to below a pose, rest in it, to above it, rest in it again, and on."""
    points, dwells = [problem.rest], [0.0]
    for pose in poses:
        points += [pose - APPROACH, pose, pose + APPROACH, pose]
        dwells += [0.0, dwell, 0.0, dwell]
    points.append(problem.rest)
    dwells.append(0.0)
    steps = np.abs(np.diff(points, axis=0))
    moves = slower * RESERVE * _times(problem, steps)
    return PoseTrajectory(np.array(points), moves, np.array(dwells))


def _times(problem: ExcitationProblem, steps: Array) -> NDArray[np.float64]:
    """Return how long steps (K, n) take within the limits of speed and acceleration (K,) [s]."""
    limits = problem.limits
    by_speed = PEAK_SPEED * steps / np.minimum(limits.velocity, GENTLE)
    by_acceleration = np.sqrt(PEAK_ACCELERATION * steps / limits.acceleration)
    return np.maximum(np.max(np.maximum(by_speed, by_acceleration), axis=1), SHORTEST_MOVE)


def pose_lines(robot: RobotModel, problem: ExcitationProblem, plan: MotionPlan) -> list[str]:
    """Return what the poses promise of a payload's mass, from noise alone."""
    poses = plan.plan if isinstance(plan, SlowedTrajectory) else plan
    assert isinstance(poses, PoseTrajectory)
    rests = poses.points[poses.dwells > 0.0][::2]
    rows = _gravity_rows(robot, problem, rests).reshape(-1, 4)
    # The payload is a difference of two recordings, each the mean of two rests.
    covariance = np.linalg.pinv(rows.T @ rows)
    return [
        f"{len(rests)} poses, each approached from both sides, {plan.duration:.0f} s.",
        f"Where the mean torque of a rest is known to {float(np.mean(problem.sigma)):.2g} N·m, "
        f"empty and loaded recordings of them show a payload's mass to "
        f"{float(np.sqrt(covariance[0, 0])):.2g} kg.",
    ]
