"""Text logs as tables; what is no row of numbers is left out and told."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from robot_sysid.logs.column_file import ColumnChoices
from robot_sysid.logs.formats import table
from robot_sysid.logs.formats.dialect import SEPARATOR_NAMES, LogDialect
from robot_sysid.logs.formats.table import NO_LINES, Block
from robot_sysid.records import Array

Batch = list[tuple[int, str]]


@dataclass(frozen=True)
class TextTable:
    """A text log.

    Attributes:
        dialect: its layout.
        program: what wrote it, where the titles tell.
        choices: what that program says of its columns.
    """

    dialect: LogDialect
    program: str = ""
    choices: ColumnChoices = ColumnChoices()
    word: str = "line"

    @property
    def path(self) -> Path:
        """The file."""
        return self.dialect.path

    @property
    def layout(self) -> str:
        """The form in a few words."""
        dialect = self.dialect
        program = f"{self.program}, " if self.program else ""
        decimal = ", decimal comma" if dialect.decimal_comma else ""
        commented = "" if dialect.header_line or not dialect.header else ", titles in a comment"
        commented += " line" if commented else ""
        separator = SEPARATOR_NAMES[dialect.separator]
        return f"{program}{dialect.width} columns separated by {separator}{decimal}{commented}"

    @property
    def titles(self) -> tuple[str, ...]:
        """Column titles; "#1", "#2", ... where there are none."""
        return self.dialect.header or tuple(f"#{k + 1}" for k in range(self.dialect.width))

    @property
    def first_row(self) -> tuple[str, ...]:
        """The cells of the first row."""
        return self.dialect.first_row

    def blocks(self, columns: Sequence[int]) -> Iterator[Block]:
        """Yield the rows in their order, with these columns."""
        rows = self.dialect.data_lines()
        waiting, read = list(islice(rows, table.BLOCK)), self.dialect.share_read()
        while waiting:
            batch, done = waiting, read
            waiting, read = list(islice(rows, table.BLOCK)), self.dialect.share_read()
            texts = [text for _, text in batch]
            cells = _fast(self.dialect, columns, texts)
            if cells is None:
                yield replace(self._careful(columns, batch, last=not waiting), done=done)
            else:
                yield Block(np.array([line for line, _ in batch]), cells, done=done)

    def _careful(self, columns: Sequence[int], batch: Batch, last: bool) -> Block:
        """Parse rows cell by cell; a last row of the file that is cut off is left out."""
        dialect, cut_off = self.dialect, NO_LINES
        if last and _is_short(dialect, batch[-1][1]):
            cut_off = np.array([batch[-1][0]])
            batch = batch[:-1]
        parsed = [_row(dialect, columns, text) for _, text in batch]
        lines = np.array([line for line, _ in batch], np.int64)
        nothing = [np.nan] * len(columns)
        cells = np.array([nothing if isinstance(row, str) else row for row in parsed], float)
        bad = [k for k, row in enumerate(parsed) if isinstance(row, str)]
        complaint = f"line {lines[bad[0]]}{parsed[bad[0]]}" if bad else ""
        shaped = cells.reshape(len(batch), len(columns))
        return Block(lines, shaped, lines[bad], cut_off, complaint)


def _is_short(dialect: LogDialect, text: str) -> bool:
    cells = dialect.split(text)
    return cells is not None and len(cells) < dialect.width


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
    blank = dialect.separator == " "
    if dialect.quoted or not all(
        len(text.split()) == dialect.width
        if blank
        else text.count(dialect.separator) == dialect.width - 1
        for text in texts
    ):
        return None
    if dialect.decimal_comma:
        texts = [text.replace(",", ".") for text in texts]
    try:
        return np.loadtxt(
            texts,
            delimiter=None if blank else dialect.separator,
            usecols=list(columns),
            comments=None,
            ndmin=2,
        )
    except ValueError:
        return None
