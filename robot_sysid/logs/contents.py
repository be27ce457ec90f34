"""What is in a log, without a model to compare it with."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robot_sysid.logs.columns import joint_kind, read_title
from robot_sysid.logs.formats.dialect import is_number
from robot_sysid.logs.formats.recognise import open_table
from robot_sysid.logs.formats.table import LogTable
from robot_sysid.logs.options import LogOptions
from robot_sysid.records import Array
from robot_sysid.records.progress import Progress


def content_lines(path: Path, options: LogOptions, progress: Progress) -> list[str]:
    """Return lines on a log's form and on the numbers in each of its columns.

    Args:
        path: the log.
        options: what was said of it.
        progress: where to tell how far it is.

    Raises:
        InputError: it cannot be read.
    """
    table = open_table(Path(path), (), options)
    numeric = [k for k, cell in enumerate(table.first_row) if is_number(cell)]
    columns = numeric if table.first_row else list(range(len(table.titles)))
    rows, extent = _extent(table, columns, progress)
    lines = [f"log layout: {table.layout}", f"{rows} {table.word}s"]
    width = max(map(len, table.titles))
    for column, (least, most, holes) in zip(columns, extent.tolist()):
        title = table.titles[column]
        kind = "time" if read_title(title).kind == "time" else joint_kind(read_title(title))
        numbers = f"{least:12.6g} to {most:12.6g}" if least <= most else "no numbers"
        empty = f", {holes:.0f} empty" if holes else ""
        lines.append(f"  {title:{width}}  {numbers}{empty}" + (f"  ({kind})" if kind else ""))
    lines.append("give the model too, to see which column is taken for what and what is wrong")
    return lines


def _extent(table: LogTable, columns: Sequence[int], progress: Progress) -> tuple[int, Array]:
    """Return (rows, (C, 3) least, largest and number of empty cells of columns)."""
    extent = np.tile([np.inf, -np.inf, 0.0], (len(columns), 1))
    rows = 0
    for block in table.blocks(columns):
        rows += len(block.cells)
        there = np.isfinite(block.cells)
        extent[:, 2] += np.count_nonzero(~there, axis=0)
        least = np.min(np.where(there, block.cells, np.inf), axis=0, initial=np.inf)
        most = np.max(np.where(there, block.cells, -np.inf), axis=0, initial=-np.inf)
        extent[:, 0] = np.minimum(extent[:, 0], least)
        extent[:, 1] = np.maximum(extent[:, 1], most)
        progress.advance(f"Reading {table.path.name}", min(block.done, 0.999), 1.0, f"{rows} rows")
    progress.advance(f"Reading {table.path.name}", 1.0, 1.0, "")
    return rows, extent
