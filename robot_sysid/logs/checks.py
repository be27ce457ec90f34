"""Checks of a log's form, before anything is estimated from it.

A check takes the usable rows. It yields notes (the run goes on) or raises InputError (the numbers
cannot be those of this arm). Both name the first line and a remedy.

The usable rows are ``LogRows``: ``samples`` in SI units (N rows, n chain joints), ``lines`` (N,)
their numbers in the file. Of all rows of the file, ``n_read`` hold something of this arm;
``anomalies`` says which were left out why.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import compress

import numpy as np

from robot_sysid.errors import InputError, prefix_input_errors
from robot_sysid.logs.table import BACKWARDS, MISSING, REPEATED, UNREADABLE, LogRows
from robot_sysid.records import RobotModel
from robot_sysid.records.messages import count_text, position_unit
from robot_sysid.signals.resampling import (
    GAP_STEPS,
    RECORDING_SEPARATION,
    sampling_period,
)
from robot_sysid.wording import option_name, option_setting, with_option_names

# The share of rows with an anomaly above which a log is refused, and the remedy. The shares are
# choices: with more than 1 % of unreadable rows a file is no such table; with 5 % of rows missing,
# most filter windows are still complete.
_TOLERANCES = {
    UNREADABLE: (
        0.01,
        "mend the recording, or name the right columns with {columns FILE}; time may be in "
        "seconds, or such as 2024-05-01T12:00:00.005",
    ),
    MISSING: (
        0.05,
        "record all joints, and position and torque, in one row, or keep a broken column that is "
        "not needed out ('velocity = none') with {columns FILE}",
    ),
    REPEATED: (
        0.05,
        "write the time with more digits, or 'rate = HZ' in {columns FILE} for evenly spaced rows",
    ),
    BACKWARDS: (0.0, "cut the log where a second recording begins"),
}
# Options, one of which lets positions pass that look like degrees.
_ANGLE_OPTIONS = (("--units", "deg"), ("--units", "rad"))


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
        InputError: the first fault.
    """
    notes: list[str] = []
    with prefix_input_errors(name):
        for anomaly in _TOLERANCES:
            notes += require_few(anomaly, rows)
        # With fewer, the other checks mean nothing.
        if len(rows.lines) < 10:
            usable_rows = count_text(len(rows.lines), "usable row")
            raise InputError(f"the log has only {usable_rows}; record longer")
        notes += clock_notes(rows)
        if not in_radians:
            require_radians(rows, robot)
        require_no_jumps(rows, robot)
        notes += rest_notes(rows, robot)
        notes += torque_notes(rows, robot)
        require_one_clock(rows)
    return tuple(notes)


def require_few(anomaly: str, rows: LogRows) -> Iterator[str]:
    """Yield a note on the rows left out for an anomaly; refuse a log where they are too many.

    ``anomaly`` is a key of ``_TOLERANCES``.
    """
    share, remedy = _TOLERANCES[anomaly]
    lines, first = rows.anomalies[anomaly]
    count = len(lines)
    if not count:
        return
    first = first or rows.cite(lines[:1])
    # One is always allowed: the last row is often cut off.
    allowed = max(1, share * rows.n_read) if share else 0
    if count > allowed:
        raise InputError(
            f"{count} of {rows.n_read} rows {anomaly}, more than {100.0 * share:g} % "
            f"(first: {first}); {with_option_names(remedy)}"
        )
    yield f"left out rows that {anomaly}: {count} (first: {first})"


def clock_notes(rows: LogRows) -> Iterator[str]:
    """Yield notes on sampling period and gaps; refuse an implausible unit of time."""
    period = sampling_period(rows.samples.time)
    # Rates of 1 to 1000 Hz are usual.
    if not 1e-5 <= period <= 0.5:
        raise InputError(
            f"time steps of {period:.6g} s are not those of a recording; pass "
            f"{option_setting('units', 'ms')}, us or ns, or write 'time = 60 * TITLE' in "
            f"{option_name('columns', 'FILE')}"
        )
    # 100 samples per second do for a slow arm, 30 hardly ever (docs/logs.md).
    if period * 50.0 > 1.0:
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


