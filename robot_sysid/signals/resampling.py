"""Long and irregular logs: split a log into pieces at gaps and by length, decimate a dense log, and
resample a piece to a uniform time grid.

Each piece is filtered by itself. Two hours at 1 kHz hold no more information about an arm than two
hours at 60 Hz, and take sixteen times the memory. So times, positions and torques of a dense log
pass one zero-phase low-pass and are decimated.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement
from robot_sysid.records.messages import count_text
from robot_sysid.signals.filters import design_low_pass

GAP_STEPS = 1.75
"""Multiple of the median step of time beyond which a step counts as a hole with at least one lost
sample; a late sample comes up to 1.7 periods after an early one (tests/signals/test_resampling.py).
"""
_CLOCK_ERROR = 0.01
"""Deviation from an even grid, in sampling periods, that most clocks have (chosen)."""


@dataclass(frozen=True)
class UniformSignals:
    """Positions and torques of N samples and n joints on a uniform grid.

    Attributes:
        start: time of the first sample [s].
        rate: samples per second [Hz].
        q: (N, n) positions [rad].
        tau: (N, n) torques [N m].
        gap: (N,) length of the hole in the log that a sample bridges [s]; zero where it bridges
            none, infinite where it is left out.
        notes: what a reader should know of the resampling.
    """

    start: float
    rate: float
    q: Array
    tau: Array
    gap: Array
    notes: tuple[str, ...]


def resample_uniformly(measurement: Measurement) -> UniformSignals:
    """Return a log on a uniform grid, or raise InputError where it has fewer than 8 samples.

    The samples of a log with evenly spaced time stamps (up to their number of digits) are not
    changed. In any other log every joint is interpolated by cubic splines, at its own time stamps
    where it has them.
    """
    time = measurement.time
    if len(time) < 8:
        raise InputError(
            f"only {len(time)} samples; a log of several seconds is needed"
        )
    has_joint_time = measurement.joint_time is not None
    if has_joint_time or not is_even(time):
        reason = "each joint at its own" if has_joint_time else "uneven"
        reason = f"{reason} time stamps, cubic splines"
        return _interpolate(measurement, 1.0 / sampling_period(time), reason)
    gap = np.zeros(len(time))
    if measurement.left_out is not None:
        gap[measurement.left_out] = np.inf
    rate = (len(time) - 1) / float(time[-1] - time[0])
    start = float(time[0])
    return UniformSignals(start, rate, measurement.q, measurement.tau, gap, notes=())


def sampling_period(time: Array) -> float:
    """Return the mean step between time stamps (N,), holes left out [s]."""
    step = np.diff(time)
    is_usual = step <= GAP_STEPS * np.median(step)
    return float(np.mean(step[is_usual]))


def is_even(time: Array) -> bool:
    """Return whether time stamps (N,) [s] are evenly spaced, up to their number of digits."""
    line = np.linspace(time[0], time[-1], len(time))
    period = float(time[-1] - time[0]) / (len(time) - 1)
    tolerance = max(_CLOCK_ERROR * period, 1.01 * _last_decimal(time))
    return bool(np.max(np.abs(time - line)) <= tolerance)


def _last_decimal(time: Array) -> float:
    """Return the weight of the last decimal of time stamps (N,), at most a millisecond [s]; zero
    where they have more than six decimals.
    """
    for digits in (3, 4, 5, 6):
        scaled = (time - time[0]) * 10.0**digits
        if np.all(np.abs(scaled - np.round(scaled)) < 1e-3):
            return 10.0**-digits
    return 0.0


def _interpolate(measurement: Measurement, rate: float, reason: str) -> UniformSignals:
    """Return a log interpolated by cubic splines at a rate [Hz], with the reason in its note."""
    from scipy.interpolate import CubicSpline

    time = measurement.time
    joint_time = measurement.joint_time
    start = float(time[0])
    end = float(time[-1])
    if joint_time is not None:
        start = float(max(start, joint_time[0].max()))
        end = float(min(end, joint_time[-1].min()))
    # A last sample that rounding puts just beyond the end is still on the grid.
    count = math.floor((end - start) * rate + 1e-6) + 1
    grid = np.minimum(start + np.arange(count) / rate, end)
    q, tau = np.empty((2, count, measurement.q.shape[1]))
    for joint in range(q.shape[1]):
        stamps = time if joint_time is None else joint_time[:, joint]
        is_new = is_new_sample(stamps)
        columns = np.column_stack((measurement.q[:, joint], measurement.tau[:, joint]))
        spline = CubicSpline(stamps[is_new], columns[is_new])
        q[:, joint], tau[:, joint] = spline(grid).T
    note = f"resampled to a uniform {rate:.6g} Hz ({reason})"
    gap = _bridged_gap(time, grid, rate)
    if measurement.left_out is not None:
        gap[np.interp(grid, time, measurement.left_out) > 0.0] = np.inf
    return UniformSignals(start, rate, q, tau, gap, (note,))


def _bridged_gap(time: Array, grid: Array, rate: float) -> Array:
    """Return (K,) the length of the hole between the time stamps (N,) of a log that each instant of
    a grid (K,) at a rate [Hz] lies in [s]; zero outside holes and next to a time stamp.
    """
    index = np.clip(np.searchsorted(time, grid) - 1, 0, len(time) - 2)
    earlier = time[index]
    later = time[index + 1]
    step = later - earlier
    nearest = np.minimum(np.abs(grid - earlier), np.abs(grid - later))
    is_bridged = (step > GAP_STEPS / rate) & (nearest >= 1e-3 / rate)
    return np.where(is_bridged, step, 0.0)


def is_new_sample(stamps: Array) -> NDArray[np.bool_]:
    """Return (N,) whether each row holds a new sample of a joint with these time stamps (N,)."""
    return np.concatenate(([True], np.diff(stamps) > 0.0))


SPLITTING_GAP = 0.5
"""Step of time beyond which a log is split into pieces (chosen) [s]."""
SPLITTING_STEPS = 20.0
"""Shortest step of time at which a log of a low sample rate is split, in sampling periods."""
RECORDING_SEPARATION = 10.0
"""Time that is put between recordings with separate clocks [s]: longer than any filter."""
SHORTEST_PIECE = 4.0
"""Length below which a piece is not worth filtering, as its ends are cut off (chosen) [s]."""
MOST_PIECE_ROWS = 100_000
"""Rows of a piece beyond which it is cut into several, so that filtering takes little memory."""
MOST_TIME = 600.0
"""Length of a log beyond which pieces of it, spread evenly, stand for the entire log [s]: half a
minute holds nearly as much information about the link as an hour (docs/logs.md)."""
PIECE_TIME = 60.0
"""Length of the pieces of a log that is longer than ``MOST_TIME`` [s]."""
_MOVING_SHARE = 0.1
"""Share of a joint's largest range of positions in any piece, up to which the joint counts as not
moving in a piece."""


def splitting_gap(period: float) -> float:
    """Return the longest step of time within a piece [s], for a sampling period [s]."""
    return max(SPLITTING_GAP, SPLITTING_STEPS * period)


def split_at_gaps(samples: Measurement) -> tuple[Measurement, ...]:
    """Return the pieces of a log between its gaps, cut to at most ``MOST_PIECE_ROWS`` rows; those
    shorter than ``SHORTEST_PIECE`` are left out.

    A log longer than ``MOST_TIME`` is cut to pieces of about ``PIECE_TIME``; of those in which a
    joint moves, as many as fit into ``MOST_TIME`` are returned, spread evenly. Pieces are views. A
    log that is not cut is its only piece, and so is one whose pieces are all too short.
    """
    step = np.diff(samples.time)
    if not len(step):
        return (samples,)
    period = float(np.median(step))
    cuts = np.flatnonzero(step > splitting_gap(period)) + 1
    edges = [0, *cuts.tolist(), len(samples)]
    most_rows = MOST_PIECE_ROWS
    if _duration(samples) > MOST_TIME:
        most_rows = min(most_rows, round(PIECE_TIME / period))
    pieces: list[Measurement] = []
    for first, last in zip(edges, edges[1:]):
        if last - first > 1:
            # Pieces of equal length.
            count = math.ceil((last - first) / most_rows)
            ends = np.linspace(first, last, count + 1).astype(int).tolist()
            pieces += map(partial(slice_samples, samples), ends, ends[1:])
    if len(pieces) == 1:
        return (samples,)
    long = [piece for piece in pieces if _duration(piece) >= SHORTEST_PIECE]
    return tuple(_select_pieces(long)) or (samples,)


def _duration(samples: Measurement) -> float:
    """Return the time from the first to the last sample [s]."""
    return float(samples.time[-1] - samples.time[0])


def piece_notes(
    samples: Measurement, pieces: tuple[Measurement, ...]
) -> tuple[str, ...]:
    """Return a sentence on how a log was split into pieces; none where it was not."""
    n_used = sum(len(piece) for piece in pieces)
    if len(pieces) == 1 and n_used == len(samples):
        return ()
    omission = ""
    if n_used < len(samples):
        rows = count_text(len(samples) - n_used, "row")
        omission = f", without {rows} of other pieces"
        if sum(map(_duration, pieces)) > 0.5 * MOST_TIME:
            omission += ", as the log is longer than any result needs"
    return (
        f"the log is filtered in {len(pieces)} pieces of at least {SHORTEST_PIECE:g} s, cut at "
        f"gaps, between recordings or by length{omission}",
    )


def _select_pieces(pieces: list[Measurement]) -> list[Measurement]:
    """Return as many pieces of a log as ``MOST_TIME`` allows, evenly spread over those in which a
    joint moves, or over all where none does.
    """
    if sum(map(_duration, pieces)) <= MOST_TIME:
        return pieces
    ranges = np.array([np.ptp(piece.q, axis=0) for piece in pieces])
    largest = np.maximum(np.max(ranges, axis=0), 1e-12)
    moved = np.max(ranges / largest, axis=1)
    moving = [pieces[k] for k in np.flatnonzero(moved > _MOVING_SHARE)] or pieces
    total = sum(map(_duration, moving))
    count = max(1, int(len(moving) * min(1.0, MOST_TIME / total)))
    numbers = np.linspace(0, len(moving) - 1, count).round()
    return [moving[int(number)] for number in numbers]


def slice_samples(samples: Measurement, start: int, stop: int) -> Measurement:
    """Return the consecutive samples from index ``start`` to before ``stop`` of a log, as views."""
    columns = {}
    for field in fields(Measurement):
        values = getattr(samples, field.name)
        if values is not None:
            columns[field.name] = values[start:stop]
    return replace(samples, **columns)


MOST_ROWS_KEPT = 300_000
"""Rows beyond which a log is decimated; so 1 GB is read in 153 MB (docs/logs.md)."""
LEAST_RATE = 60.0
"""Rows per second that decimation leaves at least (docs/logs.md) [Hz]."""
_CUTOFF_SHARE = 0.45
"""Cut-off of the low-pass over the decimated rate: its gain is flat below 0.4 times the cut-off,
and aliases fold back to frequencies above that."""


def condense_run(
    chunks: Iterable[Measurement], count: int
) -> tuple[tuple[Measurement, ...], tuple[str, ...]]:
    """Return the pieces of a simulated run, and sentences for the user on how it was cut.

    A run of more than ``MOST_ROWS_KEPT`` samples is decimated and cut as a log is. It then has no
    velocities and accelerations, which no estimate takes from a recording.

    Args:
        chunks: consecutive chunks of the run; an iterator is used up.
        count: number of its samples.
    """
    if count <= MOST_ROWS_KEPT:
        return (join_measurements(chunks),), ()
    thinning = None
    blocks = []
    for chunk in chunks:
        # The first chunk determines the sampling period.
        thinning = thinning or Thinning.of(chunk.time, count)
        # The time takes the column of line numbers, which a run does not have.
        rows = np.column_stack((chunk.time, chunk.time, chunk.q, chunk.tau))
        blocks.append(thinning.push(rows)[:, 1:])
    table = np.concatenate(blocks)
    n_joints = (table.shape[1] - 1) // 2
    time, q, tau = np.split(table, (1, 1 + n_joints), axis=1)
    samples = Measurement(time[:, 0].copy(), q.copy(), qd=None, tau=tau.copy())
    pieces = split_at_gaps(samples)
    return pieces, piece_notes(samples, pieces)


def join_measurements(chunks: Iterable[Measurement]) -> Measurement:
    """Return consecutive chunks of a log as one measurement; the first chunk determines which
    optional columns it has.
    """
    measurements = list(chunks)
    # ``qd`` has no default: it is None unless the chunks have velocities.
    columns: dict[str, Any] = {"qd": None}
    for field in fields(Measurement):
        if getattr(measurements[0], field.name) is not None:
            values = [getattr(chunk, field.name) for chunk in measurements]
            columns[field.name] = np.concatenate(values)
    return Measurement(**columns)


class Thinning:
    """Low-passes and decimates the rows of a log that arrive in blocks.

    Args:
        every: number of rows that become one; 1 leaves the rows as they are.
        period: sampling period of the log [s].
    """

    def __init__(self, every: int, period: float) -> None:
        self.every = every
        self._longest_step = splitting_gap(period)
        self._last_time = np.nan
        if every > 1:
            rate = 1.0 / period
            low_pass = design_low_pass(_CUTOFF_SHARE * rate / every, rate)
            self._low_pass = replace(low_pass, step=every)
        # The latest rows, which later decimated rows need.
        self._waiting: Array | None = None

    @classmethod
    def of(cls, time: Array, expected: float) -> Thinning:
        """Return the thinning that leaves about ``MOST_ROWS_KEPT`` rows of a log.

        It leaves more rows where there would be fewer than ``LEAST_RATE`` per second.

        Args:
            time: (N,) first time stamps of the log [s].
            expected: estimated number of rows of the log.
        """
        period = sampling_period(time)
        coarsest = 1
        if period > 0.0:
            coarsest = max(1, math.floor(1.0 / (period * LEAST_RATE)))
        return cls(min(math.ceil(expected / MOST_ROWS_KEPT), coarsest), period)

    def push(self, rows: Array) -> Array:
        """Take the next rows (N, 2 + C) of the log and return the decimated rows (K, 2 + C).

        The first column is the number of the line in the file, the second the time [s].
        """
        if self.every == 1 or not len(rows):
            return rows
        step = np.diff(rows[:, 1], prepend=self._last_time)
        self._last_time = rows[-1, 1]
        decimated = []
        # The first block is empty where a gap lies just before these rows.
        first, *others = np.split(rows, np.flatnonzero(step > self._longest_step))
        if self._waiting is not None:
            first = np.concatenate((self._waiting, first))
        # The filter does not reach over a gap.
        for block in (first, *others):
            decimated.append(self._low_pass.decimate(block))
            self._waiting = block[len(decimated[-1]) * self.every :].copy()
        return np.concatenate(decimated)
