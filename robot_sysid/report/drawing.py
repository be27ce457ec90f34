"""Drawing of figures: panels with axes become shapes, and shapes become SVG or PNG.

Readers with any kind of colour vision can distinguish the colours (after Okabe and Ito, "Color
universal design", 2008). A shape has the name of its colour: inside a page that is a CSS variable,
so that the page can be light or dark; in a file of its own it is that of ``COLOURS``. A page needs
no plotting library, which would take longer to load and to draw than all else together.
"""

from __future__ import annotations

import html
import importlib
import importlib.util
import io
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
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
_LETTER = 0.58 * _FONT
"""Width of a letter [px], a little more than that of usual fonts."""
_LINE = 1.35 * _FONT
"""Height of a line of text [px]."""
_GAP = 6.0
"""Distance of labels from axes and from each other [px]."""
_MARGIN = 0.04
"""Empty margin of an axis on each side, as a share of the range of its values."""
_TICK_ROOM = (64.0, 24.0)
"""Least distance of ticks on a horizontal and on a vertical axis [px]."""
_MAX_TICKS = 12
"""Number of ticks on a vertical axis that the width of its labels allows for."""
_MAX_DOTS = 400
"""Number of dots to which a longer scatter plot is thinned; fewer than twice as many remain. More
dots would overlap."""
_CORNERS = {"circle": 12, "square": 4, "diamond": 4}
"""Shape of a marker to the number of its corners."""


@dataclass(frozen=True)
class Line:
    """A curve of a panel through points (x, y), each (K,); NaN interrupts it.

    ``label`` is its text in the legend, "" for none; ``width`` is in px; ``dash`` is the pattern of
    SVG, such as "5 3", or "".
    """

    x: Array
    y: Array
    colour: str
    label: str = ""
    width: float = 1.4
    dash: str = ""


@dataclass(frozen=True)
class Points:
    """Markers of a panel at points (x, y), each (K,); those that are not finite are left out.

    ``shape`` is "dot" or a key of ``_CORNERS``; dots are small and thinned. ``errors`` (K,) are
    half the lengths of horizontal error bars, or None.
    """

    x: Array
    y: Array
    colour: str
    label: str = ""
    shape: str = "dot"
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
        y_range: ends of the vertical axis, likewise.
    """

    marks: Sequence[Mark]
    x_label: str = ""
    y_label: str = ""
    height: float = 1.0
    row_names: Sequence[str] = ()
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None


@dataclass(frozen=True)
class Path:
    """A polyline or an area with corners (K, 2) [px], y downwards; NaN begins another one.

    ``stroke`` and ``fill`` are names of colours, "" for none.
    """

    corners: Array
    stroke: str = ""
    fill: str = ""
    width: float = 1.0
    dash: str = ""
    opacity: float = 1.0


@dataclass(frozen=True)
class Text:
    """Text at (x, y) [px], centred on the height; ``anchor`` is "start", "middle" or "end"."""

    x: float
    y: float
    text: str
    anchor: str = "middle"
    is_upright: bool = False


Shape = Union[Path, Text]


@dataclass(frozen=True)
class Drawing:
    """Shapes on an area of ``WIDTH`` times ``height`` [px], in the order of drawing."""

    height: float
    shapes: Sequence[Shape]


def draw(panels: Sequence[Sequence[Panel]], height: float) -> Drawing:
    """Return a drawing of panels, with one legend above all of them.

    Args:
        panels: rows of panels from top to bottom; those of a row stand side by side and have the
            height of the first.
        height: height of all panels with their labels, without the legend [px].
    """
    shapes: list[Shape] = []
    top = _draw_legend(
        shapes, [mark for row in panels for p in row for mark in p.marks]
    )
    height_of_all = top + height
    below = [
        sum(p.x_label != "" for p in row[:1]) * 2.4 * _LINE + _GAP for row in panels
    ]
    unit = (height - sum(below)) / sum(row[0].height for row in panels)
    # Panels below each other have the same left edge.
    left = max(map(_label_width, [row[0] for row in panels]))
    for row, room_below in zip(panels, below):
        bottom = top + unit * row[0].height
        widths = [0.0, *map(_label_width, row[1:])]
        width = (WIDTH - 3.0 * _GAP - left - sum(widths)) / len(row)
        x = left
        for panel, label_width in zip(row, widths):
            x += label_width
            _draw_panel(shapes, panel, (x, x + width - 2.0 * _GAP, bottom, top + _GAP))
            x += width
        top = bottom + room_below
    return Drawing(height_of_all, shapes)


def _draw_legend(shapes: list[Shape], marks: Iterable[Mark]) -> float:
    """Draw the legend of marks with a label in rows at the top, and return its lower edge [px]."""
    labelled = {mark.label: mark for mark in reversed(list(marks)) if mark.label}
    x = _GAP
    y = 0.7 * _LINE
    for label, mark in reversed(list(labelled.items())):
        text = shorten(label, 62)
        width = 30.0 + _LETTER * len(text) + 2.0 * _GAP
        if x > _GAP and x + width > WIDTH:
            x = _GAP
            y += _LINE
        ends = np.array([[x, y], [x + 22.0, y]])
        if isinstance(mark, Line):
            shapes.append(Path(ends, mark.colour, "", mark.width, mark.dash))
        elif isinstance(mark, Points):
            _draw_markers(shapes, mark, np.mean(ends, axis=0)[None])
        else:
            edges = [np.array([edge]) for edge in (x, x + 22.0, y + 5.0, y - 5.0)]
            box = _boxes_path(*edges)
            shapes.append(Path(box, "", mark.colour, opacity=mark.opacity))
        shapes.append(Text(x + 28.0, y, text, "start"))
        x += width
    return y + _LINE if labelled else 0.0


def _label_width(panel: Panel) -> float:
    """Return the width of the labels left of a panel [px]."""
    names = list(map(shorten, panel.row_names))
    if not names:
        # The height of the panel, and with it the number of ticks, is not known yet.
        for count in range(2, _MAX_TICKS):
            names += [label for _, label in ticks(*_ends(panel)[1], count)]
    title_width = 1.6 * _LINE if panel.y_label else 0.5 * _LINE
    return title_width + _GAP + _LETTER * max(map(len, names), default=0)


def _ends(panel: Panel) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ends of the horizontal and of the vertical axis of a panel."""
    across: list[Array] = []
    up: list[Array] = []
    for mark in panel.marks:
        if isinstance(mark, Boxes):
            across += [mark.left, mark.right]
            up += [mark.bottom, mark.top]
            continue
        across.append(mark.x)
        up.append(mark.y)
        if isinstance(mark, Points) and mark.errors is not None:
            across += [mark.x - mark.errors, mark.x + mark.errors]
    y_range = panel.y_range
    if panel.row_names:
        y_range = (0.5 - len(panel.row_names), 0.5)
    return panel.x_range or _span(across), y_range or _span(up)


