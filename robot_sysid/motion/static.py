"""Motions that are slow, or at rest: starts, resting poses for payloads, sweeps for friction.

A new motion starts at rest as the model has it, or where the motors can hold the arm.

At rest a payload's torque is linear in [m, hx, hy, hz]. Out of many poses within the limits those
are picked one by one that make det(sum_k Y_k^T Y_k) largest (a greedy D-optimal design; Pukelsheim,
"Optimal Design of Experiments", 2006, ch. 12). Each is then approached from below and from above,
in all joints at once, so that dry friction holds the arm once from either side.

For friction alone one joint after the other goes slowly back and forth. At constant speed nothing
but friction and gravity acts on it, and gravity is the same on the way there and back. The speeds
are a geometric series, because friction bends most where it is slow; they go up and down again, so
that friction that changes with time does not look like one of speed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.errors import InputError
from robot_sysid.motion import trajectories
from robot_sysid.motion.limit_check import first_contact, keeps_limits
from robot_sysid.motion.plan_options import PoseOptions
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.motion.trajectories import LineTrajectory, straight_way
from robot_sysid.records import Array, Motion, MotionPlan
from robot_sysid.trajectory import TORQUE_MARGIN

STARTS = 1000
PARENTS = 50
SPREADS = (0.1, 0.05, 0.02, 0.01, 0.005)
"""Poses that are tried at a time; how many of the lightest get others near them, and how near one
after the other, as share of the joints' ranges."""
EASY_SHARE = 0.8
"""Share of the torque limits up to which moving off leaves room for a motion."""
CREEP = 1e-3
"""Speed at which there is dry friction and hardly anything else [rad/s or m/s]."""
MOST_WAYS = 50
"""Poses of which the way there is looked at, in the hope of a free one."""

FEWEST_POSES = 5
"""Poses that tell a payload's mass and centre of mass, with something left to check them by."""
APPROACH = 0.05
"""From how far a pose is approached [rad or m]."""
GENTLE = 0.6
"""Speed that no joint exceeds between poses, however fast it could be [rad/s or m/s]."""
UNSURE_SHARE = 0.5
"""Share of the torque limits that weighing uses: the arm may need twice what its model says."""
SHORTEST_MOVE = 0.6
RESERVE = 1.05
"""Shortest way between two points [s], and how much longer than needed each takes."""
CANDIDATES = 3000
PLACES_ON_A_WAY = 24
_MOST_SLOWER = 12
_SLOWER = 1.25
"""How often a motion that breaks a limit is slowed down, and by how much: 15 times in all."""
_TINY = 1e-6
"""Information before the first pose, whose own is singular: a millionth of what noise leaves."""

SLOWEST = 0.02
FASTEST = 1.0
"""Speeds of the first and the last sweep [rad/s]; the last is lower where limits ask for it."""
SPEEDS = 6
CRUISE = 0.8
"""How many speeds, and how long each is held at a time [s] where the joint has room."""
SHARE = 0.8
"""Share of the limits of speed and acceleration that sweeps use."""
SHORTEST_RAMP = 0.15
"""Time in which a sweep's speed rises [s]: 30 samples at the 200 Hz of ``expected_errors``."""
WIDEST = 1.0
LEAST_ROOM = 0.02
"""Farthest that a joint leaves its rest position, and way below which it is not swept [rad]."""
_STEP = 0.01
_MOST_SMALLER = 8
_SMALLER = 0.7
"""Step of looking for room [rad]; how often sweeps that break a limit are made smaller: to 6 %."""


