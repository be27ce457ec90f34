"""The usable rows of a log, and checks of its form before anything is estimated from it.

Rows with an empty or NaN cell, rows that are not numbers and rows that are no later than the row
before are left out and counted, and a jump by a full turn is unwrapped.

A check takes the usable rows: a recording in SI units (N samples, n chain joints), and ``lines``
(N,), their numbers in the file. It yields notes (the run goes on) or raises InputError (the numbers
cannot be those of this arm). Both name the first line and a remedy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError, prefix_input_errors
from robot_sysid.logs.table import (
    LARGEST_NUMBER,
    Lines,
    LogTable,
    read_cells,
    separate_recordings,
    without_copies,
)
from robot_sysid.logs.titles import TIME_UNITS, UNITS, read_title
from robot_sysid.records import Array, Column, ColumnMap, Recording, RobotModel
from robot_sysid.records.data import shift_behind
from robot_sysid.records.messages import Progress, count_text, position_unit
from robot_sysid.signals.cutoff import FEWEST_SAMPLES
from robot_sysid.signals.resampling import GAP_STEPS, sampling_period
from robot_sysid.signals.sign_bits import decode_signs
from robot_sysid.signals.stamps import even_time, is_sampled_motion
from robot_sysid.wording import option_name, option_setting, with_option_names

Rows = NDArray[np.integer[Any]]
"""Numbers of rows, counted from 0."""
_TURN = 2.0 * np.pi
LARGEST_WRAP_STEP = 0.5
"""Motion within one sample beside which a full turn is a wrap [rad]: 100 rad/s at 200 Hz."""
LARGEST_VALUE = 1e7
"""Larger positions and torques are faults of a file [SI units]."""
LEAST_TORQUE = 1e-30
"""Torque below which there is none [N m or N]: memory that was never written holds such numbers,
far below any sensor's step, and their squares are zero."""
MOST_UNREADABLE = 0.01
"""Share of unreadable rows above which a file is no such table (chosen)."""
MOST_INCOMPLETE = 0.05
"""Share of rows that lack something above which a log, or a quantity, is not used: with 5 % of rows
missing, most filter windows are still complete (chosen)."""
LEAST_MOVED_STEP = 0.7
"""Steps of time between rows that were sorted, over the usual one, of one recording: those of two
that lie in each other are a half, stamps that jitter by a whole step more than this."""
MOST_MOVED_WAY = 1.25
"""Way from row to row where rows were sorted, over that in the file, with which the order in the
file was wrong: less than one of two rows that were exchanged, more where only their stamps were."""
SHORTEST_STEP = 1e-5
LONGEST_STEP = 0.5
"""Sampling periods of a plausible unit of time [s]; rates of 1 to 1000 Hz are usual."""
LEAST_STEP = 2e-4
"""Sampling period from which on a unit of time is proposed that makes it [s]: a thousandth of the
longest one is no log's rate, so that one unit at most makes one."""
FEW_SAMPLES = 50.0
"""Samples per second below which a note is due: 100 do for a slow arm, 30 hardly ever
(docs/logs.md)."""
LARGEST_DELAY = 0.1
"""Difference of a joint's time stamp from its row's that one clock makes [s]: a few sampling
periods of the slowest logs."""
LARGEST_SPEED = 30.0
"""Speed that no arm reaches [rad/s or m/s]; a log in degrees does at half a radian per second."""
MOST_FAST = 0.01
"""Share of steps that may be faster: single samples may be wrong."""
MOST_RANGES = 10.0
"""Ranges of a slide, whose zero may be anywhere, from its zero to its farthest position."""
SMALLEST_JUMP = 0.5
"""Step of a position that is no encoder's noise [rad or m]."""
JUMP_SPEED = 100.0
"""Speed that no joint has within one step [rad/s or m/s]."""
BESIDE = 5
"""Steps on each side with which one is compared."""
JUMP_OVER_BESIDE = 8.0
"""Speed of a step, over that of the fastest of those beside it and over the joint's typical one,
above which rows are missing: as many at least. It is several times what two joints have at once in
right logs, by steps of a coarse encoder, and far less than where a second is missing."""
MOST_CUTS = 10
"""Places at which rows are missing up to which a log is cut there."""
LEAST_VISITS = 10
"""Times that all torques are zero at once from which it is no chance."""
MOST_ROWS_AT_ONCE = 20.0
"""Rows without any torque one after the other, on average, up to which they lie between those of
the driver: an arm that stands on its brakes has hundreds."""
ALTERNATING = -0.9
"""Correlation of steps of a torque with the steps after them, below which two torques alternate:
noise alone has -0.5, and right logs a little less where they are filtered oddly."""
LEAST_TRAVEL = 0.01
"""Travel below which a joint does not move [rad or m]."""
LEAST_MOTION = 0.1
"""Travel of the joint that moves most, in degrees that were taken for radians, from which on they
may be degrees [rad]: logs of arms have ten times as much."""
_NOT_NEEDED = {"velocity": "velocities", "motor_torque": "motor torques"}
"""Columns that may be left out, in the order of ``ColumnMap.groups``, and what notes call them."""
# What positions of a hinge may be that are too large for degrees.
_COUNTS = (
    ", hundredths of them ({units=cdeg}) or counts of an encoder ({units=4096/rev} for 4096 a "
    "turn, and 'zero = 2048' in {columns FILE} for what they read at zero)"
)


