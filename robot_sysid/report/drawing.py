"""How figures look, and what becomes of them: SVG inside a page, files beside it.

Colours are told apart by every kind of colour vision (after Okabe and Ito, "Color universal
design", 2008), and each goes with a marker or a line of its own. Inside a page they are variables,
so that the page can be light or dark.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import re
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.report.elements import Figure, Table

INK, GRID = "#1b1f24", "#d3d7dc"
BEFORE, AFTER, TRUTH = "#b3540a", "#0b62a8", "#0a7a5c"
MEASURED, OTHER = "#6b7178", "#8a3f9a"
VARIABLES = {
    INK: "ink",
    GRID: "grid",
    BEFORE: "before",
    AFTER: "after",
    TRUTH: "truth",
    MEASURED: "measured",
    OTHER: "other",
}
"""Colour to the name of its variable in the page's style."""
SERIES = ((AFTER, "o"), (BEFORE, "D"), (TRUTH, "s"), (OTHER, "^"), (MEASURED, "v"))
"""Colour and marker of the first, second, ... of several things beside each other."""
NARROW, WIDE = 4.6, 9.4
"""Widths of figures that stand beside another one, and that take the whole page [inch]."""
_DPI = 150
_STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.1,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
    # Names of joints and files are text, never formulas.
    "text.parse_math": False,
}


def require_libraries() -> None:
    """Raise InputError where figures cannot be drawn; asked before a long run."""
    missing = [n for n in ("matplotlib", "jinja2") if importlib.util.find_spec(n) is None]
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
def _styled(name: str) -> Iterator[None]:
    import matplotlib

    style: Any = {**_STYLE, "svg.hashsalt": name}
    with warnings.catch_warnings(), matplotlib.rc_context(style):
        # A letter that the font lacks is still text in the SVG.
        warnings.simplefilter("ignore")
        yield


def drawn(
    name: str, caption: str, numbers: Table, size: tuple[float, float], draw: Callable[[Any], None]
) -> Figure:
    """Return a figure.

    Args:
        name: of its files, unique on the page.
        caption: what is to be seen.
        numbers: what is drawn.
        size: width and height [inch].
        draw: draws into a figure of matplotlib.
    """
    from matplotlib.figure import Figure as Canvas

    with _styled(name):
        canvas = Canvas(figsize=size, layout="constrained")
        draw(canvas)
    return Figure(name, caption, numbers, canvas, wide=size[0] > NARROW)


def svg(figure: Figure) -> str:
    """Return a drawing as an SVG file; the same text for the same drawing."""
    buffer = io.StringIO()
    with _styled(figure.name):
        figure.drawing.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def png(figure: Figure) -> bytes:
    """Return a drawing as PNG on white."""
    if figure.png:
        return figure.png
    buffer = io.BytesIO()
    with _styled(figure.name):
        facts = {"Software": None}
        figure.drawing.savefig(buffer, format="png", dpi=_DPI, facecolor="w", metadata=facts)
    return buffer.getvalue()


_UNUSED_ID = re.compile(r' id="[A-Za-z][A-Za-z0-9]*_\d+"')
_STYLE_BLOCK = re.compile(r"<style.*?</style>", re.DOTALL)
_SIZE = re.compile(r'(<svg[^>]*?) (?:width|height)="[^"]*"')


def inline(figure: Figure) -> str:
    """Return a drawing as part of a page: scaled by it, in its colours, no id used twice."""
    text = svg(figure)
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = _UNUSED_ID.sub("", _STYLE_BLOCK.sub("", text))
    text = _SIZE.sub(r"\1", _SIZE.sub(r"\1", text))
    for colour, variable in VARIABLES.items():
        text = text.replace(colour, f"var(--{variable})")
    width = 72.0 * float(figure.drawing.get_figwidth())
    # For readers who do not see it the caption says what it is.
    return text.replace("<svg", f'<svg aria-hidden="true" style="max-width:{1.5 * width:.0f}px"', 1)


def legend(canvas: Any, axes: Any, columns: int = 3) -> None:
    """Put one legend above all axes."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        canvas.legend(handles, labels, loc="outside upper center", ncols=columns)
