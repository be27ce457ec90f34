"""The table of a body's numbers: each once, with its unit and with the digits of its ±."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx

from robot_sysid.results.cards import load_errors
from robot_sysid.results.parameter_table import (
    BeforeAfter,
    parameter_rows,
    table_lines,
    theta_rows,
)
from tests.support import results as made

NUMBERS = st.floats(1e-9, 1e3) | st.floats(-1e3, -1e-9)


@given(
    st.lists(st.tuples(NUMBERS, NUMBERS, st.floats(1e-5, 1e3)), min_size=1, max_size=5)
)
def test_numbers_and_errors_end_at_the_same_digit_and_no_zero_has_a_sign(rows):
    for row in rows:
        cells = BeforeAfter("it", *row, "kg", 1.0).cells
        decimals = {len(cell.partition(".")[2]) for cell in cells[1:4]}
        assert len(decimals) == 1
        for cell in cells[1:4]:
            assert "e" not in cell
            assert float(cell) != 0.0 or not cell.startswith("-")


@pytest.mark.parametrize(
    ("before", "after", "error", "share", "change"),
    [
        (1.0, 1.5, 0.1, 1.0, "+50 %"),
        (1.0, 1.5, 0.1, 0.4, "+50 %, prior"),
        (1.0, 1.05, 0.1, 0.6, "within ±"),
        (1.0, 1.05, 0.1, 0.4, "prior"),
        (1.0, 1.0, 0.1, 0.4, "prior"),
        (None, 1.0, 0.1, 1.0, ""),
        (None, 1.0, 0.1, 0.1, "prior"),
        (1.0, 1.00001, 1e-9, 1.0, "+under 0.01 %"),
        (0.0, 0.5, 0.1, 1.0, "+0.50"),
        (1.0, 1.0, np.inf, 0.0, "not identifiable"),
        (1.0, 0.0, np.nan, 1.0, "at its bound"),
        (1.0, 1.0, None, 1.0, "none"),
    ],
)
def test_the_change_says_where_a_value_comes_from(before, after, error, share, change):
    row = BeforeAfter("it", before, after, error, "kg", share)
    assert row.change == change
    assert not re.search("inf|nan", "".join(table_lines([row])))


def test_a_terminal_link_has_mass_centre_of_mass_inertia_and_friction():
    rows = {row.name: row for row in parameter_rows(made.found())}
    assert len(rows) == 12
    mass = rows["mass"]
    assert (mass.before, mass.after, mass.unit) == (1.0, 2.0, "kg")
    errors = load_errors(made.terminal(made.estimate()))
    center = rows["centre of mass z"]
    assert (center.after, center.unit, center.error) == (approx(0.1), "m", errors[3])
    inertia = rows["inertia yy about CoM"]
    assert (inertia.before, inertia.after) == (approx(0.006), approx(0.012))
    assert inertia.error == errors[7]
    friction = rows["Coulomb friction"]
    assert (friction.before, friction.after) == (0.2, 0.4)
    assert friction.error == approx(4e-4)


def test_without_a_mass_a_link_has_first_moments_and_the_inertia_about_the_origin():
    rows = {row.name: row for row in parameter_rows(made.found(made.without_mass()))}
    assert len(rows) == 12 and np.isinf(rows["mass"].error)
    assert rows["CoM moment z"].after == approx(0.2)
    assert rows["inertia xx"].after == approx(made.THETA[4])


def test_a_share_of_the_prior_is_that_of_mass_and_moment_together():
    body = made.terminal(made.estimate())
    shares = np.array([0.9, 0.2, 0.9, 0.9, *[0.9] * 6])
    result = made.found(links=made.by_name(replace(body, data_share=shares)))
    rows = {row.name: row.share for row in parameter_rows(result)}
    assert rows["centre of mass x"] == 0.2 and rows["centre of mass y"] == 0.9
    shares[0] = 0.1
    rows = {row.name: row.share for row in parameter_rows(result)}
    assert rows["centre of mass y"] == 0.1 and rows["inertia xx about CoM"] == 0.9


def test_a_payload_whose_inertia_or_mass_is_not_known_has_fewer_rows():
    assert len(parameter_rows(made.payload(made.body(shown=False)))) == 4
    assert len(parameter_rows(made.payload(made.body(-1.0)))) == 1


def test_rounding_is_no_number():
    """A product of inertia of a symmetric body comes back as 1e-18."""
    noisy = made.THETA + np.array([0, 1e-16, 0, 0, 0, 1e-18, 0, 0, 0, 0])
    terminal = made.terminal(made.estimate())
    rows = theta_rows(replace(terminal, theta=noisy))
    assert (rows[1].after, rows[5].after) == (0.0, 0.0)
    # A gripper jaw's numbers are small, not rounding.
    jaw = 1e-3 * made.THETA
    rows = theta_rows(replace(terminal, theta=jaw))
    assert all(
        (row.after != 0.0) == (parameter != 0.0) for row, parameter in zip(rows, jaw)
    )
