"""Does a trajectory file's velocity column say how its positions change?

A motor is told both; where they disagree it follows neither. Two comparisons, because rounded
positions hide much from row to row and next to nothing over a longer time:

row      each velocity lies among the slopes of the positions around it
window   over a tenth of a second, what the velocities add up to is how far the positions came

A difference quotient instead of the derivative (half a row early or late) passes both.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from robot_sysid.records import Array

# Numbers with four decimals, as the export writes them, are this far from what was meant.
_ROUNDING = 0.5e-4
_WINDOW, _LEAST_ROWS = 0.1, 4
# Rows on either side whose slopes count as around.
_AROUND = 2


class Mismatch(NamedTuple):
    """Where the velocity column is wrong.

    Attributes:
        line: of the file, counted without empty ones.
        joint: from 0.
        stated: velocity in the file [rad/s].
        shown: velocity that the positions show [rad/s].
    """

    line: int
    joint: int
    stated: float
    shown: float


class VelocityColumns:
    """Compares the velocity columns with the positions, chunk by chunk.

    Args:
        first_line: number of the first row's line in the file.

    Attributes:
        mismatch: the first one found, or None.
    """

    def __init__(self, first_line: int = 1) -> None:
        self.mismatch: Mismatch | None = None
        self._rows: Array | None = None
        self._first_line, self._begun = first_line, False

    def add(self, time: Array, q: Array, qd: Array) -> None:
        """Add rows (N,), (N, n), (N, n) [s, rad, rad/s]."""
        if self.mismatch is not None:
            return
        table = np.hstack([time[:, None], q, qd])
        self._rows = table if self._rows is None else np.vstack([self._rows, table])
        time, (q, qd) = self._rows[:, 0], np.split(self._rows[:, 1:], 2, axis=1)
        found = next(_mismatches(time, q, qd, self._begun), None)
        self._begun = True
        if found is not None:
            self.mismatch = found._replace(line=found.line + self._first_line)
        # The end of this chunk is the beginning of the windows that reach into the next one.
        kept = int(np.searchsorted(time, time[-1] - 2.0 * _WINDOW))
        kept = max(min(kept, len(time) - 2 * _LEAST_ROWS), 0)
        self._rows, self._first_line = self._rows[kept:], self._first_line + kept


def _mismatches(time: Array, q: Array, qd: Array, begun: bool) -> Iterator[Mismatch]:
    if len(time) > 1:
        step = np.diff(time)[:, None]
        slope = np.diff(q, axis=0) / step
        yield from _rows_off(step, slope, qd, _AROUND if begun else 0)
        yield from _windows_off(time, q, qd, slope)


def _rows_off(step: Array, slope: Array, qd: Array, first: int) -> Iterator[Mismatch]:
    # Rows without neighbours were compared before, or will be with the next chunk.
    padded = np.pad(slope, ((_AROUND, _AROUND), (0, 0)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND, axis=0)
    low, high = around.min(axis=-1), around.max(axis=-1)
    # Two rounded positions, of the slope and of what it is compared with, over the shortest step.
    steps = np.pad(step, ((_AROUND, _AROUND), (0, 0)), mode="edge")
    shortest = np.lib.stride_tricks.sliding_window_view(steps, 2 * _AROUND, axis=0).min(axis=-1)
    slack = 4.0 * _ROUNDING / shortest + _ROUNDING + (high - low)
    off = np.maximum(low - slack - qd, qd - high - slack)
    off[:first] = off[len(off) - _AROUND :] = 0.0
    for row, joint in np.argwhere(off > 0.0)[:1]:
        shown = slope[min(row, len(slope) - 1), joint]
        yield Mismatch(int(row), int(joint), float(qd[row, joint]), float(shown))


def _windows_off(time: Array, q: Array, qd: Array, slope: Array) -> Iterator[Mismatch]:
    step = np.diff(time)[:, None]
    longest = float(np.max(step))
    ends = np.searchsorted(time, time + max(_WINDOW, _LEAST_ROWS * longest))
    starts = np.flatnonzero(ends < len(slope))
    ends = ends[starts]
    way = _summed(0.5 * (qd[1:] + qd[:-1]) * step)
    came, said = q[ends] - q[starts], way[ends] - way[starts]
    turns = _summed(np.abs(np.diff(qd, axis=0)))
    # Half a row early or late; then what trapezoids leave out where the velocity bends.
    before = np.vstack([slope[:1], slope])
    sped_up = [np.abs(each[ends] - each[starts]) for each in (slope, before)]
    shifted = 0.6 * longest * np.maximum(*sped_up) + 2.0 * _ROUNDING
    bent = longest / 6.0 * (turns[ends] - turns[starts])
    length = (time[ends] - time[starts])[:, None]
    allowed = shifted + bent + 2.0 * _ROUNDING + _ROUNDING * length
    for k, joint in np.argwhere(np.abs(came - said) > allowed * (1.0 + 1e-9))[:1]:
        span = float(length[k, 0])
        yield Mismatch(
            int(starts[k]), int(joint), float(said[k, joint]) / span, float(came[k, joint]) / span
        )


def _summed(parts: Array) -> Array:
    """Return the sums (N, n) of the first 0, 1, ... of (N - 1, n) parts."""
    return np.vstack([np.zeros(parts.shape[1]), np.cumsum(parts, axis=0)])
