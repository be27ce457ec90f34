"""Commands and positions in logs of servos: which joints move, and whether commands are plausible.

A piece is a part of a log without gaps, with N samples of n joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.records import Array, Measurement
from robot_sysid.servo.windows import MAX_DELAY_PERIODS

MOVING_RANGE = 0.02
"""Range of positions from which on a joint moves [rad or m]."""
_UNITS = {
    ", as degrees do": 180.0 / np.pi,
    ", as steps of 4096 a turn do": 4096 / (2 * np.pi),
}
"""Other units than rad to the change of commands in them per change of positions."""
_COPIED_SHARE = 0.98
"""Share of commands that equal a position from which on they are a copy of the positions."""
_COPY_LAGS = 4
"""Number of samples over which a copy of the positions is looked for."""
_LEAST_CORRELATION = 0.5
"""Least correlation of commands and positions, at the best delay, of a joint that follows them."""
_LARGEST_OFFSET = 0.3
"""Largest median difference of commands and positions that is plausible [rad or m]."""


def commanded_pieces(
    logs: Sequence[MeasurementLog], joint_names: Sequence[str]
) -> list[Measurement]:
    """Return the pieces of all logs that have commands, after a check that these are plausible.

    Raises:
        InputError: the commands of a moving joint are implausible; says which joint's and why.
    """
    pieces = list[Measurement]()
    for log in logs:
        pieces += [piece for piece in log.pieces if piece.command is not None]
        pairs = [(p.q, p.command) for p in log.pieces if p.command is not None]
        for joint, name in enumerate(joint_names if pairs else ()):
            own = [(q[:, joint], command[:, joint]) for q, command in pairs]
            if np.ptp(np.concatenate([q for q, _ in own])) < MOVING_RANGE:
                continue
            for fault in _command_faults(own):
                raise InputError(f"{log.path}: the commands of joint {name} {fault}")
    return pieces


def _command_faults(pairs: Sequence[tuple[Array, Array]]) -> Iterator[str]:
    """Yield each fault of a joint's commands, as the predicate of a sentence about them.

    Args:
        pairs: positions (N,) and commands (N,) of the joint in each piece of a log.
    """
    # Far enough beyond the largest delay to tell a wrong lag, but three quarters always overlap.
    reach = min(3 * MAX_DELAY_PERIODS, min(len(q) for q, _ in pairs) // 4)
    fits = []
    copied_share = 0.0
    for lag in range(-reach, reach + 1):
        # Position k + lag is compared with command k, wherever both exist.
        start = max(0, lag)
        end = min(0, lag)
        overlaps = [
            (q[start : len(q) + end], c[-end : len(c) - start]) for q, c in pairs
        ]
        if 0 <= lag < _COPY_LAGS:
            is_equal = [np.abs(q - c) < 1e-9 for q, c in overlaps]
            copied_share = max(copied_share, float(np.mean(np.concatenate(is_equal))))
        q = np.concatenate([q - np.mean(q) for q, _ in overlaps])
        command = np.concatenate([c - np.mean(c) for _, c in overlaps])
        product = float(q @ command)
        norm = float(np.linalg.norm(q) * np.linalg.norm(command)) or np.inf
        # Of equal correlations the shortest lag.
        fits.append((abs(product) / norm, -abs(lag), lag, product / float(q @ q)))
    correlation, _, lag, slope = max(fits)
    offset = float(np.median(np.concatenate([c - q for q, c in pairs])))
    if copied_share > _COPIED_SHARE:
        yield (
            "repeat the measured positions: the log holds no real commands; record what was sent "
            "to the servos"
        )
    if correlation < _LEAST_CORRELATION:
        yield (
            f"are not followed (correlation {correlation:.2f} at the best delay); check the "
            "columns, and that the servos were on"
        )
    if not 0.5 < slope < 2.0:
        likely = [name for name, size in _UNITS.items() if 0.7 < slope / size < 1.4]
        yield (
            f"change {slope:.3g} times as much as its positions{''.join(likely)}; check the sign, "
            "and say their units with --units, or scale the columns with --columns FILE, such as "
            f"'command.JOINT = {1.0 / slope:.4g} * TITLE'"
        )
    if lag < 0:
        yield (
            f"come {-lag} samples after its positions; check the time stamps, and whether the "
            "columns of commands and positions were exchanged"
        )
    if lag > MAX_DELAY_PERIODS:
        yield (
            f"come {lag} samples before its positions, more than the {MAX_DELAY_PERIODS} that are "
            "sought; check the time stamps, or record faster"
        )
    if abs(offset) > _LARGEST_OFFSET:
        yield (
            f"differ from its positions by {offset:.3g} all the time; check that both count from "
            "the same zero"
        )