def startable(problem: ExcitationProblem) -> ExcitationProblem:
    """Return the problem with a start where the arm touches nothing and its motors can hold it.

    The model's own pose where that will do, else one near it, which a note then says; InputError
    that names bodies or joint where no pose is free of collisions and held.
    """
    collisions = problem.obstacles.at_rest["deep"]
    still, share = (
        _needed(problem, problem.rest[None], speed)[0] for speed in (0.0, CREEP)
    )
    worst = int(np.argmax(share))
    if share[worst] < 1.0 and not collisions:
        return problem
    joint = problem.joint_names[worst]
    allowed = problem.limits.torque[worst]
    if collisions:
        reason = f"at rest the model is in a collision: {'; '.join(collisions)}"
        remedy = (
            "choose another start with --keyframe or in the model, or write <exclude body1= "
            "body2=> under its <contact> if these parts cannot meet"
        )
    else:
        is_held = still[worst] < 1.0
        what = (
            "moving off against gravity and dry friction"
            if is_held
            else "holding still"
        )
        unit = "N" if problem.robot.is_slide[worst] else "N·m"
        reserved = ""
        if problem.has_torque_reserve:
            pose = Motion(
                np.zeros(1), problem.rest[None], *np.zeros((2, 1, problem.n_joints))
            )
            reserve = problem.torque_reserve(pose)[0, worst]
            reserved = (
                f" ({reserve:.2g} of it for errors of the links, --link-uncertainty)"
            )
        reason = (
            f"{what} takes {(share if is_held else still)[worst] * allowed:.3g} {unit}{reserved} "
            f"at joint {joint}, more than {100.0 * TORQUE_MARGIN:.0f} % of its "
            f"torque limit of {allowed / TORQUE_MARGIN:g}"
        )
        remedy = (
            f"raise the torque limit of {joint} in the model if the joint can carry it"
        )
    # One that is held and touches nothing, if possible with a free way there.
    found = list(islice(_held(problem), MOST_WAYS))
    free = (pose for pose in found if contact_on_the_way(problem, pose) is None)
    start = next(free, found[0] if found else None)
    if start is None:
        tried = STARTS * (1 + len(SPREADS))
        raise InputError(
            f"no trajectory is feasible: {reason}, and none of {tried} other poses within the "
            f"limits is held by all joints and touches nothing; {remedy}"
        )
    note = f"{reason}; the motion starts and ends at another pose"
    return replace(problem, rest=start, notes=(*problem.notes, note))


def gentle_problem(problem: ExcitationProblem) -> ExcitationProblem:
    """Return the problem with half of the torque limits and speeds of at most 0.6 rad/s or m/s.

    Accelerations are smaller by the same factor as speeds: a motion of this band needs no more.
    """
    limits = problem.limits
    velocity = np.minimum(limits.velocity, GENTLE)
    acceleration = limits.acceleration * velocity / limits.velocity
    torque = UNSURE_SHARE * limits.torque
    slow = replace(limits, velocity=velocity, acceleration=acceleration, torque=torque)
    return replace(problem, limits=slow)


def contact_on_the_way(problem: ExcitationProblem, start: Array) -> str | None:
    """Say between what a clearance is not kept on the straight way in joint space from the model's
    pose to ``start`` (n,); None where it is free.
    """
    touched = first_contact(problem, straight_way(problem.robot.reference, start))
    return None if touched is None else touched.label


def _needed(problem: ExcitationProblem, poses: Array, creep: float = CREEP) -> Array:
    """Return the share (N, n) of torque limits to hold poses (N, n), or to creep off either way."""
    torque = np.abs([problem.torque_at(poses, speed) for speed in {0.0, creep, -creep}])
    return np.asarray(np.max(torque, axis=0) / problem.limits.torque)


