"""Irregular samples to a uniform time grid."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement

GAP_STEPS = 1.75
"""A step so many times the usual one has lost at least one sample."""
# Clocks are rarely better than this part of a sampling period.
_REGULAR = 0.01
# Share of long steps beyond which they are how the stamps were rounded.
_RARELY = 0.01


@dataclass(frozen=True)
class UniformSignals:
    """Positions and torques on a uniform grid.

    Attributes:
        start: time of the first sample [s].
        rate: sample rate [Hz].
        q, tau: (N, n) [rad, N m].
        gap: (N,) length of the hole in the log that a sample bridges [s]; zero where there is none.
    """

    start: float
    rate: float
    q: Array
    tau: Array
    gap: Array
    notes: tuple[str, ...]


def resampled(measurement: Measurement) -> UniformSignals:
    """Put a log on a uniform grid.

    A log that is even up to the digits of its time stamps is taken as it is, except for single rows
    that are lost (``rows_lost``); else every joint is interpolated by cubic splines, at its own
    time stamps where it has them.
    """
    time = measurement.time
    if len(time) < 8:
        raise InputError(f"only {len(time)} samples; a log of several seconds is needed")
    if measurement.joint_time is None and is_even(time):
        lost = rows_lost(measurement)
        if np.any(lost):
            count = np.arange(len(time)) + np.concatenate(([0], np.cumsum(lost)))
            period = float(time[-1] - time[0]) / float(count[-1])
            whole = replace(measurement, time=time[0] + count * period)
            words = f"{np.sum(lost)} lost rows bridged by cubic splines"
            return _interpolated(whole, 1.0 / period, words)
        gap = np.zeros(len(time))
        exact = (len(time) - 1) / float(time[-1] - time[0])
        return UniformSignals(float(time[0]), exact, measurement.q, measurement.tau, gap, ())
    return _interpolated(measurement, 1.0 / usual_period(time))


def rows_lost(measurement: Measurement) -> NDArray[np.int64]:
    """Return (N - 1,) how many rows are missing between those of a log with coarse time stamps.

    A step that is twice as long, in stamps as coarse as the period, is a lost row, or a clock that
    is a little slow. Positions tell: over a lost row they go on twice as far as around it.
    """
    step = np.diff(measurement.time)
    lost = np.zeros(len(step), dtype=np.int64)
    usual = float(np.median(step))
    long = np.flatnonzero(step > GAP_STEPS * usual)
    if len(long) > _RARELY * len(step):
        return lost
    moved = np.diff(measurement.q, axis=0)
    for place in long[(long > 0) & (long < len(step) - 1)]:
        missing = round(float(step[place]) / usual) - 1
        around = 0.5 * (moved[place - 1] + moved[place + 1])
        further = np.sum(moved[place] * around) - (1.0 + 0.5 * missing) * np.sum(around**2)
        lost[place] = missing if further > 0.0 else 0
    return lost


def usual_period(time: Array) -> float:
    """Return the mean step between time stamps (N,), holes left out [s]."""
    step = np.diff(time)
    return float(np.mean(step[step <= GAP_STEPS * np.median(step)]))


def is_even(time: Array) -> bool:
    """Return whether time stamps are evenly spaced, up to their number of digits."""
    line = np.linspace(time[0], time[-1], len(time))
    period = float(time[-1] - time[0]) / (len(time) - 1)
    # The weight of the last decimal in use, at most a millisecond.
    scaled = (((time - time[0]) * 10.0**digits, digits) for digits in (3, 4, 5, 6))
    whole = (k for since, k in scaled if np.all(np.abs(since - np.round(since)) < 1e-3))
    last_digit = next((10.0**-k for k in whole), 0.0)
    return bool(np.max(np.abs(time - line)) <= max(_REGULAR * period, 1.01 * last_digit))


def _interpolated(measurement: Measurement, rate: float, why: str = "") -> UniformSignals:
    from scipy.interpolate import CubicSpline

    time = measurement.time
    own = measurement.joint_time
    first = float(time[0] if own is None else max(time[0], own[0].max()))
    last = float(time[-1] if own is None else min(time[-1], own[-1].min()))
    # A last sample that rounding puts just beyond the end is still on the grid.
    count = math.floor((last - first) * rate + 1e-6) + 1
    grid = np.minimum(first + np.arange(count) / rate, last)
    q, tau = np.empty((count, measurement.q.shape[1])), np.empty((count, measurement.q.shape[1]))
    for joint in range(q.shape[1]):
        stamps = time if own is None else own[:, joint]
        fresh = is_fresh(stamps)
        both = np.column_stack((measurement.q[:, joint], measurement.tau[:, joint]))
        q[:, joint], tau[:, joint] = CubicSpline(stamps[fresh], both[fresh])(grid).T
    said = "each joint at its own time stamps" if own is not None else "uneven time stamps"
    note = f"resampled to a uniform {rate:.6g} Hz ({why or said + ', cubic splines'})"
    step = np.diff(time)
    index = np.clip(np.searchsorted(time, grid) - 1, 0, len(step) - 1)
    nearest = np.minimum(np.abs(grid - time[index]), np.abs(grid - time[index + 1]))
    bridged = (step[index] > GAP_STEPS / rate) & (nearest >= 1e-3 / rate)
    return UniformSignals(first, rate, q, tau, np.where(bridged, step[index], 0.0), (note,))


def is_fresh(stamps: Array) -> NDArray[np.bool_]:
    """Return (N,) whether each row holds a new sample of a joint with these time stamps (N,)."""
    return np.concatenate(([True], np.diff(stamps) > 0.0))
