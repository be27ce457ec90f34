"""Friction alone: one joint after the other goes slowly back and forth at constant speeds.

At constant speed nothing but friction and gravity acts on a joint, and gravity is the same on the
way there and back. The speeds are a geometric series, because friction bends most where it is slow;
they go up and down again, so that friction that changes with time does not look like one of speed.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.excitation.limit_check import keeps_limits
from robot_sysid.excitation.problem import ExcitationProblem
from robot_sysid.excitation.static.sweep_trajectory import PEAK_ACCELERATION, SweepTrajectory
from robot_sysid.excitation.trajectory_files import SlowedTrajectory
from robot_sysid.records import Array, Motion, MotionPlan, RobotModel

SLOWEST, FASTEST = 0.02, 1.0
"""Speeds of the first and the last sweep [rad/s]; the last is lower where limits ask for it."""
SPEEDS, CRUISE = 6, 0.8
"""How many speeds, and how long each is held at a time [s] where the joint has room."""
SHARE = 0.8
"""Share of the limits of speed and acceleration that sweeps use."""
SHORTEST_RAMP = 0.15
WIDEST = 1.0
"""Farthest that a joint leaves its rest position [rad]."""
LEAST_ROOM = 0.02
"""Way [rad] below which a joint cannot be swept."""
_STEP, _MOST_SMALLER, _SMALLER = 0.01, 8, 0.7


def design_sweeps(problem: ExcitationProblem) -> SweepTrajectory:
    """Return a motion that sweeps every joint that has room, within all limits.

    Raises:
        InputError: no joint can move.
    """
    wide = np.array([_free_way(problem, joint) for joint in range(problem.n_joints)])
    share = 1.0
    for _ in range(_MOST_SMALLER):
        plan = _through(problem, share * wide, share)
        if keeps_limits(problem, plan):
            return plan
        share *= _SMALLER
    return plan


def sweep_lines(robot: RobotModel, problem: ExcitationProblem, plan: MotionPlan) -> list[str]:
    """Return which joints are swept how fast, and which have no room."""
    sweeps = plan.plan if isinstance(plan, SlowedTrajectory) else plan
    assert isinstance(sweeps, SweepTrajectory)
    speeds = np.abs(sweeps.speeds) * sweeps.duration / plan.duration
    fastest = np.max(speeds, axis=0)
    names = problem.joint_names
    swept = [f"{name} {speed:.2g}" for name, speed in zip(names, fastest) if speed > 0.0]
    still = [name for name, speed in zip(names, fastest) if speed == 0.0]
    lines = [
        f"{len(swept)} joints swept at constant speeds, in {plan.duration:.0f} s; fastest in "
        f"rad/s: {', '.join(swept)}."
    ]
    if still:
        lines.append(f"No room to sweep {', '.join(still)}: nothing is learnt of their friction.")
    return lines


def _free_way(problem: ExcitationProblem, joint: int) -> Array:
    """Return how far (2,) a joint may go down (negative) and up from rest, the others resting."""
    found = np.zeros(2)
    ends = problem.limits.lower[joint], problem.limits.upper[joint]
    for side, (sign, end) in enumerate(zip((-1.0, 1.0), ends)):
        room = min(abs(end - problem.rest[joint]), WIDEST)
        steps = np.arange(0.0, room, _STEP)
        at = np.tile(problem.rest, (len(steps), 1))
        at[:, joint] += sign * steps
        still = np.zeros_like(at)
        torque = np.abs(problem.torque(Motion(np.arange(float(len(at))), at, still, still)))
        fits = np.all(torque <= problem.limits.torque, axis=1)
        fits &= np.asarray(problem.obstacles.slack(at).value) >= 0.0
        free = len(steps) if np.all(fits) else int(np.argmin(fits))
        found[side] = sign * max(free - 1, 0) * _STEP
    return found


def _through(problem: ExcitationProblem, wide: Array, share: float) -> SweepTrajectory:
    """Return the sweeps of all joints; ``wide`` (n, 2) is how far each may go."""
    points, speeds = [problem.rest], [0.0]
    for joint, (down, up) in enumerate(wide):
        if up - down < LEAST_ROOM:
            continue
        fastest = SHARE * share * min(problem.limits.velocity[joint], FASTEST / SHARE)
        rising = np.geomspace(min(SLOWEST, 0.5 * fastest), fastest, SPEEDS)
        for speed in (*rising, *rising[::-1]):
            half = 0.5 * min(speed * CRUISE, up - down)
            middle = np.clip(0.0, down + half, up - half)
            for end in (middle - half, middle + half, middle - half):
                points.append(_moved(problem.rest, joint, end))
                speeds.append(speed)
        points.append(problem.rest)
        speeds.append(fastest)
    if len(points) == 1:
        raise InputError(
            "no joint has room to be swept at rest; widen the limits, or choose another rest "
            "position with --keyframe"
        )
    return _timed(problem, np.array(points), np.array(speeds[1:]), share)


def _moved(rest: Array, joint: int, way: float) -> Array:
    point = rest.copy()
    point[joint] += way
    return point


def _timed(
    problem: ExcitationProblem, points: Array, speeds: Array, share: float
) -> SweepTrajectory:
    """Return the motion along lines at speeds (P - 1,), shorter ways at what is needed for them."""
    ways = np.diff(points, axis=0)
    kept = np.any(ways != 0.0, axis=1)
    points, ways, speeds = points[np.append(True, kept)], ways[kept], speeds[kept]
    joint = np.argmax(np.abs(ways), axis=1)
    length = np.max(np.abs(ways), axis=1)
    hardest = SHARE * share * problem.limits.acceleration[joint]
    ramps = np.maximum(PEAK_ACCELERATION * speeds / hardest, SHORTEST_RAMP)
    # Speed v over a way s takes s / v + ramp; where ramps do not fit, the way is ramps alone.
    moves = np.maximum(length / speeds + ramps, 2.0 * ramps)
    return SweepTrajectory(points, moves, ramps)
