"""Rows that are evenly spaced, though their time stamps are not: those of arrival, or rounded ones.

A computer that writes the time at which a row arrived, or writes it with few digits, has stamps
that jitter around the rows' own even instants. Positions tell: a joint that moves is smooth in
time, and so by the row where rows are even, but not by such stamps. N is the number of rows, n of
joints.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.records import Array
from robot_sysid.signals.resampling import between_gaps, is_even

WINDOW = 100
"""Rows in which the stamps' typical lateness is compared: a row that is lost shifts it for good."""
STAMPS = 20
"""Stamps that a window has at least, where several rows share one, as rows that arrive together: a
window that cuts one of few bursts is late by a part of it."""
MOST_SHIFT = 0.5
"""Sampling periods by which it may differ between windows: a lost row shifts it by one."""
CLEARLY_SMOOTHER = 1.3
"""Roughness by the stamps, over that by the rows, from which on rows are even: true stamps that are
uneven have less than one, also with steps of an encoder as large as the motion between rows. Stamps
that are off by a part of a period have a little more than one beside such steps, and many times
that beside usual ones."""
USUAL_SHARE = 0.98
"""Share of the rows whose roughness counts: the others may hold a wrap, or a wrong sample."""
LEAST_STEPS = 10
"""Steps from which on their correlation means something."""
GOES_ON = 0.3
"""Correlation of a step with the one before it, from which on a column goes on in the direction in
which it came: postures in any order have about -0.5, a sine of which a period has eight rows 0.7.
"""


def is_sampled_motion(q: Array) -> bool:
    """Return whether columns (N, n) go on from row to row as they came, as samples of a motion do.

    Postures in any order do not. Steps of an encoder hide it from row to row, and not from every
    second, fourth or eighth row to the next such one.
    """
    stride = 1
    while len(q) // stride > LEAST_STEPS:
        steps = np.diff(q[::stride], axis=0)
        squares = np.sum(steps**2, axis=0)
        products = np.sum(steps[1:] * steps[:-1], axis=0)
        if np.any(products > GOES_ON * squares):
            return True
        stride *= 2
    return False


def even_time(time: Array, q: Array) -> Array | None:
    """Return the even instants (N,) of the rows of a log; None where its stamps are to be believed.

    That is where they are even as they are, a row is missing, or positions do not tell.

    Args:
        time: (N,) stamps in the file, none earlier than the one before [s].
        q: (N, n) positions.
    """
    even = time.copy()
    is_changed = False
    for rows in between_gaps(time):
        its_time = time[rows]
        is_rising = np.all(np.diff(its_time) > 0.0)
        if len(its_time) < 2 or (is_rising and is_even(its_time)):
            continue
        instants = fitted_instants(its_time)
        if instants is None or not is_smoother(q[rows], its_time, instants):
            return None
        even[rows] = instants
        is_changed = True
    return even if is_changed and np.all(np.diff(even) > 0.0) else None


def fitted_instants(time: Array) -> Array | None:
    """Return the even instants (N,) that fit stamps (N,) best; None where a row is missing."""
    shared = len(time) / (1 + np.count_nonzero(np.diff(time)))
    count = int(len(time) / max(WINDOW, STAMPS * shared))
    if count < 2:
        return None
    rows = np.arange(len(time))
    middle = 0.5 * rows[-1]
    period = float((rows - middle) @ time / ((rows - middle) @ (rows - middle)))
    late = time - period * rows
    typical = [middle_mean(part) for part in np.array_split(late, count)]
    if period <= 0.0 or np.ptp(typical) > MOST_SHIFT * period:
        return None
    return np.asarray(np.median(typical) + period * rows)


def middle_mean(values: Array) -> float:
    """Return the mean of the middle half of values, which rounded ones move by little."""
    quarter = len(values) // 4
    return float(np.mean(np.sort(values)[quarter : len(values) - quarter]))


def is_smoother(q: Array, time: Array, instants: Array) -> bool:
    """Return whether positions (N, n) are clearly smoother at instants than at stamps (N,)."""
    by_stamps, by_rows = roughness(q, time), roughness(q, instants)
    usual = max(1, int(USUAL_SHARE * len(by_stamps)))
    stamps, rows = (np.sum(np.sort(each)[:usual]) for each in (by_stamps, by_rows))
    return bool(stamps > CLEARLY_SMOOTHER * rows)


def roughness(q: Array, time: Array) -> Array:
    """Return how far (N - 2,) each row's positions (N, n) are from a line through those beside."""
    span = time[2:] - time[:-2]
    # Between two rows of one stamp, their middle.
    share = np.full(len(span), 0.5)
    np.divide(time[1:-1] - time[:-2], span, out=share, where=span > 0.0)
    line = q[:-2] + share[:, None] * (q[2:] - q[:-2])
    return np.asarray(np.linalg.norm(q[1:-1] - line, axis=1))
