"""Long and irregular logs: gaps and length split them into pieces, too many rows become fewer, and
a piece is put on a uniform time grid.

Each piece is filtered on its own. Two hours at 1 kHz say no more about an arm than the same hours
at 60 Hz, and take sixteen times the memory: times, positions and torques pass one zero-phase
low-pass and are decimated, which leaves a log recorded at a lower rate behind a proper filter.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement
from robot_sysid.signals.filters import Decimator, design_low_pass

GAP_STEPS = 1.75
"""A step so many times the usual one has lost at least one sample; a late one comes up to 1.7
periods after an early one (tests/signals/test_resampling.py)."""
# Clocks are rarely better than this part of a sampling period (chosen).
_REGULAR = 0.01
# Share of long steps beyond which they are how the stamps were rounded.
_RARELY = 0.01


@dataclass(frozen=True)
class UniformSignals:
    """Positions and torques (N, n) on a uniform grid from ``start`` [s] with ``rate`` [Hz].

    ``gap`` (N,) is the length of the hole in the log that a sample bridges [s], or zero.
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
        raise InputError(
            f"only {len(time)} samples; a log of several seconds is needed"
        )
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
        return UniformSignals(
            float(time[0]), exact, measurement.q, measurement.tau, gap, ()
        )
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
    for place in long[(long > 0) & (long < len(step) - 1)]:
        missing = round(float(step[place]) / usual) - 1
        before, moved, after = np.diff(measurement.q[place - 1 : place + 3], axis=0)
        around = 0.5 * (before + after)
        further = np.sum(moved * around) - (1.0 + 0.5 * missing) * np.sum(around**2)
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
    return bool(
        np.max(np.abs(time - line)) <= max(_REGULAR * period, 1.01 * last_digit)
    )


def _interpolated(
    measurement: Measurement, rate: float, why: str = ""
) -> UniformSignals:
    from scipy.interpolate import CubicSpline

    time = measurement.time
    own = measurement.joint_time
    first = float(time[0] if own is None else max(time[0], own[0].max()))
    last = float(time[-1] if own is None else min(time[-1], own[-1].min()))
    # A last sample that rounding puts just beyond the end is still on the grid.
    count = math.floor((last - first) * rate + 1e-6) + 1
    grid = np.minimum(first + np.arange(count) / rate, last)
    q, tau = np.empty((2, count, measurement.q.shape[1]))
    for joint in range(q.shape[1]):
        stamps = time if own is None else own[:, joint]
        fresh = is_fresh(stamps)
        both = np.column_stack((measurement.q[:, joint], measurement.tau[:, joint]))
        q[:, joint], tau[:, joint] = CubicSpline(stamps[fresh], both[fresh])(grid).T
    said = (
        "each joint at its own time stamps" if own is not None else "uneven time stamps"
    )
    note = f"resampled to a uniform {rate:.6g} Hz ({why or said + ', cubic splines'})"
    step = np.diff(time)
    index = np.clip(np.searchsorted(time, grid) - 1, 0, len(step) - 1)
    nearest = np.minimum(np.abs(grid - time[index]), np.abs(grid - time[index + 1]))
    bridged = (step[index] > GAP_STEPS / rate) & (nearest >= 1e-3 / rate)
    return UniformSignals(
        first, rate, q, tau, np.where(bridged, step[index], 0.0), (note,)
    )


def is_fresh(stamps: Array) -> NDArray[np.bool_]:
    """Return (N,) whether each row holds a new sample of a joint with these time stamps (N,)."""
    return np.concatenate(([True], np.diff(stamps) > 0.0))


SPLITTING = 0.5
"""Gap that no spline bridges and no filter reaches over (chosen) [s]."""
SPLITTING_STEPS = 20.0
"""The same in sampling periods, for slow logs."""
SHORTEST = 4.0
"""Piece that is too short to be worth filtering, as its ends are cut off (chosen) [s]."""
MOST_ROWS = 100_000
"""Rows of a piece beyond which it is cut, so that filtering it takes little memory."""
MOST_TIME = 600.0
"""Length of a log beyond which parts of it, spread evenly, stand for the whole [s]: half a minute
tells nearly as much of the link as an hour (docs/measurements.md)."""
PART_TIME = 60.0
"""Length of these parts [s]."""
_MOVING = 0.1
"""Share of the largest range of a joint in any part below which none moves in a part."""


def longest_step(period: float) -> float:
    """Return the longest step of time within a piece [s], for a usual step of ``period`` [s]."""
    return max(SPLITTING, SPLITTING_STEPS * period)