def read_recording(
    table: LogTable, columns: ColumnMap, robot: RobotModel, progress: Progress
) -> Recording:
    """Return the usable rows of a log, with a note on whatever is odd about them.

    Args:
        table: the log.
        columns: the column of each quantity.
        robot: the arm.
        progress: receives the progress of reading.

    Raises:
        InputError: the first fault.
    """
    cells, complaint = read_cells(table, columns, progress)
    sign_notes = [*restore_signs(columns, cells)]
    cells, copy_notes = without_copies(table, cells)
    restart_notes = separate_recordings(table, columns, cells)
    with prefix_input_errors(str(table.path)):
        cells, unpowered_notes = without_unpowered(columns, cells)
        columns, cells, further_notes = _complete_columns(columns, cells)
        lines, cells, notes = usable_rows(table, columns, cells, complaint)
        notes += [*sign_notes, *copy_notes, *restart_notes, *unpowered_notes]
        notes += further_notes
        # With fewer, the other checks mean nothing.
        if len(lines) < 10:
            count = count_text(len(lines), "usable row")
            raise InputError(f"the log has only {count}; record longer")
        groups = (cells[:, place] for place in group_places(columns))
        q, tau, qd, motor_torque, stamps = groups
        for joint in np.flatnonzero(~robot.is_slide):
            # Full turns by which the position jumps against the row before.
            step = np.diff(q[:, joint])
            turns = np.round(step / _TURN)
            turns[np.abs(step - turns * _TURN) > LARGEST_WRAP_STEP] = 0.0
            q[1:, joint] -= _TURN * np.cumsum(turns)
        tau[np.abs(tau) < LEAST_TORQUE] = 0.0
        recording = Recording(
            time=cells[:, 1],
            q=q,
            qd=qd if columns.velocity else None,
            # A servo's torque follows its position error, the measure of torque here [rad].
            tau=tau - q if columns.commanded else tau,
            joint_time=stamps if columns.joint_time else None,
            command=tau if columns.commanded else None,
            motor_torque=motor_torque if columns.motor_torque else None,
            name=str(table.path),
            joint_names=robot.joint_names,
            columns=columns,
        )
        notes += clock_notes(table, recording, lines)
        require_units(recording, robot, columns)
        recording, lines, spike_notes = without_spikes(table, recording, lines)
        recording, cut_notes = cut_at_lost_rows(table, recording, lines)
        notes += [*spike_notes, *cut_notes]
        require_no_jumps(table, recording, lines)
        notes += [*turn_notes(recording, robot, columns), *rest_notes(recording, robot)]
        notes += torque_notes(recording)
        require_one_clock(recording)
        require_one_source(recording)
    return replace(recording, notes=tuple(notes))


