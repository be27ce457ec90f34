"""The rows of a result as tables: each number once, with its unit and with the digits of its ±."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rigs.files import results as made
from robot_sysid.records.file_access import strict_json
from robot_sysid.records.messages import Detail
from robot_sysid.records.quantities import DATA, MODEL, Quantity, body_quantities
from robot_sysid.results.table import cells, quantity_lines

NUMBERS = st.floats(1e-9, 1e3) | st.floats(-1e3, -1e-9)


@given(
    st.lists(st.tuples(NUMBERS, NUMBERS, st.floats(1e-5, 1e3)), min_size=1, max_size=5)
)
def test_numbers_and_errors_end_at_the_same_digit_and_no_zero_has_a_sign(rows):
    for row in rows:
        texts = cells(strict_json(Quantity("mass", "it", "kg", *row)), "it")[1:4]
        decimals = {len(text.partition(".")[2]) for text in texts}
        assert len(decimals) == 1
        for text in texts:
            assert "e" not in text
            assert float(text) != 0.0 or not text.startswith("-")


def test_a_share_of_the_prior_is_that_of_mass_and_moment_together():
    body = made.terminal()
    shares = np.array([0.9, 0.2, 0.9, 0.9, *[0.9] * 6])
    for mass_share, sources in ((0.9, (MODEL, DATA)), (0.1, (MODEL, MODEL))):
        shares[0] = mass_share
        rows = body_quantities(replace(body, data_share=shares))
        by_name = {row.name: row.source for row in rows}
        assert (by_name["com_x"], by_name["com_y"]) == sources
        assert by_name["Ixx_about_com"] == DATA


def test_one_line_names_what_is_not_identified():
    """But for the mass, which is asked for: a model's value is no answer."""
    of = {"model": 1.0, "value": 1.0, "error": None, "source": MODEL, "unit": "kg"}
    names = ("mass", "hy", "Ixx", "Ixy")
    rows = [{"name": name, "of": "it", "reason": "", **of} for name in names]
    lines = [line for line in quantity_lines(rows) if not isinstance(line, Detail)]
    assert len(lines) == 3 and lines[1].split()[0] == "mass"
    assert lines[2] == "  not identifiable: CoM moment y; inertia xx, xy"


def test_rounding_is_no_number():
    """A product of inertia of a symmetric body comes back as 1e-18."""
    noisy = made.THETA + np.array([0, 1e-16, 0, 0, 0, 1e-18, 0, 0, 0, 0])
    terminal = made.terminal()
    rows = {row.name: row for row in body_quantities(replace(terminal, theta=noisy))}
    assert (rows["hx"].value, rows["Ixy"].value) == (0.0, 0.0)
    # A gripper jaw's numbers are small, not rounding.
    jaw = 1e-3 * made.THETA
    rows = {row.name: row for row in body_quantities(replace(terminal, theta=jaw))}
    assert (rows["hz"].value, rows["Iyy"].value) == (jaw[3], jaw[7])
