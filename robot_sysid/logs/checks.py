"""Checks of a log's form, before anything is estimated from it.

A check takes the usable rows and the robot. It returns notes (the run goes on) or raises InputError
(the numbers cannot be those of this arm). Both name the first line and a remedy; the error of a log
that is refused lists the faults of all checks.

The usable rows are ``LogRows``: ``samples`` in SI units (N rows, n chain joints), ``lines`` (N,)
their numbers in the file. Of all rows of the file, ``n_read`` hold something of this arm and
``n_foreign`` nothing; ``anomalies`` says how many were left out why, and where the first one is;
``empty_cells`` is title to number of the rows in which the column is empty.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.table import (
    BACKWARDS,
    MISSING,
    REPEATED,
    UNREADABLE,
    WRAPPED,
    LogRows,
    Mask,
)
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.messages import Detail, count_text, position_unit
from robot_sysid.signals.frozen import frozen_positions
from robot_sysid.signals.resampling import (
    GAP_STEPS,
    RECORDING_SEPARATION,
    sampling_period,
)

Check = Callable[[LogRows, RobotModel], "Iterable[str] | None"]
"""Function that returns notes on the rows of a log, or None, and raises InputError for a fault."""


class _Tolerance(NamedTuple):
    """Share of rows with an anomaly above which a log is refused, and the texts of the message.

    Attributes:
        share: from 0 to 1.
        description: the anomaly, behind "... rows".
        remedy: what to do where the log is refused.
    """

    share: float
    description: str
    remedy: str


# The shares are choices: with more than 1 % of unreadable rows a file is no such table; with 5 % of
# rows missing, most filter windows are still complete.
_TOLERANCES = {
    UNREADABLE: _Tolerance(
        0.01,
        "are no rows of numbers",
        "mend the recording, or name the right columns with --columns FILE; time may be in "
        "seconds, or such as 2024-05-01T12:00:00.005",
    ),
    MISSING: _Tolerance(
        0.05,
        "have empty or NaN cells",
        "mend the recording, or keep a broken column that is not needed out ('velocity = none') "
        "with --columns FILE",
    ),
    REPEATED: _Tolerance(
        0.05,
        "repeat the time stamp before them",
        "write the time with more digits, or 'rate = HZ' in --columns FILE for evenly spaced rows",
    ),
    BACKWARDS: _Tolerance(
        0.0, "are of an earlier time", "cut the log where a second recording begins"
    ),
}
_ALWAYS_TOLERATED = 1
"""Number of rows with an anomaly that is always allowed: the last row is often cut off."""
_FEWEST_ROWS = 10
"""Least number of usable rows for which the other checks are run."""
_LONGEST_PERIOD = 0.5
"""A longer sampling period is in the wrong unit of time [s]: 1 to 1000 Hz are usual."""
_SHORTEST_PERIOD = 1e-5
"""A shorter sampling period is in the wrong unit of time [s]."""
_SLOW_RATE = 50.0
"""Rate below which a note is made [Hz]: 100 do for a slow arm, 30 hardly ever (docs/logs.md)."""
_OTHER_CLOCK = 0.1
"""Difference of a joint's time stamp from the row's above which it is of another clock [s]: a few
sampling periods of the slowest logs."""
_FAST = 30.0
"""Speed that no arm's joint reaches [rad/s]; a log in degrees passes it at half a radian per
second."""
_OFTEN = 0.01
"""Share of steps faster than _FAST above which positions are not in radians."""
_ANGLE_OPTIONS = (("--units", "deg"), ("--units", "rad"))
"""Options, one of which lets positions pass that look like degrees."""
_JUMP_SPEED = 100.0
"""Speed within one step that no joint reaches [rad/s]; above _FAST, as noise adds to it."""
_JUMP = 0.5
"""Change of position in one step that an encoder's noise does not reach [rad]."""
_AT_REST = 0.01
"""Range of positions below which a joint does not move [rad]."""
_STILL = 0.002
"""Largest deviation of an encoder while its joint stands still [rad]."""
_SHORT_REST = 0.5
"""Duration of rest at either end of a log below which no note is made [s]."""
_SHORT_SHARE = 0.02
"""Duration of rest at either end, as a share of the log's, below which no note is made."""
_LIMIT_MARGIN = 1e-3
"""Excess over a joint limit below which no note is made [rad]: limits are written with three or
more digits."""


