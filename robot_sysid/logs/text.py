"""Text logs as tables, and samples as a text log.

Recognised without being declared: comma, semicolon, tab, bar or blanks between cells, a decimal
comma where the separator is another character, comment lines (``#`` or ``%``), a byte-order mark,
UTF-16, Latin-1, Windows line ends, quoted cells, a header that is itself the last comment line (as
``numpy.savetxt`` writes it), and times such as 2024-05-01T12:00:00.005Z or 12:00:00.005.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.declarations import ColumnChoices
from robot_sysid.logs.table import LATER, Block, LogTable, make_table
from robot_sysid.records import Array, Recording
from robot_sysid.records.file_access import atomic_file

# Texts, in lower case, of cells that count as empty.
_EMPTY = frozenset({"", "nan", "null", "none", "na", "n/a", "-nan", "-", "missing"})
# Separator to its name in messages, in the order in which a line is searched for them.
_SEPARATORS = {";": "semicolon", "\t": "tab", "|": "bar", ",": "comma", " ": "blanks"}
# Number of characters from which on a line is no row of a table; csv refuses cells of 131072.
_LONGEST_LINE = 100_000
# Characters that no line of text holds.
_BINARY = re.compile(r"[\0-\x08\x0b-\x1f]")
# Characters with which a comment line begins.
_COMMENT = ("#", "%")


@dataclass(frozen=True)
class Dialect:
    """Layout of one text log.

    Attributes:
        path: of the file.
        encoding: of the file, as Python calls it.
        separator: "," ";" tab, "|", or " " for any run of blanks.
        titles: of the columns, as written; "#1", "#2", ... where the file has none.
        header_line: file line of the header; 0 where it has none, or in a comment.
        first_row: the cells of the first row of data, as many as titles; "" for missing ones.
        chunk_size: number of characters that are in memory as lines at a time.
    """

    path: Path
    encoding: str
    separator: str
    titles: tuple[str, ...]
    header_line: int
    first_row: tuple[str, ...]
    chunk_size: int = 1_000_000

    @property
    def starts(self) -> dict[str, int]:
        """Title of each column of dates to the first of them, see ``LogTable``."""
        return {
            title: int(_date(cell).astype(np.int64))
            for title, cell in zip(self.titles, self.first_row)
            if _DATE.fullmatch(cell)
        }

    def blocks(self, columns: Sequence[int]) -> Iterator[Block]:
        """Yield the rows of a log, with the columns of these indices; dates as seconds."""
        for first, lines, share in self._lines():
            cells = self._read_plain_rows(lines)
            if cells is not None:
                line_numbers = np.arange(first, first + len(cells))
                yield Block(line_numbers, cells[:, list(columns)], "", share)
                continue
            rows = {}
            complaint = ""
            for number, line in enumerate(lines, first):
                if not _may_be_row(line):
                    continue
                try:
                    rows[number] = self._read_row(columns, line)
                except ValueError as error:
                    rows[number] = [np.inf] * len(columns)
                    complaint = complaint or f"line {number}{error}"
            if rows:
                cells = np.array([*rows.values()])
                yield Block(np.array([*rows]), cells, complaint, share)

    def rows(self) -> Iterator[list[str]]:
        """Yield the cells of each row as text, also of rows that have not a cell per title."""
        for _, lines, _ in self._lines():
            for line in filter(_may_be_row, lines):
                yield split_line(line, self.separator)

    def _lines(self) -> Iterator[tuple[int, list[str], float]]:
        """Yield the lines below the header, see ``_read_lines``."""
        return _read_lines(self.path, self.encoding, self.chunk_size, self.header_line)

    def _read_plain_rows(self, lines: Sequence[str]) -> Array | None:
        """Return the cells (R, C) of lines that are all rows of plain numbers, else None.

        That is several times as fast as ``_read_row``.
        """
        delimiter = self.separator.strip(" ") or None
        try:
            cells = np.loadtxt(lines, delimiter=delimiter, comments=None, ndmin=2)
        except ValueError:
            return None
        return cells if cells.shape == (len(lines), len(self.titles)) else None

    def _read_row(self, columns: Sequence[int], line: str) -> list[float]:
        """Return the numbers of a row in the columns of these indices.

        ValueError, with the fault as it follows the line's number, where the row is not numbers.
        """
        titles = self.titles
        texts = split_line(line, self.separator)
        # A row may end in a separator.
        if len(texts) != len(titles) and texts[len(titles) :] != [""]:
            raise ValueError(f": {len(texts)} cells instead of {len(titles)}")
        row = []
        for column in columns:
            try:
                row.append(parse_cell(texts[column], self.first_row[column]))
            except ValueError:
                fault = f"{texts[column][:40]!r} is not a number"
                raise ValueError(f", column {titles[column]!r}: {fault}") from None
        return row


def plain_table(dialect: Dialect) -> LogTable:
    """Return a text file with a number in each cell as a table."""
    separator = _SEPARATORS[dialect.separator]
    layout = f"{len(dialect.titles)} columns separated by {separator}"
    choices = ColumnChoices()
    if {"time", "state.q[0]", "state.tau_J[0]"} <= set(dialect.titles):
        layout = f"libfranka's logToCSV, time in ms, {layout}"
        choices = ColumnChoices(time_unit="ms")
    return make_table(
        dialect.path,
        layout,
        [(title, LATER) for title in dialect.titles],
        blocks=dialect.blocks,
        choices=choices,
        row_noun="line",
        first_row=dialect.first_row,
        starts=dialect.starts,
    )


def read_dialect(path: Path) -> Dialect:
    """Return the layout of a log by its first lines; InputError where it is no text table."""
    with path.open("rb") as stream:
        first_bytes = stream.read(4096)
    is_utf16 = first_bytes.startswith((b"\xff\xfe", b"\xfe\xff"))
    encoding = "utf-16" if is_utf16 else "utf-8-sig"
    try:
        # The last line may be cut off within a character.
        first_bytes.rpartition(b"\n")[0].decode(encoding)
    except UnicodeDecodeError:
        encoding = "utf-16" if is_utf16 else "cp1252"
    comment, lines = _read_beginning(path, encoding)
    is_text = is_utf16 or b"\0" not in first_bytes
    if not (lines and is_text):
        raise InputError(
            f"{path} is of no form that is known, and holds no rows of a table of text; export "
            "CSV, and check that the recording was written"
        )
    # The header and the first row of data, unless the header is missing or a comment.
    header_line, header_text = lines[0]
    _, row_text = lines[-1]
    separator = _find_separator(header_text)
    titles = _split_first(header_text, separator)
    row = _split_first(row_text, separator)
    if is_row(titles):
        header_line = 0
        row = titles
        numbered = tuple(map("#{}".format, range(1, len(row) + 1)))
        titles = _header_in_comment(comment, len(row)) or numbered
    elif len(lines) < 2:
        raise InputError(
            f"{path} has a header but no rows; check that the recording ran"
        )
    # As many cells as titles, though the first row may have another number.
    cells = (*row, *[""] * len(titles))[: len(titles)]
    return Dialect(path, encoding, separator, titles, header_line, cells)


def _find_separator(line: str) -> str:
    """Return the first separator of ``_SEPARATORS`` that a line holds, else a blank."""
    return next((mark for mark in _SEPARATORS if mark in line), " ")


def split_line(line: str, separator: str) -> list[str]:
    """Return the cells of a line, without quotes and surrounding blanks; nothing for no text."""
    single = " ".join(line.split()) if separator == " " else line
    if "[" in line:
        # A list without quotes is one cell, too.
        before = rf"(^|{re.escape(separator)})\s*"
        single = re.sub(before + r'(\[[^\]"]*\])', r'\1"\2"', single)
    reader = csv.reader([single], delimiter=separator, skipinitialspace=True)
    try:
        return list(map(str.strip, next(reader, [])))
    except csv.Error:
        return []


# Day, time of the day, and zone, which is left out.
_DATE = re.compile(
    r"(?:(\d{4}-\d\d-\d\d)[T ])?(\d\d:\d\d:\d\d(?:[.,]\d{1,9})?)(?:Z|[+-]\d\d:?\d\d)?",
    re.ASCII | re.IGNORECASE,
)


def parse_cell(cell: str, start: str = "") -> float:
    """Return the number in a cell, NaN where it is marked empty, or raise ValueError.

    A comma is a decimal one. A date becomes the time [s] since the date ``start``, or since 1970
    where that is "".
    """
    if cell.lower() in _EMPTY:
        return np.nan
    if ":" in cell:
        return float((_date(cell) - _date(start)) / np.timedelta64(1, "s"))
    return float(cell.replace(",", "."))


def is_empty(cell: str) -> bool:
    """Return whether a cell is marked empty."""
    return cell.strip().lower() in _EMPTY


def list_in_cell(cell: Any) -> Any:
    """Return the texts in a cell that holds a list, such as "[0.1, 0.2]" or "[0.1 0.2]"; any other
    cell as it is.
    """
    if not (isinstance(cell, str) and cell.startswith(("[", "("))):
        return cell
    # A text of NumPy's numbers is "[np.float64(0.1), ...]".
    plain = re.sub(r"[\w.]+\(", "", cell)
    return re.findall(r"[^\s,;\[\]()'\"]+", plain)


def is_number(value: Any) -> bool:
    """Return whether a value is a number, a date, or a text of one or of an empty cell."""
    if isinstance(value, str):
        try:
            parse_cell(value)
        except ValueError:
            return False
    return True


def is_names(value: Any) -> bool:
    """Return whether a value is a list of texts that are no numbers."""
    return isinstance(value, list) and bool(value) and not any(map(is_number, value))


def is_row(cells: Sequence[Any]) -> bool:
    """Return whether more than half of the cells are numbers: a row of data, not a header."""
    # A row of data may carry a joint's name or a frame, a header may have a title like "1".
    return 2 * sum(map(is_number, cells)) > len(cells)


def _date(cell: str) -> np.datetime64:
    """Return the date and time in a cell, 1970 for "", or raise ValueError.

    A time alone is taken to be of the first day of 1970.
    """
    match = _DATE.fullmatch(cell or "00:00:00")
    if match is None:
        raise ValueError(cell)
    day, clock = match.groups()
    return np.datetime64(f"{day or '1970-01-01'}T{clock.replace(',', '.')}", "ns")


def _read_lines(
    path: Path, encoding: str, size: int, above: int = 0
) -> Iterator[tuple[int, list[str], float]]:
    """Yield (number of the first line, lines, share of the file that is read) in chunks of about
    ``size`` characters, from behind the first ``above`` lines on.
    """
    file_size = max(1, path.stat().st_size)
    # Titles may hold a degree sign in any encoding; numbers never do, so replacing is harmless.
    with (
        path.open("rb") as binary,
        TextIOWrapper(binary, encoding, errors="replace") as stream,
    ):
        for _ in range(above):
            stream.readline()
        while lines := stream.readlines(size):
            first = above + 1
            above += len(lines)
            if any('"[' in line for line in lines):
                lines = _join_cells("".join(lines), stream)
            yield first, lines, binary.tell() / file_size


def _join_cells(text: str, stream: TextIOWrapper) -> list[str]:
    """Return lines of which none ends within a list in quotes, read to the end of the last one.

    NumPy writes a long array in several lines.
    """
    while text.rfind('"[') > text.rfind(']"') and (line := stream.readline()):
        text += line
    joined = re.sub(r'"\[[^\]"]*\]"', lambda cell: cell[0].replace("\n", " "), text)
    return joined.removesuffix("\n").split("\n")


def _read_beginning(path: Path, encoding: str) -> tuple[str, list[tuple[int, str]]]:
    """Return (the last line above the rows, [(line number, first row), (line number, second row)]).

    The line is a comment or no row of a table, "" for none; a row may be the header. There are
    fewer than two rows where the file has fewer.
    """
    above = ""
    rows: list[tuple[int, str]] = []
    chunks = _read_lines(path, encoding, _LONGEST_LINE)
    numbered = chain.from_iterable(
        enumerate(lines, first) for first, lines, _ in chunks
    )
    for number, line in numbered:
        is_text = len(line) < _LONGEST_LINE and not _BINARY.search(line)
        if is_text and _may_be_row(line):
            rows.append((number, line))
        elif line.strip() and not rows:
            above = line.strip()
        if len(rows) == 2:
            break
    return above, rows


def _may_be_row(line: str) -> bool:
    """Return whether a line is neither empty nor a comment."""
    text = line.lstrip()
    return bool(text) and not text.startswith(_COMMENT)


def _header_in_comment(comment: str, width: int) -> tuple[str, ...]:
    """Return the titles of ``width`` columns in a comment line; () where it does not hold them."""
    text = comment.lstrip("#% ")
    for separator in (_find_separator(text), " "):
        titles = _split_first(text, separator)
        if len(titles) == width and not is_row(titles):
            return titles
    return ()


def _split_first(line: str, separator: str) -> tuple[str, ...]:
    """Return the cells of a header or first row, without an empty one behind a last separator."""
    cells = split_line(line, separator)
    return tuple(cells[:-1] if len(cells) > 1 and not cells[-1] else cells)


# Name of samples in a recording to the quantity, as titles end in it.
_QUANTITIES = {
    "q": "position",
    "qd": "velocity",
    "tau": "torque",
    "qdd": "acceleration",
    "joint_time": "time",
}


def write_measurement_csv(
    path: Path, joint_names: Sequence[str], chunks: Iterable[Recording]
) -> None:
    """Write samples as CSV that ``reader.open_logs`` reads, with every digit.

    Columns are called ``<joint>_position`` and so on; the file appears when it is complete. All
    chunks have the quantities of the first.
    """
    with atomic_file(path) as stream:
        writer = csv.writer(stream, lineterminator="\n")
        titles: list[str] = []
        for chunk in chunks:
            names = [name for name in chunk.arrays() if name in _QUANTITIES]
            if not titles:
                pairs = product(names, joint_names)
                titles = ["time", *(f"{j}_{_QUANTITIES[name]}" for name, j in pairs)]
                # The name of a joint may hold ends of lines.
                writer.writerow(re.sub(r"[\r\n]", " ", title) for title in titles)
            values = [getattr(chunk, name) for name in names]
            writer.writerows(np.column_stack((chunk.time, *values)).tolist())
