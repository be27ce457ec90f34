"""Are the commands of a log those that its positions follow?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from robot_sysid.errors import InputError
from robot_sysid.records import Recording
from robot_sysid.servo.loop import MAX_DELAY, commands
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.wording import option_name

REACH = 3.0 * MAX_DELAY
"""Largest shift between commands and positions that is tried [s]: far enough beyond the longest
delay that a wrong one shows as what it is."""
SHIFT = 0.02
"""Distance between shifts [s], beside those of the ten nearest samples, where a copy shows."""
LEAST_MOTION = 0.02
"""Range of positions below which a joint does not move [rad or m]."""
LEAST_CORRELATION = 0.5
"""Least correlation of commands with the positions that follow them."""
SLOPES = (0.5, 2.0)
"""What commands may change by, over what positions do: a servo has no other unit than its joint."""
LARGEST_OFFSET = 0.3
"""Largest distance that commands may keep all the time [rad or m]: a soft servo sags under its
load, and no zero is so far off."""
COPIED = 1e-9
"""Distance below which a command equals a position [rad or m]: rounding of a file."""
COPIED_SHARE = 0.98
"""Share of commands that equal a position in a log whose commands were copied from them."""


def check_commands(logs: Sequence[Recording], joint_names: Sequence[str]) -> None:
    """Raise InputError where positions of a moving joint do not follow its commands.

    They follow with a delay, correlated, by about as much, from about the same zero. Commands that
    equal the positions were copied from them. No other command reads commands, so that this check
    is no part of the gate (``faults.gate``).
    """
    for log in logs:
        period = sampling_period(log.time)
        reach = min(round(REACH / period), len(log) // 4)
        steps = np.arange(reach + 1)
        sizes = steps[(steps <= 10) | (steps % max(1, round(SHIFT / period)) == 0)]
        # Of equal ones the least counts.
        lags = np.stack((sizes, -sizes), axis=1).ravel()
        for k in np.flatnonzero(np.ptp(log.q, axis=0) >= LEAST_MOTION).tolist():
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
            is_copy = np.quantile(np.abs(distances), COPIED_SHARE) < COPIED
            if (
                is_copy
                or correlation < LEAST_CORRELATION
                or not 0.0 <= lag <= MAX_DELAY
                or not SLOPES[0] < slope < SLOPES[1]
                or abs(offset) > LARGEST_OFFSET
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
