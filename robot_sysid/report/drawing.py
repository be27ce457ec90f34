"""Drawing of figures by matplotlib: panels with axes, as SVG inside a page or as SVG and PNG files.

Readers with any kind of colour vision can distinguish the colours (after Okabe and Ito, "Color
universal design", 2008). In a file a colour is that of ``COLOURS``; inside a page it is a CSS
variable, so that the page can be light or dark.
"""

from __future__ import annotations

import importlib
import importlib.util
import io
import logging
import math
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Union

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array
from robot_sysid.records.installation import install_hint

COLOURS = {
    "ink": "#1b1f24",
    "grid": "#d3d7dc",
    "before": "#b3540a",
    "after": "#0b62a8",
    "truth": "#0a7a5c",
    "measured": "#6b7178",
    "other": "#8a3f9a",
}
"""Name of a colour to the colour (RGB, hexadecimal) in a file: text and axes, grid lines, values of
the model before (orange), identified values (blue), true values of a simulated arm (green),
measured values (grey), limits and further series (purple)."""
SERIES = ("after", "before", "truth", "other", "measured")
"""Colours of the first, second, ... series of a figure."""
WIDTH = 460.0
"""Width of every drawing [px]: two fit side by side on a screen, one on a phone."""
_FONT = 13.0
"""Size of text [px]."""
_LETTER = 0.6 * _FONT
"""Width of a letter [px], a little more than that of usual fonts."""
_LINE = 1.35 * _FONT
"""Height of a line of text [px]."""
_GAP = 6.0
"""Distance of labels from axes and from each other [px]."""
_BELOW = 2.4 * _LINE
"""Height of the labels below axes [px]."""
_TICK_ROOM = (60.0, 30.0)
"""Least distance of ticks on a horizontal and on a vertical axis [px]."""
_NARROWEST = 0.02
"""Least length of an axis as a share of its largest number; less would magnify rounding errors."""
_MAX_DOTS = 150
"""Number of dots to which a longer scatter plot is thinned; fewer than twice as many remain. More
dots would overlap."""
_STYLE: dict[str, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": COLOURS["ink"],
    "axes.facecolor": "none",
    "axes.formatter.limits": (-3, 5),
    "axes.formatter.useoffset": False,
    "axes.grid": True,
    "axes.labelcolor": COLOURS["ink"],
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.unicode_minus": False,
    "axes.xmargin": 0.04,
    "axes.ymargin": 0.04,
    "figure.dpi": 72.0,
    "figure.facecolor": "none",
    "font.family": "DejaVu Sans",
    "font.size": _FONT,
    "grid.color": COLOURS["grid"],
    "grid.linewidth": 1.0,
    "legend.borderaxespad": 0.3,
    "legend.borderpad": 0.0,
    "legend.frameon": False,
    "legend.labelspacing": 0.3,
    "lines.solid_capstyle": "round",
    "svg.fonttype": "none",
    "text.color": COLOURS["ink"],
    # Names of joints and files are text, never formulas.
    "text.parse_math": False,
    "xtick.bottom": False,
    "xtick.labelcolor": COLOURS["ink"],
    "ytick.labelcolor": COLOURS["ink"],
    "ytick.left": False,
}
"""matplotlib's settings for all drawings."""
_NOT_INLINE = re.compile(
    r'\s*\n| id="[\w.]+_\d+"| transform="rotate\(-0 [^"]*"|\bfont[\w-]*:[^;"]*;? ?'
)
"""What a page needs not of tags of matplotlib's SVG: ends of lines; names of groups, which figures
share; turns by zero; fonts, which are those of the page."""


@dataclass(frozen=True)
class Line:
    """A curve of a panel through points (x, y), each (K,); NaN interrupts it.

    ``label`` is its text in the legend, "" for none; ``width`` is in px; ``style`` is matplotlib's,
    "-" or "--".
    """

    x: Array
    y: Array
    colour: str
    label: str = ""
    width: float = 1.4
    style: str = "-"


@dataclass(frozen=True)
class Points:
    """Markers of a panel at points (x, y), each (K,); those that are not finite are left out.

    ``marker`` is matplotlib's; dots (".") are thinned. ``errors`` (K,) are half the lengths of
    horizontal error bars, or None.
    """

    x: Array
    y: Array
    colour: str
    label: str = ""
    marker: str = "."
    errors: Array | None = None
    is_filled: bool = False


@dataclass(frozen=True)
class Boxes:
    """Filled boxes of a panel, from (left, bottom) to (right, top), each (K,)."""

    left: Array
    right: Array
    bottom: Array
    top: Array
    colour: str
    label: str = ""
    opacity: float = 0.8


Mark = Union[Line, Points, Boxes]


