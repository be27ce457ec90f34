"""Torque channels that end at a value, or stand still while the arm moves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.checks.finding import Finding, Level
from robot_sysid.records import Array, Measurement

LONG = 0.3
"""Time for which a torque that changes otherwise is not exactly the same [s]."""
OFTEN = 0.005
"""Share of samples at the largest value beyond which a sensor is at its end."""
_MANY_VALUES = 100
_MOVING = 0.05
_RUN = 4
_SEEN = 20


def sensor_findings(pieces: Sequence[Measurement], joint_names: Sequence[str]) -> Iterator[Finding]:
    """Yield what the torque channels of a log's pieces say."""
    for joint, name in enumerate(joint_names):
        tau = np.concatenate([piece.tau[:, joint] for piece in pieces])
        if len(np.unique(tau)) < _MANY_VALUES:
            continue
        share, value = max(_at_end(tau, 1.0), _at_end(tau, -1.0))
        if share > OFTEN:
            yield Finding(
                "saturated",
                Level.WARN,
                f"the torque of joint {name} is exactly {value:.4g} N m, the end of its range, in "
                f"{100.0 * share:.2g} % of the samples: the sensor is at its end; move slower, or "
                "carry less",
            )
        held = max(_longest_hold(piece, joint) for piece in pieces)
        if held > LONG:
            yield Finding(
                "held",
                Level.WARN,
                f"the torque of joint {name} stands still for {held:.2g} s while the arm moves: "
                "the channel holds its last value; record again",
            )


def _at_end(tau: Array, sign: float) -> tuple[float, float]:
    """Return (share of samples exactly at the end of the range, that value)."""
    end = float(np.max(sign * tau))
    there = sign * tau == end
    near = (sign * tau > end - 0.02 * float(np.ptp(tau))) & ~there
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate(([0], there.view(np.int8), [0])))))
    count, beside = int(np.sum(there)), int(np.sum(near))
    steady = np.max(runs[::2], initial=0) >= _RUN and count > 3 * beside
    clipped = steady or (count >= _SEEN and count > 5 * beside)
    return (float(np.mean(there)) if clipped else 0.0, sign * end)


def _longest_hold(piece: Measurement, joint: int) -> float:
    """Return for how long a torque stays exactly the same while any joint moves [s]."""
    changes = np.flatnonzero(np.diff(piece.tau[:, joint]))
    edges = np.concatenate(([0], changes + 1, [len(piece)]))
    longest = 0.0
    for start in np.flatnonzero(np.diff(edges) >= _RUN):
        first, last = edges[start], edges[start + 1] - 1
        length = float(piece.time[last] - piece.time[first])
        # An arm that comes back to where it was has moved as well.
        moved = np.max(np.ptp(piece.q[first : last + 1], axis=0))
        if length > longest and moved > _MOVING * min(length, 1.0):
            longest = length
    return longest
