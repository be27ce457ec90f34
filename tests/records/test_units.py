"""Every friction term has its units, in a hinge and in a slide."""

from __future__ import annotations

import pytest

from robot_sysid.dynamics.friction import BENT, TERMS
from robot_sysid.records.units import position, term_unit, torque


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
