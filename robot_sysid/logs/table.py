"""A log as a table: titled columns that every form of file is turned into.

A form's reader finds names and numbers and hands them to ``make_table``, the one place where they
become titled columns. The ``LogTable`` yields its rows in blocks; ``checks`` makes a recording of
them. Of nested names ``nested_name`` makes one, and the parts of an array or list are called by
``part_titles``.
"""

from __future__ import annotations

import contextlib
import importlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError, SysidError, error_text
from robot_sysid.logs.declarations import ColumnChoices
from robot_sysid.logs.titles import read_title
from robot_sysid.records import Array, ColumnMap
from robot_sysid.records.data import shift_behind
from robot_sysid.records.file_access import refuse_special_file
from robot_sysid.records.installation import missing_library
from robot_sysid.records.messages import Progress, visible
from robot_sysid.records.servo_setting import UNKNOWN, ServoSetting
from robot_sysid.signals.cutoff import FEWEST_SAMPLES

ROWS = 10_000
"""Number of rows of a log that are read at a time from files that are not text."""
LARGEST_NUMBER = 1e24
"""Larger numbers are faults of a file, even times of a clock of nanoseconds."""
NANOSECOND = 1e-9
"""[s]"""
# The title of a part of a time stamp of ROS: what it is of, and whether it is the nanoseconds.
_STAMP_PART = re.compile(
    r"(?P<stem>|.*[ ._/:-])(?P<nano>n(ano)?)?sec(ond)?s?", re.IGNORECASE
)
_SPARE_ROWS = 1.1
"""Memory over the rows that a file holds as far as is known: lines differ in length."""
_NEARLY_ALL = 0.999
"""Largest share of a file that is shown as read within the loop that reads it."""
Lines = NDArray[np.int64]
"""Numbers of lines, messages or rows, counted from 1."""


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
    complaint: str
    share_read: float


Chunk = Sequence[Array]
"""Successive rows of arrays, (R,) or (R, k) each."""
BlockReader = Callable[[Sequence[int]], Iterator[Block]]
"""Function of column indices that yields all rows in order, with these columns."""
LATER = np.empty(0)
"""Stands for the numbers of a column that are not read before a block of rows asks for them."""


def chunk_blocks(
    read: Callable[[], Iterable[Chunk]], n_rows: int, columns: Sequence[int]
) -> Iterator[Block]:
    """Yield the rows of chunks that a function reads, with the columns of these indices.

    ``n_rows``: of all chunks. ValueError where chunks differ in their number of columns.
    """
    count = 0
    widths = set()
    for chunk in read():
        cells = np.column_stack([np.asarray(array, dtype=float) for array in chunk])
        widths.add(cells.shape[1])
        if len(widths) > 1:
            raise ValueError("its rows differ in length")
        lines = count + 1 + np.arange(len(cells))
        count += len(cells)
        if len(cells):
            yield Block(lines, cells[:, list(columns)], "", count / n_rows)


def beginning(chunks: Iterable[Chunk]) -> Chunk:
    """Return the first ``ROWS`` rows of chunks, or all: they show which arrays are columns.

    A file may be cut to chunks of any size, of which one alone, of a single row, shows nothing.
    """
    first: list[Chunk] = []
    count = 0
    for chunk in chunks:
        first.append(chunk)
        count += min(map(len, chunk), default=ROWS)
        if count >= ROWS:
            break
    return [np.concatenate(parts) for parts in zip(*first)]


def array_blocks(arrays: Chunk, columns: Sequence[int]) -> Iterator[Block]:
    """Yield the rows of arrays, (N,) or (N, k), side by side, with the columns of these indices."""
    edges = range(0, len(arrays[0]), ROWS)
    chunks = ([array[k : k + ROWS] for array in arrays] for k in edges)
    return chunk_blocks(lambda: chunks, len(arrays[0]), columns)


def no_blocks(_: Sequence[int]) -> Iterator[Block]:
    """Yield no rows."""
    yield from ()


