"""A log as a table: titled columns that every form of file is turned into, and its usable rows.

A form's reader returns a ``LogTable``, which yields its rows in blocks. ``read_rows`` cleans them:
rows with an empty or NaN cell, rows that are not numbers and rows that are no later than the row
before are left out, and a jump by a full turn is unwrapped. Each anomaly is counted, with its first
line, for ``checks`` to judge. A log that is longer than any identification needs is low-passed and
thinned while it is read.

A compressed file of a few kilobytes may unpack to more than the computer's memory. Each form's
reader therefore calls ``refuse_bomb`` with the size that the file states.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError, SysidError, error_text
from robot_sysid.logs import LogOptions
from robot_sysid.logs.column_map import ColumnChoices, ColumnMap
from robot_sysid.records import Array, Measurement
from robot_sysid.records.file_access import refuse_special_file
from robot_sysid.records.installation import install_hint
from robot_sysid.records.messages import Progress
from robot_sysid.signals.resampling import Thinning

Lines = NDArray[np.int64]
"""Numbers of lines, messages or rows, counted from 1."""
Mask = NDArray[np.bool_]
"""One truth value per row or joint."""
BLOCK = 10_000
"""Number of rows that are in memory as text or messages at a time: some 10 MB of a wide log."""


@dataclass(frozen=True)
class Block:
    """Consecutive rows of a log.

    Attributes:
        lines: (R,) numbers of the rows in the file, from 1.
        cells: (R, C) the requested columns; NaN where empty, infinite in a row that is not numbers.
        complaint: the fault of the first row that is not numbers, for the user; "" for none.
        share_read: share of the file that has been read, 0 to 1.
    """

    lines: Lines
    cells: Array
    complaint: str = ""
    share_read: float = 1.0


@dataclass(frozen=True)
class LogTable:
    """A log as a table, whatever the form of its file.

    Attributes:
        layout: the form in a few words, for the user.
        path: of the file or folder, for messages.
        titles: of its columns; "#1", "#2", ... where the file has none.
        blocks: function of column indices that yields all rows in order, with these columns.
        choices: columns and units that the form itself declares.
        row_noun: what a row is called in messages: "line", "message" or "row".
        first_row: the cells of the first row as text, where they may hold names; else empty.
        notes: sentences for the user on what was taken from the file.
    """

    path: Path
    layout: str
    titles: tuple[str, ...]
    blocks: Callable[[Sequence[int]], Iterator[Block]]
    choices: ColumnChoices = ColumnChoices()
    row_noun: str = "row"
    first_row: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __fspath__(self) -> str:
        """The path, so that arrays may stand where a file is expected."""
        return str(self.path)

    __str__ = __fspath__


@dataclass(frozen=True)
class LogSource:
    """A file or folder that is to be read as a log.

    Attributes:
        path: of the file or folder.
        first_bytes: of the file, at most 4096; empty for a folder.
        joint_names: (n,) of the arm.
        options: of reading logs.
    """

    path: Path
    first_bytes: bytes
    joint_names: Sequence[str]
    options: LogOptions


LARGEST = 8e8
"""Largest recording of arrays that is unpacked [bytes]: three hours of seven joints at 1 kHz."""
MAX_RATIO = 100
"""Largest unpacked size of a recording over its packed size; real recordings have ten."""
ALWAYS_ALLOWED = 10**8
"""Unpacked size that is always allowed, however small the file is [bytes]."""


def refuse_bomb(path: Path, unpacked_bytes: float, packed_bytes: float) -> None:
    """Raise InputError where a file would unpack to too much, by the size of the file.

    Every caller passes the sum over all arrays of a file, before any of them takes memory.
    """
    limit = min(LARGEST, max(ALWAYS_ALLOWED, MAX_RATIO * packed_bytes))
    if unpacked_bytes > limit:
        raise InputError(
            f"{path} unpacks to {unpacked_bytes / 1e9:.3g} GB, more than the {limit / 1e9:.3g} GB "
            "that are read of its size; split the recording, or save it without compression"
        )


def import_optional(module: str, extra: str) -> Any:
    """Return a module that reads a form, or raise InputError with the extra that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        hint = install_hint(module.split(".")[0], extra)
        raise InputError(f"reading this log {hint}") from None


@contextlib.contextmanager
def as_input_errors(path: Path, form: str) -> Iterator[None]:
    """Turn any exception inside the block, which reads a file of a form, into an InputError.

    A pipe or a device is refused before the block is entered.
    """
    refuse_special_file(path, f"give {form}")
    try:
        yield
    except SysidError:
        raise
    except Exception as error:
        fault = f"{error_text(error)} ({type(error).__name__})"
        raise InputError(
            f"cannot read {path} as {form}: {fault}; it may be damaged"
        ) from error


