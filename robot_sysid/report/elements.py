"""What a page is made of: sections with sentences, tables, figures and pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from robot_sysid.records.figures import figure as number_text

MOST_ROWS = 60
"""Rows of a figure's table; more are thinned."""


@dataclass(frozen=True)
class Table:
    """Numbers in rows.

    Attributes:
        header: one title per column, with unit.
        rows: cells as text.
        note: what is left out, or "".
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Figure:
    """A drawing with its caption and its numbers.

    Attributes:
        name: of its files, unique on the page.
        caption: what is to be seen, with the unit.
        table: its numbers.
        drawing: of matplotlib; None where there is a photograph.
        png: a photograph instead.
        wide: whether it takes the whole width of the page.
    """

    name: str
    caption: str
    table: Table
    drawing: Any = None
    png: bytes = b""
    wide: bool = False


@dataclass(frozen=True)
class Section:
    """One part of the page.

    Attributes:
        key: its anchor.
        title: in a few words.
        sentences: paragraphs.
        tables, figures: what it shows.
        points: a list of sentences.
        blocks: (title, text) of what is to be copied as it is.
        missing: what is not there and what would make it so, one sentence each.
        verdict: "good", "bad" or "".
        details: (title, sentences) of what only some want to read.
    """

    key: str
    title: str
    sentences: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()
    points: tuple[str, ...] = ()
    blocks: tuple[tuple[str, str], ...] = ()
    missing: tuple[str, ...] = ()
    verdict: str = ""
    details: tuple[tuple[str, tuple[str, ...]], ...] = ()


def text(value: Any, error: float | None = None) -> str:
    """Return a number as a cell; a dash where there is none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    return number_text(float(value), error)


def plus_minus(error: float | None) -> str:
    """Return a standard error as a cell."""
    if error is None or not math.isfinite(error):
        return "not known"
    return number_text(error, error)


def table(header: Sequence[str], rows: Iterable[Sequence[Any]], note: str = "") -> Table:
    """Return a table of texts and numbers."""
    cells = tuple(
        tuple(cell if isinstance(cell, str) else text(cell) for cell in row) for row in rows
    )
    return thinned(Table(tuple(header), cells, note))


def thinned(whole: Table) -> Table:
    """Return a table with at most ``MOST_ROWS`` rows, and say so."""
    count = len(whole.rows)
    if count <= MOST_ROWS:
        return whole
    step = -(-count // MOST_ROWS)
    said = f"every {step}th of {count} rows; report_data.npz holds all that is drawn"
    return replace(whole, rows=whole.rows[::step], note=f"{whole.note} {said}".strip())
