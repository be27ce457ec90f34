"""Tables before -> after: each number with the digits of its error, its unit and its change."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.records import InertialParameters
from robot_sysid.results.cards import load_errors
from robot_sysid.results.console import BeforeAfter, asked_rows, table_lines, theta_rows
from tests.support.results import THETA, body, estimate, found, itself, payload, terminal


def row(before, after, error=0.01, share=1.0):
    return BeforeAfter("it", before, after, error, "kg", share)


NUMBERS = st.floats(1e-9, 1e3) | st.floats(-1e3, -1e-9)


@given(st.lists(st.tuples(NUMBERS, NUMBERS, st.floats(1e-9, 1e3)), min_size=1, max_size=5))
def test_no_number_that_is_not_zero_prints_as_zero(rows):
    lines = table_lines([row(*numbers) for numbers in rows])
    for line in lines[1:]:
        for number in re.findall(r"(?<![\w.])-?\d[\d.e+-]*", line):
            assert float(number) != 0.0


def test_a_terminal_link_has_its_ten_parameters_centre_of_mass_and_friction():
    rows = {each.name: each for each in asked_rows(found())}
    assert len(rows) == 15
    assert (rows["mass"].before, rows["mass"].after, rows["mass"].unit) == (1.0, 2.0, "kg")
    place = rows["centre of mass z"]
    assert (place.after, place.unit) == (pytest.approx(0.1), "m")
    assert place.error == load_errors(terminal(estimate()))[3]
    assert (rows["Coulomb friction"].before, rows["Coulomb friction"].after) == (0.2, 0.4)
    assert rows["Coulomb friction"].error == pytest.approx(4e-4)
    slide = {each.name: each for each in asked_rows(found(slides=("j6",), joints={}))}
    assert slide["viscous friction"].unit == "N·s/m"
    own = asked_rows(itself())  # a simulation of the model itself states no errors
    assert len(own) == 15 and all(each.error is None for each in own)


def test_a_payload_has_mass_place_and_inertia_about_it():
    rows = asked_rows(payload())
    assert len(rows) == 10 and all(each.before is None for each in rows)
    assert (rows[0].after, rows[0].error) == (1.2, pytest.approx(0.01))
    assert (rows[1].name, rows[1].after) == ("centre of mass x", pytest.approx(0.03))
    assert (rows[4].name, rows[4].after) == ("inertia xx about it", pytest.approx(0.006))
    assert [each.error for each in rows[4:]] == load_errors(body())[4:].tolist()
    assert len(asked_rows(payload(body(shown=False)))) == 4
    assert len(asked_rows(payload(body(-1.0)))) == 1


def test_rounding_is_no_number():
    """A product of inertia of a symmetric body comes back as 1e-18."""
    noisy = THETA + np.array([0, 1e-16, 0, 0, 0, 1e-18, 0, 0, 0, 0])
    known = terminal(estimate())
    rows = theta_rows(replace(known, inertial=InertialParameters(noisy)))
    assert (rows[1].after, rows[5].after) == (0.0, 0.0)
    # A gripper jaw's numbers are small, not rounding.
    jaw = 1e-3 * THETA
    rows = theta_rows(replace(known, inertial=InertialParameters(jaw)))
    assert all((a.after != 0.0) == (v != 0.0) for a, v in zip(rows, jaw))