def group_places(columns: ColumnMap) -> list[slice]:
    """Return where each of ``ColumnMap.groups`` stands in cells, behind line and time."""
    ends = np.cumsum([2, *map(len, columns.groups())]).tolist()
    return [slice(*pair) for pair in zip(ends, ends[1:])]


def measured(columns: Sequence[Column], place: slice) -> list[int]:
    """Return where cells hold those of a group's columns that are in the log."""
    places = range(place.start, place.stop)
    return [k for k, column in zip(places, columns) if column.factor]


def restore_signs(columns: ColumnMap, cells: Array) -> Iterator[str]:
    """Put signed numbers in the place of registers that hold their sign in a bit, and yield notes.

    ``cells``: of all rows, as ``read_cells`` returns them.
    """
    names = ("position", "commands" if columns.commanded else "torque", "velocity")
    for name, group, place in zip(names, columns.groups(), group_places(columns)):
        indices = measured(group, place)
        sources = [column for column in group if column.factor]
        if not sources:
            continue
        factors = np.array([column.factor for column in sources])
        zeros = np.array([column.zero for column in sources])
        found = decode_signs(cells[:, indices] / factors + zeros)
        if found:
            values, way = found
            cells[:, indices] = (values - zeros) * factors
            yield f"columns of {name} are numbers as {way}: they are read with their signs"


def without_unpowered(columns: ColumnMap, cells: Array) -> tuple[Array, list[str]]:
    """Return cells without the rows between others in which every torque is zero, and a note.

    A second program that publishes the same arm, as a simulator does, has no torques, and nothing
    else may tell its rows from the driver's. No two sensors read zero at once, again and again.

    ``cells``: of all rows, as ``read_cells`` returns them.
    """
    torque = measured(columns.torque, group_places(columns)[1])
    if columns.commanded or len(torque) < 2:
        return cells, []
    is_unpowered = np.all(cells[:, torque] == 0.0, axis=1)
    count = np.count_nonzero(is_unpowered)
    visits = np.count_nonzero(np.diff(is_unpowered, prepend=False) & is_unpowered)
    is_between = visits >= LEAST_VISITS and count <= MOST_ROWS_AT_ONCE * visits
    if not is_between or count == len(cells):
        return cells, []
    note = (
        f"left out rows in which every torque is 0, as another program sends them: {count} of "
        f"{len(cells)}"
    )
    return cells[~is_unpowered], [note]


def _complete_columns(
    columns: ColumnMap, cells: Array
) -> tuple[ColumnMap, Array, list[str]]:
    """Return columns and cells without quantities that are not needed and often missing, and notes
    on these.

    ``cells``: of all rows, as ``read_cells`` returns them.
    """
    needed = 2 + 2 * len(columns.position)
    is_used = ~np.isnan(cells[:, 2:needed]).any(axis=1)
    notes = []
    for name, quantity in _NOT_NEEDED.items():
        # Behind those that come before it, of which some may have been left out.
        start = needed + (len(columns.velocity) if name == "motor_torque" else 0)
        own = slice(start, start + len(getattr(columns, name)))
        count = np.count_nonzero(np.isnan(cells[is_used, own]).any(axis=1))
        # In a few rows they are missing beside what is needed.
        if count > MOST_INCOMPLETE * np.count_nonzero(is_used):
            notes.append(
                f"recorded {quantity} are not used, and not needed: {count} rows lack them"
            )
            left_out: dict[str, Any] = {name: ()}
            columns = replace(columns, **left_out)
            cells = np.delete(cells, own, axis=1)
    return columns, cells, notes


