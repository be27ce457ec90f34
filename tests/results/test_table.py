"""The rows of a result as tables: each number once, with its unit and with the digits of its ±."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs import results as made
from robot_sysid.records.file_access import strict_json
from robot_sysid.results.quantities import body_quantities
from robot_sysid.results.record import BOUND, DATA, MODEL, Quantity
from robot_sysid.results.table import cells, change, table_lines

NUMBERS = st.floats(1e-9, 1e3) | st.floats(-1e3, -1e-9)


def row_of(model, value, error, source=DATA):
    """A row of params.json with these numbers."""
    return strict_json(Quantity("mass", "it", "kg", model, value, error, source))


@given(
    st.lists(st.tuples(NUMBERS, NUMBERS, st.floats(1e-5, 1e3)), min_size=1, max_size=5)
)
def test_numbers_and_errors_end_at_the_same_digit_and_no_zero_has_a_sign(rows):
    for row in rows:
        texts = cells(row_of(*row), "it")[1:4]
        decimals = {len(text.partition(".")[2]) for text in texts}
        assert len(decimals) == 1
        for text in texts:
            assert "e" not in text
            assert float(text) != 0.0 or not text.startswith("-")


@pytest.mark.parametrize(
    ("before", "after", "error", "source", "text"),
    [
        (1.0, 1.5, 0.1, DATA, "+50 %"),
        (1.0, 1.5, 0.1, MODEL, "+50 %, prior"),
        (1.0, 1.05, 0.1, DATA, "within ±"),
        (1.0, 1.05, 0.1, MODEL, "prior"),
        (1.0, 1.0, 0.1, MODEL, "prior"),
        (None, 1.0, 0.1, DATA, ""),
        (None, 1.0, 0.1, MODEL, "prior"),
        (1.0, 1.00001, 1e-9, DATA, "+under 0.01 %"),
        (0.0, 0.5, 0.1, DATA, "+0.50"),
        (1.0, 1.0, np.inf, MODEL, "not identifiable"),
        (1.0, 0.0, np.nan, BOUND, "at its bound"),
        (1.0, 1.0, None, DATA, "none"),
    ],
)
def test_the_change_says_where_a_value_comes_from(before, after, error, source, text):
    row = row_of(before, after, error, source)
    assert change(row) == text
    assert not re.search("inf|nan", "".join(table_lines([cells(row, "it")])))


def test_a_share_of_the_prior_is_that_of_mass_and_moment_together():
    body = made.terminal(made.estimate())
    shares = np.array([0.9, 0.2, 0.9, 0.9, *[0.9] * 6])
    for mass_share, sources in ((0.9, (MODEL, DATA)), (0.1, (MODEL, MODEL))):
        shares[0] = mass_share
        rows = body_quantities(replace(body, data_share=shares))
        by_name = {row.name: row.source for row in rows}
        assert (by_name["com_x"], by_name["com_y"]) == sources
        assert by_name["Ixx_about_com"] == DATA


def test_rounding_is_no_number():
    """A product of inertia of a symmetric body comes back as 1e-18."""
    noisy = made.THETA + np.array([0, 1e-16, 0, 0, 0, 1e-18, 0, 0, 0, 0])
    terminal = made.terminal(made.estimate())
    rows = {row.name: row for row in body_quantities(replace(terminal, theta=noisy))}
    assert (rows["hx"].value, rows["Ixy"].value) == (0.0, 0.0)
    # A gripper jaw's numbers are small, not rounding.
    jaw = 1e-3 * made.THETA
    rows = {row.name: row for row in body_quantities(replace(terminal, theta=jaw))}
    assert (rows["hz"].value, rows["Iyy"].value) == (jaw[3], jaw[7])
