"""Tables of text, also those in which a row is not one instant with one number per cell.

A cell may hold a list, as pandas and SAGE write it; a row may be a message, as ``ros2 topic echo``
prints it in CSV; and a row may hold one signal or one joint of an instant (long form).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.arrays import array_blocks
from robot_sysid.logs.states import named_rows, states_table
from robot_sysid.logs.table import LogTable
from robot_sysid.logs.text import Dialect, parse_cell, plain_table, read_dialect
from robot_sysid.logs.titles import read_title


def text_table(path: Path, *_: Any) -> LogTable:
    """Return a text file as a table; lists in cells become columns, rows of signals are pivoted."""
    dialect = read_dialect(path)
    titles = dialect.titles
    if any(cell.startswith(("[", "(")) for cell in dialect.first_row):
        states = named_rows(path, titles, dialect.rows())
        return states_table(path, "lists of numbers in cells", states)
    if titles[0] == "#1" and _echo_state(dialect.first_row):
        messages = map(_echo_state, dialect.rows())
        return states_table(path, "ros2 topic echo in CSV", messages, "message")
    return _long_table(dialect) or plain_table(dialect)


def _echo_state(cells: Sequence[str]) -> Mapping[str, Any]:
    """Return the JointState in a line of ``ros2 topic echo`` in CSV; {} for another line.

    The line has seconds, nanoseconds, frame, the joints' names, and three numbers for each.
    """
    if not re.fullmatch(r"\d+,\d+", ",".join(cells[:2])):
        return {}
    count, remainder = divmod(len(cells) - 3, 4)
    if remainder or not count:
        return {}
    names, *numbers = (
        [*cells[start : start + count]] for start in range(3, len(cells), count)
    )
    stamp = {"sec": cells[0], "nanosec": cells[1]}
    lists = zip(("position", "velocity", "effort"), numbers)
    return {"header": {"stamp": stamp}, "name": names, **dict(lists)}


# Title of a column that names the signal or the joint of its row.
_NAMING = re.compile(
    r"(joint|motor|axis|actuator|dof|signal|topic|series|channel|variable|quantity|field|key|name|"
    r"label|metric|measurement)s?[ _-]*(name|id|index|number|no)?",
    re.IGNORECASE,
)
# Title of a column of numbers that the row's name says all about.
_VALUE = re.compile(r"values?|data|number", re.IGNORECASE)


def _long_table(dialect: Dialect) -> LogTable | None:
    """Return a table that has a row per signal, or per joint, and instant with a row per instant.

    Rows of one instant have one time, or each has its own and signals follow each other in turn.

    Returns:
        The table, or None where the file has another form.

    Raises:
        InputError: signals have several values at one time.
    """
    titles = dialect.titles
    columns = range(len(titles))
    naming = [k for k in columns if _NAMING.fullmatch(titles[k])]
    times = [k for k in columns if read_title(titles[k]).quantity == "time"]
    measured = [k for k in columns if k not in (*naming, *times)]
    if not naming or len(times) != 1 or not measured:
        return None
    names = []
    numbers = []
    for name, row in _long_rows(dialect, naming, [*times, *measured]):
        names.append(name)
        numbers.append(row)
    keys, first_rows, codes = np.unique(names, return_index=True, return_inverse=True)
    time, *values = np.array(numbers).T
    instants, rows = np.unique(time, return_inverse=True)
    counts = np.bincount(codes)
    n_rows = len(instants)
    stamps = []
    if n_rows > 0.9 * len(time):
        if np.ptp(counts) > 1 or len(keys) < 2:
            return None
        rows = np.zeros(len(time), int)
        for code, count in enumerate(counts):
            rows[codes == code] = np.arange(count)
        n_rows = max(counts)
        instants = np.full(n_rows, np.nan)
        first = codes == np.argmin(first_rows)
        instants[rows[first]] = time[first]
        values.append(time)
        stamps = ["time"]
    cells = np.full((n_rows, len(keys), len(values)), np.nan)
    for index, column in enumerate(values):
        cells[rows, codes, index] = column
    repeated = len(time) - len({*zip(rows.tolist(), codes.tolist())})
    if repeated > 0.05 * len(time):
        raise InputError(
            f"{dialect.path} has a row per signal, and {repeated} rows repeat the time and name of "
            "another one; give each recording a file of its own"
        )
    endings = [f"/{titles[k]}" for k in measured] + [f"/{word}" for word in stamps]
    if len(measured) == 1 and _VALUE.fullmatch(titles[measured[0]]):
        endings[0] = ""
    columns_of = [f"{key}{ending}" for key in keys.tolist() for ending in endings]
    blocks = partial(array_blocks, [instants, cells.reshape(n_rows, -1)])
    layout = f"a row per signal and instant, {len(keys)} signals"
    return LogTable(dialect.path, layout, (titles[times[0]], *columns_of), blocks)


def _long_rows(
    dialect: Dialect, naming: Sequence[int], columns: Sequence[int]
) -> Iterator[tuple[str, list[float]]]:
    """Yield (name, numbers in these columns) of each row; what is no number is NaN."""
    for cells in dialect.rows():
        if len(cells) == len(dialect.titles):
            name = "/".join(cells[k] for k in naming)
            yield name, [_number(cells[k]) for k in columns]


def _number(cell: str) -> float:
    """Return the number in a cell, or NaN."""
    try:
        return parse_cell(cell)
    except ValueError:
        return np.nan
