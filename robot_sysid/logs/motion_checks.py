"""Checks of a log's positions, velocities and torques: units, jumps, rest, limits, zero columns."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.logs.rows import LogRows
from robot_sysid.logs.timing import LogContext
from robot_sysid.records import Array
from robot_sysid.records.figures import position
from robot_sysid.signals.resampling import GAP_STEPS

# No arm's joint reaches this; a log in degrees passes it at an easy half radian per second.
_FAST = 30.0
_JUMP_SPEED = 100.0
_JUMP = 0.5
_AT_REST = 0.01
_STILL = 0.002
_LIMIT_MARGIN = 1e-3
# What a Dynamixel motor's unit of current is [mA].
_CURRENT_STEP = 2.69


def require_radians(rows: LogRows, context: LogContext) -> None:
    """Refuse positions or speeds that only make sense in degrees, unless they were declared."""
    time, q = rows.samples.time, rows.samples.q
    largest = np.max(np.abs(q), axis=0)
    reach = np.full(len(largest), 4.0 * np.pi)
    if context.limits is not None:
        limit = np.maximum(np.abs(context.limits.lower), np.abs(context.limits.upper))
        reach = np.where(np.isfinite(limit), np.maximum(2.0 * limit, 2.0 * np.pi), reach)
    hinge = ~context.is_slide
    far = hinge & (largest > reach)
    too_fast = np.abs(np.diff(q, axis=0)) > _FAST * np.diff(time)[:, None]
    fast = hinge & (np.sum(too_fast, axis=0) > 0.01 * len(too_fast))
    if context.angle_declared or not np.any(far | fast):
        return
    joint = int(np.argmax(far if np.any(far) else fast))
    what = (
        f"joint {context.joint_names[joint]} reaches {largest[joint]:.4g}"
        if np.any(far)
        else f"joint {context.joint_names[joint]} would often exceed {_FAST:g} rad/s"
    )
    raise InputError(
        f"{context.name}: positions look like degrees ({what}); pass --units deg, or "
        "--units rad if they are radians"
    )


def require_no_jumps(rows: LogRows, context: LogContext) -> None:
    """Refuse single positions no joint can reach within one step."""
    step, time = np.abs(np.diff(rows.samples.q, axis=0)), np.diff(rows.samples.time)[:, None]
    jump = (step > _JUMP) & (step > _JUMP_SPEED * time)
    if np.any(jump):
        joint = context.joint_names[np.argwhere(jump)[0, 1]]
        raise InputError(
            f"{context.name}: the position of joint {joint} jumps at "
            f"{rows.listed(rows.lines[1:][np.any(jump, axis=1)])}; delete the bad rows, or cut the "
            "log there"
        )


def rest_notes(rows: LogRows, context: LogContext) -> Iterator[str]:
    """Yield notes on joints and moments without motion; refuse an arm that is at rest."""
    time, q = rows.samples.time, rows.samples.q
    span = np.ptp(q, axis=0)
    if np.all(span < _AT_REST):
        raise InputError(
            f"{context.name}: the arm is at rest, no joint moves by more than "
            f"{span.max():.2g} rad; record an excitation trajectory (if these are other "
            "units, see --units)"
        )
    still = [n for n, s in zip(context.joint_names, span) if s < _AT_REST]
    if still:
        yield f"joints that do not move in this log: {', '.join(still)}"
    long = max(0.5, 0.02 * (time[-1] - time[0]))
    # A joint that moves by _AT_REST is away from the first and from the last posture at some time.
    first = int(np.argmax(_away(q, q[0])))
    before = time[first] - time[0]
    if before > long:
        yield f"the arm stands still up to {rows.word} {rows.lines[first]} ({before:.2f} s)"
    last = len(q) - int(np.argmax(_away(q, q[-1])[::-1]))
    after = time[-1] - time[last]
    if after > long:
        yield f"the arm stands still from {rows.word} {rows.lines[last]} on ({after:.2f} s)"


def _away(q: Array, posture: Array) -> NDArray[np.bool_]:
    """Return (N,) whether positions (N, n) have left a posture (n,)."""
    return np.any(np.abs(q - posture) > _STILL, axis=1)


def limit_notes(rows: LogRows, context: LogContext) -> Iterator[str]:
    """Yield a note on positions outside what the model allows."""
    if context.limits is None:
        return
    over = np.maximum(rows.samples.q - context.limits.upper, context.limits.lower - rows.samples.q)
    lines = rows.lines[np.any(over > _LIMIT_MARGIN, axis=1)]
    if not len(lines):
        return
    outside = [
        f"{name} by {excess:.3g} {position(slide)}"
        for name, excess, slide in zip(context.joint_names, np.max(over, axis=0), context.is_slide)
        if excess > _LIMIT_MARGIN
    ]
    yield (
        f"positions leave the model's joint limits: {', '.join(outside)} "
        f"({rows.listed(lines)}); check zero positions, signs, units and the order of the columns"
    )


def require_torque(rows: LogRows, context: LogContext) -> None:
    """Refuse torque columns that carry nothing."""
    tau = rows.samples.tau
    stuck = np.all(tau == tau[0], axis=0)
    if rows.samples.command is None and np.any(stuck):
        joint = int(np.argmax(stuck))
        what = "zero" if tau[0, joint] == 0.0 else f"the same ({tau[0, joint]:.6g} N m)"
        raise InputError(
            f"{context.name}: the torque of joint {context.joint_names[joint]} is {what} in "
            "every row; record it, or name the right column with --columns FILE"
        )


def require_no_motor_current(rows: LogRows, context: LogContext) -> None:
    """Refuse efforts that are the raw currents of Dynamixel motors, as ALOHA records them."""
    steps = rows.samples.tau / _CURRENT_STEP
    if np.all(np.abs(steps - np.round(steps)) < 1e-3) and np.max(np.abs(steps)) >= 1.0:
        raise InputError(
            f"{context.name}: all torques are multiples of {_CURRENT_STEP}: these are the motors' "
            "currents in mA; give N·m per mA with --torque-constants"
        )


def velocity_notes(rows: LogRows, context: LogContext) -> Iterator[str]:
    """Yield notes on velocity columns that do not integrate to the position columns.

    Over blocks of about 50 ms the change of position is regressed on the integral of velocity,
    which averages encoder steps out.
    """
    qd = rows.samples.qd
    if qd is None:
        return
    step = np.diff(rows.samples.time)[:, None]
    period = np.median(step)
    usual = step <= GAP_STEPS * period
    integral = 0.5 * (qd[1:] + qd[:-1]) * step * usual
    change = np.diff(rows.samples.q, axis=0) * usual
    edges = np.arange(0, len(step), max(1, round(0.05 / period)))
    a, b = np.add.reduceat(integral, edges), np.add.reduceat(change, edges)
    moments = (np.sum(product, axis=0) for product in (a * b, a * a, b * b))
    for name, ab, aa, bb in zip(context.joint_names, *moments):
        if bb < 1e-4:
            continue
        slope = ab / aa if aa > 0.0 else 0.0
        correlation = ab / np.sqrt(aa * bb) if aa > 0.0 else 0.0
        if correlation < 0.9 or abs(slope - 1.0) > 0.03:
            yield (
                f"the velocity column of joint {name} does not fit its position (position "
                f"changes by {slope:.3g} times the integral, correlation {correlation:.2f}); "
                "the identification differentiates positions and does not use it"
            )
