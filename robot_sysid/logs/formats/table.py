"""What every form of recording is turned into: titled columns, read block by block."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.logs.column_file import ColumnChoices
from robot_sysid.logs.columns import read_title
from robot_sysid.records import Array

Lines = NDArray[np.int64]
"""Numbers of lines, messages or rows, counted from 1."""
NO_LINES: Lines = np.empty(0, np.int64)
NO_LINES.flags.writeable = False
BLOCK = 10_000
"""So many rows are in memory as text or messages at a time."""


@dataclass(frozen=True)
class Block:
    """Some consecutive rows of a log.

    Attributes:
        lines: (R,) their numbers in the file.
        cells: (R, C) the wanted columns; NaN where a cell is empty or not readable.
        unreadable: which ``lines`` hold no row of numbers.
        cut_off: number of a last row that is incomplete and not among ``lines``; else nothing.
        complaint: what is wrong with the first of the unreadable rows.
        piece: recordings in one file, such as episodes, each with a clock of its own.
        done: share of the file that was read.
    """

    lines: Lines
    cells: Array
    unreadable: Lines = field(default_factory=lambda: NO_LINES)
    cut_off: Lines = field(default_factory=lambda: NO_LINES)
    complaint: str = ""
    piece: int = 0
    done: float = 1.0


class LogTable(Protocol):
    """A recording as a table."""

    @property
    def path(self) -> Path:
        """The file or folder."""

    @property
    def layout(self) -> str:
        """The form in a few words."""

    @property
    def word(self) -> str:
        """What its rows are called: "line", "message" or "row"."""

    @property
    def titles(self) -> tuple[str, ...]:
        """Column titles; "#1", "#2", ... where there are none."""

    @property
    def first_row(self) -> tuple[str, ...]:
        """The cells of the first row as text, where it may hold names; else nothing."""

    @property
    def choices(self) -> ColumnChoices:
        """What the form itself says of its columns and units."""

    def blocks(self, columns: Sequence[int]) -> Iterator[Block]:
        """Yield the rows in their order, with these columns."""


@dataclass(frozen=True)
class ArrayTable:
    """A recording that is in memory already.

    Attributes:
        path, layout, word, titles, first_row, choices: see ``LogTable``.
        pieces: (N, W) cells of each piece.
    """

    path: Path
    layout: str
    titles: tuple[str, ...]
    pieces: tuple[Array, ...]
    choices: ColumnChoices = ColumnChoices()
    word: str = "row"
    first_row: tuple[str, ...] = ()

    def __fspath__(self) -> str:
        """The path, so that arrays may stand where a file is expected."""
        return str(self.path)

    __str__ = __fspath__

    def blocks(self, columns: Sequence[int]) -> Iterator[Block]:
        """Yield the rows in their order, with these columns."""
        total, start = max(1, sum(map(len, self.pieces))), 0
        for number, piece in enumerate(self.pieces):
            for first in range(0, len(piece), BLOCK):
                cells = piece[first : first + BLOCK, list(columns)]
                start += len(cells)
                lines = np.arange(start - len(cells), start) + 1
                yield Block(lines, cells, piece=number, done=start / total)


def titled_arrays(path: Path, arrays: Mapping[str, Any]) -> tuple[tuple[str, ...], Array]:
    """Return (titles, cells (N, W)) of named arrays with one row, or column, per sample.

    A column of a two-dimensional array ``q`` is called ``q[0]``; an array of another length or
    shape, or of no numbers, is no column. Of ``group/q`` the last part is the name, if no other
    array has it.

    Raises:
        InputError: there is no array with rows.
    """
    sized = {n: a for n, a in _by_last_name(arrays).items() if _is_table(a)}
    rows = _number_of_rows(path, sized, arrays)
    titles: list[str] = []
    columns: list[Array] = []
    for name, values in sized.items():
        upright = values if len(values) == rows else values.T
        if len(upright) != rows:
            continue
        flat = np.asarray(upright, dtype=float).reshape(rows, -1)
        width = flat.shape[1]
        titles += [name] if width == 1 else [f"{name}[{k}]" for k in range(width)]
        columns.append(flat)
    return tuple(titles), np.hstack(columns)


def _by_last_name(arrays: Mapping[str, Any]) -> dict[str, Any]:
    last = [name.rsplit("/", 1)[-1] for name in arrays]
    return {
        end if last.count(end) == 1 else name: values
        for (name, values), end in zip(arrays.items(), last)
    }


def _number_of_rows(path: Path, sized: Mapping[str, Array], arrays: Mapping[str, Any]) -> int:
    """Return how many samples there are: as many as times, else what most arrays have."""
    times = [max(a.shape) for name, a in sized.items() if read_title(name).kind == "time"]
    lengths = times or [max(a.shape) for a in sized.values()]
    if not lengths:
        raise InputError(f"{path} holds no arrays with a row per sample: {_shapes(arrays)}")
    return max(set(lengths), key=lengths.count)


def _is_table(values: Any) -> bool:
    return values.dtype.kind in "fiub" and values.ndim in (1, 2) and values.size > 1


def _shapes(arrays: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {np.shape(values)}" for name, values in arrays.items()) or "nothing"