def _held(problem: ExcitationProblem) -> Iterator[Array]:
    """Yield poses (n,) that keep torque limits and clearances: easy ones first, then near ones."""
    # From near the model's to anywhere, more of them where holding is easy; the random numbers are
    # fixed, so that the start does not depend on any seed.
    lower = problem.limits.lower
    upper = problem.limits.upper
    rng = np.random.default_rng(0)
    anywhere = rng.uniform(lower, upper, (STARTS, problem.n_joints))
    nearness = np.linspace(1.0 / STARTS, 1.0, STARTS)[:, None]
    poses = problem.rest + nearness * (anywhere - problem.rest)
    for spread in SPREADS:
        lightest = np.argsort(np.max(_needed(problem, poses), axis=1))[:PARENTS]
        moved = rng.normal(size=(STARTS, problem.n_joints)) * spread * (upper - lower)
        near = np.repeat(poses[lightest], STARTS // PARENTS, axis=0) + moved
        poses = np.vstack((poses, np.clip(near, lower, upper)))
    share = np.max(_needed(problem, poses), axis=1)
    far = np.max(np.abs(poses - problem.rest) / (upper - lower), axis=1)
    for k in np.lexsort((far, share > EASY_SHARE)):
        if share[k] < 1.0 and problem.obstacles.slack_at(poses[k])[0] >= 0.0:
            yield poses[k]


def _fits(problem: ExcitationProblem, poses: Array) -> Array:
    """Tell of poses (N, n) whether at rest there nothing is touched or overloaded (N,)."""
    held = np.all(np.abs(problem.torque_at(poses)) <= problem.limits.torque, axis=1)
    return held & (np.asarray(problem.obstacles.slack(poses).value) >= 0.0)


def design_poses(
    problem: ExcitationProblem, options: PoseOptions, rng: np.random.Generator
) -> LineTrajectory:
    """Return a motion through informative poses within all limits, or raise InputError: too few."""
    # Random poses that leave room to approach them from both sides.
    lower = problem.limits.lower + 2.0 * APPROACH
    upper = problem.limits.upper - 2.0 * APPROACH
    lower = np.minimum(lower, problem.rest)
    upper = np.maximum(upper, problem.rest)
    poses = lower + rng.uniform(size=(CANDIDATES, problem.n_joints)) * (upper - lower)
    sides = (-APPROACH, 0.0, APPROACH)
    poses = poses[np.all([_fits(problem, poses + side) for side in sides], axis=0)]
    chosen = _chosen(problem, poses, _gravity_rows(problem, poses), options.poses)
    if len(chosen) < FEWEST_POSES:
        raise InputError(
            f"only {len(chosen)} of {len(poses)} poses within the limits can be reached in "
            f"straight lines, --static needs {FEWEST_POSES}; widen --workspace or the limits"
        )
    for slower in _SLOWER ** np.arange(_MOST_SLOWER):
        plan = _through(problem, chosen, options.dwell, slower)
        if keeps_limits(problem, plan):
            break
    return plan


def _gravity_rows(problem: ExcitationProblem, poses: Array) -> Array:
    """Return (K, n, 4) torques per [m, hx, hy, hz] of a payload at rest, scaled by noise."""
    still = np.zeros_like(poses)
    every = (
        LinkDynamics(problem.robot)
        .motion(poses, still, still)
        .columns((problem.n_joints - 1,))
    )
    length = problem.scale[1] / problem.scale[0]
    sigma = np.full(problem.n_joints, np.inf)
    sigma[list(problem.rows)] = problem.sigma
    return every[:, :, :4] / sigma[:, None] * np.array([1.0, length, length, length])


def _chosen(
    problem: ExcitationProblem, poses: Array, rows: Array, count: int
) -> list[Array]:
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
) -> LineTrajectory:
    """Return the motion: to below a pose, rest in it, to above it, rest in it again, and on."""
    points = [problem.rest]
    dwells = [0.0]
    for pose in poses:
        points += [pose - APPROACH, pose, pose + APPROACH, pose]
        dwells += [0.0, dwell, 0.0, dwell]
    points.append(problem.rest)
    dwells.append(0.0)
    steps = np.abs(np.diff(points, axis=0))
    limits = problem.limits
    by_speed = trajectories.PEAK_SPEED * steps / np.minimum(limits.velocity, GENTLE)
    by_acceleration = np.sqrt(
        trajectories.PEAK_ACCELERATION * steps / limits.acceleration
    )
    times = np.maximum(
        np.max(np.maximum(by_speed, by_acceleration), axis=1), SHORTEST_MOVE
    )
    return LineTrajectory(np.array(points), slower * RESERVE * times, np.array(dwells))


def pose_lines(problem: ExcitationProblem, plan: MotionPlan) -> list[str]:
    """Return what the poses promise of a payload's mass, from noise alone."""
    assert isinstance(plan, LineTrajectory)
    rests = plan.points[plan.dwells > 0.0][::2]
    rows = _gravity_rows(problem, rests).reshape(-1, 4)
    # The payload is a difference of two recordings, each the mean of two rests.
    covariance = np.linalg.pinv(rows.T @ rows)
    return [
        f"{len(rests)} poses, each approached from both sides, {plan.duration:.0f} s.",
        f"Where the mean torque of a rest is known to {float(np.mean(problem.sigma)):.2g} N·m, "
        f"empty and loaded recordings of them show a payload's mass to "
        f"{float(np.sqrt(covariance[0, 0])):.2g} kg.",
    ]


