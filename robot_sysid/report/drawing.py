"""Tables, figures and sections of a page, and the style of figures as SVG or PNG.

Colours are told apart by every kind of colour vision (after Okabe and Ito, "Color universal
design", 2008), and each goes with a marker or a line of its own. Inside a page they are variables,
so that the page can be light or dark.
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
from robot_sysid.records.messages import number_text

MOST_ROWS = 60
"""Rows of a figure's table; more are thinned."""


@dataclass(frozen=True)
class Table:
    """Numbers in rows, as text; the note says what is left out."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Figure:
    """A drawing with its caption and its numbers.

    Attributes:
        name: of its files, unique on the page.
        drawing: of matplotlib; None where there is a photograph.
        png: a photograph instead.
    """

    name: str
    caption: str
    table: Table
    drawing: Any = None
    png: bytes = b""


@dataclass(frozen=True)
class Section:
    """One part of the page.

    Attributes:
        blocks: (title, text) of what is to be copied as it is.
        missing: what is not there and what would make it so, one sentence each.
        verdict: "good", "part" where some of it is not known, "bad", or "".
        headline: what stands out of it.
        details: (title, sentences) of what only some want to read.
        is_open: whether a part is unfolded from the beginning.
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
    """Return a number as a cell; a dash where there is none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    return number_text(float(value), error)


def plus_minus(error: float) -> str:
    """Return a standard error as a cell."""
    return number_text(error, error)


def cells(value: float, error: float) -> tuple[str, str]:
    """Return a number and its standard error as cells."""
    return text(value, error), plus_minus(error)


def table(
    header: Sequence[str], rows: Iterable[Sequence[Any]], note: str = ""
) -> Table:
    """Return a table of texts and numbers; with more than ``MOST_ROWS`` rows, some of them."""
    texts = [
        tuple(cell if isinstance(cell, str) else text(cell) for cell in row)
        for row in rows
    ]
    step = -(-len(texts) // MOST_ROWS)
    if step > 1:
        thinning_note = (
            f"every {step}th of {len(texts)} rows; report_data.npz holds all that is "
            "drawn"
        )
        note = f"{note} {thinning_note}".strip()
    return Table(tuple(header), tuple(texts[:: step or 1]), note)


INK = "#1b1f24"
GRID = "#d3d7dc"
BEFORE = "#b3540a"
AFTER = "#0b62a8"
TRUTH = "#0a7a5c"
MEASURED = "#6b7178"
OTHER = "#8a3f9a"
_NAMES = ("ink", "grid", "before", "after", "truth", "measured", "other")
VARIABLES = dict(zip((INK, GRID, BEFORE, AFTER, TRUTH, MEASURED, OTHER), _NAMES))
"""Colour to the name of its variable in the page's style."""
SERIES = ((AFTER, "o"), (BEFORE, "D"), (TRUTH, "s"), (OTHER, "^"), (MEASURED, "v"))
"""Colour and marker of the first, second, ... of several things beside each other."""
WIDTH = 4.6
"""Of figures [inch]: two beside each other on a screen, one on a phone."""
HATCHES = ("", "///", "...", "xxx", "\\\\\\", "++", "oo")
"""Of the first, second, ... of several bars beside each other."""
_SCATTERED = 400
"""Dots of a cloud: more of them are one blot."""
_DPI = 150
"""Of a PNG: twice what a screen shows."""
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


def require_libraries() -> None:
    """Raise InputError where figures cannot be drawn; asked before a long run."""
    missing = [
        n for n in ("matplotlib", "jinja2") if importlib.util.find_spec(n) is None
    ]
    if missing:
        raise InputError(
            f"a report needs {' and '.join(missing)}; install with: "
            'pip install "robot-sysid[report]"'
        )
    # What it says of a cache that is not where it should be matters to nobody here.
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
    """Return a figure of a height [inch], with header and rows of its table."""
    from matplotlib.figure import Figure as Canvas

    with _matplotlib_style(name):
        canvas = Canvas(figsize=(WIDTH, height), layout="constrained")
        draw(canvas)
    return Figure(name, caption, table(*numbers), canvas)


Curves = Mapping[str, tuple[Array, dict[str, Any]]]


@dataclass(frozen=True)
class Panel:
    """Curves over one axis.

    Attributes:
        label: of the upright axis.
        curves: name to values (K,) and matplotlib's style; a name ends in its unit.
        marks: values at which a dashed line is drawn.
        cloud: places (K,) and values (K,) that are drawn as dots; some of them.
        height: beside the other panels.
    """

    label: str
    curves: Curves
    marks: Sequence[float] = ()
    cloud: tuple[Array, Array] | None = None
    height: float = 1.0


