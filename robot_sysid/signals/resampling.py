"""Long and irregular logs: split a log into pieces at gaps and by length, and resample a piece to a
uniform time grid.

Each piece is filtered by itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Recording
from robot_sysid.signals.cutoff import FEWEST_SAMPLES

GAP_STEPS = 1.75
"""Multiple of the median step of time beyond which a step counts as a hole with at least one lost
sample; a late sample comes up to 1.7 periods after an early one (tests/signals/test_resampling.py).
"""


MOST_TIME = 600.0
"""Time of a log that is used at most [s]: half a minute holds nearly as much information about the
link as an hour (docs/logs.md)."""
PIECE_LENGTH = 60.0
"""Length of the pieces that a longer log is cut to [s]."""
LONGEST_GAP = 0.5
GAP_SAMPLES = 20.0
"""Gap at which a log is split [s], or in samples where these are rarer: splines bridge shorter
ones."""
CLOCK_TOLERANCE = 0.01
"""Share of the sampling period by which most clocks deviate."""
TICKS = 1e-6, 1e-5, 1e-4, 1e-3
"""Last digits of time stamps that are looked for [s]; stamps of more digits are exact."""
TICK_ERROR = 1e-3
"""Share of a tick by which a stamp with that last digit deviates in floating point."""
TICK_TOLERANCE = 1.01
"""Ticks by which rounded time stamps differ from even ones at most, with a margin for rounding."""
ROUNDING = 1e-6
"""Samples by which rounding may put the last one beyond the end."""
ON_STAMP = 1e-3
"""Share of the sampling period within which an instant is at a time stamp."""
MOVING = 0.1
"""Share of a joint's largest range in any piece from which on it moves in a piece."""


def resample_uniformly(recording: Recording) -> Recording:
    """Return a recording on a uniform grid, or raise InputError where it has too few samples.

    The samples of a log with evenly spaced time stamps (up to their number of digits) are not
    changed. In any other log every joint is interpolated by cubic splines, at its own time stamps
    where it has them.
    """
    time = recording.time
    if len(time) < FEWEST_SAMPLES:
        raise InputError(
            f"only {len(time)} samples; record longer: several seconds are needed"
        )
    notes = recording.notes
    grid, q, tau = time, recording.q, recording.tau
    hole = np.zeros(len(time))
    if recording.joint_time is not None or not is_even(time):
        rate = 1.0 / sampling_period(time)
        text = (
            f"resampled to a uniform {rate:.6g} Hz (uneven time stamps, cubic splines)"
        )
        notes = (*notes, text)
        grid, q, tau = _interpolate(recording, rate)
        hole = bridged_hole(time, grid, rate)
    hole[np.interp(grid, time, recording.is_left_out) > 0.0] = np.inf
    return Recording(
        grid,
        q,
        None,
        tau,
        hole=hole,
        name=recording.name,
        notes=notes,
        is_loaded=recording.is_loaded,
        order=recording.order,
        setting=recording.setting,
    )


def sampling_period(time: Array) -> float:
    """Return the mean step between time stamps (N,), holes left out [s]."""
    step = np.diff(time)
    return float(np.mean(step[step <= GAP_STEPS * np.median(step)]))


def is_even(time: Array) -> bool:
    """Return whether time stamps (N,) [s] are evenly spaced, up to their number of digits.

    The last digit counts from milliseconds to microseconds; stamps of more digits are exact.
    """
    even = np.linspace(time[0], time[-1], len(time))
    tolerance = CLOCK_TOLERANCE * (even[1] - even[0])
    for unit in TICKS:
        ticks = (time - time[0]) / unit
        if np.all(np.abs(ticks - np.round(ticks)) < TICK_ERROR):
            tolerance = max(tolerance, TICK_TOLERANCE * unit)
    return bool(np.max(np.abs(time - even)) <= tolerance)