def design_sweeps(problem: ExcitationProblem) -> LineTrajectory:
    """Return a motion that sweeps every joint that has room, or raise InputError if none has."""
    wide = np.array([_free_way(problem, joint) for joint in range(problem.n_joints)])
    share = 1.0
    for _ in range(_MOST_SMALLER):
        plan = _swept(problem, share * wide, share)
        if keeps_limits(problem, plan):
            break
        share *= _SMALLER
    return plan


def sweep_lines(problem: ExcitationProblem, plan: MotionPlan) -> list[str]:
    """Return which joints are swept how fast, and which have no room."""
    assert isinstance(plan, LineTrajectory)
    fastest = np.max(np.abs(plan.speeds), axis=0)
    names = problem.joint_names
    swept = [
        f"{name} {speed:.2g}" for name, speed in zip(names, fastest) if speed > 0.0
    ]
    still = [name for name, speed in zip(names, fastest) if speed == 0.0]
    lines = [
        f"{len(swept)} joints swept at constant speeds, in {plan.duration:.0f} s; fastest in "
        f"rad/s: {', '.join(swept)}."
    ]
    if still:
        lines.append(
            f"No room to sweep {', '.join(still)}: nothing is learnt of their friction."
        )
    return lines


def _free_way(problem: ExcitationProblem, joint: int) -> Array:
    """Return how far (2,) a joint may go down (negative) and up from rest, the others resting."""
    found = np.zeros(2)
    ends = (problem.limits.lower[joint], problem.limits.upper[joint])
    for side, (sign, end) in enumerate(zip((-1.0, 1.0), ends)):
        room = min(abs(end - problem.rest[joint]), WIDEST)
        steps = np.arange(0.0, max(room, _STEP), _STEP)
        at = np.tile(problem.rest, (len(steps), 1))
        at[:, joint] += sign * steps
        free = int(np.argmin(np.append(_fits(problem, at), False)))
        found[side] = sign * max(free - 1, 0) * _STEP
    return found


def _swept(problem: ExcitationProblem, wide: Array, share: float) -> LineTrajectory:
    """Return the sweeps of all joints; ``wide`` (n, 2) is how far each may go."""
    points = [problem.rest]
    speeds = [0.0]
    for joint, (down, up) in enumerate(wide):
        if up - down < LEAST_ROOM:
            continue
        along = np.eye(problem.n_joints)[joint]
        fastest = SHARE * share * min(problem.limits.velocity[joint], FASTEST / SHARE)
        rising = np.geomspace(min(SLOWEST, 0.5 * fastest), fastest, SPEEDS)
        for speed in (*rising, *rising[::-1]):
            half = 0.5 * min(speed * CRUISE, up - down)
            middle = np.clip(0.0, down + half, up - half)
            ends = (middle - half, middle + half, middle - half)
            points += [problem.rest + end * along for end in ends]
            speeds += [speed] * len(ends)
        points.append(problem.rest)
        speeds.append(fastest)
    if len(points) == 1:
        raise InputError(
            "no joint has room to be swept at rest; widen the limits, or choose another rest "
            "position with --keyframe"
        )
    return _timed(problem, np.array(points), np.array(speeds[1:]), share)


def _timed(
    problem: ExcitationProblem, points: Array, speeds: Array, share: float
) -> LineTrajectory:
    """Return the motion along lines at speeds (P - 1,), shorter ways at what is needed for them."""
    ways = np.diff(points, axis=0)
    kept = np.any(ways != 0.0, axis=1)
    points = points[np.append(True, kept)]
    ways = ways[kept]
    speeds = speeds[kept]
    joint = np.argmax(np.abs(ways), axis=1)
    length = np.max(np.abs(ways), axis=1)
    hardest = SHARE * share * problem.limits.acceleration[joint]
    ramps = np.maximum(trajectories.PEAK_OF_RAMP * speeds / hardest, SHORTEST_RAMP)
    # Speed v over a way s takes s / v + ramp; where ramps do not fit, the way is ramps alone.
    moves = np.maximum(length / speeds + ramps, 2.0 * ramps)
    return LineTrajectory(points, moves, np.zeros(len(points)), ramps)