def _span(values: Sequence[Array]) -> tuple[float, float]:
    """Return the ends of an axis that shows all finite values, with a margin at each end."""
    joined = np.concatenate([np.zeros(0), *map(np.ravel, values)])
    finite = joined[np.isfinite(joined)]
    if not len(finite):
        return 0.0, 1.0
    low = float(np.min(finite))
    high = float(np.max(finite))
    # A narrower axis would magnify rounding errors.
    least = 0.02 * max(abs(low), abs(high)) or 1.0
    margin = max(_MARGIN * (high - low), 0.5 * (least - (high - low)))
    return low - margin, high + margin


def ticks(low: float, high: float, largest_count: int) -> list[tuple[float, str]]:
    """Return (value, text) of the ticks of an axis: multiples of 1, 2 or 5 times a power of ten.

    Args:
        low: lower end of the axis.
        high: upper end of the axis.
        largest_count: number of ticks that have room.
    """
    raw_step = (high - low) / max(largest_count, 1)
    power = 10.0 ** math.floor(math.log10(raw_step))
    steps = [factor * power for factor in (1.0, 2.0, 5.0, 10.0)]
    step = next((s for s in steps if s >= 0.7 * raw_step), steps[-1])
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    marks = []
    for k in range(first, last + 1):
        value = k * step
        is_plain = decimals <= 5 and abs(value) < 1e6
        marks.append((value, f"{value:.{decimals}f}" if is_plain else f"{value:.3g}"))
    return marks