@dataclass(frozen=True)
class Panel:
    """One pair of axes with its marks, drawn in order.

    Attributes:
        marks: what is drawn.
        x_label: label of the horizontal axis; "" for an axis without numbers.
        y_label: label of the vertical axis.
        height: height relative to that of the other panels.
        row_names: names of the rows y = 0, -1, -2, ...; empty for a vertical axis with numbers.
        x_range: ends of the horizontal axis; None for those of the marks, with a margin.
    """

    marks: Sequence[Mark]
    x_label: str = ""
    y_label: str = ""
    height: float = 1.0
    row_names: Sequence[str] = ()
    x_range: tuple[float, float] | None = None


@dataclass(frozen=True)
class Drawing:
    """Panels with one legend above all of them.

    Attributes:
        panels: panels from left to right and from top to bottom; each row has the height of its
            first. Where that of the first row has no ``x_label``, all rows share the last label.
        height: height of all panels with their labels, without the legend [px].
        n_columns: number of panels in a row.
    """

    panels: Sequence[Panel]
    height: float
    n_columns: int = 1


@contextmanager
def _style(name: str = "") -> Iterator[None]:
    """Apply ``_STYLE``, and derive the names of shapes from ``name``; hide matplotlib's warnings.

    It warns of each letter that its font lacks; the reader's font may have it.
    """
    from matplotlib import rc_context

    settings: Any = {**_STYLE, "svg.hashsalt": name}
    with rc_context(settings), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _draw(drawing: Drawing) -> Any:
    """Return a drawing as matplotlib's figure."""
    from matplotlib.figure import Figure

    panels = drawing.panels
    n_columns = drawing.n_columns
    labels = {mark.label for panel in panels for mark in panel.marks if mark.label}
    legend_widths = [50.0 + _LETTER * len(_legend_text(label)) for label in labels]
    n_legend_columns = max(1, len(labels))
    if sum(legend_widths) > WIDTH:
        n_legend_columns = max(1, int(WIDTH / max(legend_widths)))
    top = math.ceil(len(labels) / n_legend_columns) * _LINE + _GAP
    whole_height = top + drawing.height
    ratios = [panel.height for panel in panels[::n_columns]]
    row_gap = _BELOW if panels[0].x_label else _LINE
    axes_height = drawing.height - _BELOW - row_gap * (len(ratios) - 1)
    figure = Figure(figsize=(WIDTH / 72.0, whole_height / 72.0))
    figure.subplots(len(ratios), n_columns, height_ratios=ratios)
    label_widths = []
    handle_of: dict[str, Any] = {}
    heights = np.repeat(axes_height * np.array(ratios) / sum(ratios), n_columns)
    for axes, panel, height in zip(figure.axes, panels, heights.tolist()):
        _draw_marks(axes, panel)
        label_widths.append(_set_ticks(axes, panel, WIDTH / n_columns, height))
        # Fixed places are found faster than those beside the ticks' labels.
        axes.xaxis.set_label_coords(0.5, -1.4 * _LINE / height)
        handles, texts = axes.get_legend_handles_labels()
        handle_of = dict(zip(texts, handles)) | handle_of
    left = 1.6 * _LINE + _GAP + max(label_widths)
    width = (WIDTH - _LINE) / n_columns - left
    for axes in figure.axes:
        axes.yaxis.set_label_coords((1.3 * _LINE - left) / width, 0.5)
    figure.subplots_adjust(
        left=left / WIDTH,
        right=1.0 - _LINE / WIDTH,
        top=1.0 - top / whole_height,
        bottom=_BELOW / whole_height,
        wspace=left / width,
        hspace=row_gap * len(ratios) / axes_height,
    )
    if labels:
        texts = list(map(_legend_text, handle_of))
        handles = list(handle_of.values())
        figure.legend(handles, texts, loc="upper left", ncols=n_legend_columns)
    return figure


def _legend_text(label: str) -> str:
    """Return a label, shortened so that it fits into a legend."""
    return shorten(label, 62)


