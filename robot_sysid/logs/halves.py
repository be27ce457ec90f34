"""Logs of which positions and torques lie in files of their own, joined to one table.

Two files with times are joined by time, others row by row. Where the titles of a file say no
quantity, its name does: ``q.csv`` and ``current_mA.csv`` may both have the columns j1 to j6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.column_map import ColumnFinder
from robot_sysid.logs.declarations import ColumnChoices
from robot_sysid.logs.table import LARGEST_NUMBER, LogTable, make_table
from robot_sysid.logs.text import is_empty
from robot_sysid.logs.titles import read_title
from robot_sysid.records import Array, Column, ColumnMap, RobotModel
from robot_sysid.signals.resampling import bridged_hole, sampling_period

SAME_TIME = 0.01
"""Share of a step by which time stamps of one instant may differ."""
SAME_RATE = 0.95, 1.05
"""Ratios of sampling periods between which torques may be interpolated at other instants."""
LEAST_COMMON = 0.5
"""Share of the shorter file that both have to last together."""
FILE_QUANTITIES = ("position", "velocity", "torque", "current", "command")
"""Quantities that a file's name may say of its columns."""
LEAST_OF_EACH = 0.05
"""Share of rows with positions, and of those with torques, of a table in which they are apart, and
with both at most."""
FEWEST_ROWS = 10
"""Rows below which a file has no times to join it by."""


@dataclass(frozen=True, eq=False)
class Half:
    """A log as a table, its column of time, and the indices of others; empty for none.

    Velocities are with positions.
    """

    table: LogTable
    time: Sequence[Column]
    position: Sequence[int]
    torque: Sequence[int]


def join_halves(
    tables: Sequence[LogTable], robot: RobotModel, choices: ColumnChoices
) -> list[LogTable]:
    """Return tables, with each file of positions alone joined with the file of its torques.

    The first file of positions belongs to the first of torques, and so on.

    Args:
        tables: of the files, in the order in which the user gave them.
        robot: the arm.
        choices: declarations, which outrank the titles.

    Raises:
        InputError: the numbers of files differ, or two of them cannot be joined.
    """
    if not (choices.of("position") or choices.of("torque")):
        tables = [_named_by_file(table, robot) for table in tables]
    halves = [_find(table, robot, choices) for table in tables]
    positions = [half for half in halves if half.position and not half.torque]
    torques = [half for half in halves if half.torque and not half.position]
    if not positions or not torques:
        return [*tables]
    if len(positions) != len(torques):
        groups = [[str(half.table) for half in group] for group in (positions, torques)]
        raise InputError(
            "the first file of positions belongs to the first file of torques, and so on, but "
            f"their numbers differ: {'; '.join(map(', '.join, groups))}"
        )
    joined = []
    for half in halves:
        if half in positions:
            joined.append(join_pair(half, torques[positions.index(half)]))
        elif half not in torques:
            joined.append(half.table)
    return joined


def _named_by_file(table: LogTable, robot: RobotModel) -> LogTable:
    """Return a table with the quantity and unit of its file's name in the titles of its columns, if
    these say no quantity but the time.
    """
    file_title = read_title(table.path.stem)
    quantity = file_title.likely_quantity
    said = {
        read_title(text, robot.joint_names).likely_quantity for text in table.titles
    }
    if quantity not in FILE_QUANTITIES or not said <= {None, "time"}:
        return table
    texts = [*table.titles]
    if texts == [f"#{k}" for k in range(1, len(texts) + 1)]:
        # Numbers of columns become those of joints, behind a time if there is one column more.
        has_time = len(texts) == robot.n_joints + 1
        if has_time and not np.all(np.diff(table.cells([0])[:, 0]) > 0.0):
            return table
        texts = ["time"] * has_time + [
            f"{k}" for k in range(1, len(texts) + 1 - has_time)
        ]
    unit = f" [{file_title.unit}]" if file_title.unit else ""
    titles = [
        text if read_title(text).quantity == "time" else f"{text} {quantity}{unit}"
        for text in texts
    ]
    note = f"columns of {table} are taken for what its name says: {quantity}{unit}"
    return replace(table, titles=tuple(titles), notes=(*table.notes, note))


def _find(table: LogTable, robot: RobotModel, choices: ColumnChoices) -> Half:
    """Return which columns of a table are positions, torques and time."""
    stated = replace(choices.over(table.choices), currents=False)
    finder = ColumnFinder(table, robot, stated)

    def indices(key: str, *others: str) -> list[int]:
        """Return the columns of a quantity, as it is declared, or else as titles name it or one of
        others; none where joints lack theirs.
        """
        if choices.of(key):
            # What is declared of the other file is not in this one, and a joint without torque has
            # no column.
            columns = finder.recognise(key)
            return [column.index for column in columns if column.factor]
        quantities = [title.quantity_beside_name for title in finder.titles]
        found = [k for k, q in enumerate(quantities) if q in (key, *others)]
        return found if len(found) >= robot.n_joints else []

    driven = ["command"] if choices.commanded else ["torque", "current"]
    position = indices("position")
    if position:
        position += indices("velocity")
    return Half(table, finder.recognise("time"), position, indices(*driven))


