"""Finding what is wrong with a log before anything is estimated from it.

Each check looks at the usable rows and ends in notes (the run goes on) or in an InputError (the
numbers could not mean what they seem to). Both name the first line and a remedy; a log is refused
for all that is wrong with it at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.logs.table import (
    BACKWARDS,
    MISSING,
    REPEATED,
    UNREADABLE,
    WRAPPED,
    LogRows,
)
from robot_sysid.logs.titles import collected
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.figures import position
from robot_sysid.records.progress import Detail
from robot_sysid.signals.resampling import GAP_STEPS, sampling_period

Mask = NDArray[np.bool_]
# Kind of odd rows to: the share beyond which a log is refused (chosen: beyond a hundredth a file is
# not what it seems to be; holes of a twentieth still leave most filter windows whole), what they
# do, and the remedy.
_LEFT_OUT = {
    UNREADABLE: (
        0.01,
        "are no rows of numbers",
        "mend the recording, or name the right columns with --columns FILE; time may be in "
        "seconds, or such as 2024-05-01T12:00:00.005",
    ),
    MISSING: (
        0.05,
        "have empty or NaN cells",
        "mend the recording, or keep a broken column that is not needed out ('velocity = none') "
        "with --columns FILE",
    ),
    REPEATED: (
        0.05,
        "repeat the time stamp before them",
        "write the time with more digits, or 'rate = HZ' in --columns FILE for evenly spaced rows",
    ),
    BACKWARDS: (
        0.0,
        "are of an earlier time",
        "cut the log where a second recording begins",
    ),
}
# A row or two more than the share may go: the last one of a recording is often cut off.
_ALWAYS = 1
_FEWEST_ROWS = 10
# A sampling period outside this range is read in the wrong unit of time: 1 to 1000 Hz are usual.
_LONGEST_STEP = 0.5
_SHORTEST_STEP = 1e-5
# 100 samples per second do for a slow arm, 30 hardly ever (docs/logs.md) [Hz].
_SLOW_RATE = 50.0
# A joint's own stamp is a few periods from the row's, of whatever slow log [s].
_OTHER_CLOCK = 0.1
# No arm's joint reaches this [rad/s]; a log in degrees passes it at an easy half radian per second.
_FAST = 30.0
_OFTEN = 0.01
# Moved by so much at rest, a joint is as many full turns from the model's zero (chosen).
_TURN = 2.0 * np.pi
_TURNS = 3.0
# A speed over this time is none of noise [s]; rows this dense are of time in a longer unit: arms
# record at 4 kHz at most [s] (both chosen).
_WINDOW = 0.1
_DENSE = 2.4e-4
# Nor this, with a step that no encoder's noise makes [rad/s, rad]; a speed per step is noisier.
_JUMP_SPEED = 100.0
_JUMP = 0.5
# A joint that moves less does not move; while it stands still, encoders do not stray further [rad].
_AT_REST = 0.01
_STILL = 0.002
# Rests shorter than this at either end, or than this part of the log, are no news [s].
_SHORT_REST = 0.5
_SHORT_PART = 0.02
# Limits are written with three or more digits [rad].
_LIMIT_MARGIN = 1e-3


def check_log(
    name: str, rows: LogRows, robot: RobotModel, in_radians: bool
) -> tuple[str, ...]:
    """Run every check over a log's rows; return one sentence for what is worth knowing, or raise
    InputError with all that is wrong but not what only follows from another fault.
    """
    notes = list[str]()
    faults = list[str]()

    def passes(check: Callable[[LogRows, RobotModel], Iterable[str] | None]) -> bool:
        before = len(faults)
        with collected(faults):
            notes.extend(check(rows, robot) or ())
        return len(faults) == before

    sound = {kind: passes(partial(_left_out, kind)) for kind in _LEFT_OUT}
    has_time = sound[REPEATED] and sound[BACKWARDS]
    if len(rows.lines) >= _FEWEST_ROWS or not faults and passes(_require_rows):
        notes.extend(_mended(rows))
        if has_time and passes(clock_notes) and (in_radians or passes(require_radians)):
            passes(require_no_jumps)
            passes(rest_notes)
            passes(limit_notes)
        passes(require_torque)
        passes(require_one_clock)
    if faults:
        raise InputError(f"{name}: {'; '.join(faults)}")
    return tuple(notes)


def _require_rows(rows: LogRows, robot: RobotModel) -> None:
    """Refuse a log of too few rows, of which nothing else can be said."""
    if not rows.n_read and rows.foreign:
        names = ", ".join(robot.joint_names)
        raise InputError(f"none of its rows holds a position and a torque of {names}")
    raise InputError(f"the log has only {len(rows.lines)} usable rows; record longer")


def _left_out(kind: str, rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield what was left out; refuse a log that this was too much of."""
    most, what, remedy = _LEFT_OUT[kind]
    odd = rows.odd[kind]
    if kind == BACKWARDS and odd.count:
        raise InputError(f"time runs backwards at {odd.first}; {remedy}")
    if odd.count > max(_ALWAYS, most * rows.n_read):
        if kind == MISSING:
            _refuse_empty_columns(rows)
        raise InputError(
            f"{odd.count} of {rows.n_read} rows {what}, more than {100.0 * most:g} % (first: "
            f"{odd.first}{'; mostly ' + _emptiest(rows) if kind == MISSING else ''}); {remedy}"
        )
    if odd.count:
        yield f"left out {odd.count} rows that {what} (first: {odd.first})"


