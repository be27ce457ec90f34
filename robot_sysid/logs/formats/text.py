"""Text logs as tables: how one is laid out, and its rows as numbers.

Understood without being told: comma, semicolon, tab, bar or blanks between cells, a decimal comma
where the separator is not one, comment lines (``#`` or ``%``), a byte-order mark, Windows line
ends, quoted cells, and a header that is itself the last comment line (as ``numpy.savetxt`` writes
it). What is no row of numbers is left out and told.
"""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from io import TextIOWrapper
from itertools import islice
from pathlib import Path

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.column_map import ColumnChoices
from robot_sysid.logs.formats import table
from robot_sysid.logs.formats.table import NO_LINES, Asked, Block, LogTable, renamed
from robot_sysid.records import Array

_COMMENT_MARKS = ("#", "%")
_MISSING = frozenset({"", "nan", "null", "none", "na", "n/a", "-nan", "-", "missing"})
_SEPARATORS = {";": "semicolon", "\t": "tab", "|": "bar", ",": "comma", " ": "blanks"}
_LONGEST_LINE = 100_000
"""Characters of a line beyond which it is no row of a table."""
# Control characters, and their share at the beginning of a file that makes it no text.
_CONTROL = bytes({*range(32)} - {*b"\t\n\v\f\r"})
_BINARY = 0.05
# Lines between two looks at how much of the file was read.
_COUNTED = 1000

Line = tuple[int, str, float]
"""Number of a line in its file, its text, and how much of the file was read by then."""


@dataclass(frozen=True)
class LogDialect:
    """Layout of one log file.

    Attributes:
        separator: "," ";" tab, or " " for any run of blanks.
        header: column titles as written; empty where the file has none.
        header_line: file line of the header; 0 where there is none.
        flattened: makes a row of plain cells of a line; None for a line that is passed over.
    """

    path: Path
    encoding: str
    separator: str
    decimal_comma: bool
    header: tuple[str, ...]
    header_line: int
    first_row: tuple[str, ...]
    quoted: bool
    flattened: Callable[[str], str | None] | None = None

    def split(self, line: str) -> list[str] | None:
        """Return the cells of one line, without quotes, blanks or a trailing separator.

        None where the line is no text of a table.
        """
        cells = split_line(line, self.separator)
        return cells[:-1] if cells and len(cells) == self.width + 1 and not cells[-1] else cells

    @property
    def width(self) -> int:
        """Number of cells a row should have."""
        return len(self.header) or len(self.first_row)

    def data_lines(self) -> Iterator[Line]:
        """Yield each row of data."""
        for number, line, done in _lines(self.path, self.encoding):
            if number != self.header_line and not _is_comment(line):
                row = self.flattened(line) if self.flattened else line
                if row is not None:
                    yield number, row, done


def read_dialect(path: Path, start: bytes) -> LogDialect:
    """Look at the beginning of a log, and its first bytes, and return its layout."""
    encoding = "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    control = len(start) - len(start.translate(None, _CONTROL))
    if encoding != "utf-16" and control > _BINARY * len(start):
        raise InputError(
            f"{path} is of no form that is known, and not a text file; export it as CSV"
        )
    above, lines = _beginning(path, encoding)
    if not lines:
        raise InputError(
            f"{path} holds no rows of a table, a sample per line; check that "
            "the recording was written, or export it as CSV"
        )
    (number, first), last = lines[0], lines[-1][1]
    separator = _separator(first)
    rows = [split_line(line, separator) for line in (first, last)]
    cells, row = (_without_gap(each or []) for each in rows)
    if None in rows:
        raise InputError(f"{path} does not begin with a table of text; export the log as CSV")
    if _mostly_numbers(rows[0] or []):
        number, header, last, row = 0, _commented_header(above, len(cells)), first, cells
    elif len(lines) < 2:
        raise InputError(f"{path} has a header but no rows; check that the recording ran")
    else:
        header = cells
    comma, quoted = separator != "," and "," in last, '"' in last
    return LogDialect(path, encoding, separator, comma, header, number, row, quoted)


