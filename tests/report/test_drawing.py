"""Drawings: labels stay apart and inside, places keep order, SVG and PNG hold what was drawn."""

from __future__ import annotations

import io
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.image import imread

from robot_sysid.report.drawing import (
    COLOURS,
    WIDTH,
    Boxes,
    Drawing,
    Line,
    Panel,
    Points,
    png,
    svg,
)

X = np.linspace(0.0, 10.0, 101)


def panel(**options):
    """A panel with one mark of each kind."""
    marks = (
        Boxes(np.zeros(1), np.full(1, 4.0), np.zeros(1), np.ones(1), "truth", "boxes"),
        Line(X, np.sin(X), "after", "sine <1>"),
        Points(X[::20], np.cos(X[::20]), "before", "points", "o", np.full(6, 0.5)),
    )
    return Panel(marks, "time [s]", "torque [N·m]", **options)


def inline(*panels, height=200.0, name="figure", **options):
    """The SVG of panels inside a page."""
    return svg(Drawing(panels, height, **options), name, is_inline=True)


def texts_of(text):
    """Every text of an SVG with its place and whether it is upright: (text, x, y, is_upright)."""
    root = ElementTree.fromstring(text.replace("xlink:", ""))
    texts = []
    for element in root.iter():
        if not element.tag.endswith("text"):
            continue
        turn = element.get("transform", "")
        x = float(element.get("x"))
        y = float(element.get("y"))
        texts.append((element.text, x, y, "rotate(-90" in turn))
    return texts


@pytest.mark.parametrize("columns", [1, 3])
def test_a_drawing_is_an_svg_whose_text_is_escaped_and_stays_inside(columns):
    panels = [panel(height=2.0), panel(), panel()]
    root = ElementTree.fromstring(
        inline(*panels, height=300.0, n_columns=columns).replace("xlink:", "")
    )
    width, height = map(float, root.attrib["viewBox"].split()[2:])
    assert width == WIDTH and height > 300.0
    texts = texts_of(inline(*panels, height=300.0, n_columns=columns))
    labels = [text for text, *_ in texts]
    assert "sine <1>" in labels and labels.count("torque [N·m]") == 3
    for _, x, y, _ in texts:
        assert 0.0 <= x <= width and 0.0 <= y <= height


def test_a_file_is_an_svg_of_its_own_with_text_and_without_a_date():
    text = svg(Drawing([panel()], 200.0), "figure")
    assert text.startswith("<?xml") and ">torque [N·m]</text>" in text
    assert "dc:date" not in text


def test_colours_are_variables_in_a_page_and_numbers_in_a_file():
    file = svg(Drawing([panel()], 200.0), "figure")
    page = inline(panel())
    for name in ("ink", "grid", "before", "after", "truth"):
        assert f"var(--{name})" in page and COLOURS[name] in file
    assert not re.search("#[0-9a-f]{6}[^0-9a-f]", page) and "var(" not in file


def test_names_of_shapes_differ_between_the_figures_of_a_page():
    ids = []
    for name in ("one", "two"):
        names = re.findall(r' id="([^"]+)"', inline(panel(), name=name))
        assert names and len(names) == len(set(names))
        ids += names
    assert len(ids) == len(set(ids))


def test_a_drawing_does_not_depend_on_the_ones_before():
    names = ("first", "second")
    other = Panel((Points(X, -X, "truth", "more"),), "x" * 9, "y", x_range=(0, 1e-9))
    rows = Panel((Line(X, 0.0 * X, "after"),), "mass [kg]", row_names=names)
    alone = inline(panel())
    for disturbance in (other, rows):
        inline(disturbance)
        assert inline(panel()) == alone


def test_missing_values_interrupt_a_line_and_leave_out_markers():
    y = np.where(np.abs(X - 5.0) < 1.0, np.nan, X)
    curves = re.findall(
        r'<path d="([^"]*)"[^>]*var\(--after\)', inline(Panel((Line(X, y, "after"),)))
    )
    assert [curve.count("M") for curve in curves] == [2]
    dots = inline(Panel((Points(X, y, "after"),)))
    assert dots.count("<use") == np.count_nonzero(np.isfinite(y))


def test_a_panel_without_a_finite_value_has_axes():
    empty = Panel((Line(X, np.full(len(X), np.nan), "after", "nothing"),), "x", "y")
    assert {"nothing", "x", "y"} <= {text for text, *_ in texts_of(inline(empty))}


def test_an_axis_does_not_magnify_rounding_errors():
    line = Line(X, 2.7 + 1e-12 * X, "after")
    labels = [text for text, *_ in texts_of(inline(Panel((line,), "x", "y")))]
    assert "2.70" in labels and max(map(len, labels)) <= 5


def test_a_row_of_names_is_drawn_in_order_from_the_top():
    values = np.arange(3.0)
    names = ["first", "second", "third"]
    marks = (Points(values, -values, "after", "value", "s"),)
    texts = texts_of(inline(Panel(marks, "mass [kg]", row_names=names)))
    rows = [(y, text) for text, _, y, _ in texts if text in names]
    assert [text for _, text in sorted(rows)] == names


@pytest.mark.parametrize("height", [90.0, 150.0, 220.0, 400.0])
@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1.0, 4e4])
@pytest.mark.parametrize("columns", [1, 2])
def test_labels_stay_apart(height, scale, columns):
    line = Line(scale * X, scale * np.linspace(-0.7, 3.2, len(X)), "after")
    panels = [Panel((line,), "speed [rad/s]", "friction [N·m]")] * columns
    texts = texts_of(inline(*panels, height=height, n_columns=columns))
    titles = [x for _, x, _, is_upright in texts if is_upright]
    assert len(titles) == columns
    ticks = [(t, x, y) for t, x, y, _ in texts if re.fullmatch(r"[-\d.]+", t)]
    # Those of the horizontal axes are below all others.
    lowest = max(y for *_, y in ticks)
    for text, x, _ in (tick for tick in ticks if tick[2] < lowest):
        title = max(place for place in titles if place < x)
        assert x - 7.0 * len(text) > title
    across = sorted((x, text) for text, x, y in ticks if y == lowest)
    for (x, text), (next_x, next_text) in zip(across, across[1:]):
        assert next_x - x > 3.5 * (len(text) + len(next_text))


@pytest.mark.slow
def test_a_png_has_a_white_ground_and_the_colours_of_its_marks():
    content = png(Drawing([panel()], 200.0))
    pixels = 255.0 * imread(io.BytesIO(content))[..., :3].reshape(-1, 3)
    assert np.all(pixels[0] == 255.0)
    for name in ("before", "after"):
        rgb = np.array([int(COLOURS[name][k : k + 2], 16) for k in (1, 3, 5)])
        assert np.any(np.all(np.abs(pixels - rgb) < 12, axis=1)), name
