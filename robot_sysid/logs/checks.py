"""Finding what is wrong with a log before anything is estimated from it.

Each check looks at the usable rows and ends in notes (the run goes on) or in an InputError (the
numbers could not mean what they seem to). Both name the first line and a remedy.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.rows import MISSING, REPEATED, UNREADABLE, WRAPPED, LogRows
from robot_sysid.records import RobotModel
from robot_sysid.records.figures import position
from robot_sysid.signals.resampling import GAP_STEPS, usual_period

# Kind of odd rows to: the share beyond which a log is refused (chosen: beyond a hundredth a file is
# not what it seems to be; holes of a twentieth still leave most filter windows whole), what they
# do, and the remedy.
_LEFT_OUT = {
    UNREADABLE: (0.01, "are no rows of numbers", "mend the recording"),
    MISSING: (
        0.05,
        "have empty or NaN cells",
        "mend the recording, or keep a broken column out with --columns FILE",
    ),
    REPEATED: (0.05, "repeat the time stamp before them", "write the time with more digits"),
}
# A row or two more than the share may go: the last one of a recording is often cut off.
_ALWAYS = 1
_FEWEST_ROWS = 10
# A sampling period outside this range is read in the wrong unit of time: 1 to 1000 Hz are usual.
_LONGEST_STEP, _SHORTEST_STEP = 0.5, 1e-5
# 100 samples per second do for a slow arm, 30 hardly ever (docs/logs.md) [Hz].
_SLOW_RATE = 50.0
# A joint's own stamp is a few periods from the row's, of whatever slow log [s].
_OTHER_CLOCK = 0.1
# No arm's joint reaches this [rad/s]; a log in degrees passes it at an easy half radian per second.
_FAST, _OFTEN = 30.0, 0.01
# Nor this, with a step that no encoder's noise makes [rad/s, rad]; a speed per step is noisier.
_JUMP_SPEED, _JUMP = 100.0, 0.5
# A joint that moves less does not move; while it stands still, encoders do not stray further [rad].
_AT_REST, _STILL = 0.01, 0.002
# Rests shorter than this at either end, or than this part of the log, are no news [s].
_SHORT_REST, _SHORT_PART = 0.5, 0.02
# Limits are written with three or more digits [rad].
_LIMIT_MARGIN = 1e-3


def check_log(name: str, rows: LogRows, robot: RobotModel, in_radians: bool) -> tuple[str, ...]:
    """Run every check over a log's rows; return one sentence for what is worth knowing."""
    try:
        if not rows.n_read and rows.foreign:
            names = ", ".join(robot.joint_names)
            raise InputError(f"none of its rows holds a position and a torque of {names}")
        notes = list(_odd_notes(rows))
        if len(rows.lines) < _FEWEST_ROWS:
            raise InputError(f"the log has only {len(rows.lines)} usable rows; record longer")
        notes += clock_notes(rows)
        if not in_radians:
            require_radians(rows, robot)
        require_no_jumps(rows, robot)
        notes += [*rest_notes(rows, robot), *limit_notes(rows, robot)]
        require_torque(rows, robot)
        require_one_clock(rows)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    return tuple(notes)


def _odd_notes(rows: LogRows) -> Iterator[str]:
    """Yield what was left out or mended; refuse a log that this was too much of."""
    for kind, (most, what, remedy) in _LEFT_OUT.items():
        odd = rows.odd[kind]
        if odd.count > max(_ALWAYS, most * rows.n_read):
            raise InputError(
                f"{odd.count} of {rows.n_read} rows {what}, more than {100.0 * most:g} % (first: "
                f"{odd.first}); {remedy}"
            )
        if odd.count:
            yield f"left out {odd.count} rows that {what} (first: {odd.first})"
    if rows.odd[WRAPPED].count:
        yield f"unwrapped positions that jump by a full turn (first: {rows.odd[WRAPPED].first})"
    if rows.foreign:
        yield f"left out {rows.foreign} rows that hold nothing of this arm"
    if rows.thinned > 1:
        yield f"a long log: every {rows.thinned} rows were low-passed and made one"