def split_line(line: str, separator: str) -> list[str] | None:
    """Return the cells of a line, without quotes and surrounding blanks; None for no text."""
    single = " ".join(line.split()) if separator == " " else line
    try:
        cells = next(csv.reader([single], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return None
    return [cell.strip() for cell in cells]


def _lines(path: Path, encoding: str) -> Iterator[Line]:
    """Yield the lines that are not empty; of one that no table has, the beginning."""
    size, number, done = max(1, path.stat().st_size), 0, 0.0
    # Titles may hold a degree sign in any encoding; numbers never do, so replacing is harmless.
    with path.open("rb") as binary, TextIOWrapper(binary, encoding, errors="replace") as stream:
        while line := stream.readline(_LONGEST_LINE):
            rest, number = line, number + 1
            while len(rest) == _LONGEST_LINE and not rest.endswith("\n"):
                rest = stream.readline(_LONGEST_LINE)
            if number % _COUNTED == 1:
                done = binary.tell() / size
            text = line.strip("\r\n")
            if text and not text.isspace():
                yield number, text, done


def _beginning(path: Path, encoding: str) -> tuple[str, list[tuple[int, str]]]:
    """Return the line above the first row, and the first two rows with their line numbers."""
    above, rows = "", []
    for number, text, _ in _lines(path, encoding):
        if not _is_comment(text) and _is_text(text):
            rows.append((number, text))
            if len(rows) == 2:
                break
        elif not rows:
            above = text.strip()
    return above, rows


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENT_MARKS)


def _is_text(line: str) -> bool:
    plain = not any(mark < " " and mark != "\t" for mark in line) and "\ufffd" not in line[80:]
    return len(line) < _LONGEST_LINE and plain


def _commented_header(above: str, width: int) -> tuple[str, ...]:
    text = above.lstrip("#% ")
    rows = (_without_gap(split_line(text, each) or []) for each in (_separator(text), " "))
    return next((row for row in rows if len(row) == width and not _mostly_numbers(row)), ())


def _separator(line: str) -> str:
    return next((mark for mark in _SEPARATORS if mark in line), " ")


def _without_gap(cells: Sequence[str]) -> tuple[str, ...]:
    """Return the cells without an empty one behind a last separator."""
    return tuple(cells[:-1] if len(cells) > 1 and not cells[-1] else cells)


def _mostly_numbers(cells: Sequence[str]) -> bool:
    # A row of data may carry a joint's name or a frame, a header may have a title like "1".
    return 2 * sum(is_number(cell) for cell in cells) > len(cells)


def is_number(cell: str) -> bool:
    """Return whether a cell holds a number, or is marked empty."""
    with contextlib.suppress(ValueError):
        _number(cell, decimal_comma=True)
        return True
    return False


def _number(cell: str, decimal_comma: bool) -> float:
    """Return the value of a cell, NaN where it is empty or marked missing, or ValueError."""
    if cell.lower() in _MISSING:
        return float("nan")
    return float(cell.replace(",", ".") if decimal_comma else cell)


def _table(dialect: LogDialect, layout: str, choices: ColumnChoices) -> LogTable:
    titles = dialect.header or tuple(f"#{k + 1}" for k in range(dialect.width))
    read = partial(_blocks, dialect)
    return LogTable(dialect.path, layout, titles, read, choices, "line", dialect.first_row)


def _blocks(dialect: LogDialect, columns: Sequence[int]) -> Iterator[Block]:
    rows = dialect.data_lines()
    waiting = list(islice(rows, table.BLOCK))
    while batch := waiting:
        waiting = list(islice(rows, table.BLOCK))
        done = batch[-1][2] if len(batch) == table.BLOCK else 1.0
        cells = _fast(dialect, columns, [text for _, text, _ in batch])
        if cells is None:
            yield replace(_careful(dialect, columns, batch, last=not waiting), done=done)
        else:
            yield Block(np.array([line for line, *_ in batch]), cells, done=done)


def _careful(dialect: LogDialect, columns: Sequence[int], batch: list[Line], last: bool) -> Block:
    """Parse rows cell by cell; a last row of the file that is cut off is left out."""
    cut_off, end = NO_LINES, dialect.split(batch[-1][1])
    if last and end is not None and len(end) < dialect.width:
        cut_off = np.array([batch[-1][0]])
        batch = batch[:-1]
    parsed = [_row(dialect, columns, text) for _, text, _ in batch]
    lines = np.array([line for line, *_ in batch], np.int64)
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
            row.append(_number(cells[index], dialect.decimal_comma))
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
    dialect = read_dialect(asked.path, asked.start)
    header = dialect.header
    if tuple(title.lower() for title in header[:5]) == _SAGE_HEADER:
        return sage_table(dialect, asked.joint_names)
    currents = asked.options.torque_constants is not None
    program, choices = known_text(header, asked.joint_names, currents)
    decimal = ", decimal comma" if dialect.decimal_comma else ""
    commented = ", titles in a comment line" if header and not dialect.header_line else ""
    separator = _SEPARATORS[dialect.separator]
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
        return "libfranka's logToCSV, time in ms", ColumnChoices(time_unit="ms")
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
    rows = (split_line(text, ",") for _, text, _ in islice(dialect.data_lines(), table.BLOCK))
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
    return _table(flat, "SAGE state_motor.csv", ColumnChoices(time_unit=_TIMES[cells[0]]))


def _states(text: str) -> str | None:
    """Return the numbers of a row of measured states between blanks; None for a row of others."""
    cells = split_line(text, ",") or []
    if cells and cells[0] not in _TIMES and len(cells) >= len(_SAGE_HEADER):
        return None
    return " ".join(cells[1 : len(_SAGE_HEADER)]).translate(_LIST_MARKS)
