"""The rows of a log as numbers, with what had to be left out or mended.

Rows with an empty or NaN cell, rows that are no row of numbers at all and rows that are no later
than the one before are left out, a jump by a full turn is unwrapped; each kind is counted, and its
first line kept, for ``checks`` to judge.
The rows pass by in blocks; a log that is longer than any identification needs is low-passed and
thinned on the way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.logs.column_map import ColumnMap
from robot_sysid.logs.formats.table import BLOCK, Block, Lines, LogTable
from robot_sysid.records import Array, Measurement
from robot_sysid.records.progress import Progress
from robot_sysid.signals.resampling import Thinning

UNREADABLE = "unreadable"
MISSING = "missing"
REPEATED = "repeated"
WRAPPED = "wrapped"
BACKWARDS = "backwards"
_TURN = 2.0 * np.pi
# A wrap differs from a full turn by the motion within one sample: here 100 rad/s at 200 Hz.
_WRAP_TOLERANCE = 0.5
_ABSURD = 1e7
"""No joint position, speed or torque is beyond this in SI units; a cell that is was not written."""
_NO_TIME = 1e24
"""Nor is a time, even of a clock of nanoseconds that is taken for seconds."""
APART = 10.0
"""Recordings with clocks of their own are put so far apart [s]: farther than any filter reaches."""


@dataclass(frozen=True)
class Odd:
    """How many rows are odd in one way, and which is the first, in words."""

    count: int = 0
    first: str = ""


@dataclass(frozen=True)
class LogRows:
    """The usable rows of a log.

    Attributes:
        lines: (N,) file lines; of thinned rows, those in whose middle a row is.
        n_read, foreign: number of rows in the file, and of those that hold nothing of this arm.
        odd: the rows left out as UNREADABLE (no numbers, or none that can be true), MISSING (an
            empty cell), REPEATED (the time stamp before them) and BACKWARDS (of an earlier time
            than the row before them), and those that were WRAPPED.
        empty: title of a column to the number of MISSING rows in which it is empty.
        thinned: how many rows were made one.
        word: what its rows are called.
    """

    lines: Lines
    samples: Measurement
    n_read: int
    odd: Mapping[str, Odd]
    empty: Mapping[str, int]
    foreign: int
    thinned: int
    word: str

    def listed(self, lines: Lines) -> str:
        """Return lines in words: the first, and how many more."""
        more = f" and {len(lines) - 1} more" if len(lines) > 1 else ""
        return f"{self.word} {lines[0]}{more}"


def read_rows(
    table: LogTable,
    columns: ColumnMap,
    is_slide: Sequence[bool],
    progress: Progress | None = None,
) -> LogRows:
    """Read all rows of a log; a joint that is a slide (n,) has no full turn."""
    cleaner = _Cleaner(table, columns, is_slide)
    wanted = [source.index for source in columns.sources()]
    thinning = None
    kept = _Kept([1, 1, *map(len, columns.groups())])
    begun: list[Array] = []
    for block in followed(table, wanted, progress or Progress()):
        rows = cleaner.clean(block)
        expected = cleaner.n_read / max(block.done, 1e-9)
        if thinning is None:
            # The first rows tell how many there will be, and in which steps of time.
            begun = [np.concatenate((*begun, rows))]
            if len(begun[0]) < 2 or (len(begun[0]) < BLOCK and block.done < 1.0):
                continue
            rows = begun[0]
            begun = []
            thinning = Thinning.of(rows[:, 1], expected)
        kept.add(thinning.push(rows), int(expected / thinning.every))
    for rows in begun:
        kept.add(rows, len(rows))
    titles = [source.title for source in columns.sources()]
    empty = {t: int(n) for t, n in zip(titles, cleaner.empty) if n}
    told = cleaner.n_read, cleaner.odd, empty, cleaner.foreign
    lines, time, q, tau, *others = kept.taken()
    qd, stamps = (values if values.shape[1] else None for values in others)
    command, tau = (tau, tau - q) if columns.commanded else (None, tau)
    samples = Measurement(time[:, 0], q, qd, tau, None, stamps, command)
    numbers = np.round(lines[:, 0]).astype(np.int64)
    return LogRows(
        numbers, samples, *told, thinning.every if thinning else 1, table.word
    )


class _Kept:
    """Rows of some groups of columns, each an array of its own, with room for what comes."""

    def __init__(self, widths: Sequence[int]) -> None:
        self._parts = [np.empty((0, width)) for width in widths]
        self._ends = np.cumsum(widths)[:-1]
        self._count = 0

    def add(self, rows: Array, expected: int) -> None:
        """Take the next rows (R, C) of about so many in all."""
        start = self._count
        self._count = self._count + len(rows)
        if self._count > len(self._parts[0]):
            # The lines of a file are not all of one length; room that is not used takes no memory.
            most = max(self._count, expected + expected // 10)
            before = self.taken()
            self._parts = [np.empty((most, part.shape[1])) for part in before]
            for part, values in zip(self._parts, before):
                part[:start] = values[:start]
        for part, values in zip(self._parts, np.split(rows, self._ends, axis=1)):
            part[start : self._count] = values

    def taken(self) -> list[Array]:
        """Return the groups (N, width)."""
        return [part[: self._count] for part in self._parts]


def followed(
    table: LogTable, columns: Sequence[int], progress: Progress
) -> Iterator[Block]:
    """Yield the blocks of a log, and tell how far it is read."""
    label = f"Reading {table.path.name}"
    rows = 0
    for block in table.blocks(columns):
        yield block
        rows += len(block.lines)
        progress.advance(label, min(block.done, 0.999), 1.0, f"{rows} rows")
    progress.advance(label, 1.0, 1.0, "")


class _Cleaner:
    """Leaves out and mends rows, block by block; a joint may be a slide (n,)."""

    def __init__(
        self, table: LogTable, columns: ColumnMap, is_slide: Sequence[bool]
    ) -> None:
        self._word = table.word
        self._columns = columns
        self._turning = ~np.array(is_slide)
        self._factors = np.array([source.factor for source in columns.sources()])
        self._n = len(columns.position)
        self._piece = 0
        self._offset = 0.0
        self._last: Array | None = None
        self._turns = np.zeros(self._n)
        self.n_read = 0
        self.foreign = 0
        self.empty = np.zeros(len(self._factors), dtype=int)
        kinds = UNREADABLE, MISSING, REPEATED, BACKWARDS, WRAPPED
        self.odd = {kind: Odd() for kind in kinds}

    def clean(self, block: Block) -> Array:
        """Return the usable rows (R, 2 + C) of a block: line, time, then the wanted columns."""
        lines = block.lines
        cells = block.cells.copy()
        np.multiply(cells, self._factors, out=cells, where=np.isfinite(cells))
        if self._columns.time is None:
            count = self.n_read + self.foreign + np.arange(len(cells))
            cells = np.column_stack((count / float(self._columns.rate or 1.0), cells))
        usable = self._usable(block, cells)
        lines = lines[usable]
        cells = cells[usable]
        if len(cells):
            if block.piece != self._piece:
                # A piece has a clock of its own; it is put behind the one before.
                self._piece = block.piece
                self._turns = np.zeros(self._n)
                if self._last is not None and self._columns.time is not None:
                    self._offset = float(self._last[0] + APART - cells[0, 0])
                self._last = None
            cells[:, 0] += self._offset
            later = self._later(lines, cells[:, 0])
            lines = lines[later]
            cells = cells[later]
        if len(cells):
            self._unwrap(lines, cells)
        return np.column_stack((lines, cells))

    def _count(self, kind: str, lines: Lines, first: str = "") -> None:
        if len(lines):
            before = self.odd[kind]
            first = before.first or first or f"{self._word} {lines[0]}"
            self.odd[kind] = Odd(before.count + len(lines), first)

    def _usable(self, block: Block, cells: Array) -> NDArray[np.bool_]:
        """Return (R,) which rows hold numbers that can be true; count the others."""
        needed = cells[:, 1 : 1 + 2 * self._n]
        noise = np.any(np.abs(needed) > _ABSURD, axis=1) | (
            np.abs(cells[:, 0]) > _NO_TIME
        )
        foreign = np.isnan(needed).all(axis=1) & ~noise
        self.foreign += int(np.count_nonzero(foreign))
        self.n_read += int(np.count_nonzero(~foreign))
        finite = np.isfinite(cells).all(axis=1)
        self._count(UNREADABLE, block.lines[noise], block.complaint)
        missing = ~finite & ~noise & ~foreign
        self._count(MISSING, block.lines[missing])
        self.empty += (~np.isfinite(block.cells[missing])).sum(axis=0)
        return np.asarray(finite & ~noise)

    def _later(self, lines: Lines, time: Array) -> NDArray[np.bool_]:
        """Return (R,) whether each row is later than all before; count the others."""
        before = time[0] - 1.0 if self._last is None else self._last[0]
        step = np.diff(time, prepend=before)
        latest = np.maximum.accumulate(np.concatenate(([before], time)))[:-1]
        back = step < 0.0
        if np.any(back):
            at = int(np.argmax(back))
            self._count(
                BACKWARDS,
                lines[back],
                f"{self._word} {lines[at]}, by {-step[at]:.6g} s",
            )
        self._count(REPEATED, lines[step == 0.0])
        return np.asarray(time > latest)

    def _unwrap(self, lines: Lines, cells: Array) -> None:
        q = cells[:, 1 : 1 + self._n]
        step = np.diff(
            q, axis=0, prepend=q[:1] if self._last is None else self._last[None, 1:]
        )
        turns = np.round(step / _TURN) * self._turning
        turns[np.abs(step - turns * _TURN) > _WRAP_TOLERANCE] = 0.0
        self._count(WRAPPED, lines[np.any(turns != 0.0, axis=1)])
        self._last = cells[-1, : 1 + self._n].copy()
        q -= _TURN * (self._turns + np.cumsum(turns, axis=0))
        self._turns = self._turns + turns.sum(axis=0)
