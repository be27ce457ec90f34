"""Finding what is wrong with a log before anything is estimated from it.

Each check looks at the usable rows and ends in notes (the run goes on) or in an InputError (the
numbers could not mean what they seem to). Both name lines and a remedy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.rows import LogRows
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.figures import position
from robot_sysid.signals.resampling import GAP_STEPS, usual_period

LARGEST_GARBAGE = 0.01
"""Share of rows that are no rows of numbers beyond which a log is refused."""
_OUT = "; mend the recording, or keep a broken column out with --columns FILE"
_MOST = f", more than {100.0 * LARGEST_GARBAGE:g} %; mend the recording"
_TOO_MANY = (
    ("missing", 0.05, "have empty or NaN cells", _OUT),
    ("repeated", 0.05, "repeat the time stamp before them", "; write the time with more digits"),
    ("unreadable", LARGEST_GARBAGE, "are no rows of numbers", _MOST),
)
_DONE = {
    "unreadable": "left out {} rows that are no rows of numbers",
    "missing": "left out {} rows with empty or NaN cells",
    "repeated": "left out {} rows that repeat a time stamp",
    "cut_off": "left out the last row, which is cut off",
    "wrapped": "unwrapped positions that jump by a full turn",
}


def check_log(name: str, rows: LogRows, robot: RobotModel, in_radians: bool) -> tuple[str, ...]:
    """Run every check over the rows of a log and return one sentence for what is worth knowing.

    Args:
        name: what the log is called in errors.
        in_radians: whether its positions are known to be radians by now.
    """
    if not rows.n_read and rows.foreign:
        raise InputError(
            f"{name}: none of its {rows.foreign} rows holds a position and a torque of "
            f"{', '.join(robot.joint_names)}"
        )
    if len(rows.lines) < 10:
        raise InputError(
            f"{name} has only {len(rows.lines)} usable rows; an excitation of several seconds is "
            "needed"
        )
    try:
        notes = [*_repair_notes(rows), *clock_notes(rows)]
        if not in_radians:
            require_radians(rows, robot)
        require_no_jumps(rows, robot)
        notes += [*rest_notes(rows, robot), *limit_notes(rows, robot)]
        require_torque(rows, robot)
        notes += velocity_notes(rows, robot)
        require_one_clock(rows)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    return tuple(notes)


def sign_check(
    tau_measured: Array, tau_model: Array, joint_names: Sequence[str]
) -> tuple[str, ...]:
    """Compare the signs of measured torques (N, n) with those the model predicts.

    Returns:
        One sentence per joint whose torque runs against the model's. A payload can turn the torque
        of a wrist round; whether a sign is wrong is asked by ``checks``.
    """
    product = np.sum(tau_measured * tau_model, axis=0)
    norm = np.linalg.norm(tau_measured, axis=0) * np.linalg.norm(tau_model, axis=0)
    correlation = np.divide(product, norm, out=np.zeros_like(product), where=norm > 0.0)
    return tuple(
        f"the torque of joint {name} runs against the model's (correlation {value:.2f}); "
        "check its sign and the order of the columns, unless the payload is heavy"
        for name, value in zip(joint_names, correlation)
        if value < -0.3
    )


def _repair_notes(rows: LogRows) -> Iterator[str]:
    touched = {kind: (len(lines), rows.listed(lines)) for kind, lines in rows.touched.items()}
    for kind, most, what, remedy in _TOO_MANY:
        count, where = touched[kind]
        if count > most * rows.n_read:
            where = rows.complaint or where if kind == "unreadable" else where
            raise InputError(f"{count} of {rows.n_read} rows {what} ({where}){remedy}")
    if rows.foreign:
        yield f"left out {rows.foreign} rows that hold nothing of this arm"
    if rows.thinned > 1:
        yield (
            f"a long log: every {rows.thinned} rows were low-passed and made one, which leaves "
            f"{len(rows.lines)}"
        )
    for kind, (count, where) in touched.items():
        if count:
            yield f"{_DONE[kind].format(count)} ({where})"


# A sampling period outside this range is read in the wrong unit of time.
_LONGEST_STEP, _SHORTEST_STEP = 0.5, 1e-5


def clock_notes(rows: LogRows) -> Iterator[str]:
    """Yield notes on sampling period and gaps; refuse an implausible unit of time."""
    period = usual_period(rows.samples.time)
    if period > _LONGEST_STEP:
        unit = "ms" if period <= 50 else "us" if period <= 5e4 else "ns"
        raise InputError(
            f"time steps of {period:.6g} s are too long for a motion; if time is in {unit}, pass "
            f"--units {unit}"
        )
    if period < _SHORTEST_STEP:
        raise InputError(
            f"time steps of {period:.3g} s are too short for a recording; declare the unit of time "
            "with --units (s, ms, us or ns)"
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


def require_one_clock(rows: LogRows) -> None:
    """Refuse joints' own time stamps that run backwards or belong to another clock."""
    stamps = rows.samples.joint_time
    if stamps is None:
        return
    remedy = "keep them out with 'joint_time = none' in the columns file"
    backwards = rows.lines[1:][np.any(np.diff(stamps, axis=0) < 0.0, axis=1)]
    if len(backwards):
        where = rows.listed(backwards)
        raise InputError(f"a joint's own time stamp runs backwards at {where}; {remedy}")
    apart = np.max(np.abs(stamps - rows.samples.time[:, None]))
    if apart > 0.1:
        raise InputError(
            f"the joints' own time stamps are up to {apart:.3g} s away from the row's; {remedy}"
        )


