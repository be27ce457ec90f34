"""Signals of the closed loop: commands, and what is left between them and the positions.

Positions, commands and all columns pass the same short Gaussian. The low-pass of measured torques
(``signals``) reaches half a second to both sides at a cut-off of 5 Hz: samples at a servo's torque
limit and near standstill, which are left out one by one, would be in most rows.

n is the number of joints, M that of samples of all pieces.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.records import Array, Recording
from robot_sysid.signals.resampling import sampling_period

MAX_DELAY = 0.5
"""Longest time by which positions may follow their commands [s]: that of a soft servo, damping over
gain (0.14 s at a kd of 2.75 and a kp of 20), and the way of commands over a network."""
GRID = 0.01
"""Distance between ``DELAYS`` [s]."""
DELAYS = np.arange(0.0, MAX_DELAY, GRID)
"""Delays that are tried before the best of them is refined [s]."""
SMOOTHING = 0.022
"""Standard deviation of the low-pass [s]: the least of a log of 50 Hz."""
LEAST_SMOOTHING = 1.1
"""Least such standard deviation in sampling periods: the derivatives of a narrower Gaussian are
wrong."""
CUT_OFF_AT = 7.0
"""Standard deviations at which the Gaussian ends: nearer to the middle, a constant would have a
second derivative."""


def commands(piece: Recording) -> Array:
    """Return the commanded positions (N, n) of a piece of a log of servos [rad or m]."""
    assert piece.command is not None
    return piece.command


def longest_period(pieces: Sequence[Recording]) -> float:
    """Return the longest sampling period of pieces [s]."""
    return max(sampling_period(piece.time) for piece in pieces)


def rms(values: Array) -> float:
    """Return the root mean square of values."""
    return float(np.sqrt(np.mean(values**2)))


def low_pass(time: Array, values: Array, order: int = 0) -> Array:
    """Return values (N, ...) behind a Gaussian low-pass, or a derivative by the sample's number.

    Args:
        time: (N,) of the samples [s].
        values: one row per sample.
        order: of the derivative.
    """
    from scipy.ndimage import gaussian_filter1d

    width = max(SMOOTHING / sampling_period(time), LEAST_SMOOTHING)
    return gaussian_filter1d(
        values, width, 0, order, mode="nearest", truncate=CUT_OFF_AT
    )


def low_pass_motion(piece: Recording) -> tuple[Array, Array, Array]:
    """Return low-passed positions, velocities, accelerations (N, n) of a piece of a log.

    Time stamps pass the same low-pass, so that uneven ones make no speed.
    """
    step = low_pass(piece.time, piece.time, 1)[:, None]
    change = low_pass(piece.time, piece.time, 2)[:, None]
    qd = low_pass(piece.time, piece.q, 1) / step
    qdd = (low_pass(piece.time, piece.q, 2) - qd * change) / step**2
    return low_pass(piece.time, piece.q), qd, qdd


def low_pass_pieces(pieces: Sequence[Recording], values: Array) -> Array:
    """Return values (M, ...) of all samples of pieces, each piece behind the low-pass."""
    ends = np.cumsum([len(piece) for piece in pieces])
    parts = np.split(values, ends[:-1])
    smooth = [low_pass(piece.time, part) for piece, part in zip(pieces, parts)]
    return np.concatenate(smooth)


def distances(pieces: Sequence[Recording], delay: float) -> Array:
    """Return the distance (M, n) from each position to its command of ``delay`` [s] before, behind
    the low-pass.
    """
    return low_pass_pieces(pieces, raw_distances(pieces, delay))


def raw_distances(pieces: Sequence[Recording], delay: float) -> Array:
    """Return the distance (M, n) from each position to its command of ``delay`` [s] before."""
    from scipy.interpolate import make_interp_spline

    distances = []
    for piece in pieces:
        # Commands that hold until the next one are, below half of the sampling rate, a smooth curve
        # through the middles of their periods, whose means over a period they are: the mean of a
        # curve over a step h is its middle value plus h^2/24 of its second derivative.
        held = commands(piece).copy()
        held[1:-1] += np.diff(held, 2, axis=0) / 24.0
        middle = 0.5 * sampling_period(piece.time)
        curve = make_interp_spline(piece.time + middle, held)
        at = np.maximum(piece.time - delay, piece.time[0] + middle)
        distances.append(curve(at) - piece.q)
    return np.concatenate(distances)


def goal_error(pieces: Sequence[Recording]) -> float:
    """Return the error of the commands of some time before, where that time fits best [rad or m].

    It is the root mean square of all joints.
    """
    return min(rms(distances(pieces, delay)) for delay in DELAYS)
