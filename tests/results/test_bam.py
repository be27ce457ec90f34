"""A joint's friction as BAM's models hold it."""

from __future__ import annotations

import pytest
from pytest import approx

from robot_sysid.results.bam import bam_entry
from robot_sysid.results.record import JointEstimate, Quantity

STRIBECK = {"stribeck": 0.5, "stribeck_speed": 0.05}
BASIC = {"coulomb": 1.3, "viscous": 0.7, "offset": 0.1, "armature": 0.2}
IN_M1 = "friction_base friction_viscous armature"
IN_M2 = f"{IN_M1} friction_stribeck dtheta_stribeck alpha"
IN_M4 = f"{IN_M2} load_friction_base load_friction_stribeck"
"""What BAM's models m1, m2 and m4 have, beside kt and R of an actuator."""


def bam_of(values, written=None):
    """The friction of a joint as BAM states it, of the terms' values."""
    terms = {term: Quantity(value, 0.01) for term, value in values.items()}
    model = "-".join(term for term in values if not term.endswith("_speed"))
    return bam_entry(JointEstimate(model, terms), written or {})


@pytest.mark.parametrize(
    ("number", "more_terms", "keys"),
    [
        ("m1", {}, IN_M1),
        ("m2", STRIBECK, IN_M2),
        ("m3", {"load": 0.06}, f"{IN_M1} load_friction_base"),
        ("m4", {**STRIBECK, "load": 0.06}, IN_M4),
    ],
)
def test_bam_gets_its_own_model_and_names(number, more_terms, keys):
    bam = bam_of({**BASIC, **more_terms})
    assert set(bam) == {"model", *keys.split()}
    expected = {
        "model": number,
        "friction_base": 1.3,
        "friction_viscous": 0.7,
        "armature": 0.2,
    }
    assert bam == {**bam, **expected}
    assert bam.get("load_friction_base", 0.03) == approx(0.03)


def test_of_a_curve_that_bam_has_not_it_gets_the_friction_of_the_file():
    expected = {"model": "m1", "friction_base": 0.45, "friction_viscous": 0.25}
    written = {"coulomb": Quantity(0.45, 0.01), "viscous": Quantity(0.25, 0.02)}
    bam = bam_of({**BASIC, "sqrt": 0.4}, written)
    assert bam == {**bam, **expected}