def clock_notes(rows: LogRows) -> Iterator[str]:
    """Yield notes on sampling period and gaps; refuse an implausible unit of time."""
    period = usual_period(rows.samples.time)
    if period > _LONGEST_STEP:
        unit = "ms" if period <= 50 else "us" if period <= 5e4 else "ns"
        remedy = f"if time is in {unit}, pass --units {unit}"
        raise InputError(f"time steps of {period:.6g} s are too long for a motion; {remedy}")
    if period < _SHORTEST_STEP:
        remedy = "declare the unit of time with --units (s, ms, us or ns)"
        raise InputError(f"time steps of {period:.3g} s are too short for a recording; {remedy}")
    if period * _SLOW_RATE > 1.0:
        yield f"the log has only {1 / period:.3g} samples per second"
    step = np.diff(rows.samples.time)
    late = rows.lines[1:][step > GAP_STEPS * np.median(step)]
    if len(late):
        yield (
            f"samples are missing before {rows.listed(late)}; the longest gap is "
            f"{1e3 * np.max(step):.4g} ms where {1e3 * period:.4g} ms is usual"
        )


def require_one_clock(rows: LogRows) -> None:
    """Refuse joints' own time stamps that run backwards or belong to another clock."""
    stamps = rows.samples.joint_time
    if stamps is None:
        return
    remedy = "keep them out with 'joint_time = none' in the file of --columns"
    backwards = rows.lines[1:][np.any(np.diff(stamps, axis=0) < 0.0, axis=1)]
    if len(backwards):
        where = rows.listed(backwards)
        raise InputError(f"a joint's own time stamp runs backwards at {where}; {remedy}")
    apart = np.max(np.abs(stamps - rows.samples.time[:, None]))
    if apart > _OTHER_CLOCK:
        raise InputError(f"joints' own time stamps are up to {apart:.3g} s off the row's; {remedy}")


def require_radians(rows: LogRows, robot: RobotModel) -> None:
    """Refuse positions or speeds that only make sense in degrees."""
    time, q = rows.samples.time, rows.samples.q
    largest = np.max(np.abs(q), axis=0)
    limit = np.maximum(np.abs(robot.limits.lower), np.abs(robot.limits.upper))
    reach = np.where(np.isfinite(limit), np.maximum(2.0 * limit, 2.0 * np.pi), 4.0 * np.pi)
    hinge = ~robot.is_slide
    far = hinge & (largest > reach)
    too_fast = np.abs(np.diff(q, axis=0)) > _FAST * np.diff(time)[:, None]
    fast = hinge & (np.mean(too_fast, axis=0) > _OFTEN)
    if not np.any(far | fast):
        return
    joint = int(np.argmax(far if np.any(far) else fast))
    what = f"reaches {largest[joint]:.4g}" if far[joint] else f"would often exceed {_FAST:g} rad/s"
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
        where = rows.listed(lines)
        raise InputError(f"the position of joint {joint} jumps at {where}; delete the bad rows")


def rest_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield notes on joints and moments without motion; refuse an arm that is at rest."""
    time, q = rows.samples.time, rows.samples.q
    span = np.ptp(q, axis=0)
    if np.all(span < _AT_REST):
        rest = f"the arm is at rest, no joint moves by more than {span.max():.2g} rad"
        raise InputError(f"{rest}; record a motion (if these are other units, see --units)")
    still = [n for n, s in zip(robot.joint_names, span) if s < _AT_REST]
    if still:
        yield f"joints that do not move in this log: {', '.join(still)}"
    long = max(_SHORT_REST, _SHORT_PART * (time[-1] - time[0]))
    # A joint that moves by _AT_REST is away from the first and from the last posture at some time.
    first, last = (int(np.argmax(np.any(np.abs(x - x[0]) > _STILL, axis=1))) for x in (q, q[::-1]))
    last = len(q) - last
    for rest, where in (
        (time[first] - time[0], f"up to {rows.word} {rows.lines[first]}"),
        (time[-1] - time[last], f"from {rows.word} {rows.lines[last]} on"),
    ):
        if rest > long:
            yield f"the arm stands still {where} ({rest:.2f} s)"


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
    """Refuse torque columns that carry nothing."""
    tau = rows.samples.tau
    stuck = np.all(tau == tau[0], axis=0) & (rows.samples.command is None)
    for joint in np.flatnonzero(stuck).tolist():
        what = "zero" if tau[0, joint] == 0.0 else f"the same ({tau[0, joint]:.6g} N m)"
        fault = f"the torque of joint {robot.joint_names[joint]} is {what} in every row"
        raise InputError(f"{fault}; record it, or name the right column with --columns FILE")