def usable_rows(
    table: LogTable, columns: ColumnMap, cells: Array, complaint: str
) -> tuple[Lines, Array, list[str]]:
    """Return the lines (N,) and cells of the rows that can be used, and notes on the others.

    Args:
        table: the log.
        columns: the column of each quantity.
        cells: of all rows, as ``read_cells`` returns them.
        complaint: the fault of the first row that is not numbers; "" for none.

    Raises:
        InputError: too many rows cannot be used.
    """
    lines = cells[:, 0].astype(np.int64)
    is_impossible = np.abs(cells[:, 1]) > LARGEST_NUMBER
    is_foreign = ~is_impossible
    # Positions and torques; one column at a time, to bound memory.
    for column in cells.T[2 : 2 + 2 * len(columns.position)]:
        is_impossible |= np.abs(column) > LARGEST_VALUE
        is_foreign &= np.isnan(column)
    is_usable = np.isfinite(cells).all(axis=1) & ~is_impossible
    missing = np.flatnonzero(~(is_usable | is_impossible | is_foreign))
    empty = ""
    if len(missing):
        titles = [column.title for column in columns.columns()]
        is_empty = ~np.isfinite(cells[missing[0], -len(titles) :])
        listed = ", ".join(compress(titles, is_empty))
        empty = f"{table.row_noun} {lines[missing[0]]}, columns {listed}"
    rows, notes = ordered_rows(table, columns, cells, np.flatnonzero(is_usable))
    rows, repeat_notes = without_repeats(table, columns, cells, rows)
    notes += repeat_notes
    time, even_notes = even_stamps(columns, cells, rows)
    cells[rows, 1] = time
    notes += even_notes
    # Rows after a step backwards that are not yet later than all before are not counted.
    step = np.diff(time)
    after = lines[rows][1:]
    n_read = int(np.count_nonzero(~is_foreign))
    # The share of rows above which a log is refused for an anomaly, and the remedy.
    for anomaly, odd, first, share, remedy in (
        (
            "are no rows of numbers",
            lines[is_impossible],
            complaint,
            MOST_UNREADABLE,
            "mend the recording, or name the right columns with {columns FILE}; time may be in "
            "seconds, or such as 2024-05-01T12:00:00.005",
        ),
        (
            "have empty or NaN cells",
            lines[missing],
            empty,
            MOST_INCOMPLETE,
            "record all joints, and position and torque, in one row, or keep a broken column that "
            "is not needed out ('velocity = none') with {columns FILE}",
        ),
        (
            "repeat the time stamp before them",
            after[step == 0.0],
            "",
            MOST_INCOMPLETE,
            "write the time with more digits, or 'rate = HZ' in {columns FILE} for evenly spaced "
            "rows",
        ),
        (
            "run backwards in time",
            after[step < 0.0],
            "",
            0.0,
            "cut the log where a second recording begins, or where the clock was set back",
        ),
    ):
        count = len(odd)
        if not count:
            continue
        first = first or table.cite(odd[:1])
        # One is always allowed: the last row is often cut off.
        if count > (max(1, share * n_read) if share else 0):
            allowed = f", more than {100.0 * share:g} %" if share else ""
            raise InputError(
                f"{count} of {n_read} rows {anomaly}{allowed} (first: {first}); "
                f"{with_option_names(remedy)}"
            )
        notes.append(f"left out rows that {anomaly}: {count} (first: {first})")
    is_later = np.diff(np.maximum.accumulate(time), prepend=-np.inf) > 0.0
    rows = rows[is_later]
    if len(rows) == len(cells) and np.all(np.diff(rows) > 0):
        # Without a copy.
        return lines, cells, notes
    return lines[rows], cells[rows], notes


def positions(columns: ColumnMap, cells: Array, rows: Rows) -> Array:
    """Return the positions (K, n) of rows of cells."""
    return cells[rows, 2 : 2 + len(columns.position)]


def ordered_rows(
    table: LogTable, columns: ColumnMap, cells: Array, rows: Rows
) -> tuple[Rows, list[str]]:
    """Return rows (K,) in the order of time, and notes on what was mended.

    They are sorted where they are those of one recording: sorted, they do not lie closer than
    usual, as those of two recordings would.

    Args:
        table: the log.
        columns: the column of each quantity.
        cells: of all rows, as ``read_cells`` returns them.
        rows: numbers of the rows that can be used.
    """
    notes: list[str] = []
    time = cells[rows, 1]
    step = np.diff(time)
    if np.all(step > 0.0):
        return rows, notes
    time = cells[rows, 1]
    late = rows[1:][np.diff(time) < 0.0]
    order = np.argsort(time, kind="stable")
    if len(late) and is_one_recording(time, positions(columns, cells, rows), order):
        rows = rows[order]
        notes.append(
            f"rows were out of order, and are sorted by time: {len(late)} "
            f"(first: {table.cite(cells[late[:1], 0].astype(np.int64))})"
        )
    return rows, notes


