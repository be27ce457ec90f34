"""Whether the velocities of a trajectory file agree with its positions.

A motor is commanded both positions and velocities; where they disagree it follows neither. Two
comparisons find that, because rounded positions hide much from row to row and next to nothing over
a longer time:

row      each velocity lies among the slopes of the positions around it
window   over a tenth of a second, the integral of the velocities is the change of the positions

A difference quotient instead of the derivative (half a row early or late) passes both.

Every function takes the rows of one file: times (N,), positions and velocities (N, n) of n joints.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from robot_sysid.damiao.trajectory import ROUNDING
from robot_sysid.records import Array

_WINDOW = 0.1
"""Length of a window in which velocities are compared with positions [s].

Over this time 1e-4 rad of rounding are 1e-3 rad/s, and a swing takes longer.
"""
_LEAST_ROWS = 4
"""Least number of rows in a window."""
_AROUND = 2
"""Number of rows on either side of a row with whose slopes its velocity is compared.

A difference quotient is half a row early or late, and the motion may bend in one more row.
"""


class Mismatch(NamedTuple):
    """A row and joint at which velocities and positions of a trajectory disagree.

    ``stated`` is the velocity in the velocity column, ``slope`` that of the positions [rad/s].
    """

    row: int
    joint: int
    stated: float
    slope: float


def velocity_mismatch(time: Array, q: Array, qd: Array) -> Mismatch | None:
    """Return the first row where velocities disagree with the slopes of positions, or None.

    Single rows are compared first, then windows of a tenth of a second.

    Args:
        time: times (N,) of the rows [s].
        q: positions (N, n) [rad].
        qd: velocities (N, n) [rad/s].
    """
    slope = np.diff(q, axis=0) / np.diff(time)[:, None]
    mismatch = _row_mismatch(time, slope, qd)
    return mismatch or _window_mismatch(time, q, qd, slope)


def _row_mismatch(time: Array, slope: Array, qd: Array) -> Mismatch | None:
    """Return the first row whose velocity is beyond the slopes of positions around it, or None.

    Args:
        time: times (N,) of the rows [s].
        slope: slopes (N - 1, n) of the positions; number k leads from row k to row k + 1 [rad/s].
        qd: velocities (N, n) [rad/s].
    """
    step = np.diff(time)[:, None]
    slopes = _surrounding_rows(slope)
    low = slopes.min(axis=-1)
    high = slopes.max(axis=-1)
    shortest_step = _surrounding_rows(step).min(axis=-1)
    # Accepted: the rounding of two slopes, each of two positions, over the shortest step; that of
    # the velocity; and as much again as the slopes around it differ, where the motion bends.
    slack = 4.0 * ROUNDING / shortest_step + ROUNDING + (high - low)
    excess = np.maximum(low - slack - qd, qd - high - slack)
    # After the last rows there are no slopes with which their velocities could be compared.
    excess[len(excess) - _AROUND :] = 0.0
    for row, joint in np.argwhere(excess > 0.0)[:1].tolist():
        return Mismatch(row, joint, float(qd[row, joint]), float(slope[row, joint]))
    return None


def _surrounding_rows(steps: Array) -> Array:
    """Return for each of N rows the values (N, n, 2 _AROUND) of the steps around it.

    ``steps`` (N - 1, n) has a value for the step from each row to the next one. Beyond the ends its
    first and last values are repeated.
    """
    padded = np.pad(steps, ((_AROUND, _AROUND), (0, 0)), mode="edge")
    return sliding_window_view(padded, 2 * _AROUND, axis=0)


def _window_mismatch(time: Array, q: Array, qd: Array, slope: Array) -> Mismatch | None:
    """Return the first window over which velocities do not add up to the change of position.

    Positions may be half a row early or late, the trapezoid rule misses at most a sixth of a step
    times the variation of the velocity, and each printed number is rounded by ``ROUNDING``.

    Args:
        time: times (N,) of the rows [s].
        q: positions (N, n) [rad].
        qd: velocities (N, n) [rad/s].
        slope: slopes (N - 1, n) of the positions; number k leads from row k to row k + 1 [rad/s].
    """
    step = np.diff(time)[:, None]
    rows = np.arange(len(time))
    # Windows lead from each row in ``starts`` to the row at the same index of ``ends``.
    ends = np.maximum(np.searchsorted(time, time + _WINDOW), rows + _LEAST_ROWS)
    starts = np.flatnonzero(ends < len(slope))
    if not len(starts):
        return None
    ends = ends[starts]
    # The longest step of each window and of one row on either side: ``reduceat`` returns the
    # maximum from each index to the next one, of which every second is that of a window.
    padded_step = np.pad(step[:, 0], 1, mode="edge")
    windows = np.column_stack([starts, ends + 2]).ravel()
    longest_step = np.maximum.reduceat(padded_step, windows)[::2, None]
    integral = _cumulative_sum(0.5 * (qd[1:] + qd[:-1]) * step)
    variation = _cumulative_sum(np.abs(np.diff(qd, axis=0)))
    position_change = q[ends] - q[starts]
    velocity_integral = integral[ends] - integral[starts]
    # Change of slope over a window: between the steps that follow its first and its last row, or
    # between those that precede them, whichever is larger.
    slope_before = np.vstack([slope[:1], slope])
    slope_change = np.maximum(
        np.abs(slope[ends] - slope[starts]),
        np.abs(slope_before[ends] - slope_before[starts]),
    )
    # Positions that are half a row early or late, and a fifth more.
    shift = 0.6 * longest_step * slope_change + 2.0 * ROUNDING
    # What the trapezoid rule leaves out.
    curvature = longest_step / 6.0 * (variation[ends] - variation[starts])
    duration = (time[ends] - time[starts])[:, None]
    tolerance = shift + curvature + 2.0 * ROUNDING + ROUNDING * duration
    difference = np.abs(position_change - velocity_integral)
    # The factor is for rounding errors of the sums.
    for k, j in np.argwhere(difference > tolerance * (1.0 + 1e-9))[:1].tolist():
        seconds = float(duration[k, 0])
        stated = float(velocity_integral[k, j]) / seconds
        return Mismatch(
            int(starts[k]), j, stated, float(position_change[k, j]) / seconds
        )
    return None


def _cumulative_sum(steps: Array) -> Array:
    """Return the sums (N, n) of steps (N - 1, n) up to each row, beginning with zero."""
    return np.cumsum(np.insert(steps, 0, 0.0, axis=0), axis=0)
