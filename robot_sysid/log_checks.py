"""Finding what is wrong with a log before anything is estimated from it.

Each check sees the rows once, chunk by chunk, keeps a few sums and ends in notes (the run goes on)
or in an InputError (the numbers could not mean what they seem to). Both name lines and a remedy.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.log_rows import LineList, LogChunk, Repairs
from robot_sysid.records import Array, JointLimits

# A step this much longer than the usual one has lost at least one sample.
GAP_STEPS = 1.75
# No arm's joint reaches this; a log in degrees passes it at an easy half radian per second.
_FAST = 30.0
_JUMP_SPEED = 100.0
_JUMP = 0.5
_AT_REST = 0.01
_STILL = 0.002
_LIMIT_MARGIN = 1e-3
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


def check_log(
    chunks: Iterable[LogChunk], context: LogContext, repairs: Repairs
) -> tuple[Timing, tuple[str, ...]]:
    """Run every check over the rows of a log.

    Args:
        chunks: iterable of LogChunk, in order.
        context: what is known about the log.
        repairs: what reading had to leave out or mend; complete once ``chunks`` is used up.

    Returns:
        Timing, and one sentence for each thing worth knowing.

    Raises:
        InputError: the log cannot be used as it is.
    """
    clock = _Clock()
    checks: tuple[Check, ...] = (
        clock, _Angles(), _Jumps(), _Rest(), _Limits(context), _Torque(), _Velocity(clock),
        _JointTime(),
    )  # fmt: skip
    previous: LogChunk | None = None
    for chunk in chunks:
        seen = chunk if previous is None else _joined(previous, chunk)
        for check in checks:
            check.update(seen)
        previous = chunk.rows(slice(-1, None))
    timing = clock.timing(context)
    notes = _repair_notes(context, repairs)
    for check in checks:
        notes += check.finish(context, timing)
    return timing, tuple(notes)


def sign_check(
    tau_measured: Array, tau_model: Array, joint_names: Sequence[str]
) -> tuple[str, ...]:
    """Compare the signs of measured torques with those the model predicts.

    Args:
        tau_measured, tau_model: (N, n) [N m].
        joint_names: the n joints.

    Returns:
        One sentence per joint whose torque hardly follows the model.

    Raises:
        InputError: a joint's torque clearly has the opposite sign.
    """
    product = np.sum(tau_measured * tau_model, axis=0)
    norm = np.linalg.norm(tau_measured, axis=0) * np.linalg.norm(tau_model, axis=0)
    likeness = np.divide(product, norm, out=np.zeros_like(product), where=norm > 0.0)
    notes = []
    for name, value in zip(joint_names, likeness):
        if value < -0.7:
            raise InputError(
                f"the torque of joint {name} has the opposite sign of the model's (likeness "
                f"{value:.2f}); flip it in the columns file: torque.{name} = -TITLE"
            )
        if value < -0.3:
            notes.append(
                f"the torque of joint {name} runs against the model's (likeness {value:.2f}); "
                "check its sign and the order of the columns"
            )
    return tuple(notes)


def _joined(previous: LogChunk, chunk: LogChunk) -> LogChunk:
    def both(name: str) -> Array | None:
        value = getattr(chunk, name)
        return None if value is None else np.concatenate((getattr(previous, name), value))

    names = ("q", "tau", "qd", "qdd", "joint_time")
    lines = np.concatenate((previous.lines, chunk.lines))
    return LogChunk(lines, np.concatenate((previous.time, chunk.time)), *map(both, names))  # type: ignore[arg-type]


def _repair_notes(context: LogContext, repairs: Repairs) -> list[str]:
    usable = max(1, repairs.rows)
    if repairs.missing.count > 0.05 * usable:
        raise InputError(
            f"{context.name}: {repairs.missing.count} of {repairs.rows} rows have empty or NaN "
            f"cells ({repairs.missing}); mend the recording, or keep a broken column out with "
            "--columns FILE"
        )
    if repairs.repeated.count > 0.05 * usable:
        raise InputError(
            f"{context.name}: {repairs.repeated.count} of {repairs.rows} rows repeat the time "
            f"stamp before them ({repairs.repeated}); write the time with more digits"
        )
    said = (
        (repairs.missing, "left out {count} rows with empty or NaN cells ({lines})"),
        (repairs.repeated, "left out {count} rows that repeat a time stamp ({lines})"),
        (repairs.cut_off, "left out the last row, which is cut off ({lines})"),
        (repairs.wrapped, "unwrapped positions that jump by a full turn ({lines})"),
    )
    return [text.format(count=r.count, lines=r) for r, text in said if r.count]


class _Clock:
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
        if self._rows < 10:
            raise InputError(
                f"{context.name} has only {self._rows} usable rows; an excitation of several "
                "seconds is needed"
            )
        return Timing(self._rows, self._start, self._end, self._regular_time / self._regular)

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
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


class _Angles:
    """Positions or speeds that only make sense in degrees."""

    def __init__(self) -> None:
        self._largest = np.zeros(0)
        self._fast = np.zeros(0)
        self._steps = 0

    def update(self, chunk: LogChunk) -> None:
        step, time = np.abs(np.diff(chunk.q, axis=0)), np.diff(chunk.time)[:, None]
        if not self._steps:
            self._largest = self._fast = np.zeros(chunk.q.shape[1])
        self._largest = np.maximum(self._largest, np.abs(chunk.q).max(axis=0))
        self._fast = self._fast + np.sum(step > _FAST * time, axis=0)
        self._steps += len(step)

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        reach = np.full(len(self._largest), 4.0 * np.pi)
        if context.limits is not None:
            limit = np.maximum(np.abs(context.limits.lower), np.abs(context.limits.upper))
            reach = np.where(np.isfinite(limit), np.maximum(2.0 * limit, 2.0 * np.pi), reach)
        hinge = ~context.is_slide
        far = hinge & (self._largest > reach)
        fast = hinge & (self._fast > 0.01 * self._steps)
        if context.angle_declared or not np.any(far | fast):
            return []
        joint = int(np.argmax(far if np.any(far) else fast))
        what = (
            f"joint {context.joint_names[joint]} reaches {self._largest[joint]:.4g}"
            if np.any(far)
            else f"joint {context.joint_names[joint]} would often exceed {_FAST:g} rad/s"
        )
        raise InputError(
            f"{context.name}: positions look like degrees ({what}); pass --units deg, or "
            "--units rad if they are radians"
        )


class _Jumps:
    """Single positions no joint can reach within one step."""

    def __init__(self) -> None:
        self._lines = LineList()
        self._joint = 0

    def update(self, chunk: LogChunk) -> None:
        step, time = np.abs(np.diff(chunk.q, axis=0)), np.diff(chunk.time)[:, None]
        jump = (step > _JUMP) & (step > _JUMP_SPEED * time)
        if np.any(jump) and not self._lines.count:
            self._joint = int(np.argwhere(jump)[0, 1])
        self._lines.add(chunk.lines[1:][np.any(jump, axis=1)])

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        if self._lines.count:
            raise InputError(
                f"{context.name}: the position of joint {context.joint_names[self._joint]} jumps "
                f"at {self._lines}; delete the bad rows, or cut the log there"
            )
        return []


class _Rest:
    """An arm, or a joint, that does not move."""

    def __init__(self) -> None:
        self._lowest = self._highest = np.zeros(0)
        self._first: Array | None = None
        self._first_moved: tuple[int, float] | None = None
        self._held = np.zeros(0)
        self._held_since = (0, 0.0)

    def update(self, chunk: LogChunk) -> None:
        if self._first is None:
            self._first = self._lowest = self._highest = self._held = chunk.q[0]
            self._held_since = (int(chunk.lines[0]), float(chunk.time[0]))
        self._lowest = np.minimum(self._lowest, chunk.q.min(axis=0))
        self._highest = np.maximum(self._highest, chunk.q.max(axis=0))
        moved = np.any(np.abs(chunk.q - self._first) > _STILL, axis=1)
        if self._first_moved is None and np.any(moved):
            self._first_moved = _row(chunk, int(np.argmax(moved)))
        away = np.flatnonzero(np.any(np.abs(chunk.q - chunk.q[-1]) > _STILL, axis=1))
        if len(away):
            self._held_since = _row(chunk, min(int(away[-1]) + 1, len(chunk) - 1))
            self._held = chunk.q[-1]
        elif np.any(np.abs(self._held - chunk.q[-1]) > _STILL):
            self._held_since, self._held = _row(chunk, 0), chunk.q[-1]

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        span = self._highest - self._lowest
        if np.all(span < _AT_REST):
            raise InputError(
                f"{context.name}: the arm is at rest, no joint moves by more than "
                f"{span.max():.2g} rad; record an excitation trajectory (if these are other "
                "units, see --units)"
            )
        still = [n for n, s in zip(context.joint_names, span) if s < _AT_REST]
        notes = [f"joints that do not move in this log: {', '.join(still)}"] if still else []
        long = max(0.5, 0.02 * (timing.end - timing.start))
        if self._first_moved and self._first_moved[1] - timing.start > long:
            line, time = self._first_moved
            notes.append(f"the arm stands still up to line {line} ({time - timing.start:.2f} s)")
        line, time = self._held_since
        if timing.end - time > long:
            notes.append(f"the arm stands still from line {line} on ({timing.end - time:.2f} s)")
        return notes


class _Limits:
    """Positions outside what the model allows."""

    def __init__(self, context: LogContext) -> None:
        self._limits = context.limits
        self._excess = np.zeros(len(context.joint_names))
        self._lines = LineList()

    def update(self, chunk: LogChunk) -> None:
        if self._limits is None:
            return
        over = np.maximum(chunk.q - self._limits.upper, self._limits.lower - chunk.q)
        self._excess = np.maximum(self._excess, over.max(axis=0))
        self._lines.add(chunk.lines[np.any(over > _LIMIT_MARGIN, axis=1)])

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        if not self._lines.count:
            return []
        outside = [
            f"{name} by {excess:.3g}"
            for name, excess in zip(context.joint_names, self._excess)
            if excess > _LIMIT_MARGIN
        ]
        return [
            f"positions leave the model's joint limits: {', '.join(outside)} rad ({self._lines}); "
            "check zero positions, signs, units and the order of the columns"
        ]


class _Torque:
    """Torque columns that carry nothing."""

    def __init__(self) -> None:
        self._lowest = self._highest = np.zeros(0)

    def update(self, chunk: LogChunk) -> None:
        if not len(self._lowest):
            self._lowest = self._highest = chunk.tau[0]
        self._lowest = np.minimum(self._lowest, chunk.tau.min(axis=0))
        self._highest = np.maximum(self._highest, chunk.tau.max(axis=0))

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        stuck = self._lowest == self._highest
        if np.any(stuck):
            joint = int(np.argmax(stuck))
            value = self._lowest[joint]
            what = "zero" if value == 0.0 else f"the same ({value:.6g} N m)"
            raise InputError(
                f"{context.name}: the torque of joint {context.joint_names[joint]} is {what} in "
                "every row; record it, or name the right column with --columns FILE"
            )
        return []


class _Velocity:
    """Velocity columns that do not integrate to the position columns.

    Over blocks of about 50 ms the change of position is regressed on the integral of velocity,
    which averages encoder steps out.
    """

    def __init__(self, clock: _Clock) -> None:
        self._clock = clock
        self._moments: Array | None = None

    def update(self, chunk: LogChunk) -> None:
        if chunk.qd is None or len(chunk) < 2:
            return
        step = np.diff(chunk.time)[:, None]
        usual = step <= GAP_STEPS * self._clock.median
        integral = 0.5 * (chunk.qd[1:] + chunk.qd[:-1]) * step * usual
        change = np.diff(chunk.q, axis=0) * usual
        width = max(1, round(0.05 / self._clock.median))
        edges = np.arange(0, len(step), width)
        a, b = np.add.reduceat(integral, edges), np.add.reduceat(change, edges)
        moments = np.array([np.sum(a * b, axis=0), np.sum(a * a, axis=0), np.sum(b * b, axis=0)])
        self._moments = moments if self._moments is None else self._moments + moments

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        if self._moments is None:
            return []
        notes = []
        for name, (ab, aa, bb) in zip(context.joint_names, self._moments.T):
            if bb < 1e-4:
                continue
            slope = ab / aa if aa > 0.0 else 0.0
            likeness = ab / np.sqrt(aa * bb) if aa > 0.0 else 0.0
            if likeness < 0.9 or abs(slope - 1.0) > 0.03:
                notes.append(
                    f"the velocity column of joint {name} does not fit its position (position "
                    f"changes by {slope:.3g} times the integral, likeness {likeness:.2f}); "
                    "the identification differentiates positions and does not use it"
                )
        return notes


class _JointTime:
    """Joints' own time stamps that run backwards or belong to another clock."""

    def __init__(self) -> None:
        self._backwards = LineList()
        self._apart = 0.0

    def update(self, chunk: LogChunk) -> None:
        if chunk.joint_time is None:
            return
        back = np.any(np.diff(chunk.joint_time, axis=0) < 0.0, axis=1)
        self._backwards.add(chunk.lines[1:][back])
        apart = np.abs(chunk.joint_time - chunk.time[:, None])
        self._apart = max(self._apart, float(apart.max()))

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
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


def _row(chunk: LogChunk, index: int) -> tuple[int, float]:
    return int(chunk.lines[index]), float(chunk.time[index])