def _refuse_empty_columns(rows: LogRows) -> None:
    """Refuse columns without any number, and joints that do not stand in one row."""
    never = [title for title, count in rows.empty.items() if count == rows.n_read]
    if never:
        holds = "column {} holds" if len(never) == 1 else "columns {} hold"
        raise InputError(
            f"{holds.format(', '.join(map(repr, never)))} no number in any row, only empty or NaN "
            "cells; record it, or with --columns FILE name the right column, or keep out what is "
            "not needed ('velocity = none')"
        )
    if rows.odd[MISSING].count == rows.n_read:
        raise InputError(
            f"no {rows.word} holds numbers in all columns (empty: {_emptiest(rows)}): joints, or "
            f"position and torque, come in {rows.word}s of their own; record all in one {rows.word}"
        )


def _emptiest(rows: LogRows) -> str:
    """Return in words which column is empty most often."""
    title = max(rows.empty, key=lambda title: rows.empty[title])
    return f"column {title!r}, in {rows.empty[title]} of {rows.n_read}"


def _mended(rows: LogRows) -> Iterator[str]:
    """Yield what was mended, left out or made less on the way."""
    if rows.odd[WRAPPED].count:
        yield f"unwrapped positions that jump by a full turn (first: {rows.odd[WRAPPED].first})"
    if rows.foreign:
        yield f"left out {rows.foreign} rows that hold nothing of this arm"
    if rows.thinned > 1:
        yield f"a long log: every {rows.thinned} rows were low-passed and made one"


