"""Motions as people record them, around that of an excitation."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rigs.arms.wrong_arms import RATE
from robot_sysid.records import Array, Motion, MotionPlan

Move = Callable[[MotionPlan, np.random.Generator], Motion]
"""Function that returns a motion around that of an excitation."""


def sampled(time: Array, q: Array) -> Motion:
    """Return the motion through positions (N, n) at times (N,), by a spline of degree five."""
    from scipy.interpolate import make_interp_spline

    spline = make_interp_spline(time, q, 5)
    return Motion(time, spline(time), spline(time, 1), spline(time, 2))


def ranges(plan: MotionPlan) -> tuple[Array, Array]:
    """Return middle and half range (n,) of the positions of a plan."""
    q = plan.evaluate(np.arange(0.0, plan.duration, 0.02)).q
    return np.mean(q, axis=0), 0.5 * np.ptp(q, axis=0)


def sines(tones: int, plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return sines of one or more tones per joint."""
    middle, half = ranges(plan)
    time = np.arange(round(RATE * plan.duration)) / RATE
    q = np.tile(middle, (len(time), 1))
    for _ in range(tones):
        rates = 2.0 * np.pi * rng.uniform(0.1, 0.4, len(middle))
        phases = rng.uniform(0.0, 2.0 * np.pi, len(middle))
        q += half / tones * np.sin(np.outer(time, rates) + phases)
    return sampled(time, q)


def planned(plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return the excitation itself."""
    return plan.evaluate(np.arange(round(RATE * plan.duration)) / RATE)


def slow(plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return the excitation at a third of its speed."""
    motion = plan.evaluate(np.arange(round(RATE * plan.duration)) / RATE / 3.0)
    time = np.arange(len(motion.q)) / RATE
    return Motion(time, motion.q, motion.qd / 3.0, motion.qdd / 9.0)


def pick_and_place(plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return moves between poses, with rests of half a second."""
    middle, half = ranges(plan)
    poses = middle + half * rng.uniform(-1.0, 1.0, (8, len(middle)))
    time = np.arange(round(RATE * plan.duration)) / RATE
    period = plan.duration / 7.0
    part = np.minimum((time / period).astype(int), 6)
    share = np.clip((time - part * period) / (period - 0.5), 0.0, 1.0)
    s = (10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5)[:, None]
    rate = ((30.0 * share**2 - 60.0 * share**3 + 30.0 * share**4) / (period - 0.5))[
        :, None
    ]
    bend = ((60.0 * share - 180.0 * share**2 + 120.0 * share**3) / (period - 0.5) ** 2)[
        :, None
    ]
    step = np.diff(poses, axis=0)[part]
    return Motion(time, poses[part] + s * step, rate * step, bend * step)


def one_at_a_time(plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return a motion in which one joint after the other swings, and the others stand."""
    middle, half = ranges(plan)
    n = len(middle)
    time = np.arange(round(RATE * plan.duration)) / RATE
    span = plan.duration / n
    q = np.tile(middle, (len(time), 1))
    qd, qdd = np.zeros((2, *q.shape))
    rate = 2.0 * np.pi * 2.0 / span
    for joint in range(n):
        own = (time >= joint * span) & (time < (joint + 1) * span)
        phase = rate * (time[own] - joint * span)
        # Two swings that begin and end at rest.
        q[own, joint] += 0.5 * half[joint] * (1.0 - np.cos(phase))
        qd[own, joint] = 0.5 * half[joint] * rate * np.sin(phase)
        qdd[own, joint] = 0.5 * half[joint] * rate**2 * np.cos(phase)
    return Motion(time, q, qd, qdd)


def on_limit(plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return the excitation with one joint that lies on its limit now and then."""
    motion = planned(plan, rng)
    joint = int(rng.integers(motion.q.shape[1]))
    limit = np.quantile(motion.q[:, joint], 0.75)
    lies = motion.q[:, joint] > limit
    q, qd, qdd = motion.q.copy(), motion.qd.copy(), motion.qdd.copy()
    q[lies, joint] = limit
    qd[lies, joint] = qdd[lies, joint] = 0.0
    return Motion(motion.time, q, qd, qdd)


def resting(first: float, last: float, plan: MotionPlan) -> Motion:
    """Return the excitation with a rest from one share of the time to another one.

    It comes to rest and goes on within a tenth of the time.
    """
    time = np.arange(round(RATE * plan.duration)) / RATE
    share = time / plan.duration
    stops = smooth_step((share - first) / 0.1)
    goes_on = smooth_step((share - last) / 0.1)
    pace = 1.0 - stops + goes_on
    travelled = np.cumsum(pace) / RATE
    motion = sampled(time, plan.evaluate(np.minimum(travelled, plan.duration)).q)
    moves = pace[:, None] > 0.0
    return Motion(time, motion.q, moves * motion.qd, moves * motion.qdd)


def smooth_step(share: Array) -> Array:
    """Return numbers that rise from zero to one between shares zero and one, with rest at both."""
    s = np.clip(share, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


def of_joints(joints: Sequence[int], motion: Motion, size: float = 1.0) -> Motion:
    """Return a motion of some joints alone, by a share of their way; the others stand."""
    moves = np.isin(np.arange(motion.q.shape[1]), joints) * size
    middle = np.mean(motion.q, axis=0)
    return Motion(
        motion.time,
        middle + moves * (motion.q - middle),
        moves * motion.qd,
        moves * motion.qdd,
    )
