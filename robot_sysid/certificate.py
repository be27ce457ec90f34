"""Proof that a trajectory obeys its limits: a dense check of the whole motion.

Positions, velocities, accelerations and torques are compared with their limits at 1 kHz or more.
Clearance is checked between samples as well: no point of the arm moves faster than
sum_j |qd_j| reach_j, so a configuration with slack s proves the motion free until that sum,
integrated over time, has used up s; only there is the next collision test needed (conservative
advancement, Mirtich, "Impulse-based dynamic simulation of rigid body systems", 1996, ch. 2).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robot_sysid.design_problem import Closest, ExcitationProblem
from robot_sysid.motion_constraints import LIMIT_NAMES
from robot_sysid.records import Array, Motion, MotionPlan
from robot_sysid.trajectory import motion_chunks

LEAST_RATE_HZ = 1000.0
FINEST_RATE_HZ = 4000.0
"""How densely clearance is tested where it is tight."""
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Excess:
    """One limit that is not kept, where it is exceeded most.

    Attributes:
        limit: which one, in words.
        share: value over limit (a clearance: 1 + missing distance over 0.05 m).
        time: when [s].
    """

    limit: str
    share: float
    time: float

    def __str__(self) -> str:
        return f"{self.limit} ({100.0 * (self.share - 1.0):.1f} % over at {self.time:.2f} s)"


@dataclass(frozen=True)
class Certificate:
    """Peaks of a trajectory against its limits.

    Attributes:
        lowest, highest: (n,) positions [rad].
        velocity, acceleration, torque: (n,) largest absolute values.
        closest: the tightest distance.
        closest_time: when [s].
        excesses: limits that are not kept; none for a trajectory that may be run.
        binding: limits used to 98 % or more, in words.
        n_collision_tests: how many configurations were tested.
    """

    lowest: Array
    highest: Array
    velocity: Array
    acceleration: Array
    torque: Array
    closest: Closest
    closest_time: float
    excesses: tuple[Excess, ...]
    binding: tuple[str, ...]
    n_collision_tests: int

    @property
    def holds(self) -> bool:
        """Whether every limit is kept."""
        return not self.excesses


@dataclass(frozen=True)
class _Peaks:
    """Largest share of each limit (4, n), when it is reached (4, n), and extremes (5, n)."""

    share: Array
    time: Array
    extremes: Array


def certify(problem: ExcitationProblem, plan: MotionPlan, sample_rate: float = 0.0) -> Certificate:
    """Check a whole trajectory.

    Args:
        problem: the arm and its limits.
        plan: the trajectory.
        sample_rate: at which it will be run [Hz]; at least 1 kHz is checked.
    """
    peaks = _joint_peaks(problem, plan, max(LEAST_RATE_HZ, sample_rate))
    closest, when, tests = _tightest(problem, plan, stop_below=-np.inf)
    excesses = [*_joint_excesses(problem, peaks)]
    if closest.slack < 0.0:
        excesses.append(Excess(f"clearance of {closest.label}", _clearance_share(closest), when))
    lowest, highest, velocity, acceleration, torque = peaks.extremes
    return Certificate(
        lowest,
        highest,
        velocity,
        acceleration,
        torque,
        closest,
        when,
        tuple(sorted(excesses, key=lambda excess: -excess.share)),
        tuple(_binding(problem, peaks, closest)),
        tests,
    )


def joint_share(problem: ExcitationProblem, plan: MotionPlan) -> tuple[float, float, Array]:
    """Return the largest share of a motion limit and of a torque limit, and when these peak [s].

    Motion limits are those of position, velocity and acceleration.
    """
    peaks = _joint_peaks(problem, plan, LEAST_RATE_HZ)
    over = peaks.share > 1.0
    return float(np.max(peaks.share[:3])), float(np.max(peaks.share[3])), peaks.time[over]


def first_contact(problem: ExcitationProblem, plan: MotionPlan) -> float | None:
    """Return the first time at which a clearance is not kept [s], or None."""
    closest, when, _ = _tightest(problem, plan, stop_below=0.0)
    return when if closest.slack < 0.0 else None


def tight_times(problem: ExcitationProblem, plan: MotionPlan, rate: float = 100.0) -> Array:
    """Return times [s] at which the slack has a local minimum below zero."""
    motion = plan.evaluate(np.arange(0.0, plan.duration, 1.0 / rate))
    slack = problem.obstacles.slack(motion.q)[0]
    padded = np.pad(slack, 1, constant_values=np.inf)
    lowest = (slack <= padded[:-2]) & (slack < padded[2:]) & (slack < 0.0)
    return motion.time[lowest]


def _joint_peaks(problem: ExcitationProblem, plan: MotionPlan, rate: float) -> _Peaks:
    limits, n = problem.limits, problem.n_joints
    center = 0.5 * (limits.lower + limits.upper)
    half = np.stack(
        (
            0.5 * (limits.upper - limits.lower),
            limits.velocity,
            limits.acceleration,
            limits.torque,
        )
    )
    share, time = np.zeros((4, n)), np.zeros((4, n))
    extremes = np.vstack((np.full(n, np.inf), np.full(n, -np.inf), np.zeros((3, n))))
    for motion in motion_chunks(plan, rate):
        torque = problem.torque(motion)
        signals = np.stack((motion.q - center, motion.qd, motion.qdd, torque))
        here = np.abs(signals) / half[:, None, :]
        where = np.argmax(here, axis=1)
        largest = np.take_along_axis(here, where[:, None, :], axis=1)[:, 0]
        time = np.where(largest > share, motion.time[where], time)
        share = np.maximum(share, largest)
        peaks = np.max(np.abs(signals[1:]), axis=1)
        extremes[0] = np.minimum(extremes[0], np.min(motion.q, axis=0))
        extremes[1] = np.maximum(extremes[1], np.max(motion.q, axis=0))
        extremes[2:] = np.maximum(extremes[2:], peaks)
    return _Peaks(share, time, extremes)


def _joint_excesses(problem: ExcitationProblem, peaks: _Peaks) -> Iterator[Excess]:
    for i, j in np.argwhere(peaks.share > 1.0 + _ROUNDING):
        limit = f"{LIMIT_NAMES[i]} limit of joint {problem.joint_names[j]}"
        yield Excess(limit, float(peaks.share[i, j]), float(peaks.time[i, j]))


def _binding(problem: ExcitationProblem, peaks: _Peaks, closest: Closest) -> Iterator[str]:
    for i, j in np.argwhere(peaks.share >= 0.98):
        yield f"{LIMIT_NAMES[i]} limit of joint {problem.joint_names[j]}"
    if closest.slack < 0.005:
        yield f"clearance of {closest.label}"


def _clearance_share(closest: Closest) -> float:
    return 1.0 - closest.slack / 0.05


def _tightest(
    problem: ExcitationProblem, plan: MotionPlan, stop_below: float
) -> tuple[Closest, float, int]:
    """Return the tightest configuration, its time [s], and the number of tests it took."""
    best, when, tests = Closest(np.inf, np.inf, ""), 0.0, 0
    travelled = free_until = 0.0
    for motion in motion_chunks(plan, FINEST_RATE_HZ):
        path = travelled + _path(motion, problem.obstacles.reach)
        travelled = float(path[-1])
        at = int(np.searchsorted(path, free_until))
        while at < len(path) and best.slack >= stop_below:
            here = problem.obstacles.closest(motion.q[at])
            tests += 1
            if here.slack < best.slack:
                best, when = here, float(motion.time[at])
            free_until = path[at] + max(0.0, here.slack)
            at = max(at + 1, int(np.searchsorted(path, free_until)))
    return best, when, tests


def _path(motion: Motion, reach: Array) -> Array:
    """Return how far any point may have moved since just before the motion began (N,) [m]."""
    speed = np.abs(motion.qd) @ reach
    before = np.concatenate((speed[:1], speed[:-1]))
    return np.cumsum(np.maximum(speed, before)) / FINEST_RATE_HZ