def _draw_panel(
    shapes: list[Shape], panel: Panel, area: tuple[float, float, float, float]
) -> None:
    """Draw axes, labels and marks of a panel into an area: left, right, bottom, top [px]."""
    left, right, bottom, top = area
    (x_low, x_high), (y_low, y_high) = _ends(panel)

    def place(x: Array, y: Array) -> Array:
        """Return the places (K, 2) [px] of points (x, y) of the panel, each (K,)."""
        across = left + (right - left) * (x - x_low) / (x_high - x_low)
        return np.column_stack(
            (across, bottom - (bottom - top) * (y - y_low) / (y_high - y_low))
        )

    x_ticks = ticks(x_low, x_high, int((right - left) / _TICK_ROOM[0]))
    y_ticks = ticks(y_low, y_high, int((bottom - top) / _TICK_ROOM[1]))
    if panel.row_names:
        names = map(shorten, panel.row_names)
        y_ticks = [(-float(k), name) for k, name in enumerate(names)]
    for value, label in x_ticks:
        x = float(place(np.array([value]), np.array([y_low]))[0, 0])
        shapes.append(Path(np.array([[x, bottom], [x, top]]), "grid"))
        if panel.x_label:
            shapes.append(Text(x, bottom + 0.8 * _LINE, label))
    for value, label in y_ticks:
        y = float(place(np.array([x_low]), np.array([value]))[0, 1])
        shapes.append(Path(np.array([[left, y], [right, y]]), "grid"))
        shapes.append(Text(left - _GAP, y, label, "end"))
    for mark in panel.marks:
        _draw_mark(shapes, mark, place)
    frame = np.array([[left, top], [left, bottom], [right, bottom]])
    shapes.append(Path(frame, "ink"))
    middle = 0.5 * (left + right)
    shapes.append(Text(middle, bottom + 1.9 * _LINE, panel.x_label))
    shapes.append(
        Text(
            0.7 * _LINE if left < 0.5 * WIDTH else left - _label_width(panel) + _LINE,
            0.5 * (bottom + top),
            panel.y_label,
            is_upright=True,
        )
    )