def clock_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield notes on sampling period and gaps; refuse an implausible unit of time."""
    period = sampling_period(rows.samples.time)
    if period > _LONGEST_STEP:
        unit = "ms" if period <= 50 else "us" if period <= 5e4 else "ns"
        remedy = f"if time is in {unit}, pass --units {unit}"
        raise InputError(
            f"time steps of {period:.6g} s are too long for a motion; {remedy}"
        )
    if period < _SHORTEST_STEP:
        units = "declare the unit of time with --units (s, ms, us or ns)"
        fault = f"time steps of {period:.3g} s are too short for a recording; {units}"
        raise InputError(f"{fault}{_seconds(period)}")
    if period * _SLOW_RATE > 1.0:
        yield f"the log has only {1 / period:.3g} samples per second"
    step = np.diff(rows.samples.time)
    late = rows.lines[1:][step > GAP_STEPS * np.median(step)]
    if len(late):
        yield (
            f"samples are missing before {rows.listed(late)}; the longest gap is "
            f"{1e3 * np.max(step):.4g} ms where {1e3 * period:.4g} ms is usual"
        )


def require_one_clock(rows: LogRows, robot: RobotModel) -> None:
    """Refuse joints' own time stamps that run backwards or belong to another clock."""
    stamps = rows.samples.joint_time
    if stamps is None:
        return
    remedy = "keep them out with 'joint_time = none' in the file of --columns"
    backwards = rows.lines[1:][
        np.any([np.diff(each) < 0.0 for each in stamps.T], axis=0)
    ]
    if len(backwards):
        where = rows.listed(backwards)
        raise InputError(
            f"a joint's own time stamp runs backwards at {where}; {remedy}"
        )
    apart = max(np.max(np.abs(each - rows.samples.time)) for each in stamps.T)
    if apart > _OTHER_CLOCK:
        raise InputError(
            f"joints' own time stamps are up to {apart:.3g} s off the row's; {remedy}"
        )


def _seconds(period: float) -> str:
    """Return the remedy for time stamps that are so close [s], being of a longer unit."""
    units = {"minutes": 60, "hours": 3600, "days": 86400}
    fit = [
        (unit, k) for unit, k in units.items() if 1e-3 <= k * period <= _LONGEST_STEP
    ]
    scaled = "; if time is in {}, write 'time = {} * TITLE' in --columns FILE"
    return scaled.format(*fit[0]) if fit else ""


def require_radians(rows: LogRows, robot: RobotModel) -> None:
    """Refuse positions or speeds that no arm has in radians and seconds, and say what they are."""
    time = rows.samples.time
    q = rows.samples.q
    largest = np.maximum(np.max(q, axis=0), -np.min(q, axis=0))
    limit = np.maximum(np.abs(robot.limits.lower), np.abs(robot.limits.upper))
    reach = np.where(
        np.isfinite(limit), np.maximum(2.0 * limit, 2.0 * np.pi), 4.0 * np.pi
    )
    hinge = ~robot.is_slide
    far = hinge & (largest > reach)
    fast = hinge & _often_fast(q, np.diff(time))
    if np.any(far):
        turns = np.round(np.median(q, axis=0) / _TURN)
        near = np.max(np.abs(q - _TURN * turns), axis=0) <= np.where(
            limit < np.inf, limit, np.pi
        )
        joint = int(np.argmax(far))
        what = f"joint {robot.joint_names[joint]} reaches {largest[joint]:.4g}"
        count = abs(turns[joint])
        if np.all(~far | (near & (np.abs(turns) <= _TURNS))):
            raise InputError(
                f"{what} rad, {count:g} full turn{'s' if count > 1 else ''} from the model's zero; "
                "pass --units rad if it counts turns, which change nothing, or --units deg if not"
            )
        turned = f", or like {largest[joint] / _TURN:.3g} turns" * bool(
            limit[joint] == np.inf
        )
        fault = f"positions look like degrees{turned} ({what})"
        raise InputError(
            f"{fault}; pass --units deg, or --units rad if they are radians"
        )
    if np.any(fast):
        raise InputError(
            _why_fast(time, q, robot.joint_names[int(np.argmax(fast))], fast)
        )


def _often_fast(q: Array, step: Array) -> Mask:
    """Return (n,) whether joints at (N, n) are often fast in steps of time (R,) of N - R rows."""
    few = len(q) - len(step)
    return np.array(
        [np.mean(np.abs(x[few:] - x[:-few]) > _FAST * step) > _OFTEN for x in q.T]
    )


