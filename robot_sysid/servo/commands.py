"""Commands and positions in logs of servos: which joints move, and whether commands are plausible.

A log has samples of n joints.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.records import Array
from robot_sysid.servo.windows import MAX_DELAY_PERIODS, commands

MOVING_RANGE = 0.02
"""Range of positions from which on a joint moves [rad or m]."""
_COPIED_SHARE = 0.98
"""Share of commands that equal a position from which on they are a copy of the positions."""
_LEAST_CORRELATION = 0.5
"""Least correlation of commands and positions, at the best delay, of a joint that follows them."""
_LARGEST_OFFSET = 0.3
"""Largest median difference of commands and positions that is plausible [rad or m]."""


def check_commands(logs: Sequence[MeasurementLog], joint_names: Sequence[str]) -> None:
    """Raise InputError where the commands of a moving joint are implausible."""
    for log in logs:
        q = log.samples.q
        command = commands(log.samples)
        for joint, name in enumerate(joint_names):
            if np.ptp(q[:, joint]) < MOVING_RANGE:
                continue
            fault = _command_fault(q[:, joint], command[:, joint])
            if fault is not None:
                raise InputError(f"{log.path}: the commands of joint {name} {fault}")


def _command_fault(q: Array, command: Array) -> str | None:
    """Return what is wrong with commands (N,) of a joint at q (N,), as a predicate, or None."""
    # Far enough beyond the largest delay to tell a wrong lag; of equal ones the shortest counts.
    reach = min(3 * MAX_DELAY_PERIODS, len(q) // 4)
    lags = sorted(range(-reach, reach + 1), key=abs)
    # Position k + lag is compared with command k, wherever both exist.
    overlaps = [
        (
            q[max(lag, 0) : len(q) + min(lag, 0)],
            command[max(-lag, 0) : len(q) - max(lag, 0)],
        )
        for lag in lags
    ]
    variances = np.array([np.cov(*overlap) for overlap in overlaps])
    sizes = np.sqrt(variances[:, 0, 0] * variances[:, 1, 1]) + 1e-300
    correlations = np.abs(variances[:, 0, 1]) / sizes
    best = int(np.argmax(correlations))
    if correlations[best] < _LEAST_CORRELATION:
        return (
            f"are not followed (correlation {correlations[best]:.2f} at the best delay); check the "
            "columns, and that the servos were on"
        )
    slope = variances[best, 0, 1] / variances[best, 0, 0]
    if not 0.5 < slope < 2.0:
        return (
            f"change {slope:.3g} times as much as its positions (degrees do 57.3 times, steps of "
            "4096 a turn 652 times as much as rad); check the sign, and say their units with "
            "--units, or scale the columns with --columns FILE, such as "
            f"'command.JOINT = {1.0 / slope:.4g} * TITLE'"
        )
    if not 0 <= lags[best] <= MAX_DELAY_PERIODS:
        return (
            f"come {lags[best]} samples before its positions, not 0 to {MAX_DELAY_PERIODS}; check "
            "the time stamps, and whether the columns of commands and positions were exchanged, or "
            "record faster"
        )
    late_q, early_command = overlaps[best]
    if np.mean(np.abs(late_q - early_command) < 1e-9) > _COPIED_SHARE:
        return (
            "repeat the measured positions: the log holds no real commands; record what was sent "
            "to the servos"
        )
    offset = float(np.median(command - q))
    if abs(offset) > _LARGEST_OFFSET:
        return (
            f"differ from its positions by {offset:.3g} all the time; check that both count from "
            "the same zero"
        )
    return None