UNREADABLE = "unreadable"
"""Rows without numbers, or with numbers that cannot be true."""
MISSING = "missing"
"""Rows with an empty or NaN cell."""
REPEATED = "repeated"
"""Rows with the time stamp of the row before."""
BACKWARDS = "backwards"
"""Rows of an earlier time than the row before."""
WRAPPED = "wrapped"
"""Rows in which a position jumps by a full turn; these are mended, all others left out."""
_TURN = 2.0 * np.pi
# A wrap differs from a full turn by the motion within one sample: here 100 rad/s at 200 Hz.
_WRAP_TOLERANCE = 0.5
_IMPOSSIBLE = 1e7
"""Largest absolute position, speed or torque in SI units; larger numbers are faults of a file."""
_IMPOSSIBLE_TIME = 1e24
"""Largest absolute time [s], even of a clock of nanoseconds that is read as seconds."""


class Anomaly(NamedTuple):
    """How many rows have an anomaly, and where the first one is, for the user."""

    n_rows: int = 0
    first: str = ""


@dataclass(frozen=True)
class LogRows:
    """The usable rows of a log.

    Attributes:
        lines: (N,) file lines; of thinned rows, the line in the middle of those made one.
        samples: the rows as a measurement (N rows).
        n_read: number of rows in the file that hold something of this arm.
        n_foreign: number of rows that hold nothing of this arm.
        anomalies: UNREADABLE, MISSING, REPEATED, BACKWARDS and WRAPPED to their counts.
        thinning: how many rows were low-passed into one.
        row_noun: what a row is called: "line", "message" or "row".
    """

    lines: Lines
    samples: Measurement
    n_read: int
    anomalies: Mapping[str, Anomaly]
    n_foreign: int
    thinning: int
    row_noun: str

    def cite(self, lines: Lines) -> str:
        """Return lines (K,) for a sentence: "line 7 and 3 more"."""
        more = f" and {len(lines) - 1} more" if len(lines) > 1 else ""
        return f"{self.row_noun} {lines[0]}{more}"


def read_rows(
    table: LogTable,
    columns: ColumnMap,
    is_slide: Sequence[bool],
    progress: Progress | None = None,
) -> LogRows:
    """Return the usable rows of a log, cleaned and thinned.

    A cleaned row holds the line, the time and the columns of ``columns.groups()``, in this order.

    Args:
        table: the log.
        columns: the column of each quantity.
        is_slide: (n,) whether a joint is a slide, whose positions are not unwrapped.
        progress: receives the progress of reading.
    """
    cleaner = _RowCleaner(table, columns, is_slide)
    used = columns.columns()
    # Of line, time, position, torque, velocity and time stamps of the joints.
    widths = [1, 1, *map(len, columns.groups())]
    chunks = [np.empty((0, sum(widths)))]
    thinning = None
    indices = [column.index for column in used]
    progress = progress or Progress()
    label = f"Reading {table.path.name}"
    for block in table.blocks(indices):
        rows = cleaner.clean(block)
        # All is done only behind the loop, though the last blocks may report a share of 1.
        done = min(block.share_read, 0.999)
        progress.advance(label, done, total=1.0, text=f"{cleaner.n_read} rows")
        if thinning is None and len(rows) > 1:
            # The number of rows and the sampling period are estimated from the first rows.
            expected = cleaner.n_read / max(block.share_read, 1e-9)
            thinning = Thinning(rows[:, 1], expected)
        chunks.append(thinning.push(rows) if thinning else rows)
    progress.advance(label, done=1.0, total=1.0, text="")
    groups = np.split(np.concatenate(chunks), np.cumsum(widths)[:-1], axis=1)
    lines, time, q, tau, qd, stamps = map(np.ascontiguousarray, groups)
    command = None
    if columns.commanded:
        # A servo's torque follows its position error, the measure of torque here [rad].
        command = tau
        tau = command - q
    return LogRows(
        lines=np.round(lines[:, 0]).astype(np.int64),
        samples=Measurement(
            time=time[:, 0],
            q=q,
            qd=qd if columns.velocity else None,
            tau=tau,
            joint_time=stamps if columns.joint_time else None,
            command=command,
        ),
        n_read=cleaner.n_read,
        anomalies=cleaner.anomalies,
        n_foreign=cleaner.n_foreign,
        thinning=thinning.every if thinning else 1,
        row_noun=table.row_noun,
    )