def is_one_recording(time: Array, q: Array, order: Rows) -> bool:
    """Return whether rows are of one recording, and only their order in the file is wrong.

    Args:
        time: (K,) in the order of the file [s].
        q: (K, n) positions.
        order: (K,) of the rows by time.
    """
    step = np.diff(time[order])
    usual = np.median(step)
    is_new = np.diff(order) != 1
    is_lost = np.diff(np.argsort(order)) != 1
    is_apart = np.mean(np.minimum(step[is_new], usual)) > LEAST_MOVED_STEP * usual
    new, lost = (
        np.sum(np.linalg.norm(np.diff(each, axis=0)[is_changed], axis=1))
        for each, is_changed in ((q[order], is_new), (q, is_lost))
    )
    return bool(is_apart and new <= MOST_MOVED_WAY * lost)


def without_repeats(
    table: LogTable, columns: ColumnMap, cells: Array, rows: Rows
) -> tuple[Rows, list[str]]:
    """Return rows (K,) without those that repeat the sample before between two samples, and a note.

    They were written again, or the log was polled faster than the controller has samples. What
    repeats in place of a sample, as of an arm at rest, stays.

    Args:
        table: the log.
        columns: the column of each quantity.
        cells: of all rows, as ``read_cells`` returns them.
        rows: numbers of the rows that can be used, in the order of time.
    """
    time = cells[rows, 1]
    is_same = np.full(max(len(rows) - 1, 0), True)
    # Positions and torques; one column at a time, to bound memory.
    for column in cells.T[2 : 2 + 2 * len(columns.position)]:
        is_same &= np.diff(column[rows]) == 0.0
    # Of stamps that are shared, or run backwards, the even ones are not known.
    if not np.any(is_same) or np.any(np.diff(time) <= 0.0):
        return rows, []
    samples = np.flatnonzero(~np.append(False, is_same))
    if len(samples) == 1:  # the arm is at rest throughout
        return rows, []
    step = np.diff(time[samples])
    is_usual = step < GAP_STEPS * np.median(step)
    # Behind the last sample nothing says when the next one came.
    number = np.searchsorted(samples, np.arange(len(rows)), side="right") - 1
    is_between = np.append(False, is_same) & np.append(is_usual, False)[number]
    if not np.any(is_between):
        return rows, []
    first = cells[rows[is_between][:1], 0].astype(np.int64)
    note = (
        "left out rows that repeat the one before them, between two samples: "
        f"{np.count_nonzero(is_between)} (first: {table.cite(first)})"
    )
    return rows[~is_between], [note]


def even_stamps(
    columns: ColumnMap, cells: Array, rows: Rows
) -> tuple[Array, list[str]]:
    """Return the time (K,) of rows [s], at even instants where their stamps are not, and a note."""
    time = cells[rows, 1]
    if columns.joint_time or len(time) < FEWEST_SAMPLES or np.any(np.diff(time) < 0.0):
        return time, []
    even = even_time(time, positions(columns, cells, rows))
    if even is None:
        return time, []
    off = np.max(np.abs(time - even))
    note = (
        f"time stamps are up to {1e3 * off:.3g} ms off, as of arrival or of few digits: positions "
        f"show that rows are evenly spaced, and they are taken at {1.0 / sampling_period(even):.6g}"
        " Hz"
    )
    return even, [note]


def clock_notes(table: LogTable, recording: Recording, lines: Lines) -> Iterator[str]:
    """Yield notes on sampling period and gaps; refuse an implausible unit of time."""
    period = sampling_period(recording.time)
    if not SHORTEST_STEP <= period <= LONGEST_STEP:
        raise _wrong_period(recording, period)
    if period * FEW_SAMPLES > 1.0:
        yield f"the log has only {1 / period:.3g} samples per second"
    step = np.diff(recording.time)
    # Between recordings, such as the episodes of a data set, no sample is missing.
    step[recording.is_separation] = period
    late = lines[1:][step > GAP_STEPS * np.median(step)]
    if len(late):
        yield (
            f"samples are missing before {table.cite(late)}; the longest gap is "
            f"{1e3 * np.max(step):.4g} ms where {1e3 * period:.4g} ms is usual"
        )


