"""Checks of a log's time stamps: period, gaps, implausible units, joints' own clocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.logs.rows import LineList, LogChunk
from robot_sysid.records import JointLimits

# A step this much longer than the usual one has lost at least one sample.
GAP_STEPS = 1.75
# A sampling period outside this range is read in the wrong unit of time.
_LONGEST_STEP, _SHORTEST_STEP = 0.5, 1e-5


@dataclass(frozen=True)
class LogContext:
    """What the checks know about the log.

    Attributes:
        name: how the log is called in messages.
        joint_names: the n chain joints.
        limits: what the joints may do, or None.
        is_slide: (n,) whether a joint is a slide.
        angle_declared: whether the unit of angles was declared.
    """

    name: str
    joint_names: tuple[str, ...]
    limits: JointLimits | None
    is_slide: NDArray[np.bool_]
    angle_declared: bool


@dataclass(frozen=True)
class Timing:
    """When the samples were taken.

    Attributes:
        n_samples: number of usable rows.
        start, end: first and last time [s].
        period: usual sampling period, gaps left out [s].
    """

    n_samples: int
    start: float
    end: float
    period: float


class Check(Protocol):
    """One thing that can be wrong with a log."""

    def update(self, chunk: LogChunk) -> None:
        """See more rows; the first one repeats the last row seen before."""

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        """Return notes, or raise InputError."""


class Clock:
    """Sampling period, gaps and implausible time units."""

    def __init__(self) -> None:
        self.median = 0.0
        self._start = self._end = 0.0
        self._rows = 0
        self._regular = 0
        self._regular_time = 0.0
        self._gaps = LineList()
        self._longest = 0.0

    def update(self, chunk: LogChunk) -> None:
        """See more rows."""
        step = np.diff(chunk.time)
        if not self._rows:
            self._start = float(chunk.time[0])
            self._rows = 1
        if not len(step):
            return
        # The first chunk sets the measure, so that memory stays constant.
        self.median = self.median or float(np.median(step))
        gap = step > GAP_STEPS * self.median
        self._gaps.add(chunk.lines[1:][gap])
        self._longest = max(self._longest, float(step.max()))
        self._regular += int(np.sum(~gap))
        self._regular_time += float(np.sum(step[~gap]))
        self._rows += len(step)
        self._end = float(chunk.time[-1])

    def timing(self, context: LogContext) -> Timing:
        """Return the timing of all rows seen."""
        if self._rows < 10:
            raise InputError(
                f"{context.name} has only {self._rows} usable rows; an excitation of several "
                "seconds is needed"
            )
        return Timing(self._rows, self._start, self._end, self._regular_time / self._regular)

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        """Return notes, or raise InputError."""
        if timing.period > _LONGEST_STEP:
            unit = "ms" if timing.period <= 50 else "us" if timing.period <= 5e4 else "ns"
            raise InputError(
                f"{context.name}: time steps of {timing.period:.6g} s are too long for a motion; "
                f"if time is in {unit}, pass --units {unit}"
            )
        if timing.period < _SHORTEST_STEP:
            raise InputError(
                f"{context.name}: time steps of {timing.period:.3g} s are too short for a "
                "recording; declare the unit of time with --units (s, ms, us or ns)"
            )
        notes = []
        if timing.period > 0.02:
            notes.append(f"the log has only {1 / timing.period:.3g} samples per second")
        if self._gaps.count > 0.1 * self._rows:
            notes.append(
                f"the samples are unevenly spaced: {self._gaps.count} steps are longer than "
                f"{GAP_STEPS} times the usual {1e3 * timing.period:.3g} ms ({self._gaps})"
            )
        elif self._gaps.count:
            notes.append(
                f"samples are missing before {self._gaps}; the longest gap is "
                f"{1e3 * self._longest:.4g} ms where {1e3 * timing.period:.4g} ms is usual"
            )
        return notes


class JointTime:
    """Joints' own time stamps that run backwards or belong to another clock."""

    def __init__(self) -> None:
        self._backwards = LineList()
        self._apart = 0.0

    def update(self, chunk: LogChunk) -> None:
        """See more rows."""
        if chunk.joint_time is None:
            return
        back = np.any(np.diff(chunk.joint_time, axis=0) < 0.0, axis=1)
        self._backwards.add(chunk.lines[1:][back])
        apart = np.abs(chunk.joint_time - chunk.time[:, None])
        self._apart = max(self._apart, float(apart.max()))

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        """Return notes, or raise InputError."""
        remedy = "keep them out with 'joint_time = none' in the columns file"
        if self._backwards.count:
            raise InputError(
                f"{context.name}: a joint's own time stamp runs backwards at {self._backwards}; "
                f"{remedy}"
            )
        if self._apart > 0.1:
            raise InputError(
                f"{context.name}: the joints' own time stamps are up to {self._apart:.3g} s away "
                f"from the row's; {remedy}"
            )
        return []
