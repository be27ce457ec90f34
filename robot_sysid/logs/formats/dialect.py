"""How a text log is laid out: separator, decimal mark, comments, header; and its rows as cells.

Understood without being told: comma, semicolon, tab, bar or blanks between cells, a decimal comma
where the separator is not one, comment lines (``#`` or ``%``), a byte-order mark, Windows line
ends, quoted cells, and a header that is itself the last comment line (as ``numpy.savetxt`` writes
it).
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import TextIO

from robot_sysid.errors import InputError

_COMMENT_MARKS = ("#", "%")
_MISSING = frozenset({"", "nan", "null", "none", "na", "n/a", "-nan", "-", "missing"})
SEPARATOR_NAMES = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", " ": "blanks"}
LONGEST_LINE = 100_000
"""Characters of a line beyond which it is no row of a table."""
# Control characters, and their share at the beginning of a file that makes it no text.
_CONTROL = bytes({*range(32)} - {*b"\t\n\v\f\r"})
_BINARY = 0.05
# Lines between two looks at how much of the file was read.
_COUNTED = 1000


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
    _read: list[float] = field(default_factory=lambda: [0.0], repr=False, compare=False)

    def split(self, line: str) -> list[str] | None:
        """Return the cells of one line, without quotes, blanks or a trailing separator.

        None where the line is no text of a table.
        """
        cells = split_line(line, self.separator)
        if cells is None:
            return None
        return cells[:-1] if len(cells) == self.width + 1 and cells[-1] == "" else cells

    @property
    def width(self) -> int:
        """Number of cells a row should have."""
        return len(self.header) or len(self.first_row)

    def data_lines(self) -> Iterator[tuple[int, str]]:
        """Yield (file line number, text) of each row of data."""
        for number, line in _content_lines(self.path, self.encoding, self._read):
            row = self.flattened(line) if self.flattened else line
            if number != self.header_line and row is not None:
                yield number, row

    def share_read(self) -> float:
        """Return how much of the file ``data_lines`` has read so far."""
        return self._read[0]

    def number(self, cell: str) -> float:
        """Return the value of a cell, NaN where it is empty or marked missing, or ValueError."""
        text = cell.strip()
        if text.lower() in _MISSING:
            return float("nan")
        return float(text.replace(",", ".") if self.decimal_comma else text)


def read_dialect(path: Path) -> LogDialect:
    """Look at the beginning of a log and return its layout."""
    encoding = _encoding(path)
    comments, lines = _beginning(path, encoding)
    if not lines:
        raise InputError(
            f"{path} holds no rows of a table, a sample per line; check that "
            "the recording was written, or export it as CSV"
        )
    separator = _separator(lines[0][1])
    cells = _cells(path, lines[0][1], separator)
    whole, first = _without_last_gap(cells), lines[-1][1]
    if _mostly_numbers(cells):
        header_line, header, first = 0, _commented_header(comments, len(whole)), lines[0][1]
    elif len(lines) < 2:
        raise InputError(f"{path} has a header but no rows; check that the recording ran")
    else:
        header_line, header = lines[0][0], whole
    comma = separator != "," and "," in first
    row = _without_last_gap(_cells(path, first, separator))
    return LogDialect(path, encoding, separator, comma, header, header_line, row, '"' in first)


def split_line(line: str, separator: str) -> list[str] | None:
    """Return the cells of a line, without quotes and surrounding blanks; None for no text."""
    single = " ".join(line.split()) if separator == " " else line
    try:
        cells = next(csv.reader([single], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return None
    return [cell.strip() for cell in cells]


def _cells(path: Path, line: str, separator: str) -> tuple[str, ...]:
    cells = split_line(line, separator)
    if cells is None:
        raise InputError(f"{path} does not begin with a table of text; export the log as CSV")
    return tuple(cells)


def _encoding(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            start = stream.read(4096)
    except OSError as error:
        raise InputError(f"cannot read the log {path}: {error.strerror or error}") from error
    if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    if len(start) - len(start.translate(None, _CONTROL)) > _BINARY * len(start):
        raise InputError(
            f"{path} is of no form that is known, and not a text file; export it as CSV"
        )
    return "utf-8-sig"


def _content_lines(path: Path, encoding: str, read: list[float]) -> Iterator[tuple[int, str]]:
    """Yield (file line number, text) of lines that are neither empty nor comments.

    The first entry of ``read`` becomes the share of the file that was read.
    """
    size = max(1, path.stat().st_size)
    # Titles may hold a degree sign in any encoding; numbers never do, so replacing is harmless.
    with path.open("rb") as binary, TextIOWrapper(binary, encoding, errors="replace") as stream:
        for number, line in enumerate(_lines(stream), start=1):
            if number % _COUNTED == 1:
                read[0] = binary.tell() / size
            text = line.strip("\r\n")
            if text and not text.isspace() and not text.lstrip().startswith(_COMMENT_MARKS):
                yield number, text
    read[0] = 1.0


def _lines(stream: TextIO) -> Iterator[str]:
    """Yield the lines of a file; of one that no table has, the beginning."""
    while line := stream.readline(LONGEST_LINE):
        rest = line
        while len(rest) == LONGEST_LINE and not rest.endswith("\n"):
            rest = stream.readline(LONGEST_LINE)
        yield line


def _beginning(path: Path, encoding: str) -> tuple[list[str], list[tuple[int, str]]]:
    """Return the comment lines above the data and the first two content lines."""
    content = _content_lines(path, encoding, [0.0])
    lines = list(islice((pair for pair in content if _is_text(pair[1])), 2))
    last = lines[0][0] if lines else 0
    with path.open(encoding=encoding, errors="replace") as stream:
        above = [line.strip() for line in islice(stream, max(0, last - 1))]
    return [line for line in above if line], lines


def _is_text(line: str) -> bool:
    """Return whether a line is short enough for a table and without a serial line's noise."""
    plain = not any(mark < " " and mark != "\t" for mark in line) and "\ufffd" not in line[80:]
    return len(line) < LONGEST_LINE and plain


def _commented_header(comments: list[str], width: int) -> tuple[str, ...]:
    if not comments:
        return ()
    text = comments[-1].lstrip("#% ")
    for separator in dict.fromkeys((_separator(text), " ")):
        cells = _without_last_gap(tuple(split_line(text, separator) or ()))
        if len(cells) == width and not _mostly_numbers(cells):
            return cells
    return ()


def _separator(line: str) -> str:
    return next((mark for mark in (";", "\t", "|", ",") if mark in line), " ")


def _without_last_gap(cells: tuple[str, ...]) -> tuple[str, ...]:
    return cells[:-1] if len(cells) > 1 and cells[-1] == "" else cells


def _mostly_numbers(cells: tuple[str, ...]) -> bool:
    # A row of data may carry a joint's name or a frame, a header may have a title like "1".
    return 2 * sum(is_number(cell) for cell in cells) > len(cells)


def is_number(cell: str) -> bool:
    """Return whether a cell holds a number, or is marked empty."""
    if cell.lower() in _MISSING:
        return True
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True