class _RowCleaner:
    """Leaves out unusable rows and unwraps positions, block by block, in the order of the log.

    Args:
        table: the log.
        columns: the column of each quantity.
        is_slide: (n,) whether a joint is a slide, whose positions are not unwrapped.

    Attributes:
        n_read: number of rows so far that hold something of this arm.
        n_foreign: number of rows so far that hold nothing of this arm.
        anomalies: UNREADABLE, MISSING, REPEATED, BACKWARDS and WRAPPED to their counts so far.
    """

    def __init__(
        self, table: LogTable, columns: ColumnMap, is_slide: Sequence[bool]
    ) -> None:
        self._row_noun = table.row_noun
        self._columns = columns
        self._can_turn = ~np.array(is_slide)
        self._factors = np.array([column.factor for column in columns.columns()])
        self._n = len(columns.position)
        # Time and positions (1 + n,) of the last usable row.
        self._last_row: Array | None = None
        self._turns = np.zeros(self._n)
        self.n_read = 0
        self.n_foreign = 0
        anomalies = (UNREADABLE, MISSING, REPEATED, BACKWARDS, WRAPPED)
        self.anomalies = dict.fromkeys(anomalies, Anomaly())

    def clean(self, block: Block) -> Array:
        """Return the usable rows (R, 2 + C) of a block: line, time, then the C other columns.

        Numbers are in SI units. Rows left out are counted, and the last usable row is remembered
        for the next block.
        """
        lines = block.lines
        cells = block.cells.copy()
        np.multiply(cells, self._factors, out=cells, where=np.isfinite(cells))
        if self._columns.time is None:
            count = self.n_read + self.n_foreign + np.arange(len(cells))
            cells = np.column_stack((count / float(self._columns.rate or 1.0), cells))
        usable = self._find_usable(block, cells)
        lines = lines[usable]
        cells = cells[usable]
        if len(cells):
            later = self._find_later(lines, cells[:, 0])
            lines = lines[later]
            cells = cells[later]
        if len(cells):
            self._unwrap(lines, cells)
        return np.column_stack((lines, cells))

    def _count(self, anomaly: str, lines: Lines, first: str = "") -> None:
        """Count lines (K,) with an anomaly; ``first`` describes the first one, or is ""."""
        if len(lines):
            count, earlier = self.anomalies[anomaly]
            first = earlier or first or f"{self._row_noun} {lines[0]}"
            self.anomalies[anomaly] = Anomaly(count + len(lines), first)

    def _find_usable(self, block: Block, cells: Array) -> Mask:
        """Return (R,) which rows hold numbers that can be true; count the others.

        Args:
            block: the rows as the file has them.
            cells: (R, 1 + C) time, positions, torques and further columns in SI units.
        """
        # Positions and torques.
        needed = cells[:, 1 : 1 + 2 * self._n]
        impossible = np.any(np.abs(needed) > _IMPOSSIBLE, axis=1)
        impossible |= np.abs(cells[:, 0]) > _IMPOSSIBLE_TIME
        foreign = np.isnan(needed).all(axis=1) & ~impossible
        self.n_foreign += int(np.count_nonzero(foreign))
        self.n_read += int(np.count_nonzero(~foreign))
        finite = np.isfinite(cells).all(axis=1)
        self._count(UNREADABLE, block.lines[impossible], block.complaint)
        missing = np.flatnonzero(~finite & ~impossible & ~foreign)
        first = ""
        if len(missing):
            empty = ~np.isfinite(block.cells[missing[0]])
            columns = self._columns.columns()
            listed = [columns[k].title for k in np.flatnonzero(empty)]
            first = f"{self._row_noun} {block.lines[missing[0]]}, columns {', '.join(listed)}"
        self._count(MISSING, block.lines[missing], first)
        return np.asarray(finite & ~impossible)

    def _find_later(self, lines: Lines, time: Array) -> Mask:
        """Return (R,) whether each row is later than all rows so far.

        A row before its predecessor counts as BACKWARDS, one at the same time as REPEATED. Rows
        after a step backwards that are not yet later than all are left out and not counted.

        Args:
            lines: (R,) numbers of the rows in the file.
            time: (R,) of the rows [s].
        """
        previous = time[0] - 1.0 if self._last_row is None else self._last_row[0]
        step = np.diff(time, prepend=previous)
        # The latest time before each row.
        latest = np.maximum.accumulate(np.concatenate(([previous], time)))[:-1]
        self._count(BACKWARDS, lines[step < 0.0])
        self._count(REPEATED, lines[step == 0.0])
        return np.asarray(time > latest)

    def _unwrap(self, lines: Lines, cells: Array) -> None:
        """Take full turns off the positions in cells (R, 1 + C), in place; count the jumps.

        The columns of cells: time, positions, and further ones; ``lines`` (R,) are the numbers of
        the rows. The last row is remembered for the next block, as the file has it.
        """
        q = cells[:, 1 : 1 + self._n]
        previous = q[:1] if self._last_row is None else self._last_row[None, 1:]
        step = np.diff(q, axis=0, prepend=previous)
        # Full turns (R, n) by which each row jumps against the one before.
        turns = np.round(step / _TURN) * self._can_turn
        turns[np.abs(step - turns * _TURN) > _WRAP_TOLERANCE] = 0.0
        self._count(WRAPPED, lines[np.any(turns != 0.0, axis=1)])
        self._last_row = cells[-1, : 1 + self._n].copy()
        q -= _TURN * (self._turns + np.cumsum(turns, axis=0))
        self._turns = self._turns + turns.sum(axis=0)
