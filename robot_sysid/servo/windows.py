"""Windows of an arm's logs, played with a model's servos: how far off are the positions?

Before, ``check_commands``: are the commands in a log those that the positions follow?

Played are windows that are fitted, and held-out ones, by the servos before and after: the
judgement of what is written. A model that predicts positions no better than "position equals the
command of some time before" is of no use, however much better than the model before it is.

n is the number of joints, W that of windows, m that of samples in each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.estimate.held_out import is_clearly_lower
from robot_sysid.records import Array, Recording
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.simulation.playback import (
    MAX_WINDOWS,
    STEP,
    ServoParameters,
    ServoRollouts,
    ServoWindow,
    interpolate,
)
from robot_sysid.wording import option_name

MAX_DELAY = 0.2
"""Longest time by which positions may follow their commands [s]: that of a soft servo, damping over
gain (0.14 s at a kd of 2.75 and a kp of 20), or ten cycles of a slow bus of 50 Hz."""
WINDOW = 1.0
"""Length of a window [s]."""


def check_commands(logs: Sequence[Recording], joint_names: Sequence[str]) -> None:
    """Raise InputError where positions of a moving joint do not follow its commands.

    They follow with a delay, correlated, by about as much, from about the same zero. Commands that
    equal the positions were copied from them.
    """
    for log in logs:
        # Far enough beyond the largest delay to tell a wrong one, 20 ms apart, and every sample
        # nearby, where a copy shows; of equal ones the least counts.
        period = sampling_period(log.time)
        reach = min(round(3.0 * MAX_DELAY / period), len(log) // 4)
        steps = np.arange(reach + 1)
        sizes = steps[(steps <= 10) | (steps % max(1, round(0.02 / period)) == 0)]
        lags = np.stack((sizes, -sizes), axis=1).ravel()
        # A joint whose positions range over less [rad or m] does not move.
        for k in np.flatnonzero(np.ptp(log.q, axis=0) >= 0.02).tolist():
            q = log.q[:, k]
            command = commands(log)[reach : len(q) - reach, k]
            late = sliding_window_view(q, len(command))[reach + lags]
            (size, *covariances), *others = np.cov(command, late)
            variances = np.diag(others, 1)
            scales = np.sqrt(size * variances) + 1e-300
            correlations = np.abs(covariances) / scales
            best = np.argmax(correlations)
            correlation = correlations[best]
            lag = period * lags[best]
            slope = covariances[best] / variances[best]
            distances = command - late[best]
            offset = np.median(distances)
            # Of a copy, nearly all commands equal a position.
            is_copy = np.quantile(np.abs(distances), 0.98) < 1e-9
            if (
                is_copy
                or correlation < 0.5
                or not 0.0 <= lag <= MAX_DELAY
                or not 0.5 < slope < 2.0
                or abs(offset) > 0.3
            ):
                copied = " and repeat the measured ones" if is_copy else ""
                raise InputError(
                    f"{log}: the positions of joint {joint_names[k]} do not follow its "
                    f"commands as those of a servo: commands come {lag:.2g} s before them (not 0 "
                    f"to {MAX_DELAY:g} s){copied}, with a correlation of {correlation:.2f}, "
                    f"change {slope:.3g} times as much (degrees 57.3 times, steps of 4096 a turn "
                    f"652 times as much as rad), and differ by {offset:.3g} all the time; check "
                    "that they were sent to the servos, units and signs "
                    f"({option_name('units')}, or {option_name('columns', 'FILE')} such as "
                    f"'command.JOINT = {1.0 / slope:.4g} * TITLE'), columns that were exchanged, "
                    "time stamps and zeros"
                )


class ServoProblem:
    """Windows of logs and the position errors of rollouts in them.

    Pieces of logs are cut into consecutive windows of ``WINDOW``. The beginning of each piece is
    left out: commands before a window act in it. Of more than ``MAX_WINDOWS`` every second one is
    taken, or every third.

    Args:
        rollouts: plays the windows on the arm's model.
        pieces: of logs, which have commands.

    Attributes:
        rollouts: as given.
        windows: start and commands of each window.
        times: (W, m) of the samples since the start of their window [s].
        measured: (W, m, n) positions measured then [rad or m].

    Raises InputError where no piece is long enough for one window after its beginning.
    """

    def __init__(self, rollouts: ServoRollouts, pieces: Sequence[Recording]) -> None:
        self.rollouts = rollouts
        count = int(WINDOW / longest_period(pieces))
        cut = []
        for piece in pieces:
            _, qd, _ = low_pass_motion(piece)
            beginning = round(MAX_DELAY / sampling_period(piece.time))
            for first in range(beginning, len(piece) - count, count):
                at = slice(first, first + count)
                start = piece.time[first]
                window = ServoWindow(
                    start, piece.q[first], qd[first], piece.time, commands(piece)
                )
                cut.append((window, piece.time[at] - start, piece.q[at]))
        if not cut:
            raise InputError(
                "a log, or its last fifth, by which the result is judged, has no piece of "
                f"{WINDOW:g} s after its beginning; record longer"
            )
        cut = cut[:: math.ceil(len(cut) / MAX_WINDOWS)]
        self.windows, times, measured = zip(*cut)
        self.times = np.array(times)
        self.measured = np.array(measured)

    def errors(self, servos: ServoParameters) -> Array:
        """Return played minus measured positions (W, m, n), pi where a rollout has diverged."""
        # Windows over lost samples are longer than others.
        edges = np.arange(0.0, np.max(self.times) + STEP, STEP)
        q = self.rollouts.positions(servos, self.windows, edges)
        played = [interpolate(times, edges, own) for times, own in zip(self.times, q)]
        return np.nan_to_num(np.array(played) - self.measured, nan=np.pi)

    def test(
        self, before: ServoParameters, after: ServoParameters
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return what two sets of servo parameters miss.

        They are each joint's root mean square errors (n,) before and after, and whether those after
        are clearly larger, window by window (n,).
        """
        old, new = (np.mean(self.errors(s) ** 2, axis=1) for s in (before, after))
        # Encoder steps hide a third of a step of 4096 a turn [rad or m].
        hidden = 5e-4**2
        pairs = zip(old.T + hidden, new.T + hidden)
        is_worse = np.array([is_clearly_lower(*pair) for pair in pairs])
        return np.sqrt(np.mean(old, axis=0)), np.sqrt(np.mean(new, axis=0)), is_worse


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

    # A standard deviation of 22 ms; in sampling periods at least 1.1, as the derivatives of a
    # narrower Gaussian are wrong.
    width = max(0.022 / sampling_period(time), 1.1)
    # Cut off at seven widths: nearer to the middle, a constant would have a second derivative.
    return gaussian_filter1d(values, width, 0, order, mode="nearest", truncate=7.0)


def low_pass_motion(piece: Recording) -> tuple[Array, Array, Array]:
    """Return low-passed positions, velocities, accelerations (N, n) of a piece of a log.

    Time stamps pass the same low-pass, so that uneven ones make no speed.
    """
    step = low_pass(piece.time, piece.time, 1)[:, None]
    change = low_pass(piece.time, piece.time, 2)[:, None]
    qd = low_pass(piece.time, piece.q, 1) / step
    qdd = (low_pass(piece.time, piece.q, 2) - qd * change) / step**2
    return low_pass(piece.time, piece.q), qd, qdd
