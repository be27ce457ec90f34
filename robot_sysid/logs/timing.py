"""Checks of a log's time stamps: period, gaps, implausible units, joints' own clocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.logs.rows import LogRows
from robot_sysid.records import JointLimits
from robot_sysid.signals.resampling import GAP_STEPS, usual_period

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


def clock_notes(rows: LogRows, context: LogContext) -> Iterator[str]:
    """Yield notes on sampling period and gaps; refuse an implausible unit of time."""
    period = usual_period(rows.samples.time)
    if period > _LONGEST_STEP:
        unit = "ms" if period <= 50 else "us" if period <= 5e4 else "ns"
        raise InputError(
            f"{context.name}: time steps of {period:.6g} s are too long for a motion; "
            f"if time is in {unit}, pass --units {unit}"
        )
    if period < _SHORTEST_STEP:
        raise InputError(
            f"{context.name}: time steps of {period:.3g} s are too short for a "
            "recording; declare the unit of time with --units (s, ms, us or ns)"
        )
    if period > 0.02:
        yield f"the log has only {1 / period:.3g} samples per second"
    step = np.diff(rows.samples.time)
    late = rows.lines[1:][step > GAP_STEPS * np.median(step)]
    if len(late) > 0.1 * len(rows.lines):
        yield (
            f"the samples are unevenly spaced: {len(late)} steps are longer than "
            f"{GAP_STEPS} times the usual {1e3 * period:.3g} ms ({rows.listed(late)})"
        )
    elif len(late):
        yield (
            f"samples are missing before {rows.listed(late)}; the longest gap is "
            f"{1e3 * np.max(step):.4g} ms where {1e3 * period:.4g} ms is usual"
        )


def require_one_clock(rows: LogRows, context: LogContext) -> None:
    """Refuse joints' own time stamps that run backwards or belong to another clock."""
    stamps = rows.samples.joint_time
    if stamps is None:
        return
    remedy = "keep them out with 'joint_time = none' in the columns file"
    backwards = rows.lines[1:][np.any(np.diff(stamps, axis=0) < 0.0, axis=1)]
    if len(backwards):
        raise InputError(
            f"{context.name}: a joint's own time stamp runs backwards at {rows.listed(backwards)}; "
            f"{remedy}"
        )
    apart = np.max(np.abs(stamps - rows.samples.time[:, None]))
    if apart > 0.1:
        raise InputError(
            f"{context.name}: the joints' own time stamps are up to {apart:.3g} s away "
            f"from the row's; {remedy}"
        )