def _why_fast(time: Array, q: Array, name: str, fast: Mask) -> str:
    """Return what makes positions (N, n) of some joints (n,) fast, and what to do about it."""
    step = np.diff(time)
    period = sampling_period(time)
    what = f"joint {name} would often exceed {_FAST:g} rad/s"
    if period < _DENSE:
        return (
            f"time steps of {period:.3g} s are so short that {what}{_seconds(period)}"
        )
    if not np.any(fast & _often_fast(q, np.maximum(step, np.median(step)))):
        mean = float(np.mean(step))
        return (
            f"time stamps are uneven ({np.mean(step < 0.5 * mean):.0%} of the steps are below half "
            f"of the mean of {1e3 * mean:.3g} ms), so that {what}: they say when rows arrived or "
            "were written; record when they were measured, or write "
            f"'rate = {1.0 / mean:.6g}' in --columns FILE if rows are evenly spaced"
        )
    few = max(2, int(np.ceil(_WINDOW / period)))
    if not np.any(fast & _often_fast(q, time[few:] - time[:-few])):
        noise = np.median(np.abs(np.diff(q, axis=0)[:, int(np.argmax(fast))]))
        return (
            f"the position of joint {name} goes to and fro by {noise:.2g} rad from row to row; "
            "check its encoder, its unit and the order of the rows"
        )
    return (
        f"positions look like degrees ({what}); pass --units deg, or --units rad if they are "
        f"radians{_seconds(period)}"
    )


def require_no_jumps(rows: LogRows, robot: RobotModel) -> None:
    """Refuse single positions no joint can reach within one step."""
    least = np.maximum(_JUMP, _JUMP_SPEED * np.diff(rows.samples.time))
    each = []
    for name, q in zip(robot.joint_names, rows.samples.q.T):
        jumps = np.abs(np.diff(q)) > least
        if np.any(jumps):
            each.append(
                f"of joint {name} jumps at {rows.listed(rows.lines[1:][jumps])}"
            )
    if each:
        raise InputError(f"the position {', '.join(each)}; delete the bad rows")


def rest_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield notes on joints and moments without motion; refuse an arm that is at rest."""
    time = rows.samples.time
    q = rows.samples.q
    span = np.ptp(q, axis=0)
    if np.all(span < _AT_REST):
        rest = f"the arm is at rest, no joint moves by more than {span.max():.2g} rad"
        raise InputError(
            f"{rest}; record a motion (if these are other units, see --units)"
        )
    still = [n for n, s in zip(robot.joint_names, span) if s < _AT_REST]
    if still:
        yield f"joints that do not move in this log: {', '.join(still)}"
    long = max(_SHORT_REST, _SHORT_PART * (time[-1] - time[0]))
    # A joint that moves by _AT_REST is away from the first and from the last posture at some time.
    away = ([np.abs(x - x[0]) > _STILL for x in each.T] for each in (q, q[::-1]))
    first, last = (int(np.argmax(np.any(each, axis=0))) for each in away)
    last = len(q) - last
    for rest, where in (
        (time[first] - time[0], f"up to {rows.word} {rows.lines[first]}"),
        (time[-1] - time[last], f"from {rows.word} {rows.lines[last]} on"),
    ):
        if rest > long:
            yield Detail(f"the arm stands still {where} ({rest:.2f} s)")


def limit_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield a note on positions outside what the model allows."""
    limits = zip(rows.samples.q.T, robot.limits.lower, robot.limits.upper)
    over = (np.maximum(q - upper, lower - q) for q, lower, upper in limits)
    most, where = zip(*((np.max(each), each > _LIMIT_MARGIN) for each in over))
    lines = rows.lines[np.any(where, axis=0)]
    if not len(lines):
        return
    outside = [
        f"{name} by {excess:.3g} {position(slide)}"
        for name, excess, slide in zip(robot.joint_names, most, robot.is_slide)
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
    said: dict[str, list[str]] = {}
    for joint in np.flatnonzero(stuck).tolist():
        what = "zero" if tau[0, joint] == 0.0 else f"the same ({tau[0, joint]:.6g} N m)"
        said.setdefault(what, []).append(robot.joint_names[joint])
    if said:
        each = (
            f"of joint {' and '.join(names)} is {what} in every row"
            for what, names in said.items()
        )
        fault = f"the torque {', that '.join(each)}"
        raise InputError(
            f"{fault}; record it, or name the right column with --columns FILE"
        )
