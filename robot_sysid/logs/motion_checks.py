"""Checks of a log's positions, velocities and torques: units, jumps, rest, limits, zero columns."""

from __future__ import annotations

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.rows import LineList, LogChunk
from robot_sysid.logs.timing import GAP_STEPS, Clock, LogContext, Timing
from robot_sysid.records import Array

# No arm's joint reaches this; a log in degrees passes it at an easy half radian per second.
_FAST = 30.0
_JUMP_SPEED = 100.0
_JUMP = 0.5
_AT_REST = 0.01
_STILL = 0.002
_LIMIT_MARGIN = 1e-3


class Angles:
    """Positions or speeds that only make sense in degrees."""

    def __init__(self) -> None:
        self._largest = np.zeros(0)
        self._fast = np.zeros(0)
        self._steps = 0

    def update(self, chunk: LogChunk) -> None:
        """See more rows."""
        step, time = np.abs(np.diff(chunk.q, axis=0)), np.diff(chunk.time)[:, None]
        if not self._steps:
            self._largest = self._fast = np.zeros(chunk.q.shape[1])
        self._largest = np.maximum(self._largest, np.abs(chunk.q).max(axis=0))
        self._fast = self._fast + np.sum(step > _FAST * time, axis=0)
        self._steps += len(step)

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        """Return notes, or raise InputError."""
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


class Jumps:
    """Single positions no joint can reach within one step."""

    def __init__(self) -> None:
        self._lines = LineList()
        self._joint = 0

    def update(self, chunk: LogChunk) -> None:
        """See more rows."""
        step, time = np.abs(np.diff(chunk.q, axis=0)), np.diff(chunk.time)[:, None]
        jump = (step > _JUMP) & (step > _JUMP_SPEED * time)
        if np.any(jump) and not self._lines.count:
            self._joint = int(np.argwhere(jump)[0, 1])
        self._lines.add(chunk.lines[1:][np.any(jump, axis=1)])

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        """Return notes, or raise InputError."""
        if self._lines.count:
            raise InputError(
                f"{context.name}: the position of joint {context.joint_names[self._joint]} jumps "
                f"at {self._lines}; delete the bad rows, or cut the log there"
            )
        return []


class Rest:
    """An arm, or a joint, that does not move."""

    def __init__(self) -> None:
        self._lowest = self._highest = np.zeros(0)
        self._first: Array | None = None
        self._first_moved: tuple[int, float] | None = None
        self._held = np.zeros(0)
        self._held_since = (0, 0.0)

    def update(self, chunk: LogChunk) -> None:
        """See more rows."""
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
        """Return notes, or raise InputError."""
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


class Limits:
    """Positions outside what the model allows."""

    def __init__(self, context: LogContext) -> None:
        self._limits = context.limits
        self._excess = np.zeros(len(context.joint_names))
        self._lines = LineList()

    def update(self, chunk: LogChunk) -> None:
        """See more rows."""
        if self._limits is None:
            return
        over = np.maximum(chunk.q - self._limits.upper, self._limits.lower - chunk.q)
        self._excess = np.maximum(self._excess, over.max(axis=0))
        self._lines.add(chunk.lines[np.any(over > _LIMIT_MARGIN, axis=1)])

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        """Return notes, or raise InputError."""
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


class Torque:
    """Torque columns that carry nothing."""

    def __init__(self) -> None:
        self._lowest = self._highest = np.zeros(0)

    def update(self, chunk: LogChunk) -> None:
        """See more rows."""
        if not len(self._lowest):
            self._lowest = self._highest = chunk.tau[0]
        self._lowest = np.minimum(self._lowest, chunk.tau.min(axis=0))
        self._highest = np.maximum(self._highest, chunk.tau.max(axis=0))

    def finish(self, context: LogContext, timing: Timing) -> list[str]:
        """Return notes, or raise InputError."""
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


class Velocity:
    """Velocity columns that do not integrate to the position columns.

    Over blocks of about 50 ms the change of position is regressed on the integral of velocity,
    which averages encoder steps out.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._moments: Array | None = None

    def update(self, chunk: LogChunk) -> None:
        """See more rows."""
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
        """Return notes, or raise InputError."""
        if self._moments is None:
            return []
        notes = []
        for name, (ab, aa, bb) in zip(context.joint_names, self._moments.T):
            if bb < 1e-4:
                continue
            slope = ab / aa if aa > 0.0 else 0.0
            correlation = ab / np.sqrt(aa * bb) if aa > 0.0 else 0.0
            if correlation < 0.9 or abs(slope - 1.0) > 0.03:
                notes.append(
                    f"the velocity column of joint {name} does not fit its position (position "
                    f"changes by {slope:.3g} times the integral, correlation {correlation:.2f}); "
                    "the identification differentiates positions and does not use it"
                )
        return notes


def _row(chunk: LogChunk, index: int) -> tuple[int, float]:
    return int(chunk.lines[index]), float(chunk.time[index])
