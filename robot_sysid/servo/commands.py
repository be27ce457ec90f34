"""Commands of a log, looked at before anything is searched for: can they be what they seem?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.records import Array, Measurement

# Range of positions from which on a joint moves [rad or m]; largest delay that is sought, in
# sampling periods; slopes of commands in other units; how much is alike, followed, off.
MOVES, MOST_PERIODS = 0.02, 10
_SLOPES = {"degrees": 180.0 / np.pi, "steps of 4096 a turn": 4096 / (2 * np.pi)}
_ALIKE, _FOLLOWS, _OFFSET = 0.98, 0.5, 0.3


def commanded_pieces(logs: Sequence[MeasurementLog], joints: Sequence[str]) -> list[Measurement]:
    """Return the pieces between the gaps of some logs that were read for their commands.

    Raises:
        InputError: the commands cannot be what they seem; says which joint and why.
    """
    for log in logs:
        for joint in np.flatnonzero(moving(log.pieces)).tolist():
            asked = [(p.q, p.command) for p in log.pieces if p.command is not None]
            pairs = [(q[:, joint], command[:, joint]) for q, command in asked]
            for fault in _faults(pairs):
                raise InputError(f"{log.path}: the commands of joint {joints[joint]} {fault}")
    return [part for log in logs for part in log.pieces]


def moving(parts: Sequence[Measurement]) -> NDArray[np.bool_]:
    """Return (n,) which joints move."""
    return np.asarray(np.ptp(np.concatenate([part.q for part in parts]), axis=0) >= MOVES)


def _faults(pairs: Sequence[tuple[Array, Array]]) -> Iterator[str]:
    """Yield what is wrong with a joint's commands, as the end of a sentence."""
    best, at, slope = _best_lag(pairs)
    same = [[np.abs(c[: len(c) - lag] - q[lag:]) < 1e-9 for q, c in pairs] for lag in range(4)]
    unit = next((u for u, k in _SLOPES.items() if 0.7 < abs(slope) / k < 1.4), None)
    offset = float(np.median(np.concatenate([c - q for q, c in pairs])))
    if max(float(np.mean(np.concatenate(each))) for each in same) > _ALIKE:
        yield (
            "repeat the measured positions: the log holds no real commands; record what was sent "
            "to the servos"
        )
    if unit is not None:
        yield (
            f"change {abs(slope):.3g} times as much as its positions: they look like {unit}; say "
            "what they are with --units, or scale the columns with --columns FILE, such as "
            f"'command.JOINT = {1.0 / slope:.4g} * TITLE'"
        )
    if best < _FOLLOWS:
        yield (
            f"are not followed (correlation {best:.2f} at the best delay); check the columns, and "
            "that the servos were on"
        )
    if not 0.5 < slope < 2.0:
        yield f"change {slope:.3g} times as much as its positions; check their units and sign"
    if at < 0:
        yield (
            f"come {-at} samples after its positions; check the time stamps, and whether the "
            "columns of commands and positions were exchanged"
        )
    if at > MOST_PERIODS:
        yield (
            f"come {at} samples before its positions, more than the {MOST_PERIODS} that are "
            "sought; check the time stamps, or record faster"
        )
    if abs(offset) > _OFFSET:
        yield (
            f"differ from its positions by {offset:.3g} all the time; check that both count from "
            "the same zero"
        )


def _best_lag(pairs: Sequence[tuple[Array, Array]]) -> tuple[float, int, float]:
    """Return (correlation, by how many samples positions are behind, slope of commands) there."""
    reach = min(3 * MOST_PERIODS, min(len(q) for q, _ in pairs) // 4)
    found = []
    for lag in range(-reach, reach + 1):
        first, last = max(0, lag), min(0, lag)
        same = [(q[first : len(q) + last], c[-last : len(c) - first]) for q, c in pairs]
        position, asked = (np.concatenate([v - np.mean(v) for v in side]) for side in zip(*same))
        own, both = float(position @ position), float(position @ asked)
        norm = np.sqrt(own) * float(np.linalg.norm(asked))
        alike, slope = (abs(both) / norm, both / own) if norm > 0.0 else (0.0, 0.0)
        found.append((alike, -abs(lag), lag, slope))
    alike, _, lag, slope = max(found)
    return alike, lag, slope
