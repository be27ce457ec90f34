"""A motion to be shown, with how near it comes to its limits; and whether it is shown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.records import Array, Measurement, Motion, MotionPlan, RobotModel

if TYPE_CHECKING:
    from robot_sysid.motion.problem import ExcitationProblem

RATE = 20.0
"""Pictures per second."""
_FARTHEST = 0.3
"""Clearance above which it is all the same [m]: thirty times the least that a plan keeps."""
_STEP = 0.02
"""By which a log is shifted along its plan to find where it fits [s]: under half a picture."""


@dataclass(frozen=True)
class Strip:
    """One quantity over time (T,), NaN where nothing is known, and what it has to keep."""

    title: str
    values: Array
    limit: float


@dataclass(frozen=True)
class Shown:
    """What is shown of a motion, T pictures.

    Attributes:
        ghost: (T, n) measured positions beside those shown; NaN before and after the log.
    """

    time: Array
    q: Array
    strips: tuple[Strip, ...]
    ghost: Array | None = None
    notes: tuple[str, ...] = ()


def shown_plan(
    problem: ExcitationProblem, plan: MotionPlan, log: Measurement | None = None
) -> Shown:
    """Return a planned motion with its limits, and a log of the arm that played it as ghost."""
    motion = plan.evaluate(np.linspace(0.0, plan.duration, _count(plan.duration)))
    limits, largest = problem.limits, problem.limits.largest
    torque = problem.torque(motion)
    clearances = problem.obstacles.distances
    near = np.array([min(clearances.slack_at(q)[0], _FARTHEST) for q in motion.q])
    known = near if np.isfinite(clearances.closest(motion.q[0]).distance) else near * np.nan
    shares = _shares((motion.q - limits.center, motion.qd, torque), largest[[0, 1, 3]])
    strips = (*shares, Strip("clearance [mm]", 1000.0 * known, 0.0))
    if log is None:
        return Shown(motion.time, motion.q, strips)
    ghost, note = _beside(motion, log, problem.joint_names)
    return Shown(motion.time, motion.q, strips, ghost, (note,))


def shown_log(robot: RobotModel, log: Measurement) -> Shown:
    """Return the motion of a log with the model's limits."""
    time = log.time - log.time[0]
    at = np.linspace(0.0, float(time[-1]), _count(float(time[-1])))
    q, tau = (at_times(at, time, values) for values in (log.q, log.tau))
    qd = np.gradient(q, at, axis=0) if log.qd is None else at_times(at, time, log.qd)
    limits = robot.limits
    span = 0.5 * (limits.upper - limits.lower)
    center = np.where(np.isfinite(span), limits.upper, 0.0) - np.where(np.isfinite(span), span, 0.0)
    largest = (span, limits.velocity, limits.torque)
    return Shown(at, q, tuple(_shares((q - center, qd, tau), largest)))


def _count(duration: float) -> int:
    return max(2, round(duration * RATE) + 1)


def _shares(signals: Iterable[Array], limits: Iterable[Array]) -> Iterator[Strip]:
    """Yield each signal's (T, n) largest share of its limit (n,) [%], NaN without limits."""
    titles = ("position [% of range]", "speed [% of limit]", "torque [% of limit]")
    for title, values, limit in zip(titles, signals, limits):
        shares = 100.0 * np.max(np.abs(values) / limit, axis=1)
        yield Strip(title, shares if np.any(np.isfinite(limit)) else shares * np.nan, 100.0)


def at_times(at: Array | float, time: Array, values: Array, outside: float | None = None) -> Array:
    """Return values (N, n) at times (N,) at other times (M,) or one, ``outside`` beyond them."""
    return np.stack([np.interp(at, time, column, outside, outside) for column in values.T], axis=-1)


def _beside(motion: Motion, log: Measurement, joints: tuple[str, ...]) -> tuple[Array, str]:
    """Return (a log's positions beside a motion, at the shift that fits best; how they fit)."""
    time = log.time - log.time[0]
    longest, played = float(time[-1]), float(motion.time[-1])
    overlap = 0.5 * min(longest, played)
    shifts = np.arange(overlap - played, longest - overlap + _STEP, _STEP)
    thin = slice(None, None, max(1, len(motion.time) // 200))
    planned, when = motion.q[thin], motion.time[thin]
    off_by = (planned - at_times(when + shift, time, log.q, np.nan) for shift in shifts)
    shift = float(shifts[int(np.argmin([np.nanmean(off**2) for off in off_by]))])
    ghost = at_times(motion.time + shift, time, log.q, np.nan)
    off = np.nanmax(np.abs(ghost - motion.q), axis=0)
    worst = int(np.argmax(off))
    note = (
        f"the plan begins {shift:.2f} s into the log; measured positions are up to "
        f"{off[worst]:.3g} rad off it, at {joints[worst]}"
    )
    return ghost, note
