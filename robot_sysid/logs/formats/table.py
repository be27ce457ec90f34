"""What every form of recording is turned into: titled columns, read block by block."""

from __future__ import annotations

import contextlib
import importlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError, SysidError, words_of
from robot_sysid.logs.column_map import ColumnChoices
from robot_sysid.logs.columns import read_title
from robot_sysid.logs.options import LogOptions
from robot_sysid.records import Array

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
    """

    path: Path
    layout: str
    titles: tuple[str, ...]
    blocks: Callable[[Sequence[int]], Iterator[Block]]
    choices: ColumnChoices = ColumnChoices()
    word: str = "row"
    first_row: tuple[str, ...] = ()

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


def pieces_table(
    path: Path,
    layout: str,
    titles: Sequence[str],
    pieces: Sequence[Array],
    choices: ColumnChoices | None = None,
) -> LogTable:
    """Return a recording that is in memory already, in pieces with cells (N, W)."""
    return LogTable(path, layout, tuple(titles), partial(_rows, pieces), choices or ColumnChoices())


def _rows(pieces: Sequence[Array], columns: Sequence[int]) -> Iterator[Block]:
    total, start = max(1, sum(map(len, pieces))), 0
    for number, piece in enumerate(pieces):
        for first in range(0, len(piece), BLOCK):
            cells = piece[first : first + BLOCK, list(columns)]
            start += len(cells)
            lines = np.arange(start - len(cells), start) + 1
            yield Block(lines, cells, piece=number, done=start / total)


def arrays_table(path: Path, layout: str, arrays: Mapping[str, Any]) -> LogTable:
    """Return a recording that is named arrays, see ``titled_arrays``."""
    titles, cells = titled_arrays(path, arrays)
    return pieces_table(path, layout, titles, (cells,))


def titled_arrays(path: Path, arrays: Mapping[str, Any]) -> tuple[tuple[str, ...], Array]:
    """Return (titles, cells (N, W)) of named arrays with one row, or column, per sample.

    A column of a two-dimensional array ``q`` is called ``q[0]``; an array of another length or
    shape, or of no numbers, is no column. Of ``group/q`` the last part is the name, if no other
    array has it. InputError where there is no array with rows.
    """
    last = [name.rsplit("/", 1)[-1] for name in arrays]
    ends = zip(last, arrays.items())
    named = {end if last.count(end) == 1 else name: np.asarray(a) for end, (name, a) in ends}
    sized = {
        n: a for n, a in named.items() if a.dtype.kind in "fiub" and a.ndim in (1, 2) and a.size > 1
    }
    # As many samples as times, else what most arrays have.
    times = [max(a.shape) for name, a in sized.items() if read_title(name).kind == "time"]
    lengths = times or [max(a.shape) for a in sized.values()]
    if not lengths:
        shapes = ", ".join(f"{name} {np.shape(a)}" for name, a in arrays.items()) or "nothing"
        raise InputError(f"{path} holds no arrays with a row per sample: {shapes}")
    rows = max(set(lengths), key=lengths.count)
    titles: list[str] = []
    columns: list[Array] = []
    for name, values in sized.items():
        upright = values if len(values) == rows else values.T
        if len(upright) == rows:
            columns.append(np.asarray(upright, dtype=float).reshape(rows, -1))
            width = columns[-1].shape[1]
            titles += [name] if width == 1 else [f"{name}[{k}]" for k in range(width)]
    return tuple(titles), np.hstack(columns)


def renamed(names: Sequence[str], joint_names: Sequence[str]) -> list[str]:
    """Return a recording's names in the model's spelling, for joints that only differ in a prefix.

    ``fr3_joint1`` is ``joint1`` where no other name ends in it; upper case and underscores make no
    difference. A name that two joints could have stays as it is.
    """
    found = []
    for name in names:
        owners = [] if name in joint_names else [j for j in joint_names if _alike(name, j)]
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
    """Turn whatever a library complains about in a file into an InputError."""
    try:
        yield
    except SysidError:
        raise
    except MemoryError:
        fault = "asks for more memory than there is; it is damaged, or too long"
        raise InputError(f"{path} {fault}") from None
    except Exception as error:
        raise InputError(f"cannot read {path} as {what}: {words_of(error)}") from error
