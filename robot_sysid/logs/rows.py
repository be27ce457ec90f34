"""The rows of a log as numbers, with what had to be left out or mended.

Rows with an empty or NaN cell and rows that repeat the previous time stamp are left out, a jump by
a full turn is unwrapped; the lines of each are kept. What cannot be mended (text in a number
column, a row of another length, time running backwards) is an error with its line number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.logs.column_map import ColumnMap, Source
from robot_sysid.logs.dialect import LogDialect
from robot_sysid.records import Array, Measurement

Lines = NDArray[np.int64]
"""File line numbers, counted from 1."""

_TURN = 2.0 * np.pi
# A wrap differs from a full turn only by the motion within one sample.
_WRAP_TOLERANCE = 0.5
# The text of so many rows is in memory at a time.
_BATCH = 10_000


@dataclass(frozen=True)
class LogRows:
    """The usable rows of a log; row i stands in file line ``lines[i]``.

    Attributes:
        lines: (N,) file lines.
        samples: what stands there, in SI units.
        n_read: number of rows in the file, except one that is cut off.
        missing, repeated: lines left out for an empty cell or for the time stamp before them.
        wrapped: lines at which a position was unwrapped.
        cut_off: the last line, where it is incomplete; else nothing.
    """

    lines: Lines
    samples: Measurement
    n_read: int
    missing: Lines
    repeated: Lines
    wrapped: Lines
    cut_off: Lines


def listed(lines: Lines) -> str:
    """Return lines in words: the first few and how many more."""
    first = ", ".join(str(line) for line in lines[:3])
    more = f" and {len(lines) - 3} more" if len(lines) > 3 else ""
    return f"line{'s' if len(lines) > 1 else ''} {first}{more}"


def read_rows(dialect: LogDialect, columns: ColumnMap, is_slide: Sequence[bool]) -> LogRows:
    """Read all rows of a log.

    Args:
        dialect: the file's layout.
        columns: what each column is.
        is_slide: (n,) whether a joint is a slide, which has no full turn.

    Raises:
        InputError: a row cannot be read, or time runs backwards.
    """
    optional = (columns.velocity, columns.acceleration, columns.joint_time)
    groups = (columns.position, columns.torque, *optional)
    sources = [columns.time] if columns.time else []
    sources += [source for group in groups for source in group or ()]
    lines, cut_off, table = _numbers(dialect, sources)
    n_read = len(table)
    table *= [source.factor for source in sources]
    if columns.time is None:
        table = np.column_stack((np.arange(n_read) / float(columns.rate or 1.0), table))
    finite = np.all(np.isfinite(table), axis=1)
    missing, lines, table = lines[~finite], lines[finite], table[finite]
    later = _later(dialect.path, lines, table[:, 0])
    repeated, lines, table = lines[~later], lines[later], table[later]
    ends = np.cumsum([1, *(len(group or ()) for group in groups)])
    time, *parts = np.split(table, ends[:-1], axis=1)
    q, tau, *others = (np.ascontiguousarray(part) for part in parts)
    qd, qdd, stamps = (values if values.shape[1] else None for values in others)
    turns = _turns(q) * ~np.array(is_slide)
    wrapped = lines[np.any(turns != 0.0, axis=1)]
    q = q - _TURN * np.cumsum(turns, axis=0)
    samples = Measurement(time[:, 0].copy(), q, qd, tau, qdd, stamps)
    return LogRows(lines, samples, n_read, missing, repeated, wrapped, cut_off)


def _later(path: Path, lines: Lines, time: Array) -> NDArray[np.bool_]:
    """Return (N,) whether each row is later than the one before, or raise InputError."""
    step = np.diff(time, prepend=time[:1] - 1.0)
    if np.any(step < 0.0):
        at = int(np.argmax(step < 0.0))
        raise InputError(
            f"{path}: time runs backwards at line {lines[at]}, by {-step[at]:.6g} s; sort the "
            "log, or cut it where a second recording begins"
        )
    return step > 0.0


def _turns(q: Array) -> Array:
    """Return by how many full turns each position (N, n) jumps."""
    step = np.diff(q, axis=0, prepend=q[:1])
    turns = np.round(step / _TURN)
    return np.where(np.abs(step - turns * _TURN) > _WRAP_TOLERANCE, 0.0, turns)


def _numbers(dialect: LogDialect, sources: Sequence[Source]) -> tuple[Lines, Lines, Array]:
    """Return the lines of all rows (R,), that of a last row which is cut off, and cells (R, S)."""
    rows = dialect.data_lines()
    lines: list[int] = []
    cut_off: list[int] = []
    tables = []
    while batch := list(islice(rows, _BATCH)):
        table = _fast(dialect, sources, [text for _, text in batch])
        if table is None:
            table = _careful(dialect, sources, batch, rows)
        tables.append(table)
        lines += [line for line, _ in batch[: len(table)]]
        cut_off += [line for line, _ in batch[len(table) :]]
    return np.array(lines, np.int64), np.array(cut_off, np.int64), np.concatenate(tables)


def _fast(dialect: LogDialect, sources: Sequence[Source], texts: list[str]) -> Array | None:
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
            usecols=[source.index for source in sources],
            comments=None,
            ndmin=2,
        )
    except ValueError:
        return None


def _careful(
    dialect: LogDialect,
    sources: Sequence[Source],
    batch: list[tuple[int, str]],
    rest: Iterator[tuple[int, str]],
) -> Array:
    """Parse rows cell by cell, so that an error names the line and the column.

    A last row of the file that is cut off is left out.
    """
    table = []
    for line, text in batch:
        cells = dialect.split(text)
        if len(cells) < dialect.width and line == batch[-1][0] and next(rest, None) is None:
            break
        if len(cells) != dialect.width:
            raise InputError(
                f"{dialect.path} line {line}: {len(cells)} cells instead of {dialect.width}; "
                "mend or delete the line"
            )
        table.append([_cell(dialect, cells[s.index], s.title, line) for s in sources])
    return np.array(table).reshape(len(table), len(sources))


def _cell(dialect: LogDialect, cell: str, title: str, line: int) -> float:
    try:
        return dialect.number(cell)
    except ValueError:
        raise InputError(
            f"{dialect.path} line {line}, column {title!r}: {cell!r} is not a number; "
            "mend or delete the line"
        ) from None