def _interpolate(recording: Recording, rate: float) -> tuple[Array, Array, Array]:
    """Return the instants (K,) of a grid at a rate [Hz], and positions and torques (K, n) there, by
    cubic splines through each joint's samples.
    """
    from scipy.interpolate import CubicSpline

    time = recording.time
    stamps = recording.joint_time
    if stamps is None:
        stamps = np.broadcast_to(time[:, None], recording.q.shape)
    start = max(time[0], stamps[0].max())
    end = min(time[-1], stamps[-1].min())
    # A last sample that rounding puts just beyond the end is still on the grid.
    count = math.floor((end - start) * rate + ROUNDING) + 1
    grid = np.minimum(start + np.arange(count) / rate, end)
    signals = []
    for its_time, *samples in zip(stamps.T, recording.q.T, recording.tau.T):
        is_new = np.diff(its_time, prepend=-np.inf) > 0.0
        kept = np.stack(samples)[:, is_new]
        signals.append(CubicSpline(its_time[is_new], kept, axis=1)(grid))
    q, tau = np.stack(signals, axis=-1)
    return grid, q, tau


def bridged_hole(time: Array, grid: Array, rate: float) -> Array:
    """Return (K,) the length of the hole between the time stamps (N,) of a log that each instant of
    a grid (K,) at a rate [Hz] lies in [s]; zero outside holes and next to a time stamp.
    """
    margin = ON_STAMP / rate
    # Next to a time stamp these are two steps of time, elsewhere one.
    ends = np.searchsorted(time, (grid - margin, grid + margin))
    steps = np.diff(time)[np.clip(ends, 1, len(time) - 1) - 1]
    hole = np.min(steps, axis=0)
    return np.where(hole > GAP_STEPS / rate, hole, 0.0)


SHORTEST_PIECE = 4.0
"""Length below which a piece is not worth filtering, as its ends are cut off (chosen) [s]."""


def split_at_gaps(samples: Recording) -> tuple[Recording, ...]:
    """Return the pieces of a log between its gaps; those shorter than ``SHORTEST_PIECE`` are left
    out.

    A log longer than 10 minutes is cut to pieces of about one; of those in which a joint moves, as
    many as fit into 10 minutes are returned, spread evenly. Pieces are views. A log that is not cut
    is its only piece, and so is one whose pieces are all too short.
    """
    pieces = [samples[rows] for rows in between_gaps(samples.time)]
    pieces = [piece for piece in pieces if piece.duration >= SHORTEST_PIECE]
    if samples.duration > MOST_TIME:
        pieces = [*cut_pieces(pieces, PIECE_LENGTH)]
    return tuple(select_pieces(pieces, MOST_TIME)) or (samples,)


def between_gaps(time: Array) -> Iterator[slice]:
    """Yield the rows between the gaps of a log, by its time stamps (N,) [s]."""
    step = np.diff(time)
    longest_step = max(LONGEST_GAP, GAP_SAMPLES * float(np.median(step)))
    edges = [0, *(np.flatnonzero(step > longest_step) + 1).tolist(), len(time)]
    yield from map(slice, edges, edges[1:])


def duration(pieces: Iterable[Recording]) -> float:
    """Return the time from the first to the last sample of each piece, summed [s]."""
    return sum(piece.duration for piece in pieces)


def cut_pieces(pieces: Iterable[Recording], longest: float) -> Iterator[Recording]:
    """Yield pieces cut to parts of at most ``longest`` [s]."""
    for piece in pieces:
        count = math.ceil(piece.duration / longest)
        edges = np.linspace(0, len(piece), count + 1).astype(int).tolist()
        for first, last in zip(edges, edges[1:]):
            yield piece[first:last]


def piece_notes(samples: Recording, pieces: tuple[Recording, ...]) -> tuple[str, ...]:
    """Return a sentence on how a log was split into pieces; none where it was not."""
    used = sum(map(len, pieces))
    if len(pieces) == 1 and used == len(samples):
        return ()
    return (
        f"the log is filtered in {len(pieces)} pieces of at least {SHORTEST_PIECE:g} s, cut at "
        f"gaps, between recordings or by length; they hold {used} of {len(samples)} rows",
    )


def select_pieces(pieces: list[Recording], most_time: float) -> list[Recording]:
    """Return as many pieces of a log as last ``most_time`` [s], evenly spread over those in which a
    joint moves, or over all where none does.
    """
    if duration(pieces) <= most_time:
        return pieces
    ranges = np.array([np.ptp(piece.q, axis=0) for piece in pieces])
    moved = np.max(ranges / np.maximum(np.max(ranges, axis=0), 1e-12), axis=1)
    moving = [pieces[k] for k in np.flatnonzero(moved > MOVING)] or pieces
    count = int(len(moving) * min(1.0, most_time / duration(moving)))
    numbers = np.linspace(0, len(moving) - 1, max(1, count)).round().astype(int)
    return [moving[number] for number in numbers]
