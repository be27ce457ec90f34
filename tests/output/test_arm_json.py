"""friction.json: what controllers and BAM read is what was found."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from robot_sysid.dynamics.friction import BENT, TERMS
from robot_sysid.output.arm_json import FORMULAS, friction_json_text
from robot_sysid.records.whole_arm import ArmEstimate, ArmStatus, FrictionCurve, HeldFriction

JOINT = "elbow"
# What BAM's models m1 to m4 have, beside kt and R of an actuator.
IN_BAM = {
    "m1": {"friction_base", "friction_viscous", "armature"},
    "m2": {"friction_stribeck", "dtheta_stribeck", "alpha"},
    "m3": {"load_friction_base"},
    "m4": {
        *("friction_stribeck", "dtheta_stribeck", "alpha"),
        *("load_friction_base", "load_friction_stribeck"),
    },
}
NONE = FrictionCurve(*[np.zeros(0)] * 6)
HELD = HeldFriction({"coulomb": 2.0, "viscous": 1.0, "armature": 0.1}, {}, (), {}, NONE)


def content_of(model, **values):
    names = tuple(f"{term}[{JOINT}]" for term in values)
    numbers = np.array(list(values.values()), dtype=float)
    estimate = ArmEstimate(
        names=names,
        values=numbers,
        standard_errors=0.01 * np.ones(len(numbers)),
        data_share=np.ones(len(numbers)),
        thetas=np.zeros((1, 10)),
        theta_errors=np.zeros((1, 10)),
        friction={JOINT: model},
        couplings=(),
        gamma=1.0,
        noise_per_joint={JOINT: 0.1},
        base=None,
        two_way={JOINT: ((1.4, 0.02), (1.2, 0.03))},
    )
    found = SimpleNamespace(
        estimate=estimate, status=ArmStatus.OK, joint_names=(JOINT,), model_friction={JOINT: HELD}
    )
    return json.loads(friction_json_text(found))


STRIBECK = {"stribeck": 0.5, "stribeck_speed": 0.05}
BASIC = {"coulomb": 1.3, "viscous": 0.7, "offset": 0.1, "armature": 0.2}


@pytest.mark.parametrize(
    ("number", "model", "more"),
    [
        ("m1", "coulomb-viscous-offset-armature", {}),
        ("m2", "coulomb-viscous-offset-armature-stribeck", STRIBECK),
        ("m3", "coulomb-viscous-offset-armature-load", {"load": 0.06}),
        ("m4", "coulomb-viscous-offset-armature-stribeck-load", {**STRIBECK, "load": 0.06}),
    ],
)
def test_bam_gets_its_own_model_and_names(number, model, more):
    bam = content_of(model, **BASIC, **more)["joints"][JOINT]["bam"]
    assert bam["model"] == number
    assert set(bam) - {"model"} == IN_BAM["m1"] | IN_BAM[number]
    assert (bam["friction_base"], bam["friction_viscous"], bam["armature"]) == (1.3, 0.7, 0.2)
    if "load" in more:
        assert bam["load_friction_base"] == pytest.approx(0.03)


def test_a_curve_that_bam_has_not_becomes_the_nearest_it_has():
    values = {**BASIC, "sqrt": 0.4}
    bam = content_of("coulomb-viscous-offset-armature-sqrt", **values)["joints"][JOINT]["bam"]
    assert (bam["model"], bam["friction_base"], bam["friction_viscous"]) == ("m1", 2.0, 1.0)


def test_a_controller_reads_terms_intervals_and_both_directions():
    model = "coulomb-viscous-offset-armature-stribeck"
    joint = content_of(model, **BASIC, **STRIBECK)["joints"][JOINT]
    assert joint["model"] == model
    assert set(joint["terms"]) == {"coulomb", "viscous", "offset", *STRIBECK}
    low, high = joint["terms"]["stribeck"]["interval"]
    assert (low, high) == pytest.approx((0.5 - 0.0196, 0.5 + 0.0196))
    assert joint["coulomb_forward"]["value"] == 1.4 and joint["coulomb_backward"]["value"] == 1.2


def test_every_formula_is_the_column_of_its_term():
    assert set(FORMULAS) == set(TERMS) - {"armature"}
    qd, load = np.linspace(-1.0, 1.0, 9), np.linspace(-3.0, 5.0, 9)
    known = {f"{term}_speed": bent.usual for term, bent in BENT.items()}
    functions = {name: getattr(np, name) for name in ("sign", "sqrt", "abs", "exp", "tanh")}
    for term, formula in FORMULAS.items():
        value = eval(formula, {**functions, **known, "qd": qd, "load": load})
        np.testing.assert_allclose(value * np.ones(9), TERMS[term](qd, qd, load), rtol=1e-12)