def _wrong_period(recording: Recording, period: float) -> InputError:
    """Return the error of a period that no recording has [s], with the unit that makes it one.

    Postures that are far apart in time are no recording in any unit.
    """
    fault = f"time steps of {period:.6g} s are not those of a recording"
    time = recording.columns.time if recording.columns else None
    if period > LONGEST_STEP and not is_sampled_motion(recording.q):
        return InputError(
            f"{fault}: positions jump from row to row, so they are postures, and these show no "
            "friction, no inertia and no clock; record while the arm moves, at 100 rows per second "
            "or more"
        )
    seconds = UNITS["time"]
    # One of these units at most makes the rate of a log.
    fitting = [
        unit
        for unit in TIME_UNITS
        if time and LEAST_STEP <= period / time.factor * seconds[unit] <= LONGEST_STEP
    ]
    if not fitting:
        return InputError(
            f"{fault}; write 'time = 60 * TITLE', with its true factor to seconds, in "
            f"{option_name('columns', 'FILE')}"
        )
    unit = fitting[0]
    assert time is not None
    if read_title(time.title).unit:
        return InputError(
            f"{fault}, though the title {time.title!r} says so: they fit {unit}; write 'time = "
            f"{seconds[unit] / time.factor:g} * TITLE' in {option_name('columns', 'FILE')}"
        )
    units = option_setting("units", unit)
    return InputError(f"{fault}: they fit {unit}; pass {units}", [("--units", unit)])


def require_one_clock(recording: Recording) -> None:
    """Raise InputError where the joints' time stamps run backwards or are of another clock."""
    # (N, n) [s], or None where all joints have the row's time.
    stamps = recording.joint_time
    if stamps is None:
        return
    difference = np.max(np.abs(stamps - recording.time[:, None]))
    if np.any(np.diff(stamps, axis=0) < 0.0) or difference > LARGEST_DELAY:
        raise InputError(
            f"joints' own time stamps run backwards, or are of another clock (up to "
            f"{difference:.3g} s off the row's); keep them out with 'joint_time = none' in the "
            f"file of {option_name('columns')}"
        )


def require_one_source(recording: Recording) -> None:
    """Raise InputError where the torques of all joints alternate from row to row.

    Two programs that publish one arm, with torques of two sensors or in two units, make such rows,
    and the links that follow are of neither.
    """
    if recording.command is not None:
        return
    steps = np.diff(recording.tau, axis=0)
    steps = steps[:, np.any(steps, axis=0)]
    products = np.sum(steps[1:] * steps[:-1], axis=0)
    if steps.size and np.all(products < ALTERNATING * np.sum(steps**2, axis=0)):
        raise InputError(
            "the torques of all joints alternate from row to row between two values, as where two "
            "programs publish one arm: stop one of them and record again, or keep the rows of one"
        )


