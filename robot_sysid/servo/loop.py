"""Signals of the closed loop: commands, and what is left between them and the positions.

Positions pass a short Gaussian. The low-pass of measured torques (``signals``) reaches half a
second to both sides at a cut-off of 5 Hz: as long as a whole move of a servo.

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
LEAST_MOTION = 0.02
"""Range of positions below which a joint does not move [rad or m]."""
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


def stretches(piece: Recording) -> list[slice]:
    """Return the stretches of a piece, of two samples at least, between those that are left out."""
    used = np.flatnonzero(~piece.is_left_out)
    parts = np.split(used, np.flatnonzero(np.diff(used) > 1) + 1)
    return [slice(part[0], part[-1] + 1) for part in parts if len(part) > 1]


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


def distances(pieces: Sequence[Recording], delay: float) -> Array:
    """Return the distance (M, n) from each position to its command of ``delay`` [s] before."""
    found = []
    for piece in pieces:
        at = np.searchsorted(piece.time, piece.time - delay, side="right") - 1
        distance = commands(piece)[np.maximum(at, 0)] - piece.q
        found.append(distance[~piece.is_left_out])
    return np.concatenate(found)


def goal_error(pieces: Sequence[Recording]) -> float:
    """Return the error of the commands of some time before, where that time fits best [rad or m].

    It is the root mean square of all joints.
    """
    return min(rms(distances(pieces, delay)) for delay in DELAYS)
