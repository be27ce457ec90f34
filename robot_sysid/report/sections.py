"""Sections, tables and figures of a report page, and numbers as text of table cells."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from robot_sysid.records.messages import number_text
from robot_sysid.report.drawing import Drawing

Block = tuple[str, str, str]
"""Title, explanation and preformatted text for the reader to copy."""
_NUMBER = re.compile(
    r"[-+–(]?\d|–$|$|no limit|not known|within|at its|not ident|none|prior"
)
"""Start of a cell of numbers; other cells are text."""


@dataclass(frozen=True)
class Table:
    """A table of a page; all cells are text.

    Attributes:
        header: titles of the C columns.
        rows: one tuple of C cells per row.
        note: sentence below the table; "" for none.
        title: line above the table; "" for none.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    title: str = ""

    @property
    def is_text(self) -> list[bool]:
        """Whether each of the C columns holds text, not numbers."""
        columns = list(zip(*self.rows)) or [()] * len(self.header)
        return [not all(map(_NUMBER.match, column)) for column in columns]


@dataclass(frozen=True)
class Figure:
    """A drawing or a rendered picture with its caption.

    Attributes:
        name: file name without suffix, unique on the page.
        caption: sentence below the drawing.
        drawing: the drawing; None where ``png`` has a picture.
        png: content of a PNG file, rendered by the simulator; empty where there is a ``drawing``.
    """

    name: str
    caption: str
    drawing: Drawing | None = None
    png: bytes = b""


@dataclass(frozen=True)
class Section:
    """One section of the page.

    Attributes:
        key: identifier of the section in the page, unique there.
        title: heading.
        sentences: paragraphs below the heading.
        tables: tables in order.
        figures: figures in order.
        points: items of a bulleted list.
        blocks: (title, explanation, text) of preformatted text for the reader to copy.
        folded_blocks: (title of a fold, its blocks); the fold is closed when the page opens.
        missing: one sentence for each table or figure that cannot be shown, with cause and remedy.
        verdict: of the verdict's section, "good", "bad", or "part" if a caveat limits what the
            result may be used for; "" in all other sections.
        details: (title, sentences) of folded paragraphs with further information.
        is_open: whether the section is unfolded when the page opens.
    """

    key: str
    title: str
    sentences: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    points: Sequence[str] = ()
    blocks: Sequence[Block] = ()
    folded_blocks: tuple[str, Sequence[Block]] = ("", ())
    missing: Sequence[str] = ()
    verdict: str = ""
    details: Sequence[tuple[str, Sequence[str]]] = ()
    is_open: bool = False


def text(value: Any, error: float | None = None) -> str:
    """Return a number as text of a table cell; "–" for None, NaN or infinity.

    Args:
        value: number, or None.
        error: standard error of the number, in its unit, which determines the digits shown; None
            where there is none.
    """
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    return number_text(float(value), error)


def plus_minus(error: float | None) -> str:
    """Return a standard error as text of a table cell, with the digits of a standard error.

    "not known" for None, NaN or infinity.
    """
    return "not known" if error is None else number_text(error, error)


def table(
    header: Sequence[str],
    rows: Iterable[Sequence[Any]],
    note: str = "",
    title: str = "",
) -> Table:
    """Return a table with numbers as text.

    Args:
        header: titles of the columns.
        rows: texts and numbers, one sequence per row; a number that is None or not finite is "–".
        note: sentence below the table; "" for none.
        title: line above the table; "" for none.
    """
    texts = []
    for row in rows:
        cells_of_row = [cell if isinstance(cell, str) else text(cell) for cell in row]
        texts.append(tuple(cells_of_row))
    return Table(tuple(header), tuple(texts), note, title)