def require_units(recording: Recording, robot: RobotModel, columns: ColumnMap) -> None:
    """Raise InputError for positions or speeds that no arm has in the units taken for granted.

    Those are radians or metres, and seconds. The error names probable units.
    """
    time = recording.time
    step = np.diff(time)
    for joint, is_slide in enumerate(robot.is_slide):
        if columns.length_declared if is_slide else columns.angle_declared:
            continue
        q = recording.q[:, joint]
        largest = np.max(np.abs(q))
        speed = np.abs(np.diff(q)) / step
        # Two turns either way are more than an arm's joints have.
        reach = 4.0 * np.pi
        if is_slide:
            limits = [robot.limits.lower[joint], robot.limits.upper[joint]]
            reach = MOST_RANGES * np.max(np.abs(limits))
        is_fast = np.mean(speed > LARGEST_SPEED) > MOST_FAST
        if largest <= reach and not is_fast:
            continue
        probable, unit = ("mm", "m") if is_slide else ("deg", "rad")
        fault = f"positions look like {'millimetres' if is_slide else 'degrees'}"
        # With steps of another time no unit of angles makes a motion of an arm.
        is_motion = (
            is_slide or np.radians(np.max(np.ptp(recording.q, axis=0))) > LEAST_MOTION
        )
        options = [("--units", probable)] * bool(is_motion)
        options += [("--units", unit)] * (not is_fast)
        # Degrees are less, and no whole numbers.
        is_counted = np.radians(largest) > reach or np.all(q == np.round(q))
        if is_counted and not is_slide:
            fault += with_option_names(_COUNTS)
            options = []
        rate = (len(time) - 1) / (time[-1] - time[0])
        raise InputError(
            f"{fault}, or time stamps are those of another unit, or of when rows were written "
            f"(joint {robot.joint_names[joint]} would reach {largest:.4g} {unit} and "
            f"{np.max(speed):.4g} {unit}/s); pass {option_setting('units', probable)}, or "
            f"{option_setting('units', unit)}, if that is what they are, or write 'rate = "
            f"{rate:.6g}' in {option_name('columns', 'FILE')} if rows are evenly spaced",
            options,
        )


def without_spikes(
    table: LogTable, recording: Recording, lines: Lines
) -> tuple[Recording, Lines, list[str]]:
    """Return a recording without single rows in which a position jumps and is back, and a note.

    More of them are no single readings that went wrong: nothing is left out then.
    """
    step = np.abs(np.diff(recording.q, axis=0))
    is_far = step > jump_sizes(recording)
    back = np.abs(recording.q[2:] - recording.q[:-2])
    is_back = back < SMALLEST_JUMP
    is_spike = np.any(is_far[:-1] & is_far[1:] & is_back, axis=1)
    count = np.count_nonzero(is_spike)
    if not 0 < count <= MOST_UNREADABLE * len(recording):
        return recording, lines, []
    kept = np.flatnonzero(~np.pad(is_spike, 1))
    wrong = lines[1:-1][is_spike]
    note = f"left out rows in which a position jumps and is back: {count}"
    where = f"(first: {table.cite(wrong[:1])})"
    arrays = {name: values[kept] for name, values in recording.arrays().items()}
    return replace(recording, **arrays), lines[kept], [f"{note} {where}"]


def cut_at_lost_rows(
    table: LogTable, recording: Recording, lines: Lines
) -> tuple[Recording, list[str]]:
    """Return a recording that is cut where rows are missing and its time does not show it.

    There, several joints jump at once, by far more than in any step beside. What is on both sides
    is right; only the time between them is not known. Of one joint that jumps alone the zero may
    have been set. Where there are many such places, the clock is judged (``faults.samples``).
    """
    step = np.diff(recording.time)
    speed = np.abs(np.diff(recording.q, axis=0)) / step[:, None]
    if len(speed) <= 2 * BESIDE:
        return recording, []
    usual = np.array([np.median(of[of > 0.0]) if np.any(of) else 0.0 for of in speed.T])
    middle = slice(BESIDE, len(speed) - BESIDE)
    before = beside = np.zeros_like(speed[middle])
    for back in range(1, BESIDE + 1):
        before = np.maximum(before, speed[BESIDE - back : len(speed) - BESIDE - back])
        beside = np.maximum(beside, speed[BESIDE + back : len(speed) - BESIDE + back])
    beside = np.maximum(np.maximum(before, beside), usual)
    # What repeats its value for a while is left out (``faults.stretches``).
    jumps = (speed[middle] > JUMP_OVER_BESIDE * beside) & (before > 0.0)
    is_gap = step[middle] > GAP_STEPS * np.median(step)
    places = BESIDE + np.flatnonzero((np.sum(jumps, axis=1) > 1) & ~is_gap)
    if not 0 < len(places) <= MOST_CUTS:
        return recording, []
    time = recording.time.copy()
    for place in places.tolist():
        time[place + 1 :] += shift_behind(time[place], time[place + 1])
    note = (
        f"rows are missing before {table.cite(lines[1 + places])} that the time does not show, as "
        "positions jump there: the log is cut there"
    )
    return replace(recording, time=time), [note]


