"""Check whether a trajectory keeps all limits, at all times, however it was made.

Positions, velocities, accelerations and torques are compared with their limits at 1 kHz or more.
Clearance is checked between samples as well: two bodies approach each other no faster than
sum_j |qd_j| rate_j, so between two configurations with slacks s1 and s2 the slack is at least half
of s1 + s2 less that sum, integrated over the time between them. Where that is not enough, the
configuration in the middle is tested, and so on (conservative advancement from both sides; Mirtich,
"Impulse-based dynamic simulation of rigid body systems", 1996, ch. 2).

The check is for one serial chain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.motion.clearance import Clearance, Closest
from robot_sysid.motion.problem import OBSTACLE_LENGTH, ExcitationProblem
from robot_sysid.records import LimitUse, MotionPlan
from robot_sysid.trajectory import (
    SineTrajectory,
    StoppingTrajectory,
    motion_chunks,
    sample_times,
)

LEAST_RATE_HZ = 1000.0
"""Lowest rate at which a motion is checked [Hz]."""
FIRST_RATE_HZ = 100.0
"""Rate of the first look at a motion of which only whether it keeps its limits is asked [Hz]."""
TOUCH = 1e-6
"""By how much a clearance may be missed [m]: MuJoCo's tolerance for distances of convex shapes. The
approach is a sum with rounding errors, so a motion that just keeps a clearance may miss it by
1e-9 m."""

PRECISION = 1e-3
"""How exactly the least slack of a motion is told [m]."""
CONTACT_RATE_HZ = 4000.0
"""Highest rate of tests of clearance, where bodies are near each other [Hz]: at 2 m/s a body moves
0.5 mm between two of them."""
SHRINKAGE = 0.95
"""Factor by which a motion that breaks a limit is scaled down again and again."""
SOFTENING = 1.5
"""Factor by which stops that break a limit take longer, again and again."""
LONGEST_STOPPING = 10.0
"""Longest time in which a motion stops [s]: its acceleration is that of the path, or its limits are
broken by the path itself."""


@dataclass(frozen=True)
class LimitCheck:
    """A trajectory against all its limits.

    Attributes:
        uses: of all limits of joints and tool.
        closest: the pair with the least slack: distance minus required distance.
        excesses: limits that are not kept, the worst first; none for a trajectory that may be run.
    """

    uses: Sequence[LimitUse]
    closest: Closest
    excesses: Sequence[LimitUse]


def check_limits(
    problem: ExcitationProblem, plan: MotionPlan, sample_rate: float = 0.0
) -> LimitCheck:
    """Return the check of an entire trajectory against all limits.

    Args:
        problem: the arm and its limits.
        plan: the trajectory.
        sample_rate: at which it will be run [Hz]; it is checked at this rate, at least at 1 kHz.
    """
    uses = _uses(problem, plan, max(LEAST_RATE_HZ, sample_rate))
    excesses = [use for use in uses if not use.is_kept]
    closest = _tightest(problem.obstacles, plan, PRECISION)
    if closest.slack < -TOUCH:
        missing = OBSTACLE_LENGTH - closest.slack
        numbers = missing, OBSTACLE_LENGTH, closest.time, False
        excesses.append(LimitUse("clearance", closest.label, 0.0, *numbers))
    excesses.sort(key=lambda excess: -excess.share)
    return LimitCheck(uses, closest, excesses)


def scale_to_limits(
    problem: ExcitationProblem, plan: SineTrajectory, sample_rate: float
) -> tuple[SineTrajectory, float]:
    """Return a motion with amplitudes scaled down to keep all limits, and their factor.

    Where even the smallest motion breaks a limit, the smallest motion is returned.

    Args:
        problem: the arm and its limits.
        plan: the motion.
        sample_rate: at which it will be run [Hz]; it is checked at this rate, at least at 1 kHz.
    """
    rate = max(LEAST_RATE_HZ, sample_rate)
    factor = 1.0
    scaled = plan
    while factor > 2.0**-9 and not keeps_limits(problem, scaled, rate):
        factor *= SHRINKAGE
        scaled = plan.scale_amplitudes(factor)
    return scaled, factor


def with_stops(problem: ExcitationProblem, path: SineTrajectory) -> StoppingTrajectory:
    """Return a path with stops on its way, the shortest ones tried that keep all limits.

    Its positions are those of the path, and keep all clearances where the path does.

    Args:
        problem: the arm and its limits.
        path: the motion without stops.
    """
    stopping = StoppingTrajectory(path)
    while stopping.stopping_time < LONGEST_STOPPING:
        if all(use.is_kept for use in _uses(problem, stopping, LEAST_RATE_HZ)):
            break
        softer = SOFTENING * stopping.stopping_time
        stopping = replace(stopping, stopping_time=softer)
    return stopping


def keeps_limits(
    problem: ExcitationProblem, plan: MotionPlan, sample_rate: float = LEAST_RATE_HZ
) -> bool:
    """Return whether a motion keeps every limit, sampled at ``sample_rate`` [Hz]; clearances are
    checked between the samples too.
    """
    # Most motions that break a limit break it at the samples of a lower rate too.
    for rate in sorted({min(FIRST_RATE_HZ, sample_rate), sample_rate}):
        if not all(use.is_kept for use in _uses(problem, plan, rate)):
            return False
    return first_contact(problem, plan) is None


def first_contact(problem: ExcitationProblem, plan: MotionPlan) -> Closest | None:
    """Return the bodies between which a clearance is first not kept along a motion, and when; None
    where all are kept.
    """
    # How much room there is where all clearances are kept is not asked.
    closest = _tightest(problem.obstacles, plan, np.inf)
    return closest if closest.slack < 0.0 else None


def _uses(problem: ExcitationProblem, plan: MotionPlan, rate: float) -> list[LimitUse]:
    """Return how far a motion sampled at a rate [Hz] uses the limits of joints and tool."""
    chunks = motion_chunks(plan, rate)
    samples = ((motion.time, problem.signals(motion)) for motion in chunks)
    return problem.limits.uses(samples, problem.owners)


def _tightest(obstacles: Clearance, plan: MotionPlan, precision: float) -> Closest:
    """Return the pair with the least slack along a motion, and the time of that configuration.

    A slack below -TOUCH anywhere along the motion is found, and the search ends after the stretch
    of the motion with it.

    Args:
        obstacles: distances of the arm.
        plan: the motion.
        precision: by how much the least slack of a motion without contact may be smaller than the
            one returned [m].
    """
    least = np.inf
    rate = CONTACT_RATE_HZ
    for time in sample_times(plan.duration, rate):
        # Up to the first sample of the next stretch.
        end = min(time[-1] + 1.0 / rate, plan.duration)
        motion = plan.evaluate(np.append(time, end))
        # How far the pairs of each row of ``rates`` may have approached since the first sample.
        speed = np.abs(motion.qd) @ obstacles.rates.T
        steps = np.maximum(speed[1:], speed[:-1]) / rate
        path = np.vstack((0.0 * speed[:1], np.cumsum(steps, axis=0)))
        # Every 64th sample first.
        tested = np.append(np.arange(0, len(time), 64), len(time))
        slacks = obstacles.slacks(motion.q[tested])
        while True:
            best = np.argmin(np.min(slacks, axis=1))
            if np.min(slacks[best]) < least:
                least = np.min(slacks[best])
                tightest = motion.q[tested[best]], motion.time[tested[best]]
            # Slack above the floor may be used up untested: no contact and no lower minimum is
            # missed by it.
            floor = least - PRECISION
            if least >= -TOUCH:
                floor = max(-TOUCH, least - precision)
            approach = np.diff(path[tested], axis=0)
            room = 0.5 * np.min(slacks[:-1] + slacks[1:] - approach, axis=1)
            is_open = (room < floor) & (np.diff(tested) > 1)
            if not np.any(is_open):
                break
            middle = (tested[:-1] + tested[1:])[is_open] // 2
            at = np.flatnonzero(is_open) + 1
            tested = np.insert(tested, at, middle)
            slacks = np.insert(slacks, at, obstacles.slacks(motion.q[middle]), axis=0)
        if least < -TOUCH:
            break
    q, instant = tightest
    return replace(obstacles.closest_pair(q), time=instant)