def _draw_marks(axes: Any, panel: Panel) -> None:
    """Draw the marks of a panel on matplotlib's axes, and set the ends of the axes."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    for mark in panel.marks:
        style: dict[str, Any] = {"color": COLOURS[mark.colour], "label": mark.label}
        if isinstance(mark, Line):
            axes.plot(mark.x, mark.y, lw=mark.width, ls=mark.style, **style)
        elif isinstance(mark, Boxes):
            x = np.column_stack((mark.left, mark.right, mark.right, mark.left))
            y = np.column_stack((mark.bottom, mark.bottom, mark.top, mark.top))
            corners = np.stack((x, y), axis=2)
            # All boxes in one path: far fewer objects than a patch for each.
            path = Path.make_compound_path_from_polys(corners)
            axes.add_artist(PathPatch(path, lw=0.0, alpha=mark.opacity, **style))
            axes.update_datalim(corners.reshape(-1, 2))
        elif mark.marker == ".":
            used = np.flatnonzero(np.isfinite(mark.x) & np.isfinite(mark.y))
            dots = used[:: max(1, len(used) // _MAX_DOTS)]
            style = {**style, "ls": "", "mec": "none", "ms": 5.0, "alpha": 0.7}
            axes.plot(mark.x[dots], mark.y[dots], marker=".", **style)
        else:
            style["mfc"] = style["color"] if mark.is_filled else "none"
            axes.errorbar(
                mark.x, mark.y, xerr=mark.errors, fmt=mark.marker, ms=7.0, **style
            )
    axes.autoscale_view()
    for name in "xy":
        low, high = getattr(axes, f"get_{name}lim")()
        middle = 0.5 * (low + high)
        half = max(0.5 * (high - low), 0.5 * _NARROWEST * max(abs(low), abs(high)))
        axes.set(**{f"{name}lim": (middle - half, middle + half)})
    if panel.x_range:
        axes.set_xlim(panel.x_range)
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)


def _set_ticks(axes: Any, panel: Panel, width: float, height: float) -> float:
    """Set the ticks of a panel, and return the width of the labels left of it [px].

    Args:
        axes: matplotlib's axes of the panel, with their marks.
        panel: the panel.
        width: width of the axes with their labels [px].
        height: height of the axes [px].
    """
    from matplotlib.ticker import MaxNLocator

    sizes = (0.75 * width, height)
    for axis, size, least_gap in zip((axes.xaxis, axes.yaxis), sizes, _TICK_ROOM):
        locator = MaxNLocator(max(2, round(size / least_gap)), steps=(1, 2, 2.5, 5, 10))
        low, high = axis.get_view_interval()
        values = locator.tick_values(low, high)
        # Ticks outside would be made and not be drawn.
        axis.set_ticks(values[(values >= low) & (values <= high)])
    axes.tick_params(axis="x", labelbottom=bool(panel.x_label))
    texts = list(map(shorten, panel.row_names))
    if texts:
        axes.set_yticks(-np.arange(len(texts)), texts)
        axes.set_ylim(0.5 - len(texts), 0.5)
    else:
        formatter = axes.yaxis.get_major_formatter()
        texts = formatter.format_ticks(axes.yaxis.get_majorticklocs())
    return _LETTER * max(map(len, texts), default=0)


def shorten(name: str, max_length: int = 22) -> str:
    """Return a name, cut to ``max_length`` characters, the last an ellipsis, if it is longer."""
    return name if len(name) <= max_length else f"{name[: max_length - 1]}…"


def svg(drawing: Drawing, name: str, is_inline: bool = False) -> str:
    """Return a drawing as an ``<svg>`` element; equal drawings of a name give equal texts.

    Inside a page (``is_inline``) the element refers to colours by CSS variables and is hidden from
    screen readers, which read its caption. Its names of shapes differ from those of other ``name``.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.StringIO()
    with _style(name):
        # Not by savefig, which draws twice.
        figure = _draw(drawing)
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    if not is_inline:
        return text
    # The first definitions are a style, which would be that of the whole page.
    _, _, body = text.partition("</defs>")
    height = f"{72.0 * figure.get_figheight():.0f}"
    opening = f'<svg aria-hidden="true" viewBox="0 0 {WIDTH:g} {height}" font-size="{_FONT:g}">'
    return opening + re.sub(" *(<[^>]*>)", _inline_tag, body)


def _inline_tag(tag: re.Match[str]) -> str:
    """Return a tag of matplotlib's SVG with rounded numbers and with colours as CSS variables."""
    text = _NOT_INLINE.sub("", tag[1])
    text = re.sub(r"(\.\d)\d{2,}", r"\1", text)
    for name, colour in COLOURS.items():
        text = text.replace(colour, f"var(--{name})")
    return text


def png(drawing: Drawing) -> bytes:
    """Return a drawing as the content of a PNG file with a white background."""
    buffer = io.BytesIO()
    with _style():
        # matplotlib's version would make equal drawings differ.
        _draw(drawing).savefig(
            buffer,
            format="png",
            dpi=150,
            facecolor="white",
            metadata={"Software": None},
        )
    return buffer.getvalue()


def require_libraries() -> None:
    """Raise InputError if a library that a report needs is missing.

    A run calls this before its long computations, so that it does not fail at their end. Silences
    matplotlib's warnings for the rest of the process.
    """
    libraries = ("jinja2", "matplotlib")
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
