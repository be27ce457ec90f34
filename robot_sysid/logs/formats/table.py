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
from robot_sysid.logs.column_map import ColumnChoices
from robot_sysid.logs.columns import read_title
from robot_sysid.logs.options import LogOptions
from robot_sysid.records import Array
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
