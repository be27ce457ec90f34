"""Figures of the page, drawn by matplotlib as SVG whose colours follow the page, light or dark.

Readers with any kind of colour vision can distinguish the colours (after Okabe and Ito, "Color
universal design", 2008).
"""

from __future__ import annotations

import importlib.util
import io
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from robot_sysid.records.installation import missing_library

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

COLOURS = {
    "ink": "#1b1f24",
    "grid": "#d3d7dc",
    "before": "#b3540a",
    "after": "#0b62a8",
    "measured": "#6b7178",
}
"""Name of a colour, a CSS variable of the page, to the colour that stands for it while matplotlib
draws: text and axes, grid lines, the model before, identified and
measured values."""
PIXELS_PER_INCH = 72.0
"""Resolution of matplotlib's SVG, whose unit is then the pixel."""
WIDTH = 460.0
"""Width of a figure [px]: two fit side by side on a screen, one on a phone."""
# matplotlib's settings for all figures.
_STYLE: Any = {
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
    "figure.constrained_layout.use": True,
    "figure.dpi": PIXELS_PER_INCH,
    "figure.facecolor": "none",
    "font.family": "DejaVu Sans",
    "font.size": 13.0,
    "grid.color": COLOURS["grid"],
    "legend.borderpad": 0.0,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "svg.fonttype": "none",
    "text.color": COLOURS["ink"],
    # Names of joints and files are text, never formulas.
    "text.parse_math": False,
    "xtick.color": COLOURS["ink"],
    "ytick.color": COLOURS["ink"],
}
# What a page has no use for in matplotlib's SVG: names of groups, which figures share, and fonts,
# which are those of the page.
_NOT_INLINE = re.compile(r' id="[\w.]+_\d+"|\bfont[\w-]*:[^;"]*;? ?')


class Figure(NamedTuple):
    """A figure of the page: its SVG or the content of a PNG file, and the sentence below it."""

    caption: str
    svg: str = ""
    png: bytes = b""


@contextmanager
def drawing_style() -> Iterator[None]:
    """Apply the settings of all figures while they are drawn.

    Hides that matplotlib's font lacks some letters, which the reader's font may have.
    """
    from matplotlib import rc_context

    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    with rc_context(_STYLE):
        yield


def new_figure(height: float, rows: int = 1, width: float = WIDTH) -> Any:
    """Return (matplotlib's figure of a size [px], its axes (rows, 1) above one another)."""
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=(width / PIXELS_PER_INCH, height / PIXELS_PER_INCH))
    return canvas, canvas.subplots(rows, squeeze=False, sharex=True)


def add_legend(canvas: Canvas) -> None:
    """Put one legend of all labels above the axes of a figure."""
    labelled: dict[str, Any] = {}
    for axes in canvas.axes:
        handles, labels = axes.get_legend_handles_labels()
        labelled |= dict(zip(labels, handles))
    longest = max(map(len, labelled), default=0)
    columns = max(1, min(len(labelled), int(52 / (longest + 5))))
    canvas.legend(
        list(labelled.values()), list(labelled), loc="outside upper left", ncols=columns
    )


def svg(canvas: Canvas, name: str) -> str:
    """Return a figure as an ``<svg>`` element for a page, without its caption.

    Equal figures of a name give equal texts; its names of shapes differ from those of others.
    """
    from matplotlib import rc_context

    buffer = io.StringIO()
    with rc_context({"svg.hashsalt": name}):
        canvas.savefig(buffer, format="svg", metadata={"Date": None})
    # The first definitions are a style, which would be that of the whole page.
    body = buffer.getvalue().partition("</defs>")[2]
    body = re.sub(r"<[^>]*>", _inline_tag, body)
    width, height = PIXELS_PER_INCH * canvas.get_size_inches()
    view = f'viewBox="0 0 {width:.0f} {height:.0f}" font-size="13"'
    return f'<svg aria-hidden="true" {view}>{body}'


def _inline_tag(tag: re.Match[str]) -> str:
    """Return a tag of matplotlib's SVG with rounded numbers and with colours as CSS variables."""
    text = re.sub(r"(\.\d)\d{2,}", r"\1", _NOT_INLINE.sub("", tag[0]))
    for colour, value in COLOURS.items():
        text = text.replace(value, f"var(--{colour})")
    return text


def require_matplotlib() -> None:
    """Raise InputError if matplotlib is missing, before the long computations of a run."""
    if importlib.util.find_spec("matplotlib") is None:
        raise missing_library("a report", "matplotlib", "report")
