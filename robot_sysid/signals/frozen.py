"""Stretches in which a channel of a log repeats one value, as of a sensor that failed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.records import Array

LEAST_TIME = 0.2
"""Least time for which a channel that failed repeats its value [s]."""
LEAST_RUN = 4
"""Least number of equal samples in a row that does not occur by chance."""
_NEAR = 5
"""Number of steps on each side of a stretch that a jump at its end is compared with."""
_JUMP = 3.0
"""Least jump at the end of a stretch of frozen positions, over the usual and the nearby steps."""
_FASTEST = 3.0
"""Largest mean speed at which a joint moves while its position is frozen, over its usual highest
speed: a zero that shifts is no frozen position."""


def equal_runs(time: Array, values: Array) -> Iterator[slice]:
    """Yield the rows of each run of equal values (N,) that lasts at least ``LEAST_TIME``."""
    changes = np.flatnonzero(np.diff(values)) + 1
    starts = np.append(0, changes)
    stops = np.append(changes, len(values))
    lasts = time[stops - 1] - time[starts] >= LEAST_TIME
    is_long = lasts & (stops - starts >= LEAST_RUN)
    yield from map(slice, starts[is_long].tolist(), stops[is_long].tolist())


def frozen_positions(time: Array, q: Array) -> Iterator[slice]:
    """Yield the rows of each stretch in which a joint's position q (N,) [rad] is not measured.

    It repeats one value and then jumps to where the joint has moved meanwhile. A joint that stands
    still does not jump, however long it stands.
    """
    steps = np.abs(np.diff(q))
    moving = steps > 0.0
    if not np.any(moving):
        return
    usual = float(np.median(steps[moving]))
    speeds = steps[moving] / np.diff(time)[moving]
    fastest = float(np.quantile(speeds, 0.95))
    for run in equal_runs(time, q):
        if run.stop == len(q):
            continue
        jump = steps[run.stop - 1]
        before = steps[max(run.start - _NEAR, 0) : run.start]
        after = steps[run.stop : run.stop + _NEAR]
        nearby = float(np.max(np.append(before, after), initial=usual))
        duration = time[run.stop] - time[run.start]
        if _JUMP * nearby < jump < _FASTEST * fastest * duration:
            yield run
