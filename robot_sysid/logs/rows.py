"""The rows of a log as numbers, chunk by chunk, with what had to be left out or mended.

Rows with an empty or NaN cell and rows that repeat the previous time stamp are left out, a jump by
a full turn is unwrapped; each is counted with its line numbers. What cannot be mended (text in a
number column, a row of another length, time running backwards) is an error with its line number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.logs.column_map import ColumnMap
from robot_sysid.logs.dialect import LogDialect
from robot_sysid.records import Array

_TURN = 2.0 * np.pi
# A wrap differs from a full turn only by the motion within one sample.
_WRAP_TOLERANCE = 0.5


@dataclass
class LineList:
    """Counts file lines and remembers the first few."""

    count: int = 0
    first: list[int] = field(default_factory=list)

    def add(self, lines: NDArray[np.int64]) -> None:
        """Count these lines."""
        self.count += len(lines)
        self.first.extend(int(line) for line in lines[: max(0, 3 - len(self.first))])

    def __str__(self) -> str:
        listed = ", ".join(str(line) for line in self.first)
        more = f" and {self.count - len(self.first)} more" if self.count > len(self.first) else ""
        return f"line{'s' if self.count > 1 else ''} {listed}{more}"


@dataclass
class Repairs:
    """What was left out or mended while reading."""

    rows: int = 0
    missing: LineList = field(default_factory=LineList)
    repeated: LineList = field(default_factory=LineList)
    wrapped: LineList = field(default_factory=LineList)
    cut_off: LineList = field(default_factory=LineList)


@dataclass(frozen=True)
class LogChunk:
    """Consecutive rows of a log in SI units; row i stands in file line ``lines[i]``.

    Attributes:
        lines: (N,) file line numbers.
        time: (N,) [s], increasing.
        q, tau: (N, n) positions [rad], torques [N m].
        qd, qdd, joint_time: (N, n), or None where the log has no such columns.
    """

    lines: NDArray[np.int64]
    time: Array
    q: Array
    tau: Array
    qd: Array | None
    qdd: Array | None
    joint_time: Array | None

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, selection: slice | NDArray[np.bool_]) -> LogChunk:
        """Return some of the rows."""

        def part(values: Array | None) -> Array | None:
            return None if values is None else values[selection]

        return LogChunk(
            self.lines[selection],
            self.time[selection],
            self.q[selection],
            self.tau[selection],
            part(self.qd),
            part(self.qdd),
            part(self.joint_time),
        )


class LogRows:
    """Reads a log in chunks, as often as wanted.

    Args:
        dialect: the file's layout.
        columns: what each column is.
        is_slide: (n,) whether a joint is a slide, which has no full turn.
    """

    def __init__(
        self, dialect: LogDialect, columns: ColumnMap, is_slide: Sequence[bool] = ()
    ) -> None:
        self._dialect = dialect
        self._columns = columns
        self._turns = ~np.array(list(is_slide) or [False] * len(columns.position))
        groups = (columns.position, columns.torque, columns.velocity)
        self._groups = (*groups, columns.acceleration, columns.joint_time)
        time = (columns.time,) if columns.time else ()
        self._sources = (*time, *(s for group in self._groups if group for s in group))

    def chunks(self, size: int, repairs: Repairs | None = None) -> Iterator[LogChunk]:
        """Yield the rows, at most ``size`` at a time, and note in ``repairs`` what was mended.

        Raises:
            InputError: a row cannot be read, or time runs backwards.
        """
        mended = repairs if repairs is not None else Repairs()
        cleaner = _Cleaner(mended, self._turns)
        for lines, values in self._numbers(size, mended):
            chunk = self._chunk(lines, values, mended.rows)
            mended.rows += len(lines)
            clean = cleaner.clean(chunk)
            if len(clean):
                yield clean

    def _chunk(self, lines: NDArray[np.int64], values: Array, rows_before: int) -> LogChunk:
        values = values * np.array([source.factor for source in self._sources])
        start = 0
        if self._columns.time is None:
            time = (rows_before + np.arange(len(lines))) / float(self._columns.rate or 1.0)
        else:
            time, start = values[:, 0], 1
        parts: list[Array | None] = []
        for group in self._groups:
            stop = start + (len(group) if group else 0)
            parts.append(values[:, start:stop] if group else None)
            start = stop
        q, tau, qd, qdd, joint_time = parts
        assert q is not None and tau is not None
        return LogChunk(lines, time, q, tau, qd, qdd, joint_time)

    def _numbers(self, size: int, repairs: Repairs) -> Iterator[tuple[NDArray[np.int64], Array]]:
        rows = self._dialect.data_lines()
        following = next(rows, None)
        while following is not None:
            batch = [following, *islice(rows, size - 1)]
            following = next(rows, None)
            lines = np.array([line for line, _ in batch])
            values = self._fast([text for _, text in batch])
            if values is None:
                keep, values = self._careful(batch, following is None, repairs)
                lines = lines[keep]
            yield lines, values

    def _fast(self, texts: list[str]) -> Array | None:
        """Parse rows with numpy; None where a row needs a closer look."""
        dialect = self._dialect
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
                usecols=[source.index for source in self._sources],
                comments=None,
                ndmin=2,
            )
        except ValueError:
            return None

    def _careful(
        self, batch: list[tuple[int, str]], at_end: bool, repairs: Repairs
    ) -> tuple[slice, Array]:
        """Parse rows cell by cell, so that an error names the line and the column."""
        rows = []
        for position, (line, text) in enumerate(batch):
            cells = self._dialect.split(text)
            last = at_end and position == len(batch) - 1
            if len(cells) < self._dialect.width and last:
                repairs.cut_off.add(np.array([line]))
            elif len(cells) != self._dialect.width:
                raise InputError(
                    f"{self._dialect.path} line {line}: {len(cells)} cells instead of "
                    f"{self._dialect.width}; mend or delete the line"
                )
            else:
                rows.append([self._cell(cells[s.index], s.title, line) for s in self._sources])
        return slice(len(rows)), np.array(rows).reshape(len(rows), len(self._sources))

    def _cell(self, cell: str, title: str, line: int) -> float:
        try:
            return self._dialect.number(cell)
        except ValueError:
            raise InputError(
                f"{self._dialect.path} line {line}, column {title!r}: {cell!r} is not a number; "
                "mend or delete the line"
            ) from None


class _Cleaner:
    """Leaves out and mends rows; remembers the last row of the chunk before."""

    def __init__(self, repairs: Repairs, turns: NDArray[np.bool_]) -> None:
        self._repairs = repairs
        self._turns = turns
        self._last_time: float | None = None
        self._last_q: Array | None = None
        self._offset = np.zeros(len(turns))

    def clean(self, chunk: LogChunk) -> LogChunk:
        """Return the usable rows of a chunk."""
        finite = np.isfinite(chunk.time)
        for values in (chunk.q, chunk.tau, chunk.qd, chunk.qdd, chunk.joint_time):
            finite &= True if values is None else np.all(np.isfinite(values), axis=1)
        self._repairs.missing.add(chunk.lines[~finite])
        chunk = chunk.rows(finite)
        return self._unwrapped(self._in_order(chunk)) if len(chunk) else chunk

    def _in_order(self, chunk: LogChunk) -> LogChunk:
        before = chunk.time[0] - 1.0 if self._last_time is None else self._last_time
        step = np.diff(chunk.time, prepend=before)
        if np.any(step < 0.0):
            at = int(np.argmax(step < 0.0))
            raise InputError(
                f"time runs backwards at line {chunk.lines[at]}, by {-step[at]:.6g} s; sort the "
                "log, or cut it where a second recording begins"
            )
        self._last_time = float(chunk.time[-1])
        self._repairs.repeated.add(chunk.lines[step == 0.0])
        return chunk.rows(step > 0.0)

    def _unwrapped(self, chunk: LogChunk) -> LogChunk:
        if not len(chunk):
            return chunk
        before = chunk.q[0] if self._last_q is None else self._last_q
        step = np.diff(chunk.q, axis=0, prepend=before[None])
        turns = np.round(step / _TURN) * self._turns
        turns[np.abs(step - turns * _TURN) > _WRAP_TOLERANCE] = 0.0
        self._last_q = chunk.q[-1].copy()
        self._repairs.wrapped.add(chunk.lines[np.any(turns != 0.0, axis=1)])
        offset = self._offset - _TURN * np.cumsum(turns, axis=0)
        self._offset = offset[-1]
        if np.any(offset):
            chunk.q[:] = chunk.q + offset
        return chunk
