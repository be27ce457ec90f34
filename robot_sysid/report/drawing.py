"""Tables, figures and sections of a report page, and drawing of figures as SVG or PNG.

Readers with any kind of colour vision can distinguish the colours (after Okabe and Ito, "Color
universal design", 2008), and each colour has its own marker or line style as well. A figure inside
a page refers to colours by CSS variables, so that the page can be light or dark.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array
from robot_sysid.records.installation import install_hint
from robot_sysid.records.messages import number_text

MOST_ROWS = 60
"""Largest number of rows of a table; of a longer one, every n-th row is shown."""


@dataclass(frozen=True)
class Table:
    """A table of a page; all cells are text.

    Attributes:
        header: titles of the C columns.
        rows: one tuple of C cells per row.
        note: sentence below the table on units or left-out rows; "" for none.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Figure:
    """A drawing or a rendered picture with its caption and a table of its numbers.

    Attributes:
        name: file name without suffix, unique on the page.
        caption: sentence below the drawing.
        table: the numbers that the figure shows.
        drawing: matplotlib figure; None where ``png`` has a picture.
        png: content of a PNG file, rendered by the simulator; empty where there is a ``drawing``.
    """

    name: str
    caption: str
    table: Table
    drawing: Any = None
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
        blocks: (title, text) of preformatted text for the reader to copy.
        missing: one sentence for each table or figure that cannot be shown, with cause and remedy.
        verdict: of the verdict's section, "good", "bad", or "part" if the payload is only partly
            known; "" in all other sections.
        headline: the section's main numbers in one short line; "" for none.
        details: (title, sentences) of folded paragraphs with further information.
        is_open: whether the section is unfolded when the page opens.
    """

    key: str
    title: str
    sentences: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    points: Sequence[str] = ()
    blocks: Sequence[tuple[str, str]] = ()
    missing: Sequence[str] = ()
    verdict: str = ""
    headline: str = ""
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


def plus_minus(error: float) -> str:
    """Return a standard error as text of a table cell, with the digits of a standard error."""
    return number_text(error, error)


def cells(value: float, error: float) -> tuple[str, str]:
    """Return (text of a number, text of its standard error), the texts of two table cells."""
    return text(value, error), plus_minus(error)


def table(
    header: Sequence[str], rows: Iterable[Sequence[Any]], note: str = ""
) -> Table:
    """Return a table with numbers as text and at most ``MOST_ROWS`` evenly spaced rows.

    Args:
        header: titles of the columns.
        rows: texts and numbers, one sequence per row; a number that is None or not finite is "–".
        note: sentence below the table; one on left-out rows is added to it where there are any.
    """
    texts = []
    for row in rows:
        cells_of_row = [cell if isinstance(cell, str) else text(cell) for cell in row]
        texts.append(tuple(cells_of_row))
    step = math.ceil(len(texts) / MOST_ROWS)
    if step > 1:
        thinning_note = (
            f"every {step}th of {len(texts)} rows; report_data.npz holds all that is "
            "drawn"
        )
        note = f"{note} {thinning_note}".strip()
    return Table(tuple(header), tuple(texts[:: step or 1]), note)


INK = "#1b1f24"
"""Colour of text, axes and outlines."""
GRID = "#d3d7dc"
"""Colour of grid lines."""
BEFORE = "#b3540a"
"""Colour of values of the model before identification (orange)."""
AFTER = "#0b62a8"
"""Colour of identified values (blue)."""
TRUTH = "#0a7a5c"
"""Colour of the true values of a simulated arm (green)."""
MEASURED = "#6b7178"
"""Colour of measured values (grey)."""
OTHER = "#8a3f9a"
"""Colour of limits and of series that have no colour above (purple)."""
VARIABLES = {
    INK: "ink",
    GRID: "grid",
    BEFORE: "before",
    AFTER: "after",
    TRUTH: "truth",
    MEASURED: "measured",
    OTHER: "other",
}
"""Colour to the name of its CSS variable in the page's style sheet."""
SERIES = ((AFTER, "o"), (BEFORE, "D"), (TRUTH, "s"), (OTHER, "^"), (MEASURED, "v"))
"""(colour, marker) of the first, second, ... series of a figure."""
WIDTH = 4.6
"""Width of every figure [inch]: two fit side by side on a screen, one on a phone."""
HATCHES = ("", "///", "...", "xxx", "\\\\\\", "++", "oo")
"""Hatch pattern (matplotlib) of the bars of the first, second, ... series of a figure."""
_SCATTERED = 400
"""Least number of dots to which a longer scatter plot is thinned; fewer than twice as many remain.
More dots would overlap."""
_DPI = 150
"""Resolution of a PNG file [dots per inch]: about twice that of a screen."""
_STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    **dict.fromkeys(("axes.edgecolor", "axes.labelcolor", "text.color"), INK),
    **dict.fromkeys(("xtick.color", "ytick.color"), INK),
    **dict.fromkeys(("axes.grid", "axes.axisbelow"), True),
    **dict.fromkeys(
        ("axes.spines.top", "axes.spines.right", "axes.formatter.useoffset"), False
    ),
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.1,
    **dict.fromkeys(
        ("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"
    ),
    "svg.fonttype": "none",
    # Names of joints and files are text, never formulas.
    "text.parse_math": False,
}
"""Settings of matplotlib (``rcParams``) under which every figure is drawn and saved."""