def _draw_mark(
    shapes: list[Shape], mark: Mark, place: Callable[[Array, Array], Array]
) -> None:
    """Draw a mark of a panel; ``place`` returns the places (K, 2) [px] of points."""
    if isinstance(mark, Line):
        path = Path(place(mark.x, mark.y), mark.colour, "", mark.width, mark.dash)
        shapes.append(path)
    elif isinstance(mark, Boxes):
        left, bottom = place(mark.left, mark.bottom).T
        right, top = place(mark.right, mark.top).T
        corners = _boxes_path(left, right, bottom, top)
        shapes.append(Path(corners, "", mark.colour, opacity=mark.opacity))
    else:
        used = np.flatnonzero(np.isfinite(mark.x) & np.isfinite(mark.y))
        if mark.shape == "dot":
            used = used[:: max(1, len(used) // _MAX_DOTS)]
        x = mark.x[used]
        y = mark.y[used]
        if mark.errors is not None:
            errors = np.nan_to_num(mark.errors[used], posinf=0.0)
            gap = np.full(len(x), np.nan)
            ends = np.column_stack((x - errors, x + errors, gap)).ravel()
            bars = place(ends, np.repeat(y, 3))
            shapes.append(Path(bars, mark.colour, "", 1.4))
        _draw_markers(shapes, mark, place(x, y))


def _boxes_path(left: Array, right: Array, bottom: Array, top: Array) -> Array:
    """Return the corners (6 K, 2) of K boxes [px]; a row of NaN ends each box."""
    gap = np.full(len(left), np.nan)
    x = np.column_stack((left, right, right, left, left, gap)).ravel()
    y = np.column_stack((bottom, bottom, top, top, bottom, gap)).ravel()
    return np.column_stack((x, y))


def _draw_markers(shapes: list[Shape], points: Points, places: Array) -> None:
    """Draw markers at places (K, 2) [px]."""
    if points.shape == "dot":
        # A line without length and with round ends is a dot.
        places = np.repeat(places, 3, axis=0)
        places[2::3] = np.nan
        shapes.append(Path(places, points.colour, "", 2.4, opacity=0.7))
        return
    count = _CORNERS[points.shape]
    turn = 0.25 * np.pi if points.shape == "square" else 0.0
    angles = np.append(2.0 * np.pi * np.arange(count + 1) / count + turn, np.nan)
    outline = 4.0 * np.column_stack((np.cos(angles), np.sin(angles)))
    corners = (places[:, None] + outline).reshape(-1, 2)
    fill = points.colour if points.is_filled else ""
    shapes.append(Path(corners, points.colour, fill, 1.4))


def shorten(name: str, max_length: int = 22) -> str:
    """Return a name, cut to ``max_length`` characters, the last an ellipsis, if it is longer."""
    return name if len(name) <= max_length else f"{name[: max_length - 1]}…"


def svg(drawing: Drawing, is_inline: bool = False) -> str:
    """Return a drawing as an ``<svg>`` element; equal drawings give equal texts.

    Inside a page (``is_inline``) the element refers to colours by CSS variables and is hidden from
    screen readers, which read its caption.
    """

    def colour(name: str) -> str:
        """Return the value of an attribute for the name of a colour, "" for none."""
        if not name:
            return "none"
        return f"var(--{name})" if is_inline else COLOURS[name]

    size = f'viewBox="0 0 {WIDTH:g} {drawing.height:.0f}" font-size="{_FONT:g}"'
    opening = (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif">'
    )
    if is_inline:
        opening = f'<svg aria-hidden="true" {size}>'
    lines = [opening]
    for shape in drawing.shapes:
        if isinstance(shape, Path):
            attributes = f'stroke="{colour(shape.stroke)}" fill="{colour(shape.fill)}"'
            if shape.stroke:
                attributes += f' stroke-width="{shape.width:g}" stroke-linecap="round"'
            if shape.dash:
                attributes += f' stroke-dasharray="{shape.dash}"'
            if shape.opacity < 1.0:
                attributes += f' opacity="{shape.opacity:g}"'
            lines.append(f'<path d="{_path_text(shape.corners)}" {attributes}/>')
        elif shape.text:
            # A third of the font's height below its middle is the line that letters stand on.
            place = f'x="{shape.x:.1f}" y="{shape.y + 0.35 * _FONT:.1f}"'
            if shape.is_upright:
                place = (
                    f'transform="translate({shape.x + 0.35 * _FONT:.1f} {shape.y:.1f}) '
                )
                place += 'rotate(-90)"'
            style = f'text-anchor="{shape.anchor}" fill="{colour("ink")}"'
            lines.append(f"<text {place} {style}>{html.escape(shape.text)}</text>")
    return "\n".join([*lines, "</svg>"])


def _path_text(corners: Array) -> str:
    """Return the ``d`` attribute of a path through corners (K, 2) [px]; NaN interrupts it."""
    parts = []
    command = "M"
    for x, y in np.round(corners, 1).tolist():
        if math.isnan(x) or math.isnan(y):
            command = "M"
            continue
        parts.append(f"{command}{x:g} {y:g}")
        command = "L"
    return "".join(parts)


def png(drawing: Drawing) -> bytes:
    """Return a drawing as the content of a PNG file with a white background, by matplotlib."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    inches = (WIDTH / 72.0, drawing.height / 72.0)
    buffer = io.BytesIO()
    # Names of joints and files are text, never formulas.
    with rc_context({"text.parse_math": False, "font.family": "DejaVu Sans"}):
        figure = Figure(figsize=inches)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, WIDTH))
        axes.set(ylim=(drawing.height, 0.0))
        axes.set_axis_off()
        for order, shape in enumerate(drawing.shapes):
            if isinstance(shape, Text):
                anchor = {"start": "left", "middle": "center", "end": "right"}
                style: dict[str, Any] = {"ha": anchor[shape.anchor]}
                style["va"] = "center_baseline"
                turn = 90.0 if shape.is_upright else 0.0
                axes.text(
                    shape.x, shape.y, shape.text, rotation=turn, size=10.5, **style
                )
                continue
            _plot_path(axes, shape, order)
        # matplotlib's version would make equal drawings differ.
        figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return buffer.getvalue()


def _plot_path(axes: Any, path: Path, order: int) -> None:
    """Draw a path on matplotlib's axes, above what has a smaller ``order``."""
    style: dict[str, Any] = {"alpha": path.opacity, "lw": path.width, "zorder": order}
    dash = tuple(map(float, path.dash.split()))
    line_style = {"ls": (0.0, dash) if dash else "-", "solid_capstyle": "round"}
    for corners in _pieces(path.corners):
        if path.fill:
            axes.fill(*corners.T, color=COLOURS[path.fill], **style)
        if path.stroke:
            axes.plot(*corners.T, color=COLOURS[path.stroke], **style, **line_style)


def _pieces(corners: Array) -> Iterator[Array]:
    """Yield the uninterrupted pieces (m, 2) of corners (K, 2) with rows of NaN between them."""
    is_gap = ~np.all(np.isfinite(corners), axis=1)
    for piece in np.split(corners, np.flatnonzero(is_gap)):
        finite = piece[np.all(np.isfinite(piece), axis=1)]
        if len(finite):
            yield finite


def require_libraries(plots: bool = False) -> None:
    """Raise InputError if a library is missing that a page, or with ``plots`` its files, need.

    A run calls this before its long computations, so that it does not fail at their end. Silences
    matplotlib's warnings for the rest of the process.
    """
    libraries = ("jinja2", "matplotlib") if plots else ("jinja2",)
    missing = [name for name in libraries if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"a report {install_hint(' and '.join(missing), 'report')}")
    if not plots:
        return
    # Without this, matplotlib warns when it moves its cache to a temporary folder.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    try:
        importlib.import_module("matplotlib")
    except OSError:
        raise InputError(
            "a report needs a folder for matplotlib's cache; set MPLCONFIGDIR to one that can be "
            "written to"
        ) from None