def join_pair(position: Half, torque: Half) -> LogTable:
    """Return the rows of a table of positions beside those of a table of torques."""
    q_time, tau_time = ([c.index for c in half.time] for half in (position, torque))
    q_columns = [*q_time, *position.position]
    tau_columns = [*tau_time, *torque.torque]
    q = position.table.cells(q_columns)
    tau = torque.table.cells(tau_columns)
    how = "row by row"
    if q_time and tau_time:
        # The times of both in the unit of the first, and from one instant on.
        own, other = position.time[0], torque.time[0]
        tau[:, 0] *= other.factor / own.factor
        later = torque.table.seconds_after(other.index, position.table, own.index)
        tau[:, 0] += later / own.factor
        if len(q) != len(tau) or not _are_equal(q[:, 0], tau[:, 0]):
            q, tau, how = _interpolate(position.table, torque.table, q, tau)
        tau, tau_columns = tau[:, 1:], tau_columns[1:]
    elif len(q) != len(tau):
        raise InputError(
            f"{position.table} has {len(q)} rows of positions and {torque.table} {len(tau)} of "
            "torques, and they have no times by which they could be joined; give files of one run, "
            "or write the time into both"
        )
    table = position.table
    # Columns that are not read keep their place: they may list the joints' names.
    cells = np.full((len(q), len(table.titles)), np.nan)
    cells[:, q_columns] = q
    note = (
        f"positions of {table} and torques of {torque.table} are one log, joined {how}"
    )
    torque_titles = [torque.table.titles[k] for k in tau_columns]
    joined = make_table(
        table.path,
        table.layout,
        [*zip(table.titles, cells.T), *zip(torque_titles, tau.T)],
        first_row=table.first_row and (*table.first_row, *[""] * len(tau_columns)),
        choices=table.choices.over(torque.table.choices),
        notes=(*table.notes, *torque.table.notes, note),
        starts=table.starts,
    )
    return replace(joined, setting=torque.table.setting.over(table.setting))


def join_rows(table: LogTable, columns: ColumnMap) -> LogTable:
    """Return a table whose rows hold positions or torques, and hardly ever both, as where two
    topics were written below each other, with the torques at the times of the positions. Another
    table is returned as it is.
    """
    if columns.time is None or columns.joint_time or columns.commanded:
        return table
    time = columns.time.index
    position = [column.index for column in columns.position if column.factor]
    torque = [column.index for column in columns.torque if column.factor]
    # Messages, and rows of arrays, hold all of an instant.
    row = table.first_row
    is_whole = not any(is_empty(row[k]) for k in (*position, *torque) if row)
    if is_whole and (row or table.row_noun != "state"):
        return table
    first = np.isfinite(table.cells([*position, *torque], 1))
    has_q = first[:, : len(position)].all(axis=1)
    has_tau = first[:, len(position) :].all(axis=1)
    least = LEAST_OF_EACH * len(first)
    is_apart = min(np.sum(has_q), np.sum(has_tau)) > least > np.sum(has_q & has_tau)
    if not is_apart:
        return table
    q = table.cells([time, *position])
    tau = table.cells([time, *torque])
    q, tau, how = _interpolate(table, table, q, tau)
    cells = np.full((len(q), len(table.titles)), np.nan)
    cells[:, [time, *position]] = q
    cells[:, torque] = tau[:, 1:]
    note = f"positions and torques are in rows of their own, and are joined {how}"
    arrays = zip(table.titles, cells.T)
    joined = make_table(table.path, table.layout, arrays, first_row=table.first_row)
    notes = (*table.notes, note)
    return replace(joined, notes=notes, choices=table.choices, starts=table.starts)


def _are_equal(times: Array, others: Array) -> bool:
    """Return whether two arrays of times (N,) deviate by less than a hundredth of their step."""
    if not np.isfinite([times, others]).all():
        return False
    return bool(np.max(np.abs(times - others)) < SAME_TIME * sampling_period(times))


def _interpolate(
    position: LogTable, torque: LogTable, q: Array, tau: Array
) -> tuple[Array, Array, str]:
    """Return rows of positions and of torques at the same instants, and how torques were found.

    Args:
        position, torque: the tables, for messages.
        q, tau: their rows, with time in front.

    Raises:
        InputError: they have other sampling rates, or hardly overlap in time.
    """
    from scipy.interpolate import CubicSpline

    q, tau = (_increasing_rows(cells) for cells in (q, tau))
    if min(len(q), len(tau)) < FEWEST_ROWS:
        raise InputError(f"{position} and {torque} have too few rows with times")
    start = max(q[0, 0], tau[0, 0])
    end = min(q[-1, 0], tau[-1, 0])
    lasting = [f"from {cells[0, 0]:.6g} to {cells[-1, 0]:.6g}" for cells in (q, tau)]
    if end - start < LEAST_COMMON * min(np.ptp(q[:, 0]), np.ptp(tau[:, 0])):
        raise InputError(
            f"{position} lasts {lasting[0]} and {torque} {lasting[1]}: less than half is common "
            "to both; give files of one run with times of one clock"
        )
    periods = [sampling_period(cells[:, 0]) for cells in (q, tau)]
    if not SAME_RATE[0] < periods[0] / periods[1] < SAME_RATE[1]:
        raise InputError(
            f"{position} has a row each {periods[0]:.4g} and {torque} each {periods[1]:.4g} of "
            "time, which cannot be joined; export both at one rate"
        )
    is_common = (q[:, 0] >= start) & (q[:, 0] <= end)
    common = q[is_common]
    values = CubicSpline(tau[:, 0], tau)(common[:, 0])
    # Nothing is known within a hole.
    hole = bridged_hole(tau[:, 0], common[:, 0], 1.0 / periods[1])
    values[hole > 0.0] = np.nan
    how = (
        "by time: torques are interpolated at the times of positions, which both have in "
        f"{len(common)} of {len(q)} rows"
    )
    return common, values, how


def _increasing_rows(cells: Array) -> Array:
    """Return the rows of numbers that are later than all before; time is their first column."""
    rows = cells[(np.abs(cells) < LARGEST_NUMBER).all(axis=1)]
    is_later = np.diff(np.maximum.accumulate(rows[:, 0]), prepend=-np.inf) > 0.0
    return rows[is_later]
