"""The rows of a result as tables: each number once, with its unit and with the digits of its ±."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx

from rigs import results as made
from robot_sysid.records.file_access import strict_json
from robot_sysid.results.content import content_of
from robot_sysid.results.quantities import BEYOND, MOMENT, body_quantities
from robot_sysid.results.record import BOUND, DATA, MODEL, Quantity, Verdict
from robot_sysid.results.table import (
    all_cells,
    beyond_line,
    body_rows,
    cells,
    change,
    friction_rows,
    largest_changes,
    table_lines,
)

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


def rows_by_name(result, of="link6"):
    """Name to row of a body and of the last joint."""
    content = content_of(result)
    rows = [*body_rows(content, of), *friction_rows(content, "j6")]
    return {row["name"]: row for row in rows}


def test_a_terminal_link_has_mass_centre_of_mass_inertia_and_friction():
    rows = rows_by_name(made.found())
    assert len(rows) == 12
    mass = rows["mass"]
    assert (mass["model"], mass["value"], mass["unit"]) == (1.0, 2.0, "kg")
    assert mass["reason"] == "the other links' parameters"
    center = rows["com_z"]
    assert (center["value"], center["unit"]) == (approx(0.1), "m")
    inertia = rows["Iyy_about_com"]
    assert (inertia["model"], inertia["value"]) == (approx(0.006), approx(0.012))
    friction = rows["coulomb"]
    assert (friction["model"], friction["value"]) == (0.2, 0.4)
    assert friction["error"] == approx(4e-4)


def test_without_a_mass_a_link_has_first_moments_and_the_inertia_about_the_origin():
    rows = rows_by_name(made.found(made.without_mass()))
    assert len(rows) == 12 and rows["mass"]["error"] is None
    assert change(rows["mass"]) == "not identifiable"
    assert rows["hz"]["value"] == approx(0.2)
    assert rows["Ixx"]["value"] == approx(made.THETA[4])


def test_a_share_of_the_prior_is_that_of_mass_and_moment_together():
    body = made.terminal(made.estimate())
    shares = np.array([0.9, 0.2, 0.9, 0.9, *[0.9] * 6])
    for mass_share, sources in ((0.9, (MODEL, DATA)), (0.1, (MODEL, MODEL))):
        shares[0] = mass_share
        rows = body_quantities(replace(body, data_share=shares))
        by_name = {row.name: row.source for row in rows}
        assert (by_name["com_x"], by_name["com_y"]) == sources
        assert by_name["Ixx_about_com"] == DATA


def test_a_payload_whose_inertia_or_mass_is_not_known_has_fewer_rows():
    unknown = content_of(made.payload(made.body(shown=False)))
    assert len(body_rows(unknown, "payload")) == 4


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


def test_the_table_of_all_links_has_every_number_once():
    *lines, meanings = table_lines(
        all_cells(content_of(made.whole())), "Before -> after"
    )
    assert meanings.startswith("  ±: standard error ")
    titles = [re.split("  +", line.strip())[0] for line in lines]
    assert len(set(titles)) == len(titles) == 1 + 2 * 10 + 2 * 2 + 1
    assert "in the file" in lines[0]
    (mass,) = (line.split() for line in lines if "link5 mass" in line)
    assert mass == [
        "link5",
        "mass",
        "1.0000",
        "2.0000",
        "0.0020",
        "3.0000",
        "kg",
        "+100",
        "%",
    ]
    (viscous,) = (line.split() for line in lines if "j5+j6" in line)
    assert viscous[-3:] == ["0.0500", "0.0020", "N·m·s/rad"]


def test_what_the_printed_digits_hide_is_no_other_number_in_the_file():
    row = row_of(1.0, 2.0, 0.002)
    assert cells(row, "it", row_of(1.0, 2.00004, None))[4] == ""
    assert cells(row, "it", row_of(1.0, 2.0001, None))[4] == "2.0001"


@pytest.mark.parametrize(
    ("mass", "error", "text"),
    [
        (
            0.5,
            0.09,
            "mass times distance 0.0500 ± 0.0090 kg·m, mass 0.500 ± 0.090 kg, centre",
        ),
        (
            0.5,
            0.15,
            "from the frame of link6; its mass is not known from one log (0.50 ± 0.15",
        ),
        (
            0.1,
            0.1,
            "nothing seen (mass times distance 0.010 ± 0.010 kg·m, mass 0.10 ± 0.10",
        ),
        (-0.5, 0.1, "link6 weighs 0.50 ± 0.10 kg less"),
        (0.5, np.inf, "These torques do not show whether anything is bolted to link6"),
    ],
)
def test_what_is_bolted_on_has_its_mass_and_place(mass, error, text):
    source = DATA if np.isfinite(error) else MODEL
    rows = [Quantity(MOMENT, BEYOND, "kg·m", None, 0.1 * abs(mass), 0.1 * error)]
    rows += [Quantity("mass", BEYOND, "kg", None, mass, error, source)]
    rows += [Quantity(f"com_{x}", BEYOND, "m", None, 0.1, 0.01) for x in "xyz"]
    found = made.found()
    content = content_of(replace(found, quantities=(*found.quantities, *rows)))
    assert text in beyond_line(content)
    assert beyond_line(content_of(found)) == ""


def test_the_largest_changes_are_those_beyond_the_errors():
    content = content_of(made.found(verdict=Verdict.BETTER))
    (line,) = largest_changes(content)
    assert line.startswith(
        "Changed most, compared with the errors: viscous friction of j6 +0.10000 N·m·s/rad, "
        "viscous friction of j5 +100 %, "
    )
    still = [{**row, "model": row["value"]} for row in content["quantities"]]
    assert not [*largest_changes({**content, "quantities": still})]
