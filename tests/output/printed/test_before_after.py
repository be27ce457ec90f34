"""Tables before -> after: each number with the digits of its error, its unit and its change."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.output.printed.before_after import BeforeAfter, link_rows, table_lines, theta_rows
from robot_sysid.records import JointFriction
from tests.support.results import THETA, estimate, found, own_simulation, without_mass


def row(before, after, error=0.01, share=1.0):
    return BeforeAfter("it", before, after, error, "kg", share)


@pytest.mark.parametrize(
    ("one", "change"),
    [
        (row(1.0, 1.5), "+50 %"),
        (row(-1.0, -0.5), "-50 %"),
        (row(1.0, 1.005), "within ±"),
        (row(1.0, 1.0, None), "none"),
        (row(1.0, -1.0), "-2.000"),
        (row(0.0, 0.5), "+0.500"),
        (row(1e-6, 0.5), "+0.500"),
        (row(None, 0.5), ""),
        (row(1.0, 1.0, np.inf, 0.0), "not seen: the model's"),
        (row(1.0, 1.2, np.inf, 0.0), "not seen"),
        (row(1.0, 1.2, np.inf, 0.4), "partly the model's (data 40 %)"),
        (row(1.0, 1.5, 0.01, 0.4), "+50 %; partly the model's (data 40 %)"),
    ],
)
def test_what_is_said_of_a_change(one, change):
    assert one.change == change


NUMBERS = st.floats(1e-9, 1e3) | st.floats(-1e3, -1e-9)


@given(st.lists(st.tuples(NUMBERS, NUMBERS, st.floats(1e-9, 1e3)), min_size=1, max_size=5))
def test_no_number_that_is_not_zero_prints_as_zero(rows):
    lines = table_lines([row(*numbers) for numbers in rows])
    for line in lines[1:]:
        for number in re.findall(r"(?<![\w.])-?\d[\d.e+-]*", line):
            assert float(number) != 0.0


def test_columns_stand_under_their_headings():
    assert table_lines([row(1.0, 1.5), row(-10.25, 2.0, 0.3)]) == [
        "       model  identified      ±  unit  change",
        "  it   1.000       1.500  0.010  kg    +50 %",
        "  it  -10.25        2.00   0.30  kg    +12.25",
    ]


def test_a_column_without_entries_is_left_out():
    assert table_lines([row(None, 0.5)])[0].split() == ["identified", "±", "unit"]


def test_a_terminal_link_has_its_ten_parameters_centre_of_mass_and_friction():
    covariance = np.diag(np.asarray(estimate().standard_errors) ** 2)
    known = estimate(covariance=covariance)
    friction = JointFriction(np.array([0.3, 0.2]), np.array([0.1, 0.05]))
    rows = {each.name: each for each in link_rows(found(known, model_friction=friction))}
    assert len(rows) == 15
    assert (rows["mass"].before, rows["mass"].after, rows["mass"].unit) == (1.0, 2.0, "kg")
    # c = h / m: 0.2 / 2 with errors of 2e-4 and 2e-3, to first order.
    place = rows["centre of mass z"]
    assert place.after == pytest.approx(0.1) and place.unit == "m"
    assert place.error == pytest.approx(np.hypot(2e-4, 0.1 * 2e-3) / 2.0)
    assert (rows["Coulomb friction"].before, rows["Coulomb friction"].after) == (0.2, 0.4)
    assert rows["viscous friction"].unit == "N·m·s/rad"
    slide = {each.name: each for each in link_rows(found(known, slides=("j6",)))}
    assert slide["viscous friction"].unit == "N·s/m"
    assert slide["Coulomb friction"].before is None


def test_what_is_not_seen_says_so_and_has_no_error():
    rows = link_rows(found(without_mass()))
    assert rows[0].change == "not seen"
    assert not any(each.name.startswith("centre") for each in rows)
    assert "inf" not in "".join(table_lines(rows))


def test_a_simulation_of_the_model_itself_states_no_errors():
    rows = link_rows(found(data=own_simulation()))
    assert all(each.error is None for each in rows)


def test_rounding_is_no_number():
    """A product of inertia of a symmetric body comes back as 1e-18."""
    noisy = THETA + np.array([0, 1e-16, 0, 0, 0, 1e-18, 0, 0, 0, 0])
    rows = theta_rows(THETA, noisy, None)
    assert (rows[1].after, rows[5].after) == (0.0, 0.0)
    # A gripper jaw's numbers are small, not rounding.
    jaw = 1e-3 * THETA
    assert all((a.after != 0.0) == (v != 0.0) for a, v in zip(theta_rows(jaw, jaw, None), jaw))