def require_no_jumps(table: LogTable, recording: Recording, lines: Lines) -> None:
    """Raise InputError for positions that no joint can reach within one step."""
    threshold = jump_sizes(recording)[:, 0]
    for name, q in zip(recording.joint_names, recording.q.T):
        step = np.abs(np.diff(q))
        # What repeats its value for a while is left out (``faults.stretches``).
        is_jump = (step > threshold) & (np.roll(step, 1) > 0.0)
        if np.any(is_jump):
            where = table.cite(lines[1:][is_jump])
            raise InputError(
                f"the position of joint {name} jumps at {where} and stays there, as where its "
                "zero was set, or its encoder lost count; use the part of the log before it, or "
                "behind it"
            )


def jump_sizes(recording: Recording) -> Array:
    """Return the way (N - 1, 1) that no joint makes in each step; noise adds to it."""
    most = np.maximum(SMALLEST_JUMP, JUMP_SPEED * np.diff(recording.time))
    return np.asarray(most[:, None])


def turn_notes(
    recording: Recording, robot: RobotModel, columns: ColumnMap
) -> Iterator[str]:
    """Yield a note on the hinges whose positions lie whole turns outside of their limits.

    Their links are where they would be within them; a spring or a cable is not.
    """
    limits = robot.limits
    lines = []
    for joint in np.flatnonzero(~robot.is_slide).tolist():
        lower, upper = float(limits.lower[joint]), float(limits.upper[joint])
        least = float(np.min(recording.q[:, joint]))
        most = float(np.max(recording.q[:, joint]))
        is_outside = least > upper or most < lower
        if not (is_outside and np.isfinite(upper - lower)):
            continue
        shift = _TURN * round((least + most - lower - upper) / (2.0 * _TURN))
        if lower <= least - shift and most - shift <= upper:
            column = columns.position[joint]
            # Of a joint that stands still there is no column.
            zero = column.zero + shift / (column.factor or 1.0)
            lines.append(f"zero.{robot.joint_names[joint]} = {zero:.6g}")
    if lines:
        yield (
            "positions are whole turns outside of the joints' limits, where links are as within "
            "them, and springs and cables are not; to take the turns off, write "
            f"'{', '.join(lines)}' in {option_name('columns')}"
        )


def rest_notes(recording: Recording, robot: RobotModel) -> Iterator[str]:
    """Yield a note on joints that do not move; refuse an arm at rest."""
    travel = np.ptp(recording.q, axis=0)
    is_at_rest = travel < LEAST_TRAVEL
    if np.all(is_at_rest):
        unit = position_unit(robot.is_slide[np.argmax(travel)])
        raise InputError(
            f"the arm is at rest, no joint moves by more than {travel.max():.2g} {unit}; record a "
            f"motion (if these are other units, see {option_name('units')})"
        )
    unmoved = [*compress(robot.joint_names, is_at_rest)]
    if unmoved:
        yield f"joints that do not move in this log: {', '.join(unmoved)}"


def torque_notes(recording: Recording) -> Iterator[str]:
    """Yield a note on joints without torque; refuse torques that are constant over the log.

    Logs of commanded positions are not checked: these may be constant.
    """
    if recording.command is not None:
        return
    tau = recording.tau
    is_constant = np.ptp(tau, axis=0) == 0.0
    is_zero = ~np.any(tau, axis=0) & ~np.all(is_constant)
    unpowered = ", ".join(compress(recording.joint_names, is_zero))
    if unpowered:
        yield (
            "joints without torque in this log, whose equations are left out and whose friction "
            f"is the model's: {unpowered}"
        )
    names = [*compress(recording.joint_names, is_constant & ~is_zero)]
    if names:
        value = "zero" if not np.any(tau) else "the same"
        raise InputError(
            f"the torque of joint {' and '.join(names)} is {value} in every row; record it, or "
            f"name the right column with {option_name('columns', 'FILE')}, or state there that it "
            f"has none: torque.{names[0]} = none"
        )
