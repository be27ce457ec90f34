"""Text logs as tables; what is no row of numbers is left out and told."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.column_map import ColumnChoices, Units
from robot_sysid.logs.formats import table
from robot_sysid.logs.formats.dialect import SEPARATOR_NAMES, LogDialect, read_dialect, split_line
from robot_sysid.logs.formats.table import NO_LINES, Asked, Block, LogTable, renamed
from robot_sysid.records import Array

Batch = list[tuple[int, str]]


def _table(dialect: LogDialect, layout: str, choices: ColumnChoices) -> LogTable:
    titles = dialect.header or tuple(f"#{k + 1}" for k in range(dialect.width))
    read = partial(_blocks, dialect)
    return LogTable(dialect.path, layout, titles, read, choices, "line", dialect.first_row)


def _blocks(dialect: LogDialect, columns: Sequence[int]) -> Iterator[Block]:
    """Yield the rows of a text log in their order, with these columns."""
    rows = dialect.data_lines()
    waiting, read = list(islice(rows, table.BLOCK)), dialect.share_read()
    while waiting:
        batch, done = waiting, read
        waiting, read = list(islice(rows, table.BLOCK)), dialect.share_read()
        cells = _fast(dialect, columns, [text for _, text in batch])
        if cells is None:
            yield replace(_careful(dialect, columns, batch, last=not waiting), done=done)
        else:
            yield Block(np.array([line for line, _ in batch]), cells, done=done)


def _careful(dialect: LogDialect, columns: Sequence[int], batch: Batch, last: bool) -> Block:
    """Parse rows cell by cell; a last row of the file that is cut off is left out."""
    cut_off, end = NO_LINES, dialect.split(batch[-1][1])
    if last and end is not None and len(end) < dialect.width:
        cut_off = np.array([batch[-1][0]])
        batch = batch[:-1]
    parsed = [_row(dialect, columns, text) for _, text in batch]
    lines = np.array([line for line, _ in batch], np.int64)
    nothing = [np.nan] * len(columns)
    cells = np.array([nothing if isinstance(row, str) else row for row in parsed], float)
    bad = [k for k, row in enumerate(parsed) if isinstance(row, str)]
    complaint = f"line {lines[bad[0]]}{parsed[bad[0]]}" if bad else ""
    return Block(lines, cells.reshape(len(batch), len(columns)), lines[bad], cut_off, complaint)


def _row(dialect: LogDialect, columns: Sequence[int], text: str) -> list[float] | str:
    """Return the wanted cells of a line, or why it is no row of numbers."""
    cells = dialect.split(text)
    if cells is None or len(cells) != dialect.width:
        return f": {len(cells or ())} cells instead of {dialect.width}"
    row: list[float] = []
    for index in columns:
        try:
            row.append(dialect.number(cells[index]))
        except ValueError:
            title = dialect.header[index] if dialect.header else f"#{index + 1}"
            return f", column {title!r}: {cells[index][:40]!r} is not a number"
    return row


def _fast(dialect: LogDialect, columns: Sequence[int], texts: list[str]) -> Array | None:
    """Parse rows with numpy; None where a row needs a closer look."""
    mark = None if dialect.separator == " " else dialect.separator
    if dialect.quoted or any(len(text.split(mark)) != dialect.width for text in texts):
        return None
    if dialect.decimal_comma:
        texts = [text.replace(",", ".") for text in texts]
    try:
        return np.loadtxt(texts, delimiter=mark, usecols=list(columns), comments=None, ndmin=2)
    except ValueError:
        return None


def text_table(asked: Asked) -> LogTable | None:
    """Return any other file as a table of text; None for a folder."""
    if asked.path.is_dir():
        return None
    dialect = read_dialect(asked.path)
    header = dialect.header
    if tuple(title.lower() for title in header[:5]) == _SAGE_HEADER:
        return sage_table(dialect, asked.joint_names)
    currents = asked.options.torque_constants is not None
    program, choices = known_text(header, asked.joint_names, currents)
    decimal = ", decimal comma" if dialect.decimal_comma else ""
    commented = ", titles in a comment line" if header and not dialect.header_line else ""
    separator = SEPARATOR_NAMES[dialect.separator]
    layout = f"{dialect.width} columns separated by {separator}{decimal}{commented}"
    return _table(dialect, f"{program}, {layout}" if program else layout, choices)


UR_TORQUE, UR_CURRENT = "actual_current_as_torque", "actual_current"


def known_text(
    titles: Sequence[str], joint_names: Sequence[str], currents: bool
) -> tuple[str, ColumnChoices]:
    """Return (program that wrote the log, what it says of its columns); ("", nothing) if unknown.

    ``currents``: whether torque constants were given, so that currents are wanted.
    """
    if {"time", "state.q[0]", "state.tau_J[0]"} <= set(titles):
        return "libfranka's logToCSV, time in ms", ColumnChoices(units=Units(time="ms"))
    if {"timestamp", "actual_q_0"} <= set(titles):
        return "Universal Robots RTDE record", _rtde(titles, joint_names, currents)
    return "", ColumnChoices()


def _rtde(titles: Sequence[str], joint_names: Sequence[str], currents: bool) -> ColumnChoices:
    """Return the columns of RTDE's fields; ``target_moment`` is computed, not measured."""
    torque = UR_CURRENT if currents else UR_TORQUE
    fields = {"position": "actual_q", "velocity": "actual_qd", "torque": torque}
    columns = {
        quantity: {joint: f"{field}_{k}" for k, joint in enumerate(joint_names)}
        for quantity, field in fields.items()
    }
    there = {q: c for q, c in columns.items() if set(c.values()) <= set(titles)}
    if "torque" not in there:
        raise InputError(
            f"this RTDE recording has no {torque}_0 to {torque}_{len(joint_names) - 1}: "
            "actual_current is in amperes and target_moment is the controller's model, no "
            "measurement; record actual_current_as_torque (PolyScope 5.23 or 10.11 and later), or "
            "record actual_current and give --torque-constants"
        )
    return ColumnChoices(time="timestamp", columns=there)


