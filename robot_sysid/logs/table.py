"""What every form of recording is turned into: titled columns, read block by block."""

from __future__ import annotations

import contextlib
import importlib
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError, SysidError, error_text
from robot_sysid.logs import LogOptions
from robot_sysid.logs.column_map import ColumnChoices, ColumnMap
from robot_sysid.logs.titles import read_title
from robot_sysid.records import Array, Measurement
from robot_sysid.records.progress import Progress
from robot_sysid.signals.resampling import Thinning
from robot_sysid.special_files import refuse_special_file

Lines = NDArray[np.int64]
"""Numbers of lines, messages or rows, counted from 1."""
BLOCK = 10_000
"""So many rows are in memory as text or messages at a time: some 10 MB of a wide log."""


@dataclass(frozen=True)
class Block:
    """Some consecutive rows of a log.

    Attributes:
        lines: (R,) their numbers in the file.
        cells: (R, C) the wanted columns; NaN where empty, infinite where a row is none of numbers.
        complaint: what is wrong with the first of those rows.
        piece: recordings in one file, such as episodes, each with a clock of its own.
        done: share of the file that was read.
    """

    lines: Lines
    cells: Array
    complaint: str = ""
    piece: int = 0
    done: float = 1.0


@dataclass(frozen=True)
class LogTable:
    """A recording as a table, whatever its form, which ``layout`` says in a few words.

    Attributes:
        titles: of its columns; "#1", "#2", ... where there are none.
        blocks: reads its rows in their order, with some of the columns.
        choices: what the form itself says of its columns and units.
        word: what its rows are called: "line", "message" or "row".
        first_row: the cells of the first row as text, where it may hold names; else nothing.
        elsewhere: what it only refers to, in other files, and what to do about it; "" for nothing.
    """

    path: Path
    layout: str
    titles: tuple[str, ...]
    blocks: Callable[[Sequence[int]], Iterator[Block]]
    choices: ColumnChoices = ColumnChoices()
    word: str = "row"
    first_row: tuple[str, ...] = ()
    elsewhere: str = ""

    def __fspath__(self) -> str:
        """The path, so that arrays may stand where a file is expected."""
        return str(self.path)

    __str__ = __fspath__


@dataclass(frozen=True)
class Asked:
    """A recording that is to be read; ``start``: its first bytes, nothing of a folder."""

    path: Path
    start: bytes
    joint_names: Sequence[str]
    options: LogOptions


# Year to day, time of the day, and how far the clock is ahead of UTC.
DATE = re.compile(
    r"(?:(\d{4}-\d\d-\d\d)[T ])?(\d\d:\d\d:\d\d(?:[.,]\d{1,9})?)(?:Z|([+-])(\d\d):?(\d\d))?",
    re.ASCII | re.IGNORECASE,
)

LARGEST = 8e8
"""Largest recording of arrays that is unpacked [bytes]: three hours of seven joints at 1 kHz."""
MOST_RATIO = 100
ALWAYS = 10**8
"""Recordings shrink to a tenth; one may unpack to 100 times its size, or to 100 MB."""
MOST_ARRAYS = 10_000
"""Arrays in a recording, and columns of them; with ten times as many, names take a minute."""
_BESIDE = 2e8
"""Memory that reading takes beside what is read: caches, a chunk packed and unpacked [bytes]."""


def most_bytes(packed: float) -> float:
    """Return how many bytes a recording of so many may unpack to."""
    return min(LARGEST, max(ALWAYS, MOST_RATIO * packed))


def refuse_bomb(path: Path, unpacked: float, packed: float, arrays: int = 0) -> None:
    """Raise InputError for a recording of so many bytes, packed to so many, that is not unpacked.

    Every caller asks for all of a recording together, before any of it takes memory.
    """
    most = most_bytes(packed)
    if unpacked > most:
        raise InputError(
            f"{path} unpacks to {unpacked / 1e9:.3g} GB, more than the {most / 1e9:.3g} GB that "
            "are read of its size; split the recording, or save it without compression"
        )
    if arrays > MOST_ARRAYS:
        fault = f"{path} holds {arrays} arrays or columns, more than the {MOST_ARRAYS} of a log"
        raise InputError(f"{fault}; save those of the arm alone")


@contextlib.contextmanager
def bounded_memory(most: float) -> Iterator[None]:
    """Let this process take so many bytes more within a block, and a little, on Linux: a library
    may unpack all that is in a file, whatever its head says. Beyond that it meets a MemoryError.
    """
    if not sys.platform.startswith("linux"):
        yield
        return
    import resource

    taken = (
        int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    )
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    bound = taken + int(most + _BESIDE)
    resource.setrlimit(
        resource.RLIMIT_AS, (bound if soft < 0 else min(bound, soft), hard)
    )
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def pieces_table(
    path: Path,
    layout: str,
    titles: Sequence[str],
    pieces: Sequence[Sequence[Array]],
    choices: ColumnChoices | None = None,
) -> LogTable:
    """Return a recording in memory, in pieces of arrays (N,) or (N, k) that stand side by side."""
    return LogTable(
        path, layout, tuple(titles), partial(_rows, pieces), choices or ColumnChoices()
    )