def curves(
    name: str,
    caption: str,
    across: tuple[str, Array],
    panels: Sequence[Panel],
    height: float,
) -> Figure:
    """Return curves in panels over one axis, ``across``, broken where that is NaN; with a table."""
    every = {
        label: values for panel in panels for label, (values, _) in panel.curves.items()
    }

    def draw(canvas: Any) -> None:
        ratios = [panel.height for panel in panels]
        axes = canvas.subplots(
            len(panels), 1, sharex=True, squeeze=False, height_ratios=ratios
        )
        for (ax,), panel in zip(axes, panels):
            if panel.cloud is not None:
                dots(ax, *panel.cloud)
            for label, (values, style) in panel.curves.items():
                ax.plot(across[1], values, label=label.split(" [")[0], **style)
            for mark in panel.marks:
                ax.axhline(mark, color=OTHER, ls="--", lw=1.0)
            ax.set_ylabel(panel.label)
        axes[-1, 0].set_xlabel(across[0])
        canvas.align_ylabels()
        if len(panels[0].curves) > 1:
            legend(canvas, axes[0, 0])

    rows = [row for row in zip(across[1], *every.values()) if np.isfinite(row[0])]
    return draw_figure(name, caption, ((across[0], *every), rows), height, draw)


def svg(figure: Figure) -> str:
    """Return a drawing as an SVG file; the same text for the same drawing."""
    buffer = io.StringIO()
    with _matplotlib_style(figure.name):
        figure.drawing.savefig(
            buffer, format="svg", metadata={"Date": None, "Creator": None}
        )
    return buffer.getvalue()


def png(figure: Figure) -> bytes:
    """Return a drawing as PNG on white."""
    if figure.png:
        return figure.png
    buffer = io.BytesIO()
    with _matplotlib_style(figure.name):
        facts = {"Software": None}
        figure.drawing.savefig(
            buffer, format="png", dpi=_DPI, facecolor="w", metadata=facts
        )
    return buffer.getvalue()


_DROPPED = re.compile(
    r' id="[A-Za-z][A-Za-z0-9]*_\d+"|<style.*?</style>|<metadata>.*?</metadata>',
    re.DOTALL,
)
"""What a drawing inside a page has no use for: ids that nothing refers to, styles, facts."""
_SIZE = re.compile(r'(<svg[^>]*?) (?:width|height)="[^"]*"')


def inline(figure: Figure) -> str:
    """Return a drawing as part of a page: scaled by it, in its colours, no id used twice."""
    text = svg(figure)
    text = _DROPPED.sub("", text[text.index("<svg") :])
    text = _SIZE.sub(r"\1", _SIZE.sub(r"\1", text))
    for colour, variable in VARIABLES.items():
        text = text.replace(colour, f"var(--{variable})")
    width = 72.0 * float(figure.drawing.get_figwidth())
    # For readers who do not see it the caption says what it is.
    return text.replace(
        "<svg", f'<svg aria-hidden="true" style="max-width:{1.5 * width:.0f}px"', 1
    )


def legend(canvas: Any, axes: Any, columns: int = 3) -> None:
    """Put one legend above all axes."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        canvas.legend(handles, labels, loc="outside upper center", ncols=columns)


def dots(axes: Any, x: Array, values: Array) -> None:
    """Draw finite values over places, both (K,), as small dots; at most about 400 of them."""
    indices = np.flatnonzero(np.isfinite(values))
    indices = indices[:: max(1, len(indices) // _SCATTERED)]
    axes.plot(x[indices], values[indices], ".", color=MEASURED, ms=2.5, alpha=0.7)


def bars(
    canvas: Any,
    groups: Sequence[str],
    series: Sequence[tuple[str, Any, str]],
    label: str,
) -> None:
    """Draw bars below each other; (name, lengths (n,), colour) of the first, ... of each group.

    What is not finite is not drawn.
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
    axes.set_yticks(positions, [shorten(name) for name in groups])
    axes.set_xlabel(label)
    legend(canvas, axes, 1)


def shorten(name: str, most: int = 22) -> str:
    """Return a name, cut to at most some characters with an ellipsis at its end."""
    return name if len(name) <= most else f"{name[: most - 1]}…"