@dataclass(frozen=True)
class LogTable:
    """A log as a table, whatever the form of its file.

    Attributes:
        layout: the form in a few words, for the user.
        path: of the file or folder, for messages.
        titles: of its columns; "#1", "#2", ... where the file has none.
        blocks: yields the rows.
        choices: columns and units that the form itself declares.
        row_noun: what a row is called in messages: "line", "message" or "row".
        first_row: the cells of the first row as text, where they may hold names; else empty.
        notes: sentences for the user on what was taken from the file.
        starts: title of a column of dates to the first of them, from which its times count [ns
            since 1970]: a float of seconds since 1970 would round them to half a microsecond.
            Columns and files are aligned by them (``seconds_after``). Dates that lie among other
            texts, as in JSON, count from 1970 themselves.
        form: what the file has to be, for the error where its rows cannot be read.
        setting: what servos were recorded with, where the file says it.
    """

    path: Path
    layout: str
    titles: tuple[str, ...]
    blocks: BlockReader
    choices: ColumnChoices = ColumnChoices()
    row_noun: str = "row"
    first_row: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    starts: Mapping[str, int] = field(default_factory=dict)
    form: str = "a log"
    setting: ServoSetting = UNKNOWN

    def __fspath__(self) -> str:
        """The path, so that arrays may stand where a file is expected."""
        return str(self.path)

    __str__ = __fspath__

    def without_rows(self) -> LogTable:
        """Return the table with its titles alone, for a record of where numbers came from."""
        return replace(self, blocks=no_blocks)

    def cite(self, lines: Lines) -> str:
        """Return lines (K,) for a sentence: "line 7 and 3 more"."""
        more = f" and {len(lines) - 1} more" if len(lines) > 1 else ""
        return f"{self.row_noun} {lines[0]}{more}"

    def seconds_after(self, column: int, other: LogTable, its_column: int) -> float:
        """Return how much later the times of a column begin to count than those of another [s].

        Zero where one of them has no dates: then both have one clock, as far as is known.
        """
        start = self.starts.get(self.titles[column])
        its_start = other.starts.get(other.titles[its_column])
        if start is None or its_start is None:
            return 0.0
        return NANOSECOND * (start - its_start)

    def rows(self, columns: Sequence[int]) -> Iterator[Block]:
        """Yield all rows with these columns; what their reader raises is an InputError.

        What the caller's loop raises, such as where progress cannot be printed, is no fault of the
        file, and passes.
        """
        with as_input_errors(self.path, self.form):
            yield from self.blocks(columns)

    def cells(self, columns: Sequence[int], most_blocks: int | None = None) -> Array:
        """Return these columns of all rows (R, C), or of those of the first blocks."""
        blocks = islice(self.rows(columns), most_blocks)
        none = np.empty((0, len(columns)))
        return np.vstack([none, *(block.cells for block in blocks)])


def select_columns(table: LogTable, columns: Sequence[int]) -> LogTable:
    """Return a table with these columns (indices) alone."""

    def blocks(selected: Sequence[int]) -> Iterator[Block]:
        """Yield the rows with columns by their places among the selected ones."""
        return table.blocks([columns[k] for k in selected])

    titles = tuple(table.titles[k] for k in columns)
    first_row = tuple(table.first_row[k] for k in columns if table.first_row)
    return replace(table, titles=titles, blocks=blocks, first_row=first_row)


def nested_name(group: str, name: str) -> str:
    """Return the name of what lies in a group, ``group/name``; "" is no group."""
    return f"{group}/{name}" if group else name


def part_titles(name: str, count: int, joint_names: Sequence[str] = ()) -> list[str]:
    """Return the titles of the parts of an array or list: ``q[0]``, or ``elbow/q`` by joints."""
    if joint_names:
        return [nested_name(joint, name) for joint in joint_names]
    return [f"{name}[{k}]" for k in range(count)]