def _rows(pieces: Sequence[Sequence[Array]], columns: Sequence[int]) -> Iterator[Block]:
    lengths = [len(piece[0]) for piece in pieces]
    total = max(1, sum(lengths))
    start = 0
    for number, (piece, length) in enumerate(zip(pieces, lengths)):
        for first in range(0, length, BLOCK):
            parts = [
                np.asarray(part[first : first + BLOCK], dtype=float) for part in piece
            ]
            cells = np.column_stack(parts)[:, list(columns)]
            start += len(cells)
            lines = np.arange(start - len(cells), start) + 1
            yield Block(lines, cells, piece=number, done=start / total)


def arrays_table(path: Path, layout: str, arrays: Mapping[str, Any]) -> LogTable:
    """Return a recording of named arrays with one row, or column, per sample.

    A column of a two-dimensional array ``q`` is called ``q[0]``; dates are seconds from the first;
    an array of another length or
    shape, or of no numbers, is no column. Of ``group/q`` the last part is the name, if no other
    array has it. InputError where there is no array with rows.
    """
    last = [name.rsplit("/", 1)[-1] for name in arrays]
    dated = ((name, _seconds(array)) for name, array in arrays.items())
    ends = zip(last, dated)
    often = Counter(last)
    named = {end if often[end] == 1 else name: a for end, (name, a) in ends}
    sized = {n: a for n, a in named.items() if is_column(a)}
    # As many samples as times, else what most arrays have.
    times = [
        max(a.shape) for name, a in sized.items() if read_title(name).kind == "time"
    ]
    lengths = times or [max(a.shape) for a in sized.values()]
    if not lengths:
        shapes = (
            ", ".join(f"{name} {np.shape(a)}" for name, a in arrays.items())
            or "nothing"
        )
        raise InputError(f"{path} holds no arrays with a row per sample: {shapes}")
    rows = max(set(lengths), key=Counter(lengths).__getitem__)
    upright = {n: a if len(a) == rows else a.T for n, a in sized.items()}
    kept = {n: a.reshape(rows, -1) for n, a in upright.items() if len(a) == rows}
    refuse_bomb(path, 0.0, 0.0, sum(a.shape[1] for a in kept.values()))
    titles = [
        f"{name}[{k}]" if a.shape[1] > 1 else name
        for name, a in kept.items()
        for k in range(a.shape[1])
    ]
    return pieces_table(path, layout, titles, [list(kept.values())])


def nanoseconds(cell: str) -> int:
    """Return a date and time, or a time alone, as ISO 8601 writes them, or ValueError."""
    matched = DATE.fullmatch(cell)
    if matched is None:
        raise ValueError(cell)
    day, clock, sign, hours, minutes = matched.groups()
    stamp = np.datetime64(f"{day or '1970-01-01'}T{clock.replace(',', '.')}", "ns")
    ahead = 60 * int(hours or 0) + int(minutes or 0)
    return int(stamp.astype(np.int64)) - int(f"{sign or '+'}1") * ahead * 60 * 10**9


def _seconds(array: Any) -> Any:
    """Return dates, also as text, and lengths of time as seconds from the first; else the array."""
    kind = getattr(getattr(array, "dtype", None), "kind", "")
    if kind in ("M", "m") and array.size:
        return (array - array.flat[0]) / np.timedelta64(1, "s")
    if kind not in ("O", "U") or array.ndim != 1 or not array.size:
        return array
    first = array[0]
    with contextlib.suppress(ValueError, TypeError, AttributeError):
        if isinstance(first, str):
            return np.array(
                [1e-9 * (nanoseconds(each) - nanoseconds(first)) for each in array]
            )
        return np.array([(each - first).total_seconds() for each in array])
    return array


def is_column(array: Any) -> bool:
    """Return whether something may hold columns of a recording; asks for no element of it."""
    is_numbers = hasattr(array, "dtype") and array.dtype.kind in "fiub"
    return is_numbers and len(array.shape) in (1, 2) and array.size > 1


def renamed(names: Sequence[str], joint_names: Sequence[str]) -> list[str]:
    """Return a recording's names in the model's spelling, for joints that only differ in a prefix.

    ``fr3_joint1`` is ``joint1`` where no other name ends in it; upper case and underscores make no
    difference. A name that two joints could have stays as it is.
    """
    found = []
    for name in names:
        owners = (
            [] if name in joint_names else [j for j in joint_names if _alike(name, j)]
        )
        owner = owners[0] if len(owners) == 1 else name
        rivals = [n for n in names if n == owner or _alike(n, owner)]
        found.append(owner if len(rivals) == 1 else name)
    return found


def _alike(first: str, second: str) -> bool:
    """Return whether one name is the end of the other."""
    both = (re.findall(r"[a-z]+|\d+", name.lower()) for name in (first, second))
    short, long = sorted(both, key=len)
    return bool(short) and long[-len(short) :] == short and not short[0].isdigit()


def library(module: str, extra: str, what: str) -> Any:
    """Return a module that is not always installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        remedy = f"{module.split('.')[0]}: pip install 'robot-sysid[{extra}]'"
        raise InputError(f"reading {what} needs {remedy}") from None


@contextlib.contextmanager
def as_input_errors(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a library complains about in a file into an InputError.

    A pipe or a device never gets there.
    """
    refuse_special_file(path, f"give {what}")
    try:
        yield
    except SysidError:
        raise
    except MemoryError:
        fault = "asks for more memory than there is; it is damaged, or too long"
        raise InputError(f"{path} {fault}") from None
    except Exception as error:
        raise InputError(
            f"cannot read {path} as {what}: {error_text(error)}"
        ) from error


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
