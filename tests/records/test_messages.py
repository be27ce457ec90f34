"""Numbers as text: as many digits as the error deserves, and never zero for what is not."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.friction import NONLINEAR_TERMS, TERMS
from robot_sysid.records.messages import (
    number_text,
    position_unit,
    term_unit,
    torque_unit,
)

NUMBERS = st.floats(1e-12, 1e6) | st.floats(-1e6, -1e-12)


@given(NUMBERS, st.floats(1e-12, 1e6))
def test_a_number_is_off_by_less_than_its_error_and_never_zero(value, error):
    """Two digits of the error count: rounding takes at most half of the second one."""
    text = number_text(value, error)
    assert float(text) != 0.0
    rounding = 0.051 * error if abs(value) > error else 0.5 * abs(value)
    assert abs(float(text) - value) <= rounding + 1e-12 * abs(value)


@given(NUMBERS)
def test_without_an_error_four_digits_count(value):
    assert float(number_text(value)) == pytest.approx(value, rel=5.1e-4)


@pytest.mark.parametrize("is_slide", [False, True])
def test_every_friction_term_has_a_unit_but_the_loss_per_load(is_slide):
    units = torque_unit(is_slide), position_unit(is_slide)
    for term in TERMS:
        unit = term_unit(term, is_slide)
        assert (unit == "") == (term == "load")
        assert is_slide or not unit.startswith("N·s")
    for term in NONLINEAR_TERMS:
        assert term_unit(f"{term}_speed", is_slide) == f"{units[1]}/s"
    assert (term_unit("coulomb", is_slide), term_unit("zero", is_slide)) == units
