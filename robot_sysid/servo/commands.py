"""Are the commands in a log of servos those that the positions follow?

A log has samples of n joints.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from robot_sysid.errors import InputError
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.servo.windows import MAX_DELAY, commands
from robot_sysid.signals.resampling import sampling_period


def check_commands(logs: Sequence[MeasurementLog], joint_names: Sequence[str]) -> None:
    """Raise InputError where positions of a moving joint do not follow its commands.

    They follow with a delay, correlated, by about as much, from about the same zero. Commands that
    equal the positions were copied from them.
    """
    for log in logs:
        # Far enough beyond the largest delay to tell a wrong one, 20 ms apart, and every sample
        # nearby, where a copy shows; of equal ones the least counts.
        period = sampling_period(log.samples.time)
        reach = min(round(3.0 * MAX_DELAY / period), len(log.samples) // 4)
        steps = np.arange(reach + 1)
        sizes = steps[(steps <= 10) | (steps % max(1, round(0.02 / period)) == 0)]
        lags = np.stack((sizes, -sizes), axis=1).ravel()
        # A joint whose positions range over less [rad or m] does not move.
        for k in np.flatnonzero(np.ptp(log.samples.q, axis=0) >= 0.02).tolist():
            q = log.samples.q[:, k]
            command = commands(log.samples)[reach : len(q) - reach, k]
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
                    f"{log.path}: the positions of joint {joint_names[k]} do not follow its "
                    f"commands as those of a servo: commands come {lag:.2g} s before them (not 0 "
                    f"to {MAX_DELAY:g} s){copied}, with a correlation of {correlation:.2f}, "
                    f"change {slope:.3g} times as much (degrees 57.3 times, steps of 4096 a turn "
                    f"652 times as much as rad), and differ by {offset:.3g} all the time; check "
                    "that they were sent to the servos, units and signs (--units, or --columns "
                    f"FILE such as 'command.JOINT = {1.0 / slope:.4g} * TITLE'), columns that were "
                    "exchanged, time stamps and zeros"
                )