# No arm's joint reaches this; a log in degrees passes it at an easy half radian per second.
_FAST = 30.0
_JUMP_SPEED = 100.0
_JUMP = 0.5
_AT_REST = 0.01
_STILL = 0.002
_LIMIT_MARGIN = 1e-3
# What a Dynamixel motor's unit of current is [mA].
_CURRENT_STEP = 2.69


def require_radians(rows: LogRows, robot: RobotModel) -> None:
    """Refuse positions or speeds that only make sense in degrees."""
    time, q = rows.samples.time, rows.samples.q
    largest = np.max(np.abs(q), axis=0)
    limit = np.maximum(np.abs(robot.limits.lower), np.abs(robot.limits.upper))
    reach = np.where(np.isfinite(limit), np.maximum(2.0 * limit, 2.0 * np.pi), 4.0 * np.pi)
    hinge = ~robot.is_slide
    far = hinge & (largest > reach)
    too_fast = np.abs(np.diff(q, axis=0)) > _FAST * np.diff(time)[:, None]
    fast = hinge & (np.sum(too_fast, axis=0) > 0.01 * len(too_fast))
    if not np.any(far | fast):
        return
    joint, what = int(np.argmax(fast)), f"would often exceed {_FAST:g} rad/s"
    if np.any(far):
        joint = int(np.argmax(far))
        what = f"reaches {largest[joint]:.4g}"
    raise InputError(
        f"positions look like degrees (joint {robot.joint_names[joint]} {what}); "
        "pass --units deg, or --units rad if they are radians"
    )


def require_no_jumps(rows: LogRows, robot: RobotModel) -> None:
    """Refuse single positions no joint can reach within one step."""
    step, time = np.abs(np.diff(rows.samples.q, axis=0)), np.diff(rows.samples.time)[:, None]
    jump = (step > _JUMP) & (step > _JUMP_SPEED * time)
    if np.any(jump):
        joint = robot.joint_names[np.argwhere(jump)[0, 1]]
        lines = rows.lines[1:][np.any(jump, axis=1)]
        raise InputError(
            f"the position of joint {joint} jumps at {rows.listed(lines)}; delete the bad rows, or "
            "cut the log there"
        )


def rest_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield notes on joints and moments without motion; refuse an arm that is at rest."""
    time, q = rows.samples.time, rows.samples.q
    span = np.ptp(q, axis=0)
    if np.all(span < _AT_REST):
        raise InputError(
            f"the arm is at rest, no joint moves by more than {span.max():.2g} rad; record an "
            "excitation trajectory (if these are other units, see --units)"
        )
    still = [n for n, s in zip(robot.joint_names, span) if s < _AT_REST]
    if still:
        yield f"joints that do not move in this log: {', '.join(still)}"
    long = max(0.5, 0.02 * (time[-1] - time[0]))
    # A joint that moves by _AT_REST is away from the first and from the last posture at some time.
    first, last = (int(np.argmax(np.any(np.abs(x - x[0]) > _STILL, axis=1))) for x in (q, q[::-1]))
    before = time[first] - time[0]
    if before > long:
        yield f"the arm stands still up to {rows.word} {rows.lines[first]} ({before:.2f} s)"
    last = len(q) - last
    after = time[-1] - time[last]
    if after > long:
        yield f"the arm stands still from {rows.word} {rows.lines[last]} on ({after:.2f} s)"


def limit_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield a note on positions outside what the model allows."""
    over = np.maximum(rows.samples.q - robot.limits.upper, robot.limits.lower - rows.samples.q)
    lines = rows.lines[np.any(over > _LIMIT_MARGIN, axis=1)]
    if not len(lines):
        return
    outside = [
        f"{name} by {excess:.3g} {position(slide)}"
        for name, excess, slide in zip(robot.joint_names, np.max(over, axis=0), robot.is_slide)
        if excess > _LIMIT_MARGIN
    ]
    yield (
        f"positions leave the model's joint limits: {', '.join(outside)} "
        f"({rows.listed(lines)}); check zero positions, signs, units and the order of the columns"
    )


def require_torque(rows: LogRows, robot: RobotModel) -> None:
    """Refuse torque columns that carry nothing, or the raw currents that ALOHA's motors report."""
    tau = rows.samples.tau
    stuck = np.all(tau == tau[0], axis=0)
    if rows.samples.command is None and np.any(stuck):
        joint = int(np.argmax(stuck))
        what = "zero" if tau[0, joint] == 0.0 else f"the same ({tau[0, joint]:.6g} N m)"
        raise InputError(
            f"the torque of joint {robot.joint_names[joint]} is {what} in every row; record it, or "
            "name the right column with --columns FILE"
        )
    steps = tau / _CURRENT_STEP
    if np.all(np.abs(steps - np.round(steps)) < 1e-3) and np.max(np.abs(steps)) >= 1.0:
        raise InputError(
            f"all torques are multiples of {_CURRENT_STEP}: these are the motors' currents in mA; "
            "give N·m per mA with --torque-constants"
        )


def velocity_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
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
    for name, ab, aa, bb in zip(robot.joint_names, *moments):
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