def make_table(
    path: Path,
    layout: str,
    columns: Iterable[tuple[str, Array]],
    joint_names: Mapping[int, Sequence[str]] | None = None,
    blocks: BlockReader | None = None,
    choices: ColumnChoices | None = None,
    row_noun: str = "row",
    first_row: tuple[str, ...] = (),
    notes: tuple[str, ...] = (),
    starts: Mapping[str, int] | None = None,
) -> LogTable:
    """Return named columns of numbers as a table, whatever form of file they are from.

    Args:
        path: of the file or folder.
        layout: see ``LogTable``.
        columns: (name, numbers) from left to right; numbers are (N,), or (N, k) for k columns,
            which have the titles of ``part_titles``.
        joint_names: number of columns of an array to the names of the joints that they are of.
        blocks: yields the rows, where ``columns`` do not hold all of them; their numbers then only
            show their shape, or are ``LATER``.
        choices, row_noun, first_row, notes, starts: see ``LogTable``.
    """
    titles: list[str] = []
    arrays = []
    for name, values in columns:
        arrays.append(values)
        width = values.size // len(values) if len(values) else 1
        if width == 1:
            titles.append(name)
        else:
            titles += part_titles(name, width, (joint_names or {}).get(width, ()))
    shown = tuple(map(visible, titles))
    if shown != tuple(titles):
        odd = next(title for title in titles if title != visible(title))
        notes = (
            *notes,
            f"titles hold characters that nobody sees, and are read without them: {odd!r} is "
            f"{visible(odd)}",
        )
    table = LogTable(
        path,
        layout,
        shown,
        blocks or partial(array_blocks, arrays),
        choices or ColumnChoices(),
        row_noun,
        first_row,
        notes,
        {visible(title): start for title, start in (starts or {}).items()},
    )
    return with_whole_stamps(table)


def with_whole_stamps(table: LogTable) -> LogTable:
    """Return a table with one time for each that is in two columns, seconds and nanoseconds, as
    ROS has it; the time takes the place of the seconds.
    """
    parts: dict[str, dict[str, int]] = {}
    for index, title in enumerate(table.titles):
        match = _STAMP_PART.fullmatch(title)
        if match:
            part = "nanoseconds" if match["nano"] else "seconds"
            parts.setdefault(match["stem"], {})[part] = index
    titles = [*table.titles]
    nanoseconds: dict[int, int] = {}
    for stem, indices in parts.items():
        if len(indices) < 2 or not _are_parts(table, **indices):
            continue
        stamp = stem.rstrip(" ._/:-") or "time"
        if read_title(stamp).quantity != "time":
            stamp = f"{stamp} time" if "time [s]" in titles else "time"
        titles[indices["seconds"]] = f"{stamp} [s]"
        titles[indices["nanoseconds"]] = f"nanoseconds of {stamp}"
        nanoseconds[indices["seconds"]] = indices["nanoseconds"]
    if not nanoseconds:
        return table
    blocks = partial(_whole_stamps, table.blocks, nanoseconds)
    return replace(table, titles=tuple(titles), blocks=blocks)


def _are_parts(table: LogTable, seconds: int, nanoseconds: int) -> bool:
    """Return whether two columns are whole seconds and the nanoseconds behind them, and not one
    time in two units.
    """
    first = next(table.blocks([seconds, nanoseconds]), None)
    if first is None:
        return True
    whole, rest = first.cells[np.isfinite(first.cells).all(axis=1)].T
    is_whole = np.all(whole == np.round(whole))
    return bool(is_whole and np.all((rest >= 0.0) & (rest < 1.0 / NANOSECOND)))


def _whole_stamps(
    blocks: BlockReader, nanoseconds: Mapping[int, int], columns: Sequence[int]
) -> Iterator[Block]:
    """Yield the rows of these columns, with the nanoseconds (column of seconds to theirs) added."""
    stamps = [k for k, column in enumerate(columns) if column in nanoseconds]
    further = [nanoseconds[columns[k]] for k in stamps]
    for block in blocks([*columns, *further]):
        cells = block.cells[:, : len(columns)]
        cells[:, stamps] += NANOSECOND * block.cells[:, len(columns) :]
        yield replace(block, cells=cells)


