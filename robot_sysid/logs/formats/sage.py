"""SAGE's state_motor.csv: a row is ``type,timestamp,"[positions]","[velocities]","[torques]"``."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.column_file import ColumnChoices, Units
from robot_sysid.logs.formats import table
from robot_sysid.logs.formats.dialect import LogDialect
from robot_sysid.logs.formats.joint_titles import renamed
from robot_sysid.logs.formats.table import Block

HEADER = ("type", "timestamp", "positions", "velocities", "torques")
_NAMES_FILE = "joint_list.txt"
# The simulation writes STATE_MOTOR and seconds, the recorder of a real robot StateMotor and us.
_TIMES = {"STATE_MOTOR": "s", "StateMotor": "us"}


@dataclass(frozen=True)
class SageTable:
    """A recording of SAGE.

    Attributes:
        dialect: of the text file.
        titles: one per position, velocity and torque of each joint.
        choices: the unit of time.
    """

    dialect: LogDialect
    titles: tuple[str, ...]
    choices: ColumnChoices
    word: str = "line"
    layout: str = "SAGE state_motor.csv"
    first_row: tuple[str, ...] = ()

    @property
    def path(self) -> Path:
        """The file."""
        return self.dialect.path

    def blocks(self, columns: Sequence[int]) -> Iterator[Block]:
        """Yield the rows of measured states."""
        rows = self.dialect.data_lines()
        while batch := list(islice(rows, table.BLOCK)):
            parsed = [(line, _numbers(text, len(self.titles))) for line, text in batch]
            kept = [(line, cells) for line, cells in parsed if cells is None or len(cells)]
            lines = np.array([line for line, _ in kept], np.int64)
            nothing = [np.nan] * len(self.titles)
            cells = np.array([nothing if c is None else c for _, c in kept], float)
            wanted = cells.reshape(len(kept), len(self.titles))[:, list(columns)]
            unreadable = lines[[c is None for _, c in kept]] if kept else table.NO_LINES
            yield Block(lines, wanted, unreadable, done=self.dialect.share_read())


def sage_table(dialect: LogDialect, joint_names: Sequence[str]) -> SageTable:
    """Return a recording of SAGE; the joints' names stand in a file beside it.

    Raises:
        InputError: it holds no measured states.
    """
    cells = next((c for c in map(_cells, _texts(dialect)) if c and c[0] in _TIMES), None)
    if cells is None:
        raise InputError(f"{dialect.path} holds no rows of type {' or '.join(_TIMES)}")
    try:
        count = len(_list(cells[2]))
    except (IndexError, ValueError):
        raise InputError(
            f"{dialect.path}: its first row of type {cells[0]} lists no positions; record it again"
        ) from None
    names = _names(dialect.path.parent / _NAMES_FILE, count)
    shown = [f"{name} " for name in renamed(names, joint_names)] if names else [""] * count
    titles = ["timestamp"]
    for quantity in ("position", "velocity", "torque"):
        titles += [f"{n}{quantity}" + ("" if n else f"[{k}]") for k, n in enumerate(shown)]
    return SageTable(dialect, tuple(titles), ColumnChoices(units=Units(time=_TIMES[cells[0]])))


def _texts(dialect: LogDialect) -> Iterator[str]:
    return (text for _, text in islice(dialect.data_lines(), table.BLOCK))


def _names(path: Path, count: int) -> list[str]:
    if not path.is_file():
        return []
    names = [line.strip() for line in path.read_text("utf-8-sig", errors="replace").splitlines()]
    names = [name for name in names if name]
    return names if len(names) == count else []


def _cells(text: str) -> list[str]:
    try:
        return next(csv.reader(io.StringIO(text)), [])
    except csv.Error:
        return []


def _list(text: str) -> list[float]:
    return [float(cell) for cell in text.strip(" []").replace(",", " ").split()]


def _numbers(text: str, width: int) -> list[float] | None:
    """Return a row's numbers; nothing for another type of row, None for no row at all."""
    cells = _cells(text)
    if cells and cells[0] not in _TIMES and len(cells) >= len(HEADER):
        return []
    try:
        lists = [number for cell in cells[2:5] for number in _list(cell)]
        row = [float(cells[1]), *lists]
    except (ValueError, IndexError):
        return None
    return row if len(row) == width else None
