"""Text logs as tables: how one is laid out, and its rows as numbers.

Understood without being told: comma, semicolon, tab, bar or blanks between cells, a decimal comma
where the separator is not one, comment lines (``#`` or ``%``), a byte-order mark, UTF-16, Windows
line ends, quoted cells, a header that is itself the last comment line (as ``numpy.savetxt``
writes it), and times such as 2024-05-01T12:00:00.005Z or 12:00:00.005. NumPy reads the rows; only a
block with a row that NumPy refuses is read cell by cell.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from io import TextIOWrapper
from pathlib import Path

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.column_map import ColumnChoices
from robot_sysid.logs.table import DATE, Asked, Block, LogTable, nanoseconds
from robot_sysid.records import Array, Measurement
from robot_sysid.records.atomic_files import whole_file

_MISSING = frozenset({"", "nan", "null", "none", "na", "n/a", "-nan", "-", "missing"})
_SEPARATORS = {";": "semicolon", "\t": "tab", "|": "bar", ",": "comma", " ": "blanks"}
# Characters of a line beyond which it is no row of a table; csv refuses cells of 131072.
_LONGEST_LINE = 100_000
PIECE = 1_000_000
"""Characters of a log that are in memory as lines at a time."""
# How a line begins that may be empty or a comment.
_NO_ROW = frozenset({"", *" \t\v\f#%"})
# Control characters, and their share at the beginning of a file that makes it no text: a few may
# be a serial port's noise.
_CONTROL = bytes({*range(32)} - {*b"\t\n\v\f\r"})
_BINARY = 0.05


@dataclass(frozen=True)
class Dialect:
    """Layout of one text log.

    Attributes:
        separator: "," ";" tab, "|", or " " for any run of blanks.
        header: column titles as written; empty where the file has none.
        header_line: file line of the header; 0 where it has none, or in a comment.
    """

    path: Path
    encoding: str
    separator: str
    header: tuple[str, ...]
    header_line: int
    first_row: tuple[str, ...]
    quoted: bool

    @property
    def titles(self) -> tuple[str, ...]:
        """The header, or the numbers of the columns."""
        return self.header or tuple(f"#{k + 1}" for k in range(len(self.first_row)))

    def cells(self, line: str) -> list[str]:
        """Return the cells of a row, without an empty one behind a last separator."""
        cells = split_line(line, self.separator)
        return (
            cells[:-1]
            if len(cells) == len(self.titles) + 1 and not cells[-1]
            else cells
        )


def text_table(asked: Asked) -> LogTable:
    """Return a file as a table of text."""
    dialect = read_dialect(asked.path, asked.start)
    layout = (
        f"{len(dialect.titles)} columns separated by {_SEPARATORS[dialect.separator]}"
    )
    comma = any("," in cell and is_number(cell) for cell in dialect.first_row)
    layout += ", decimal comma" * comma
    layout += ", titles in a comment line" * bool(
        dialect.header and not dialect.header_line
    )
    layout += ", time in dates" * any(
        DATE.fullmatch(cell) for cell in dialect.first_row
    )
    is_franka = {"time", "state.q[0]", "state.tau_J[0]"} <= set(dialect.header)
    layout = "libfranka's logToCSV, time in ms, " * is_franka + layout
    choices = ColumnChoices(time_unit="ms" if is_franka else None)
    read = partial(_blocks, dialect)
    return LogTable(
        asked.path, layout, dialect.titles, read, choices, "line", dialect.first_row
    )


def read_dialect(path: Path, start: bytes) -> Dialect:
    """Look at the beginning of a log, and its first bytes, and return its layout."""
    encoding = "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    control = len(start) - len(start.translate(None, _CONTROL))
    if encoding != "utf-16" and control > _BINARY * len(start):
        raise InputError(
            f"{path} is of no form that is known, and not a text file; export CSV"
        )
    above, lines = _beginning(path, encoding)
    if not lines:
        raise InputError(
            f"{path} holds no rows of a table; check that the recording was written"
        )
    (number, first) = lines[0]
    last = lines[-1][1]
    separator = next((mark for mark in _SEPARATORS if mark in first), " ")
    header, row = (_without_gap(split_line(line, separator)) for line in (first, last))
    if not header or not row:
        raise InputError(f"{path} does not begin with a table of text; export CSV")
    if _mostly_numbers(header):
        number = 0
        last = first
        row = header
        header = _commented_header(above, len(row))
    elif len(lines) < 2:
        raise InputError(
            f"{path} has a header but no rows; check that the recording ran"
        )
    return Dialect(path, encoding, separator, header, number, row, '"' in last)


def split_line(line: str, separator: str) -> list[str]:
    """Return the cells of a line, without quotes and surrounding blanks; nothing for no text."""
    single = " ".join(line.split()) if separator == " " else line
    try:
        cells = next(
            csv.reader([single], delimiter=separator, skipinitialspace=True), []
        )
    except csv.Error:
        return []
    return [cell.strip() for cell in cells]


def is_number(cell: str) -> bool:
    """Return whether a cell holds a number, or is marked empty."""
    with contextlib.suppress(ValueError):
        _number(cell)
        return True
    return False


def _number(cell: str, start: str = "") -> float:
    """Return the value of a cell, NaN where it is empty or marked missing, or ValueError; of a date
    the time since another one [s]. A comma in a cell is a decimal one.
    """
    if cell.lower() in _MISSING:
        return float("nan")
    if ":" in cell:
        return 1e-9 * (nanoseconds(cell) - _start(start))
    return float(cell.replace(",", "."))


@functools.lru_cache(maxsize=1)
def _start(cell: str) -> int:
    return nanoseconds(cell) if DATE.fullmatch(cell) else 0


def _pieces(
    path: Path, encoding: str, most: int
) -> Iterator[tuple[int, list[str], float]]:
    """Yield (number of the first line, lines, share of the file read by then), so many characters
    at a time, to the end of a line; of a line that no table has, the beginning.
    """
    size = max(1, path.stat().st_size)
    number = 1
    # Titles may hold a degree sign in any encoding; numbers never do, so replacing is harmless.
    with (
        path.open("rb") as binary,
        TextIOWrapper(binary, encoding, errors="replace") as stream,
    ):
        while text := stream.read(most):
            rest = "" if text.endswith("\n") else stream.readline(_LONGEST_LINE)
            text += rest
            while len(rest) == _LONGEST_LINE and not rest.endswith("\n"):
                rest = stream.readline(_LONGEST_LINE)
            lines = [
                line[:_LONGEST_LINE] for line in text.removesuffix("\n").split("\n")
            ]
            yield number, lines, binary.tell() / size
            number += len(lines)


def _beginning(path: Path, encoding: str) -> tuple[str, list[tuple[int, str]]]:
    """Return the line above the first row, and the first two rows with their line numbers."""
    above = ""
    rows = []
    pieces = _pieces(path, encoding, _LONGEST_LINE)
    for number, text in (
        each for first, lines, _ in pieces for each in enumerate(lines, first)
    ):
        if not _is_comment(text) and _is_text(text):
            rows.append((number, text))
            if len(rows) == 2:
                break
        elif text.strip() and not rows:
            above = text.strip()
    return above, rows


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(("#", "%"))


def _is_text(line: str) -> bool:
    """Return whether a line may be a row of a table; one without text is none."""
    plain = (
        not any(mark < " " and mark != "\t" for mark in line)
        and "\ufffd" not in line[80:]
    )
    return len(line) < _LONGEST_LINE and plain and bool(line.strip())


def _commented_header(above: str, width: int) -> tuple[str, ...]:
    text = above.lstrip("#% ")
    marks = (next((mark for mark in _SEPARATORS if mark in text), " "), " ")
    rows = (_without_gap(split_line(text, mark)) for mark in marks)
    return next(
        (row for row in rows if len(row) == width and not _mostly_numbers(row)), ()
    )


def _without_gap(cells: Sequence[str]) -> tuple[str, ...]:
    """Return the cells without an empty one behind a last separator."""
    return tuple(cells[:-1] if len(cells) > 1 and not cells[-1] else cells)


def _mostly_numbers(cells: Sequence[str]) -> bool:
    # A row of data may carry a joint's name or a frame, a header may have a title like "1".
    return 2 * sum(is_number(cell) for cell in cells) > len(cells)


def _blocks(dialect: Dialect, columns: Sequence[int]) -> Iterator[Block]:
    for first, lines, done in _pieces(dialect.path, dialect.encoding, PIECE):
        numbers: Sequence[int] = range(first, first + len(lines))
        texts: Sequence[str] = lines
        # A look at the first characters tells of most pieces that every line is a row.
        if dialect.header_line in numbers or not _NO_ROW.isdisjoint(
            line[:1] for line in lines
        ):
            rows = [
                (number, line)
                for number, line in zip(numbers, lines)
                if number != dialect.header_line
                and line.strip()
                and not _is_comment(line)
            ]
            if not rows:
                continue
            numbers, texts = zip(*rows)
        cells = _fast(dialect, columns, texts)
        complaint = ""
        if cells is None:
            cells = np.full((len(texts), len(columns)), np.inf)
            for number, text, row in zip(numbers, texts, cells):
                wrong = _read_row(dialect, columns, text, row)
                complaint = complaint or (wrong and f"line {number}{wrong}")
        yield Block(np.array(numbers), cells, complaint, done=done)


def _fast(
    dialect: Dialect, columns: Sequence[int], texts: Sequence[str]
) -> Array | None:
    """Parse rows with numpy; None where a row needs a closer look."""
    if dialect.quoted:
        return None
    mark = None if dialect.separator == " " else dialect.separator
    first = dialect.first_row
    if mark != ",":
        texts = [text.replace(",", ".") for text in texts]
    dates = [k for k in columns if k < len(first) and ":" in first[k]]
    # A type of all columns, unlike a choice of some, refuses rows with more or fewer cells.
    kinds = [("", float if k in columns else "U1") for k in range(len(dialect.titles))]
    try:
        if dates:
            rows = [text.split(mark) for text in texts]
            for row, k in itertools.product(rows, dates):
                row[k] = repr(_number(row[k].strip(), first[k]))
            texts = [(mark or " ").join(row) for row in rows]
        read = np.loadtxt(texts, kinds, delimiter=mark, comments=None, ndmin=1)
    except (ValueError, IndexError):
        return None
    # Lines of odd blanks alone are no rows to numpy.
    whole = len(read) == len(texts)
    return np.column_stack([read[f"f{k}"] for k in columns]) if whole else None


def _read_row(dialect: Dialect, columns: Sequence[int], text: str, row: Array) -> str:
    """Read the wanted cells of a line into a row (C,), or return why it is none of numbers."""
    cells = dialect.cells(text)
    titles = dialect.titles
    if len(cells) != len(titles):
        return f": {len(cells)} cells instead of {len(titles)}"
    try:
        for place, at in enumerate(columns):
            start = dialect.first_row[at] if at < len(dialect.first_row) else ""
            row[place] = _number(cells[at], start)
    except ValueError:
        return f", column {titles[at]!r}: {cells[at][:40]!r} is not a number"
    return ""


_WRITTEN = {"position": "q", "velocity": "qd", "torque": "tau", "acceleration": "qdd"}
_WRITTEN["time"] = "joint_time"
"""Quantity, as titles end in it, to attribute of a measurement."""


def write_measurement_csv(
    path: Path, joint_names: Sequence[str], chunks: Iterable[Measurement]
) -> None:
    """Write samples in the form ``open_log`` reads, with every digit; the file appears whole.

    Columns are called ``<joint>_position`` and so on.
    """
    with whole_file(path) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        there: dict[str, str] = {}
        for chunk in chunks:
            if not there:
                there = {
                    n: a for n, a in _WRITTEN.items() if getattr(chunk, a) is not None
                }
                titles = [f"{joint}_{name}" for name in there for joint in joint_names]
                writer.writerow(
                    ["time", *(re.sub(r"[\r\n]", " ", title) for title in titles)]
                )
            values = [getattr(chunk, attribute) for attribute in there.values()]
            writer.writerows(
                map(repr, r) for r in np.column_stack((chunk.time, *values)).tolist()
            )
        if not there:
            raise InputError("there are no samples to write")