def check_log(
    name: str, rows: LogRows, robot: RobotModel, in_radians: bool
) -> tuple[str, ...]:
    """Run every check over a log's rows and return the notes, one sentence each.

    Args:
        name: of the log, for the error.
        rows: the usable rows in SI units.
        robot: the arm.
        in_radians: whether the unit of angles was declared, so that it is not checked.

    Raises:
        InputError: lists all faults, but not those that only follow from another one.
    """
    notes = list[str]()
    faults = list[InputError]()

    def passes(check: Check) -> bool:
        """Run a check, add its notes or its fault to the lists, and return whether it passed."""
        try:
            notes.extend(check(rows, robot) or ())
        except InputError as error:
            faults.append(error)
            return False
        return True

    is_tolerable = {}
    for anomaly in _TOLERANCES:
        is_tolerable[anomaly] = passes(partial(require_few, anomaly))
    has_time = is_tolerable[REPEATED] and is_tolerable[BACKWARDS]
    if len(rows.lines) >= _FEWEST_ROWS:
        notes.extend(_mending_notes(rows))
        # Checks of speeds and positions need a plausible time, and then plausible radians.
        if has_time and passes(clock_notes) and (in_radians or passes(require_radians)):
            passes(require_no_jumps)
            passes(rest_notes)
            passes(limit_notes)
        passes(require_torque)
        passes(require_one_clock)
    elif not faults:
        faults.append(InputError(_too_few_rows(rows, robot)))
    if faults:
        # No option is enough where something else is wrong as well.
        options = faults[0].options if len(faults) == 1 else ()
        raise InputError(f"{name}: {'; '.join(map(str, faults))}", options)
    return tuple(notes)


def _too_few_rows(rows: LogRows, robot: RobotModel) -> str:
    """Return the fault of a log of too few rows for any other check."""
    if not rows.n_read and rows.n_foreign:
        names = ", ".join(robot.joint_names)
        return f"none of its rows holds a position and a torque of {names}"
    usable_rows = count_text(len(rows.lines), "usable row")
    return f"the log has only {usable_rows}; record longer"


