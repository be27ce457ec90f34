"""Numbers as text: as many digits as the error deserves, and never zero for what is not."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.friction import BENT, TERMS
from robot_sysid.records.figures import figure, percent, position, term_unit, torque, with_error

NUMBERS = st.floats(1e-12, 1e6) | st.floats(-1e6, -1e-12)


@given(NUMBERS, st.floats(1e-12, 1e6))
def test_a_number_is_off_by_less_than_its_error_and_never_zero(value, error):
    """Two digits of the error count: rounding takes at most half of the second one."""
    text = figure(value, error)
    assert float(text) != 0.0
    rounding = 0.051 * error if abs(value) > error else 0.5 * abs(value)
    assert abs(float(text) - value) <= rounding + 1e-12 * abs(value)


@given(NUMBERS)
def test_without_an_error_four_digits_count(value):
    assert float(figure(value)) == pytest.approx(value, rel=5.1e-4)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (1.5512, 0.087, "1.551"),
        (0.4, 0.0046, "0.4000"),
        (-4.7e-5, 5e-4, "-0.00005"),
        (1e-6, 5e-4, "1e-06"),
        (123.4, 120.0, "123"),
        (0.625, 10.0, "0.6"),
        (1.2346e-7, 1e-9, "1.235e-07"),
        (0.0, 0.1, "0"),
        (2.0, math.inf, "2"),
        (math.nan, 0.1, "not known"),
    ],
)
def test_examples(value, error, text):
    assert figure(value, error) == text


def test_a_number_with_its_error_and_unit():
    assert with_error(1.5512, 0.087, "kg") == "1.551 ± 0.087 kg"
    assert with_error(1.5512, math.inf, "kg") == "1.551 kg"


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.0561, "5.6 %"),
        (0.001, "0.1 %"),
        (1.06, "106 %"),
        (-0.41, "-41 %"),
        (186429530.15, "over 1000 %"),
        (math.inf, "over 1000 %"),
        (math.nan, "not known"),
    ],
)
def test_percentages_stay_readable(share, text):
    assert percent(share) == text


@pytest.mark.parametrize("is_slide", [False, True])
def test_every_friction_term_has_a_unit_but_the_loss_per_load(is_slide):
    own = torque(is_slide), position(is_slide)
    for term in TERMS:
        unit = term_unit(term, is_slide)
        assert (unit == "") == (term == "load")
        assert is_slide or not unit.startswith("N·s")
    for bent in BENT:
        assert term_unit(f"{bent}_speed", is_slide) == f"{own[1]}/s"
    assert (term_unit("coulomb", is_slide), term_unit("zero", is_slide)) == own