def pieces_of(samples: Measurement) -> tuple[Measurement, ...]:
    """Return the pieces between the gaps of a log, those that are long enough.

    A log without gaps is its own only piece, and so is one whose pieces are all too short.
    """
    step = np.diff(samples.time)
    if not len(step):
        return (samples,)
    cuts = np.flatnonzero(step > longest_step(float(np.median(step)))) + 1
    edges = [0, *cuts.tolist(), len(samples)]
    span = float(samples.time[-1] - samples.time[0])
    most = (
        MOST_ROWS
        if span <= MOST_TIME
        else min(MOST_ROWS, round(PART_TIME / np.median(step)))
    )
    # Equal parts of each piece, none with more rows than that.
    parts = [
        np.linspace(a, b, -(-(b - a) // most) + 1) for a, b in zip(edges, edges[1:])
    ]
    cut = (part.astype(int).tolist() for part in parts if part[-1] - part[0] > 1)
    spans = [span for ends in cut for span in zip(ends, ends[1:])]
    if len(spans) == 1:
        return (samples,)
    long = [
        (a, b) for a, b in spans if samples.time[b - 1] - samples.time[a] >= SHORTEST
    ]
    return tuple(part_of(samples, a, b) for a, b in _spread(samples, long)) or (
        samples,
    )


def piece_note(
    samples: Measurement, pieces: tuple[Measurement, ...]
) -> tuple[str, ...]:
    """Return a sentence on a log that gaps split; nothing on one that has none."""
    used = sum(len(piece) for piece in pieces)
    if len(pieces) == 1 and used == len(samples):
        return ()
    left = f"; {len(samples) - used} rows of other pieces are left out" * (
        used < len(samples)
    )
    if sum(float(piece.time[-1] - piece.time[0]) for piece in pieces) > 0.5 * MOST_TIME:
        left += ", as the log is longer than any result needs" * (used < len(samples))
    gap = float(np.max(np.diff(samples.time)))
    has_gaps = gap > longest_step(float(np.median(np.diff(samples.time))))
    why = f"gaps of up to {gap:.3g} s split" if has_gaps else "its length splits"
    return (
        f"{why} the log into {len(pieces)} pieces of at least {SHORTEST:g} s, each filtered on its "
        f"own{left}",
    )


def _spread(
    samples: Measurement, spans: list[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Return as many of the spans as ``MOST_TIME`` allows, evenly spread over those that move."""
    time = samples.time
    if sum(time[b - 1] - time[a] for a, b in spans) <= MOST_TIME:
        return spans
    ranges = np.array([np.ptp(samples.q[a:b], axis=0) for a, b in spans])
    moved = np.max(ranges / np.maximum(np.max(ranges, axis=0), 1e-12), axis=1)
    moving = [span for span, share in zip(spans, moved) if share > _MOVING]
    total = float(sum(time[b - 1] - time[a] for a, b in moving))
    count = max(1, int(len(moving) * min(1.0, MOST_TIME / total)))
    return [
        moving[k] for k in np.linspace(0, len(moving) - 1, count).round().astype(int)
    ]


def part_of(samples: Measurement, start: int, stop: int) -> Measurement:
    """Return some consecutive samples of a log."""
    whole = {each.name: getattr(samples, each.name) for each in fields(Measurement)}
    return replace(
        samples, **{n: v[start:stop] for n, v in whole.items() if v is not None}
    )


MOST_KEPT = 300_000
"""Rows beyond which a log is thinned; so 1 GB is read in 153 MB (docs/logs.md)."""
LEAST_RATE = 60.0
"""Rows per second that thinning leaves at least (docs/logs.md) [Hz]."""
# Of the rate that is left; flat below 0.4 times this, and what folds back stays above that.
_CUTOFF = 0.45


def bounded(
    chunks: Iterable[Measurement], count: int
) -> tuple[tuple[Measurement, ...], tuple[str, ...]]:
    """Return (pieces of a simulated run of so many samples, a sentence on how it was cut).

    A long one is thinned and cut as a log is, without velocities and accelerations, which no
    estimate takes from a recording.
    """
    if count <= MOST_KEPT:
        return (join_measurements(chunks),), ()
    parts = []
    thinning = None
    for each in chunks:
        thinning = thinning or Thinning.of(each.time, count)
        rows = thinning.push(np.column_stack((each.time, each.time, each.q, each.tau)))
        parts.append(rows[:, 1:])
    time, q, tau = np.split(np.concatenate(parts), (1, 1 + each.q.shape[1]), axis=1)
    whole = Measurement(time[:, 0].copy(), q.copy(), None, tau.copy())
    pieces = pieces_of(whole)
    return pieces, piece_note(whole, pieces)


def join_measurements(chunks: Iterable[Measurement]) -> Measurement:
    """Return consecutive chunks as one measurement."""
    parts = list(chunks)
    there = [
        each.name
        for each in fields(Measurement)
        if getattr(parts[0], each.name) is not None
    ]
    made: dict[str, Any] = {"qd": None}
    made |= {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in there
    }
    return Measurement(**made)


class Thinning:
    """Passes rows on, every one or every so many; ``period`` is their usual step of time [s]."""

    def __init__(self, every: int, period: float) -> None:
        self.every = every
        self._longest = longest_step(period)
        self._last = np.nan
        if every > 1:
            rate = 1.0 / period
            self._low_pass = replace(
                design_low_pass(_CUTOFF * rate / every, rate), step=every
            )
            self._decimator = Decimator(self._low_pass)

    @classmethod
    def of(cls, time: Array, expected: float) -> Thinning:
        """Return what suits a log of about so many rows with these first time stamps (N,) [s]."""
        period = usual_period(time)
        slowest = max(1, math.floor(1.0 / (period * LEAST_RATE))) if period > 0.0 else 1
        return cls(min(math.ceil(expected / MOST_KEPT), slowest), period)

    def push(self, rows: Array) -> Array:
        """Take the next rows (N, 2 + C), line and time first, and return those that are kept."""
        if self.every == 1 or not len(rows):
            return rows
        step = np.diff(rows[:, 1], prepend=self._last)
        self._last = rows[-1, 1]
        parts = []
        for part in np.split(rows, np.flatnonzero(step > self._longest)):
            parts.append(self._decimator.push(part))
            if part is not rows and part[-1:, 1] != self._last:
                # The filter does not reach over a gap.
                self._decimator = Decimator(self._low_pass)
        return np.concatenate(parts)
