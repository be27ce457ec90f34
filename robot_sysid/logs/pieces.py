"""Gaps that split a log into pieces, each filtered on its own."""

from __future__ import annotations

import numpy as np

from robot_sysid.records import Array, Measurement

SPLITTING = 0.5
"""Gap that no filter reaches over [s]."""
SPLITTING_STEPS = 20.0
"""The same in sampling periods, for slow logs."""
SHORTEST = 4.0
"""Piece that is too short to be worth filtering [s]."""
_FIELDS = ("time", "q", "qd", "tau", "qdd", "joint_time")


def longest_step(period: float) -> float:
    """Return the longest step of time within a piece [s], for a usual step of ``period`` [s]."""
    return max(SPLITTING, SPLITTING_STEPS * period)


def pieces_of(samples: Measurement) -> tuple[Measurement, ...]:
    """Return the pieces between the gaps of a log, those that are long enough.

    A log without gaps is its own only piece, and so is one whose pieces are all too short.
    """
    step = np.diff(samples.time)
    if not len(step):
        return (samples,)
    cuts = np.flatnonzero(step > longest_step(float(np.median(step)))) + 1
    if not len(cuts):
        return (samples,)
    edges = [0, *cuts.tolist(), len(samples)]
    spans = [(a, b) for a, b in zip(edges, edges[1:]) if b - a > 1]
    long = [(a, b) for a, b in spans if samples.time[b - 1] - samples.time[a] >= SHORTEST]
    return tuple(_part(samples, a, b) for a, b in long) or (samples,)


def piece_note(samples: Measurement, pieces: tuple[Measurement, ...]) -> tuple[str, ...]:
    """Return a sentence on a log that gaps split; nothing on one that has none."""
    used = sum(len(piece) for piece in pieces)
    if len(pieces) == 1 and used == len(samples):
        return ()
    gap = float(np.max(np.diff(samples.time)))
    left = f"; {len(samples) - used} rows of shorter pieces are left out" * (used < len(samples))
    return (
        f"gaps of up to {gap:.3g} s split the log into {len(pieces)} pieces of at least "
        f"{SHORTEST:g} s, each filtered on its own{left}",
    )


def _part(samples: Measurement, start: int, stop: int) -> Measurement:
    values: dict[str, Array | None] = {}
    for name in _FIELDS:
        whole = getattr(samples, name)
        values[name] = None if whole is None else whole[start:stop]
    return Measurement(**values)  # type: ignore[arg-type]