_SAGE_HEADER = ("type", "timestamp", "positions", "velocities", "torques")
_NAMES_FILE = "joint_list.txt"
# The simulation writes STATE_MOTOR and seconds, the recorder of a real robot StateMotor and us.
_TIMES = {"STATE_MOTOR": "s", "StateMotor": "us"}
_LIST_MARKS = str.maketrans("[],", "   ")


def sage_table(dialect: LogDialect, joint_names: Sequence[str]) -> LogTable:
    """Return a recording of SAGE; the joints' names stand in a file beside it."""
    rows = (split_line(text, ",") for _, text in islice(dialect.data_lines(), table.BLOCK))
    cells = next((row for row in rows if row and row[0] in _TIMES), None)
    if cells is None:
        raise InputError(f"{dialect.path} holds no rows of type {' or '.join(_TIMES)}")
    try:
        count = len([float(cell) for cell in cells[2].translate(_LIST_MARKS).split()])
    except (IndexError, ValueError):
        raise InputError(
            f"{dialect.path}: its first row of type {cells[0]} lists no positions; record it again"
        ) from None
    listed = dialect.path.parent / _NAMES_FILE
    text = listed.read_text("utf-8-sig", errors="replace") if listed.is_file() else ""
    names = [line.strip() for line in text.splitlines() if line.strip()]
    known = [f"{name} " for name in renamed(names, joint_names)] if len(names) == count else []
    titles = ["timestamp"]
    for quantity in ("position", "velocity", "torque"):
        titles += [f"{n}{quantity}" for n in known] or [f"{quantity}[{k}]" for k in range(count)]
    flat = replace(
        dialect, separator=" ", header=tuple(titles), first_row=(), quoted=False, flattened=_states
    )
    units = Units(time=_TIMES[cells[0]])
    return _table(flat, "SAGE state_motor.csv", ColumnChoices(units=units))


def _states(text: str) -> str | None:
    """Return the numbers of a row of measured states between blanks; None for a row of others."""
    cells = split_line(text, ",") or []
    if cells and cells[0] not in _TIMES and len(cells) >= len(_SAGE_HEADER):
        return None
    return " ".join(cells[1 : len(_SAGE_HEADER)]).translate(_LIST_MARKS)