def require_one_clock(rows: LogRows) -> None:
    """Raise InputError where the joints' time stamps run backwards or are of another clock."""
    # (N, n) [s], or None where all joints have the row's time.
    stamps = rows.samples.joint_time
    if stamps is None:
        return
    difference = np.max(np.abs(stamps - rows.samples.time[:, None]))
    # A few sampling periods of the slowest logs.
    if np.any(np.diff(stamps, axis=0) < 0.0) or difference > 0.1:
        raise InputError(
            f"joints' own time stamps run backwards, or are of another clock (up to "
            f"{difference:.3g} s off the row's); keep them out with 'joint_time = none' in the "
            f"file of {option_name('columns')}"
        )


def require_radians(rows: LogRows, robot: RobotModel) -> None:
    """Raise InputError for positions or speeds that no arm has in radians and seconds.

    The error names a probable unit.
    """
    time = rows.samples.time
    step = np.diff(time)
    for joint in np.flatnonzero(~robot.is_slide):
        q = rows.samples.q[:, joint]
        largest = np.max(np.abs(q))
        speed = np.abs(np.diff(q)) / step
        # Two turns either way are more than an arm's joints have. None reaches 30 rad/s; a log in
        # degrees does at half a radian per second.
        if largest <= 4.0 * np.pi and np.mean(speed > 30.0) <= 0.01:
            continue
        rate = (len(time) - 1) / (time[-1] - time[0])
        raise InputError(
            f"positions look like degrees, or time stamps are those of another unit, or of when "
            f"rows were written (joint {robot.joint_names[joint]} would reach {largest:.4g} rad "
            f"and {np.max(speed):.4g} rad/s); pass {option_setting('units', 'deg')}, or "
            f"{option_setting('units', 'rad')}, if they are radians or count turns, or write "
            f"'rate = {rate:.6g}' in {option_name('columns', 'FILE')} if rows are evenly spaced",
            _ANGLE_OPTIONS,
        )


def require_no_jumps(rows: LogRows, robot: RobotModel) -> None:
    """Raise InputError for single positions that no joint can reach within one step."""
    # An encoder's noise does not reach half a radian; it adds to the speed of a joint.
    threshold = np.maximum(0.5, 100.0 * np.diff(rows.samples.time))
    for name, q in zip(robot.joint_names, rows.samples.q.T):
        step = np.abs(np.diff(q))
        # What repeats its value for a while is left out (``diagnosis.limited_in_time``).
        is_jump = (step > threshold) & (np.roll(step, 1) > 0.0)
        if np.any(is_jump):
            where = rows.cite(rows.lines[1:][is_jump])
            raise InputError(
                f"the position of joint {name} jumps at {where}; delete the bad rows"
            )


def rest_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield a note on joints that do not move; refuse an arm at rest."""
    travel = np.ptp(rows.samples.q, axis=0)
    is_at_rest = travel < 0.01
    if np.all(is_at_rest):
        unit = position_unit(robot.is_slide[np.argmax(travel)])
        raise InputError(
            f"the arm is at rest, no joint moves by more than {travel.max():.2g} {unit}; record a "
            f"motion (if these are other units, see {option_name('units')})"
        )
    unmoved = [*compress(robot.joint_names, is_at_rest)]
    if unmoved:
        yield f"joints that do not move in this log: {', '.join(unmoved)}"


def torque_notes(rows: LogRows, robot: RobotModel) -> Iterator[str]:
    """Yield a note on joints without torque; refuse torques that are constant over the log.

    Logs of commanded positions are not checked: these may be constant.
    """
    if rows.samples.command is not None:
        return
    tau = rows.samples.tau
    is_constant = np.ptp(tau, axis=0) == 0.0
    is_zero = ~np.any(tau, axis=0) & ~np.all(is_constant)
    unpowered = ", ".join(compress(robot.joint_names, is_zero))
    if unpowered:
        yield (
            "joints without torque in this log, whose equations are left out and whose friction "
            f"is the model's: {unpowered}"
        )
    names = [*compress(robot.joint_names, is_constant & ~is_zero)]
    if names:
        raise InputError(
            f"the torque of joint {' and '.join(names)} is the same in every row; record it, or "
            f"name the right column with {option_name('columns', 'FILE')}, or state there that it "
            f"has none: torque.{names[0]} = none"
        )
