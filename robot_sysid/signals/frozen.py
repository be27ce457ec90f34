"""Stretches of a log in which a channel repeats one value, as of a sensor that failed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array
from robot_sysid.records.fault_names import FaultName

FAILURE_TIME = 0.2
"""Time for which a channel that failed repeats one value [s]."""
CLEAR_JUMP = 3.0
"""Ratio of a jump to the steps around it above which the position was not measured before it."""


class Stretch(NamedTuple):
    """A stretch of time with a fault: begin and end [s], joints that show it, and its name."""

    start: float
    stop: float
    joints: NDArray[np.bool_]
    name: FaultName = FaultName.CONTACT


def true_runs(mask: NDArray[np.bool_]) -> Iterator[slice]:
    """Yield the slices of consecutive true elements of a mask (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False]))))
    for start, stop in edges.reshape(-1, 2).tolist():
        yield slice(start, stop)


def equal_runs(time: Array, values: Array) -> Iterator[slice]:
    """Yield the rows of each run of equal values (N,) that lasts as long as a failure.

    A run of fewer than four samples may be chance.
    """
    for steps in true_runs(np.diff(values) == 0.0):
        is_long = time[steps.stop] - time[steps.start] >= FAILURE_TIME
        if is_long and steps.stop - steps.start > 2:
            yield slice(steps.start, steps.stop + 1)


def frozen_positions(time: Array, q: Array) -> Iterator[slice]:
    """Yield the rows of each stretch in which a joint's position q (N,) [rad] is not measured.

    It repeats one value and then jumps to where the joint has moved meanwhile. A joint that stands
    still does not jump, however long it stands.
    """
    # Number of steps on each side of a stretch that a jump at its end is compared with.
    near = 5
    steps = np.abs(np.diff(q))
    usual = np.median(steps[steps > 0.0]) if np.any(steps) else 0.0
    for run in equal_runs(time, q):
        before = steps[max(run.start - near, 0) : run.start]
        jump, *after = steps[run.stop - 1 : run.stop + near].tolist() or [0.0]
        if jump > CLEAR_JUMP * max([usual, *before, *after]):
            yield run
