"""Drawings: ticks are round and inside, places keep order, SVG and PNG hold what was drawn."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.report.drawing import (
    COLOURS,
    WIDTH,
    Boxes,
    Line,
    Panel,
    Points,
    draw,
    png,
    svg,
    ticks,
)

X = np.linspace(0.0, 10.0, 101)


def panel(**options):
    """A panel with one mark of each kind."""
    marks = (
        Boxes(np.zeros(1), np.full(1, 4.0), np.zeros(1), np.ones(1), "truth", "boxes"),
        Line(X, np.sin(X), "after", "sine <1>"),
        Points(X[::20], np.cos(X[::20]), "before", "points", "circle", np.full(6, 0.5)),
    )
    return Panel(marks, "time [s]", "torque [N·m]", **options)


@given(low=st.floats(-1e6, 1e6), size=st.floats(1e-3, 1e6), count=st.integers(1, 12))
def test_ticks_are_inside_evenly_spaced_and_few(low, size, count):
    values = [value for value, _ in ticks(low, low + size, count)]
    slack = 1e-6 * size + 1e-9 * abs(low)
    assert all(low - slack <= value <= low + size + slack for value in values)
    assert len(values) <= 2 * count + 1
    assert np.allclose(np.diff(values, n=2), 0.0, atol=slack)


@pytest.mark.parametrize(
    ("ends", "texts"),
    [
        ((-0.6, 0.6), ["-0.5", "0.0", "0.5"]),
        ((0.0, 1200.0), ["0", "500", "1000"]),
        ((0.0, 2.4e-3), ["0.000", "0.001", "0.002"]),
    ],
)
def test_ticks_have_as_many_decimals_as_their_step(ends, texts):
    assert [text for _, text in ticks(*ends, largest_count=3)] == texts


def test_a_drawing_is_an_svg_whose_text_is_escaped_and_stays_inside():
    drawing = draw([[panel(height=2.0)], [panel(), panel()]], height=300.0)
    root = ElementTree.fromstring(svg(drawing))
    assert root.attrib["viewBox"] == f"0 0 {WIDTH:g} {drawing.height:.0f}"
    texts = [element.text for element in root if element.tag.endswith("text")]
    assert "sine <1>" in texts and texts.count("torque [N·m]") == 3
    places = re.findall(r"[ML]([-\d.]+) ([-\d.]+)", svg(drawing))
    x, y = np.array(places, dtype=float).T
    assert np.min(x) >= 0.0 and np.max(x) <= WIDTH
    assert np.min(y) >= 0.0 and np.max(y) <= drawing.height


def test_colours_are_variables_in_a_page_and_numbers_in_a_file():
    drawing = draw([[panel()]], height=200.0)
    assert "var(--after)" in svg(drawing, is_inline=True)
    assert COLOURS["after"] not in svg(drawing, is_inline=True)
    assert COLOURS["after"] in svg(drawing) and "var(" not in svg(drawing)


def test_missing_values_interrupt_a_line_and_leave_out_markers():
    y = np.where(np.abs(X - 5.0) < 1.0, np.nan, X)
    line = Panel((Line(X, y, "after"),))
    dots = Panel((Points(X, y, "after"),))
    curve = [
        s for s in svg(draw([[line]], 200.0)).splitlines() if COLOURS["after"] in s
    ]
    assert curve[0].count("M") == 2
    points = [
        s for s in svg(draw([[dots]], 200.0)).splitlines() if COLOURS["after"] in s
    ]
    assert points[0].count("M") == np.count_nonzero(np.isfinite(y))


def test_a_panel_without_a_finite_value_has_axes():
    empty = Panel((Line(X, np.full(len(X), np.nan), "after", "nothing"),), "x", "y")
    assert "nothing" in svg(draw([[empty]], 200.0))


def test_a_row_of_names_is_drawn_in_order_from_the_top():
    values = np.arange(3.0)
    names = ("first", "second", "third")
    marks = (Points(values, -values, "after", "value", "square"),)
    text = svg(draw([[Panel(marks, "mass [kg]", row_names=names)]], 200.0))
    heights = [float(re.search(rf'y="([\d.]+)"[^>]*>{n}<', text)[1]) for n in names]
    assert heights == sorted(heights)


@pytest.mark.parametrize("height", [90.0, 150.0, 220.0, 400.0])
def test_labels_of_ticks_stay_right_of_the_label_of_their_axis(height):
    line = Line(X, np.linspace(-0.7, 3.2, len(X)), "after")
    text = svg(draw([[Panel((line,), "speed [rad/s]", "friction [N·m]")]], height))
    (title,) = re.findall(r"translate\(([\d.]+)", text)
    for x, label in re.findall(r'x="([\d.]+)"[^>]*anchor="end"[^>]*>([^<]+)<', text):
        assert float(x) - 7.0 * len(label) > float(title)


@pytest.mark.slow
def test_a_png_has_a_white_ground_and_the_colours_of_its_marks():
    pytest.importorskip("matplotlib")
    imageio = pytest.importorskip("imageio.v2")
    content = png(draw([[panel()]], height=200.0))
    pixels = imageio.imread(content)[..., :3].reshape(-1, 3)
    assert tuple(pixels[0]) == (255, 255, 255)
    for name in ("before", "after"):
        rgb = np.array([int(COLOURS[name][k : k + 2], 16) for k in (1, 3, 5)])
        assert np.any(np.all(np.abs(pixels.astype(int) - rgb) < 12, axis=1)), name