def import_optional(module: str, extra: str) -> Any:
    """Return a module that reads a form, or raise InputError with the extra that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        start = "export this log as CSV; reading it"
        raise missing_library(start, module.split(".")[0], extra) from None


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


def read_cells(
    table: LogTable, columns: ColumnMap, progress: Progress
) -> tuple[Array, str]:
    """Return the cells (R, 2 + C) of all rows of a log, and the fault of one that is not numbers.

    The cells are a row's line, its time, and the columns of ``columns.groups()``, in SI units.
    """
    used = columns.columns()
    cells = np.empty((0, 2 + sum(map(len, columns.groups()))))
    count = 0
    complaint = ""
    label = f"Reading {table.path.name}"
    for block in table.rows([column.index for column in used]):
        last = count + len(block.lines)
        if last > len(cells):
            # Memory beyond the rows that are read is not touched, and so not taken.
            size = round(_SPARE_ROWS * last / block.share_read)
            larger = np.empty((size, cells.shape[1]))
            larger[:count] = cells[:count]
            cells = larger
        cells[count:last, 0] = block.lines
        cells[count:last, -len(used) :] = block.cells
        count = last
        complaint = complaint or block.complaint
        # All is done only behind the loop, though the last blocks may report a share of 1.
        done = min(block.share_read, _NEARLY_ALL)
        text = f"{table.row_noun} {block.lines[-1]}"
        progress.advance(label, done, 1.0, text)
    progress.advance(label, 1.0, 1.0, "")
    cells = cells[:count]
    for column, numbers in zip(used, cells.T[-len(used) :]):
        numbers -= column.zero
        np.multiply(numbers, column.factor, out=numbers, where=np.isfinite(numbers))
        numbers += column.constant
    if columns.time is None:
        cells[:, 1] = np.arange(count) / (columns.rate or 1.0)
    else:
        for number, column in enumerate(reversed(columns.joint_time), start=1):
            later = table.seconds_after(column.index, table, columns.time.index)
            cells[:, -number] += later
    return cells, complaint


def without_copies(table: LogTable, cells: Array) -> tuple[Array, list[str]]:
    """Return cells without rows that are the same as another one in all columns, and a note.

    A row that is written twice says nothing else than once, of the clock or of anything: it goes
    before steps of time are judged.

    ``cells``: of all rows, as ``read_cells`` returns them.
    """
    rows = np.flatnonzero(np.isfinite(cells[:, 1]))
    time = cells[rows, 1]
    if np.all(np.diff(time) > 0.0):
        return cells, []
    order = np.argsort(time, kind="stable")
    is_shared = np.diff(time[order], prepend=-np.inf) == 0.0
    is_shared[:-1] |= is_shared[1:]
    shared = rows[np.sort(order[is_shared])]
    numbers = np.ascontiguousarray(cells[shared, 1:])
    # By their bytes, as empty cells are equal, too.
    texts = numbers.view(f"V{numbers.itemsize * numbers.shape[1]}")
    _, first = np.unique(texts, return_index=True)
    copies = np.delete(shared, first)
    if not len(copies):
        return cells, []
    note = (
        f"left out rows that are written twice, the same in all columns: {len(copies)} (first: "
        f"{table.cite(cells[copies[:1], 0].astype(np.int64))})"
    )
    return np.delete(cells, copies, axis=0), [note]


def separate_recordings(table: LogTable, columns: ColumnMap, cells: Array) -> list[str]:
    """Put the recordings that follow each other in a log behind each other in time; return a note.

    A recording begins where time goes back by more than half of the recording before it. Where one
    would have too few rows to be filtered, nothing is changed, and no note returned.

    Args:
        table: the log.
        columns: the column of each quantity.
        cells: of all rows, as ``read_cells`` returns them; times are replaced.
    """
    time = cells[:, 1]
    rows = np.flatnonzero(np.isfinite(time))
    edges = [0]
    for k in (np.flatnonzero(np.diff(time[rows]) < 0.0) + 1).tolist():
        first, last, after = time[rows[[edges[-1], k - 1, k]]]
        if after < 0.5 * (first + last):
            edges.append(k)
    if len(edges) == 1 or np.min(np.diff([*edges, len(rows)])) < FEWEST_SAMPLES:
        return []
    starts = np.array(edges[1:])
    stamps = [1, *range(cells.shape[1] - len(columns.joint_time), cells.shape[1])]
    for before, start in zip(rows[starts - 1], rows[starts]):
        cells[start:, stamps] += shift_behind(time[before], time[start])
    lines = cells[rows[starts], 0].astype(np.int64)
    return [
        f"time starts again at {table.cite(lines)}: {len(edges)} recordings are read, one after "
        "the other"
    ]
