"""Logs of commanded and measured positions: are the commands what they seem, and where to start."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.records import Array, Measurement
from robot_sysid.signals.resampling import usual_period
from robot_sysid.simulation.rollout.servo import Window

MOVES = 0.02
"""Range of positions from which on a joint moves [rad or m]."""
MOST_PERIODS = 10
"""Largest delay that is sought, in sampling periods."""
SMOOTHED = 0.12
"""Length of the parabolas that give speeds at the start of a window [s]."""
_SLOPES = {"degrees": 180.0 / np.pi, "steps of 4096 a turn": 4096 / (2 * np.pi)}
_ALIKE, _FOLLOWS, _OFFSET = 0.98, 0.5, 0.3


@dataclass(frozen=True)
class Piece:
    """A stretch of a log, with what is needed to start a rollout anywhere in it.

    Attributes:
        time: (N,) [s].
        q, qd: (N, n) measured positions and their smoothed derivatives [rad, rad/s].
        smooth: (N, n) smoothed positions [rad].
        command: (N, n) [rad].
    """

    time: Array
    q: Array
    qd: Array
    smooth: Array
    command: Array

    def part(self, inside: NDArray[np.bool_]) -> Piece:
        """Return the samples (N,) inside a stretch."""
        values = (getattr(self, name)[inside] for name in ("time", "q", "qd", "smooth", "command"))
        return Piece(*values)

    @property
    def period(self) -> float:
        """Usual step between samples [s]."""
        return usual_period(self.time)

    def window(self, sample: int) -> Window:
        """Return the window that starts at a sample."""
        start, state = float(self.time[sample]), (self.smooth[sample], self.qd[sample])
        return Window(start, *state, self.time, self.command)


def commanded_pieces(logs: Sequence[MeasurementLog], joints: Sequence[str]) -> list[Piece]:
    """Return the pieces of some logs that were read for their commands.

    Raises:
        InputError: the commands cannot be what they seem; says which joint and why.
    """
    found = []
    for log in logs:
        for joint, name in enumerate(joints):
            complaint = _complaint(log.pieces, joint)
            if complaint is not None:
                raise InputError(f"{log.path}: the commands of joint {name} {complaint}")
        found += [piece_of(part) for part in log.pieces]
    return found


def moving(pieces: Sequence[Piece]) -> NDArray[np.bool_]:
    """Return (n,) which joints move."""
    spans = [np.ptp(piece.q, axis=0) for piece in pieces]
    return np.asarray(np.max(spans, axis=0) >= MOVES)


def piece_of(part: Measurement) -> Piece:
    """Return a stretch with smoothed motion."""
    from scipy.signal import savgol_filter

    assert part.command is not None
    period = usual_period(part.time)
    length = max(5, 2 * round(0.5 * SMOOTHED / period) + 1)
    if len(part) < 4 * length:
        raise InputError(f"only {len(part)} samples; a log of several seconds is needed")
    smooth = savgol_filter(part.q, length, 2, axis=0)
    qd = savgol_filter(part.q, length, 2, deriv=1, delta=period, axis=0)
    return Piece(part.time, part.q, qd, smooth, part.command)


def _complaint(parts: Sequence[Measurement], joint: int) -> str | None:
    """Return what is wrong with a joint's commands, as the end of a sentence; or None."""
    q = [part.q[:, joint] for part in parts]
    command = [part.command[:, joint] for part in parts if part.command is not None]
    if np.ptp(np.concatenate(q)) < MOVES:
        return None
    return next(_faults(q, command), None)


def _faults(q: Sequence[Array], command: Sequence[Array]) -> Iterator[str]:
    at, best = _best_lag(q, command)
    if max(_repeats(q, command, lag) for lag in range(4)) > _ALIKE:
        yield (
            "repeat the measured positions: the log holds no real commands; record what was sent "
            "to the servos"
        )
    slope = _slope(q, command, at)
    unit = next((u for u, k in _SLOPES.items() if 0.7 < abs(slope) / k < 1.4), None)
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
    offset = float(np.median(np.concatenate(command) - np.concatenate(q)))
    if abs(offset) > _OFFSET:
        yield (
            f"differ from its positions by {offset:.3g} all the time; check that both count from "
            "the same zero"
        )


def _repeats(q: Sequence[Array], command: Sequence[Array], lag: int) -> float:
    """Return the share of samples whose command is exactly the position so many samples later."""
    same = [np.abs(c[: len(c) - lag] - p[lag:]) < 1e-9 for p, c in zip(q, command)]
    return float(np.mean(np.concatenate(same)))


def _shifted(q: Sequence[Array], command: Sequence[Array], lag: int) -> tuple[Array, Array]:
    """Return (positions, commands) so many samples before them, each without its mean."""
    first, last = max(0, lag), min(0, lag)
    pairs = [(p[first : len(p) + last], c[-last : len(c) - first]) for p, c in zip(q, command)]
    whole = (np.concatenate([each - np.mean(each) for each in side]) for side in zip(*pairs))
    return tuple(whole)  # type: ignore[return-value]


def _best_lag(q: Sequence[Array], command: Sequence[Array]) -> tuple[int, float]:
    """Return (by how many samples positions are behind commands, correlation there)."""
    reach = min(3 * MOST_PERIODS, min(map(len, q)) // 4)
    found = []
    for lag in range(-reach, reach + 1):
        position, asked = _shifted(q, command, lag)
        norm = float(np.linalg.norm(position) * np.linalg.norm(asked))
        found.append((abs(float(position @ asked)) / norm if norm > 0.0 else 0.0, -abs(lag), lag))
    correlation, _, lag = max(found)
    return lag, correlation


def _slope(q: Sequence[Array], command: Sequence[Array], lag: int) -> float:
    """Return how much commands change where positions change by one."""
    position, asked = _shifted(q, command, lag)
    return float(position @ asked / (position @ position))
