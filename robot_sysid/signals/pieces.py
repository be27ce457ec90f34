"""Gaps that split a log into pieces, each filtered on its own; a long log is cut into some too."""

from __future__ import annotations

import numpy as np

from robot_sysid.records import Array, Measurement

SPLITTING = 0.5
"""Gap that no filter reaches over [s]."""
SPLITTING_STEPS = 20.0
"""The same in sampling periods, for slow logs."""
SHORTEST = 4.0
"""Piece that is too short to be worth filtering [s]."""
MOST_ROWS = 100_000
"""Rows of a piece beyond which it is cut, so that filtering it takes little memory."""
MOST_TIME = 600.0
"""Length of a log beyond which parts of it, spread evenly, stand for the whole [s]."""
PART_TIME = 60.0
"""Length of these parts [s]."""
_MOVING = 0.1
"""Share of the largest range of a joint in any part below which none moves in a part."""
_FIELDS = ("time", "q", "qd", "tau", "qdd", "joint_time", "command")


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
    edges = [0, *cuts.tolist(), len(samples)]
    span = float(samples.time[-1] - samples.time[0])
    most = MOST_ROWS if span <= MOST_TIME else min(MOST_ROWS, round(PART_TIME / np.median(step)))
    spans = [part for a, b in zip(edges, edges[1:]) for part in _cut(a, b, most) if b - a > 1]
    if len(spans) == 1:
        return (samples,)
    long = [(a, b) for a, b in spans if samples.time[b - 1] - samples.time[a] >= SHORTEST]
    return tuple(part_of(samples, a, b) for a, b in _spread(samples, long)) or (samples,)


def piece_note(samples: Measurement, pieces: tuple[Measurement, ...]) -> tuple[str, ...]:
    """Return a sentence on a log that gaps split; nothing on one that has none."""
    used = sum(len(piece) for piece in pieces)
    if len(pieces) == 1 and used == len(samples):
        return ()
    left = f"; {len(samples) - used} rows of other pieces are left out" * (used < len(samples))
    if sum(float(piece.time[-1] - piece.time[0]) for piece in pieces) > 0.5 * MOST_TIME:
        left += ", as the log is longer than any result needs" * (used < len(samples))
    gap = float(np.max(np.diff(samples.time)))
    why = f"gaps of up to {gap:.3g} s split" if _has_gaps(samples.time) else "its length splits"
    return (
        f"{why} the log into {len(pieces)} pieces of at least {SHORTEST:g} s, each filtered on its "
        f"own{left}",
    )


def _has_gaps(time: Array) -> bool:
    step = np.diff(time)
    return bool(np.max(step) > longest_step(float(np.median(step))))


def _spread(samples: Measurement, spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return as many of the spans as ``MOST_TIME`` allows, evenly spread over those that move."""
    time = samples.time
    if sum(time[b - 1] - time[a] for a, b in spans) <= MOST_TIME:
        return spans
    ranges = np.array([np.ptp(samples.q[a:b], axis=0) for a, b in spans])
    moved = np.max(ranges / np.maximum(np.max(ranges, axis=0), 1e-12), axis=1)
    moving = [span for span, share in zip(spans, moved) if share > _MOVING]
    total = float(sum(time[b - 1] - time[a] for a, b in moving))
    count = max(1, int(len(moving) * min(1.0, MOST_TIME / total)))
    return [moving[k] for k in np.linspace(0, len(moving) - 1, count).round().astype(int)]


def _cut(start: int, stop: int, most: int) -> list[tuple[int, int]]:
    """Return the ends of equal parts of a piece, none with more than ``most`` rows."""
    count = -(-(stop - start) // most)
    edges = np.linspace(start, stop, count + 1).astype(int).tolist()
    return list(zip(edges, edges[1:]))


def part_of(samples: Measurement, start: int, stop: int) -> Measurement:
    """Return some consecutive samples of a log."""
    values: dict[str, Array | None] = {}
    for name in _FIELDS:
        whole = getattr(samples, name)
        values[name] = None if whole is None else whole[start:stop]
    return Measurement(**values)  # type: ignore[arg-type]