def require_few(anomaly: str, rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield a note on the rows left out for an anomaly; refuse a log where they are too many.

    ``anomaly`` is a key of ``_TOLERANCES``.
    """
    share, description, remedy = _TOLERANCES[anomaly]
    count, first = rows.anomalies[anomaly]
    if anomaly == BACKWARDS and count:
        raise InputError(f"time runs backwards at {first}; {remedy}")
    if count > max(_ALWAYS_TOLERATED, share * rows.n_read):
        where = f"first: {first}"
        if anomaly == MISSING:
            _refuse_empty_columns(rows)
            where += f"; mostly {_emptiest_column(rows)}"
        raise InputError(
            f"{count} of {rows.n_read} rows {description}, more than {100.0 * share:g} % "
            f"({where}); {remedy}"
        )
    if count:
        yield f"left out rows that {description}: {count} (first: {first})"


def _refuse_empty_columns(rows: LogRows) -> None:
    """Raise InputError for columns without any number, and for joints that are in separate rows."""
    counts = rows.empty_cells.items()
    empty = [repr(title) for title, count in counts if count == rows.n_read]
    if empty:
        subject = f"column {empty[0]} holds"
        if len(empty) > 1:
            subject = f"columns {', '.join(empty)} hold"
        raise InputError(
            f"{subject} no number in any row, only empty or NaN "
            "cells; record it, or with --columns FILE name the right column, or keep out what is "
            "not needed ('velocity = none')"
        )
    if rows.anomalies[MISSING].n_rows == rows.n_read:
        noun = rows.row_noun
        raise InputError(
            f"no {noun} holds numbers in all columns (empty: {_emptiest_column(rows)}): joints, or "
            f"position and torque, come in {noun}s of their own; record all in one {noun}"
        )


def _emptiest_column(rows: LogRows) -> str:
    """Return a phrase with the column that is empty most often, and how often."""
    title = max(rows.empty_cells, key=lambda title: rows.empty_cells[title])
    return f"column {title!r}, in {rows.empty_cells[title]} of {rows.n_read}"


def _mending_notes(rows: LogRows) -> Iterator[str]:
    """Yield notes on unwrapped positions, rows without this arm's data, and thinning."""
    if rows.anomalies[WRAPPED].n_rows:
        first = rows.anomalies[WRAPPED].first
        yield f"unwrapped positions that jump by a full turn (first: {first})"
    if rows.n_foreign:
        yield f"left out {rows.n_foreign} rows that hold nothing of this arm"
    if rows.thinning > 1:
        yield f"a long log: every {rows.thinning} rows were low-passed and made one"


def clock_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield notes on sampling period and gaps; refuse an implausible unit of time."""
    period = sampling_period(rows.samples.time)
    if period > _LONGEST_PERIOD:
        # The first unit in which the period is at most 50 ms, else ns.
        unit = "ms" if period <= 50 else "us" if period <= 5e4 else "ns"
        remedy = f"if time is in {unit}, pass --units {unit}"
        raise InputError(
            f"time steps of {period:.6g} s are too long for a motion; {remedy}"
        )
    if period < _SHORTEST_PERIOD:
        raise InputError(
            f"time steps of {period:.3g} s are too short for a recording; declare the unit of time "
            "with --units (s, ms, us or ns), or write 'time = 60 * TITLE' in --columns FILE"
        )
    if period * _SLOW_RATE > 1.0:
        yield f"the log has only {1 / period:.3g} samples per second"
    step = np.diff(rows.samples.time)
    # Between recordings, such as the episodes of a data set, no sample is missing.
    step[np.isclose(step, RECORDING_SEPARATION, rtol=0.0, atol=1e-6)] = period
    late = rows.lines[1:][step > GAP_STEPS * np.median(step)]
    if len(late):
        yield (
            f"samples are missing before {rows.cite(late)}; the longest gap is "
            f"{1e3 * np.max(step):.4g} ms where {1e3 * period:.4g} ms is usual"
        )


def require_one_clock(rows: LogRows, robot: RobotModel) -> None:
    """Raise InputError where the joints' time stamps run backwards or are of another clock."""
    # (N, n) [s], or None where all joints have the row's time.
    stamps = rows.samples.joint_time
    if stamps is None:
        return
    remedy = "keep them out with 'joint_time = none' in the file of --columns"
    is_backwards = np.any(np.diff(stamps, axis=0) < 0.0, axis=1)
    if np.any(is_backwards):
        lines = rows.cite(rows.lines[1:][is_backwards])
        raise InputError(
            f"a joint's own time stamp runs backwards at {lines}; {remedy}"
        )
    difference = np.max(np.abs(stamps - rows.samples.time[:, None]))
    if difference > _OTHER_CLOCK:
        raise InputError(
            f"joints' own time stamps are up to {difference:.3g} s off the row's; {remedy}"
        )


def require_radians(rows: LogRows, robot: RobotModel) -> None:
    """Raise InputError for positions or speeds that no arm has in radians and seconds.

    The error names a probable unit.
    """
    time = rows.samples.time
    q = rows.samples.q
    limit = np.maximum(np.abs(robot.limits.lower), np.abs(robot.limits.upper))
    # Twice the limit, but at least one full turn; two turns for a joint without limit.
    reach = np.maximum(2.0 * limit, 2.0 * np.pi)
    reach = np.where(np.isfinite(limit), reach, 4.0 * np.pi)
    largest = np.maximum(np.max(q, axis=0), -np.min(q, axis=0))
    is_far = ~robot.is_slide & (largest > reach)
    is_fast = ~robot.is_slide & _are_often_fast(q, np.diff(time))
    if np.any(is_far):
        joint = int(np.argmax(is_far))
        subject = f"joint {robot.joint_names[joint]} reaches {largest[joint]:.4g}"
        raise InputError(
            f"positions look like degrees ({subject}); pass --units deg, or --units rad if they "
            "are radians or count turns",
            _ANGLE_OPTIONS,
        )
    if np.any(is_fast):
        name = robot.joint_names[int(np.argmax(is_fast))]
        raise _speed_error(time, q, name, is_fast)


def _are_often_fast(q: Array, step: Array) -> Mask:
    """Return whether each joint (n,) at positions q (N, n) [rad] is often faster than _FAST.

    A speed is the mean speed from a row to the one r rows later. ``step`` (N - r,) are the times
    that this takes [s]; its length says what r is.
    """
    rows_apart = len(q) - len(step)
    is_fast = np.abs(q[rows_apart:] - q[:-rows_apart]) > _FAST * step[:, None]
    return np.asarray(np.mean(is_fast, axis=0) > _OFTEN)


def _speed_error(time: Array, q: Array, name: str, is_fast: Mask) -> InputError:
    """Return the error that states the probable reason for implausible speeds, and a remedy.

    Args:
        time: (N,) [s].
        q: (N, n) positions [rad].
        name: of the first joint that is too fast.
        is_fast: (n,) whether a joint is too fast.
    """
    step = np.diff(time)
    symptom = f"joint {name} would often exceed {_FAST:g} rad/s"
    # Are speeds plausible once no step is shorter than the usual one?
    if not np.any(is_fast & _are_often_fast(q, np.maximum(step, np.median(step)))):
        mean = float(np.mean(step))
        return InputError(
            f"time stamps are uneven ({np.mean(step < 0.5 * mean):.0%} of the steps are below half "
            f"of the mean of {1e3 * mean:.3g} ms), so that {symptom}: they say when rows arrived "
            "or were written; record when they were measured, or write "
            f"'rate = {1.0 / mean:.6g}' in --columns FILE if rows are evenly spaced"
        )
    return InputError(
        f"positions look like degrees, or time has another unit or an encoder is noisy: {symptom} "
        f"at steps of {np.median(step):.3g} s; pass --units deg, or --units rad if they are "
        "radians",
        _ANGLE_OPTIONS,
    )


def require_no_jumps(rows: LogRows, robot: RobotModel) -> None:
    """Raise InputError for single positions that no joint can reach within one step."""
    threshold = np.maximum(_JUMP, _JUMP_SPEED * np.diff(rows.samples.time))
    faults = []
    for name, q in zip(robot.joint_names, rows.samples.q.T):
        is_jump = np.abs(np.diff(q)) > threshold
        if rows.samples.command is None:
            # What is frozen for a while is left out (``diagnosis.limited_in_time``).
            for frozen in frozen_positions(rows.samples.time, q):
                is_jump[frozen.stop - 1] = False
        if np.any(is_jump):
            lines = rows.lines[1:][is_jump]
            faults.append(f"of joint {name} jumps at {rows.cite(lines)}")
    if faults:
        raise InputError(f"the position {', '.join(faults)}; delete the bad rows")


def rest_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield notes on joints that do not move and on rest at either end; refuse an arm at rest."""
    time = rows.samples.time
    q = rows.samples.q
    travel = np.ptp(q, axis=0)
    if np.all(travel < _AT_REST):
        fault = (
            f"the arm is at rest, no joint moves by more than {travel.max():.2g} rad"
        )
        raise InputError(
            f"{fault}; record a motion (if these are other units, see --units)"
        )
    unmoved = [n for n, s in zip(robot.joint_names, travel) if s < _AT_REST]
    if unmoved:
        yield f"joints that do not move in this log: {', '.join(unmoved)}"
    shortest = max(_SHORT_REST, _SHORT_SHARE * (time[-1] - time[0]))
    # A joint that moves by _AT_REST is away from the first and from the last posture at some time:
    # from row ``first`` on, and up to the row before ``last``.
    has_left = np.any(np.abs(q - q[0]) > _STILL, axis=1)
    is_away = np.any(np.abs(q - q[-1]) > _STILL, axis=1)
    first = int(np.argmax(has_left))
    last = int(np.flatnonzero(is_away)[-1]) + 1
    rests = {
        f"up to {rows.row_noun} {rows.lines[first]}": time[first] - time[0],
        f"from {rows.row_noun} {rows.lines[last]} on": time[-1] - time[last],
    }
    for extent, duration in rests.items():
        if duration > shortest:
            yield Detail(f"the arm stands still {extent} ({duration:.2f} s)")


def limit_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield a note on positions outside the model's joint limits."""
    q = rows.samples.q
    excess = np.maximum(q - robot.limits.upper, robot.limits.lower - q)
    lines = rows.lines[np.any(excess > _LIMIT_MARGIN, axis=1)]
    if not len(lines):
        return
    largest = np.max(excess, axis=0)
    outside = []
    for joint in np.flatnonzero(largest > _LIMIT_MARGIN).tolist():
        unit = position_unit(robot.is_slide[joint])
        outside.append(f"{robot.joint_names[joint]} by {largest[joint]:.3g} {unit}")
    yield (
        f"positions leave the model's joint limits: {', '.join(outside)} "
        f"({rows.cite(lines)}); check zero positions, signs, units and the order of the columns"
    )


def require_torque(rows: LogRows, robot: RobotModel) -> None:
    """Raise InputError for torques that are constant over the log.

    Logs of commanded positions are not checked: these may be constant.
    """
    if rows.samples.command is not None:
        return
    tau = rows.samples.tau
    names_by_torque = defaultdict[str, list[str]](list)
    for joint in np.flatnonzero(np.all(tau == tau[0], axis=0)).tolist():
        constant = tau[0, joint]
        torque = f"the same ({constant:.6g} N m)" if constant else "zero"
        names_by_torque[torque].append(robot.joint_names[joint])
    faults = []
    for torque, names in names_by_torque.items():
        faults.append(f"of joint {' and '.join(names)} is {torque} in every row")
    if faults:
        raise InputError(
            f"the torque {', that '.join(faults)}; record it, or name the right column with "
            "--columns FILE"
        )
