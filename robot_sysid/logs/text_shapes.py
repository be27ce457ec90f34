"""Tables of text, also those in which a row is not one instant with one number per cell.

A cell may hold a list, as pandas and SAGE write it; a row may be a message, as ``ros2 topic echo``
prints it in CSV; and a row may hold one signal or one joint of an instant (long form).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.states import list_in_cell, named_rows, states_table
from robot_sysid.logs.table import LogTable
from robot_sysid.logs.text import (
    Dialect,
    is_names,
    is_number,
    parse_cell,
    plain_table,
    read_dialect,
)
from robot_sysid.logs.titles import read_title


def text_table(path: Path, joint_names: Sequence[str], *_: Any) -> LogTable:
    """Return a text file as a table; lists in cells become columns, rows of signals are pivoted.

    ``joint_names``: (n,) of the arm.
    """
    dialect = read_dialect(path)
    titles = dialect.titles
    cells = map(list_in_cell, dialect.first_row)
    # A list of names alone is read with the numbers of the titles.
    if any(isinstance(cell, list) and not is_names(cell) for cell in cells):
        states = named_rows(path, titles, dialect.rows())
        return states_table(path, "lists of numbers in cells", states)
    if titles[0] == "#1" and _echo_state(dialect.first_row):
        messages = map(_echo_state, dialect.rows())
        return states_table(path, "ros2 topic echo in CSV", messages, "message")
    quantities = [read_title(title).quantity_beside_name for title in titles]
    if quantities.count("position") < len(joint_names):
        return _long_table(dialect) or plain_table(dialect)
    return plain_table(dialect)


def _echo_state(cells: Sequence[str]) -> Mapping[str, Any]:
    """Return the JointState in a line of ``ros2 topic echo`` in CSV; {} for another line.

    The line has seconds, nanoseconds, frame, the joints' names, and three numbers for each.
    """
    is_stamped = re.fullmatch(r"\d+,\d+", ",".join(cells[:2]))
    if not is_stamped or len(cells) < 7 or len(cells) % 4 != 3:
        return {}
    lists = np.reshape(cells[3:], (4, -1)).tolist()
    stamp = {"sec": cells[0], "nanosec": cells[1]}
    message = dict(zip(("name", "position", "velocity", "effort"), lists))
    return {"header": {"stamp": stamp}, **message}


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

    Rows of one instant have one time; or each has its own, and signals follow each other in turn.

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
    (time_column,) = times
    time_title = titles[time_column]
    # Name and cells of each row.
    rows = []
    for cells in dialect.rows():
        if len(cells) == len(titles) and is_number(cells[time_column]):
            rows.append(("/".join(cells[k] for k in naming), cells))
    counts = Counter(name for name, _ in rows)
    instants = {cells[time_column] for _, cells in rows}
    # Nearly all times are there once.
    in_turn = len(instants) > 0.9 * len(rows)
    if in_turn and (len(counts) < 2 or max(counts.values()) > min(counts.values()) + 1):
        return None
    is_value = len(measured) == 1 and _VALUE.fullmatch(titles[measured[0]])
    states: dict[Any, dict[str, str]] = {}
    read: Counter[str] = Counter()
    repeated = 0
    for name, cells in rows:
        time = cells[time_column]
        state = states.setdefault(read[name] if in_turn else time, {time_title: time})
        read[name] += 1
        row = {name if is_value else f"{name}/{titles[k]}": cells[k] for k in measured}
        repeated += row.keys() <= state.keys()
        state.update(row)
        if in_turn:
            state[f"{name}/time"] = time
    if repeated > 0.05 * len(rows):
        raise InputError(
            f"{dialect.path} has a row per signal, and {repeated} rows repeat the time and name of "
            "another one; give each recording a file of its own"
        )
    layout = f"a row per signal and instant, {len(counts)} signals"
    ordered = sorted(states.values(), key=lambda state: parse_cell(state[time_title]))
    return states_table(dialect.path, layout, ordered)
