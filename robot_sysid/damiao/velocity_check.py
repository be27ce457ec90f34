"""Whether the velocities of a trajectory file agree with its positions.

A motor is commanded both positions and velocities; where they disagree it follows neither. Over
each window of a tenth of a second, the integral of the velocities has to be the change of the
positions: rounding hides much from row to row and next to nothing over a window. A difference
quotient instead of the derivative (half a row early or late) passes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robot_sysid.damiao.trajectory import ROUNDING
from robot_sysid.records import Array

_WINDOW = 0.1
"""Length of a window in which velocities are compared with positions [s].

Over this time 1e-4 rad of rounding are 1e-3 rad/s, and a swing takes longer.
"""
_LEAST_ROWS = 4
"""Least number of rows in a window."""


class Mismatch(NamedTuple):
    """A window in which a joint's velocities and positions disagree.

    ``row`` is the index of its first row, ``stated`` the mean velocity by the velocity column,
    ``slope`` that by the positions [rad/s].
    """

    row: int
    joint: int
    stated: float
    slope: float


def velocity_mismatch(time: Array, q: Array, qd: Array) -> Mismatch | None:
    """Return the first window over which velocities do not add up to the change of position.

    Positions may be half a row early or late, the trapezoid rule misses at most a sixth of a step
    times the variation of the velocity, and each printed number is rounded by ``ROUNDING``. None
    where there is no such window.

    Args:
        time: times (N,) of the rows [s].
        q: positions (N, n) [rad].
        qd: velocities (N, n) [rad/s].
    """
    step = np.diff(time)[:, None]
    # Number k leads from row k to row k + 1.
    slope = np.diff(q, axis=0) / step
    rows = np.arange(len(time))
    # Windows lead from each row in ``starts`` to the row at the same index of ``ends``.
    ends = np.maximum(np.searchsorted(time, time + _WINDOW), rows + _LEAST_ROWS)
    # A file that is shorter has one window. The last row has no slope after it.
    starts = rows[: max(np.count_nonzero(ends < len(slope)), 1)]
    ends = np.minimum(ends[starts], len(slope) - 1)
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