def require_libraries() -> None:
    """Raise InputError if matplotlib or jinja2 is missing or matplotlib has no cache folder.

    A run calls this before its long computations, so that it does not fail at their end. Silences
    matplotlib's warnings for the rest of the process.
    """
    libraries = ("matplotlib", "jinja2")
    missing = [name for name in libraries if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"a report {install_hint(' and '.join(missing), 'report')}")
    # Without this, matplotlib warns when it moves its cache to a temporary folder.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    try:
        importlib.import_module("matplotlib")
    except OSError:
        raise InputError(
            "a report needs a folder for matplotlib's cache; set MPLCONFIGDIR to one that can be "
            "written to"
        ) from None


@contextlib.contextmanager
def _matplotlib_style(name: str) -> Iterator[None]:
    """Apply ``_STYLE`` to matplotlib and silence its warnings inside a ``with`` block.

    Ids in an SVG are hashed from the figure's ``name``, so that they are reproducible.
    """
    import matplotlib

    style: Any = {**_STYLE, "svg.hashsalt": name}
    with warnings.catch_warnings(), matplotlib.rc_context(style):
        # A letter that the font lacks is still text in the SVG.
        warnings.simplefilter("ignore")
        yield


def draw_figure(
    name: str,
    caption: str,
    numbers: tuple[Sequence[str], Iterable[Sequence[Any]]],
    height: float,
    draw: Callable[[Any], None],
) -> Figure:
    """Draw and return a figure with its caption and a table of its numbers.

    Args:
        name: name of the figure's files without suffix, unique on the page.
        caption: sentence below the drawing.
        numbers: (header, rows) of the figure's table, as of ``table``.
        height: height of the drawing [inch]; its width is ``WIDTH``.
        draw: adds axes and curves to the empty matplotlib figure it is called with.
    """
    from matplotlib.figure import Figure as Canvas

    with _matplotlib_style(name):
        canvas = Canvas(figsize=(WIDTH, height), layout="constrained")
        draw(canvas)
    return Figure(name, caption, table(*numbers), canvas)


Curves = Mapping[str, tuple[Array, dict[str, Any]]]
"""Label that ends in a unit, as "measured [N·m]", to (values (K,), style for matplotlib)."""


@dataclass(frozen=True)
class Panel:
    """One pair of axes of a figure, with curves; all panels of a figure share the horizontal axis.

    Attributes:
        label: label of the vertical axis.
        curves: label of each curve to its values (K,) and style, see ``Curves``.
        marks: vertical coordinates of dashed horizontal lines.
        cloud: horizontal (M,) and vertical (M,) coordinates of a thinned scatter plot; None for
            none.
        height: height relative to that of the other panels.
    """

    label: str
    curves: Curves
    marks: Sequence[float] = ()
    cloud: tuple[Array, Array] | None = None
    height: float = 1.0


def curves_figure(
    name: str,
    caption: str,
    across: tuple[str, Array],
    panels: Sequence[Panel],
    height: float,
) -> Figure:
    """Return a figure of panels below each other, with a table of all their curves.

    Args:
        name: name of the figure's files without suffix, unique on the page.
        caption: sentence below the drawing.
        across: label and values (K,) of the common horizontal axis; a NaN interrupts the curves.
        panels: the panels from top to bottom; all curves have K values and labels of their own.
        height: height of the drawing [inch].
    """
    horizontal_label, horizontal_values = across
    curve_values: dict[str, Array] = {}
    for panel in panels:
        for label, (values, _) in panel.curves.items():
            curve_values[label] = values

    def draw(canvas: Any) -> None:
        """Draw all panels on an empty matplotlib figure."""
        ratios = [panel.height for panel in panels]
        axes = canvas.subplots(
            len(panels), 1, sharex=True, squeeze=False, height_ratios=ratios
        )
        for (ax,), panel in zip(axes, panels):
            if panel.cloud is not None:
                draw_dots(ax, *panel.cloud)
            for label, (values, style) in panel.curves.items():
                label_without_unit = label.split(" [")[0]
                ax.plot(horizontal_values, values, label=label_without_unit, **style)
            for mark in panel.marks:
                ax.axhline(mark, color=OTHER, ls="--", lw=1.0)
            ax.set_ylabel(panel.label)
        axes[-1, 0].set_xlabel(horizontal_label)
        canvas.align_ylabels()
        if len(panels[0].curves) > 1:
            draw_legend(canvas, axes[0, 0])

    header = (horizontal_label, *curve_values)
    numbers = np.column_stack((horizontal_values, *curve_values.values()))
    rows = numbers[np.isfinite(horizontal_values)]
    return draw_figure(name, caption, (header, rows), height, draw)


def svg(figure: Figure) -> str:
    """Return the text of an SVG file of a figure that has a ``drawing``.

    The text has neither date nor random ids, so that equal drawings give equal texts.
    """
    buffer = io.StringIO()
    with _matplotlib_style(figure.name):
        figure.drawing.savefig(
            buffer, format="svg", metadata={"Date": None, "Creator": None}
        )
    return buffer.getvalue()


def png(figure: Figure) -> bytes:
    """Return the content of a PNG file of a figure; a drawing gets a white background."""
    if figure.png:
        return figure.png
    buffer = io.BytesIO()
    with _matplotlib_style(figure.name):
        # matplotlib's version would make equal drawings differ.
        metadata = {"Software": None}
        figure.drawing.savefig(
            buffer, format="png", dpi=_DPI, facecolor="w", metadata=metadata
        )
    return buffer.getvalue()


_DROPPED = re.compile(
    r' id="[A-Za-z][A-Za-z0-9]*_\d+"|<style.*?</style>|<metadata>.*?</metadata>',
    re.DOTALL,
)
"""Text of an SVG file that is removed inside a page: ids that nothing refers to, which might occur
twice on the page; style sheets, which would hold for the whole page; metadata."""
_SIZE = re.compile(r'(<svg[^>]*?) (?:width|height)="[^"]*"')
"""Width or height of the ``<svg>`` element; without them, the page scales the drawing."""


def inline_svg(figure: Figure) -> str:
    """Return a figure's drawing as an ``<svg>`` element of a page.

    The element has no fixed size, refers to colours by the page's CSS variables and shares no id
    with another one.
    """
    text = svg(figure)
    text = _DROPPED.sub("", text[text.index("<svg") :])
    # One substitution for the width and one for the height.
    text = _SIZE.sub(r"\1", text)
    text = _SIZE.sub(r"\1", text)
    for colour, variable in VARIABLES.items():
        text = text.replace(colour, f"var(--{variable})")
    width_points = 72.0 * float(figure.drawing.get_figwidth())
    # Screen readers read the caption instead of the drawing.
    return text.replace(
        "<svg",
        f'<svg aria-hidden="true" style="max-width:{1.5 * width_points:.0f}px"',
        1,
    )


def draw_legend(canvas: Any, axes: Any, columns: int = 3) -> None:
    """Draw the legend of one pair of axes above all axes of a figure; nothing without labels.

    Args:
        canvas: matplotlib figure to draw on.
        axes: axes whose labelled curves the legend lists.
        columns: number of columns of the legend.
    """
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        canvas.legend(handles, labels, loc="outside upper center", ncols=columns)


def draw_dots(axes: Any, x: Array, values: Array) -> None:
    """Draw a scatter plot in the colour ``MEASURED``, thinned to fewer than 800 dots.

    Args:
        axes: matplotlib axes to draw on.
        x: horizontal coordinates (K,).
        values: vertical coordinates (K,); those that are not finite are left out.
    """
    indices = np.flatnonzero(np.isfinite(values))
    indices = indices[:: max(1, len(indices) // _SCATTERED)]
    axes.plot(x[indices], values[indices], ".", color=MEASURED, ms=2.5, alpha=0.7)


def draw_bars(
    canvas: Any,
    groups: Sequence[str],
    series: Sequence[tuple[str, Any, str]],
    label: str,
) -> None:
    """Draw a grouped horizontal bar chart with a legend on an empty matplotlib figure.

    Args:
        canvas: matplotlib figure to draw on.
        groups: names of the n groups, from top to bottom, each with one bar per series.
        series: (name, lengths of the bars (n,), colour) of at most ``len(HATCHES)`` series; a
            length that is not finite is drawn as no bar.
        label: label of the horizontal axis.
    """
    axes = canvas.subplots()
    height = 0.8 / len(series)
    positions = -np.arange(len(groups), dtype=float)
    for index, (name, lengths, colour) in enumerate(series):
        style = {
            "facecolor": colour,
            "edgecolor": INK,
            "alpha": 0.8,
            "hatch": HATCHES[index],
        }
        drawable = np.where(np.isfinite(lengths), lengths, 0.0)
        bar_positions = positions - height * (index - 0.5 * (len(series) - 1))
        axes.barh(
            bar_positions, drawable, 0.92 * height, label=shorten(name, 40), **style
        )
    axes.set_yticks(positions, list(map(shorten, groups)))
    axes.set_xlabel(label)
    draw_legend(canvas, axes, 1)


def shorten(name: str, max_length: int = 22) -> str:
    """Return a name, cut to ``max_length`` characters, the last an ellipsis, if it is longer."""
    return name if len(name) <= max_length else f"{name[: max_length - 1]}…"
