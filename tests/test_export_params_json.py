"""params.json: every specified key, full precision, strict JSON, the same schema for all."""

from __future__ import annotations

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import NONLINEAR_TERMS, TERMS
from robot_sysid.export import FORMULAS, export_params_json, params_json_text
from robot_sysid.results.cards import load_errors, payload_cards
from robot_sysid.results.record import JointEstimate, Quantity, Verdict
from tests.support import results as made
from tests.support.model_files import random_theta
from tests.support.results import (
    FRICTION,
    VALUES,
    estimate,
    found,
    itself,
    payload,
    theta_in,
)
from tests.support.schemas import schema

SPECIFIED = [
    *(
        "joint_name",
        "mass",
        "center_of_mass_moment",
        "inertia_tensor",
        "coulomb_friction",
    ),
    *("viscous_friction", "rmse", "condition_number", "n_base_params"),
]


def content_of(result, cards=(), notes=()):
    text = params_json_text(result, cards, notes)
    content = json.loads(text, parse_constant=pytest.fail)
    jsonschema.Draft202012Validator(schema("params")).validate(content)
    return content


@pytest.mark.parametrize("result", [found(), made.whole(), payload(), itself()])
def test_one_schema_holds_the_answer_to_every_question(result):
    content = content_of(result)
    assert list(content)[: len(SPECIFIED) + 1] == ["schema_version", *SPECIFIED]
    assert list(content) == schema("params")["required"]
    validator = jsonschema.Draft202012Validator(schema("params"))
    for wrong in (
        {**content, "weight": 1.0},
        {k: v for k, v in content.items() if k != "links"},
    ):
        assert not validator.is_valid(wrong)


@pytest.mark.parametrize("name", ["params", "servo"])
def test_a_schema_is_one(name):
    jsonschema.Draft202012Validator.check_schema(schema(name))


@given(seed=st.integers(0, 2**32 - 1))
def test_reading_back_gives_the_same_bits(tmp_path_factory, seed):
    theta = random_theta(np.random.default_rng(seed))
    path = tmp_path_factory.mktemp("p") / "params.json"
    export_params_json(found(estimate(values=np.append(theta, VALUES[10:]))), path)
    np.testing.assert_array_equal(theta_in(path), theta)
    content = json.loads(path.read_text())
    _, com, about_com = spatial.com_from_theta(theta)
    np.testing.assert_array_equal(content["center_of_mass"], com)
    six = list(content["inertia_about_com"].values())
    np.testing.assert_array_equal(six, spatial.six_from_symmetric(about_com))


def test_the_specified_keys_hold_the_terminal_link_and_the_others_what_the_run_was():
    content = content_of(found())
    figures = [
        content[key] for key in ("mass", "coulomb_friction", "viscous_friction", "rmse")
    ]
    assert figures == [2.0, 0.4, 0.1, 0.03]
    assert (content["condition_number"], content["n_base_params"]) == (50.0, 12)
    assert content["known_to"] == pytest.approx(1e-3) and content["question"] == "link"
    content = content_of(
        found(made.without_mass(), reasons=("why",), verdict=Verdict.TOO_WEAK)
    )
    assert (
        content["parameter_source"]["m"]
        == content["links"][0]["source"]["m"]
        == "from_model"
    )
    assert content["parameter_source"]["viscous[j6]"] == "identified"
    assert list(content["valid"].values()) == [True, False, False]
    assert (content["status"], content["reasons"]) == ("TOO_WEAK", ["why"])
    assert (
        content["unidentifiable_combinations"] == ["mass"]
        and content["known_to"] is None
    )
    bare = estimate(names=(*spatial.PARAMETER_NAMES, *(f"{n}x" for n in FRICTION)))
    assert content_of(found(bare, joints={}))["viscous_friction"] is None
    content = content_of(itself())
    assert (content["source"], content["seed"]) == ("simulation of the model itself", 1)
    assert [content["duration"], content["sample_rate"]] == [15.0, 1000.0]


def test_what_is_not_finite_is_null_everywhere():
    result = made.without_mass()
    seen = replace(result.identifiability, condition_number=np.inf)
    result = replace(result, identifiability=seen, rmse=np.float64("nan"))
    content = content_of(found(result, sensors={"zero[j6]": Quantity(0.0, np.nan)}))
    assert content["condition_number"] is None and content["rmse"] is None
    assert content["standard_errors"]["m"] is None
    held = {"value": 0.0, "standard_error": None, "interval": [None, None]}
    assert content["sensors"] == {"zero[j6]": held}
    errors = content["links"][0]["standard_errors"]
    assert errors["mass"] is None and errors["com_x"] is None and errors["Ixx"] > 0.0


def test_links_joints_and_the_file_stand_beside_the_models():
    content = content_of(made.whole(), notes=("another",))
    first, last = content["links"]
    assert (first["name"], first["joint"], last["name"]) == ("link5", "j5", "link6")
    masses = [last[key]["mass"] for key in ("model", "in_the_file")]
    assert [last["mass"], *masses] == pytest.approx([2.0, 1.0, 1.8])
    assert first["in_the_file"]["mass"] == pytest.approx(3.0)
    assert last["error_budget"]["links"]["m"] == pytest.approx(0.8 * 2e-3)
    file = content["file"]
    assert file["torque_error"] == {"before": 0.27, "after": 0.0025}
    assert file["others"][0]["before"]["relative_error"] == 0.3
    assert file["others"][0]["after"]["rmse"] == 0.05
    assert (file["gravity"], file["kept"]) == ([0.0, 0.1, -9.8], ["rotor inertia"])
    assert content["notes"] == ["a note", "another"]
    joint = content["joints"]["j5"]
    low, high = joint["terms"]["coulomb"]["interval"]
    assert (low, high) == pytest.approx((0.5 - 1.96 * 5e-4, 0.5 + 1.96 * 5e-4))
    assert [joint["two_ways"][way]["value"] for way in ("forward", "backward")] == [
        0.6,
        0.4,
    ]
    assert joint["in_the_file"]["viscous"]["value"] == 0.25
    assert joint["another_day"]["coulomb"]["standard_error"] == 0.08
    assert [log["coulomb"]["value"] for log in joint["logs"].values()] == [0.45, 0.55]
    assert content["couplings"]["j5+j6"]["terms"]["viscous"]["value"] == 0.05
    assert list(content["base_parameters"][1].values()) == [
        "hx(link6)",
        0.02,
        0.03,
        False,
    ]
    massless = made.model_file(
        thetas=np.array([np.zeros(10), made.THETA]), validation_after=None
    )
    content = content_of(made.whole(file=massless))
    assert (
        content["links"][0]["in_the_file"]
        is content["file"]["torque_error"]["after"]
        is None
    )


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
STRIBECK = {"stribeck": 0.5, "stribeck_speed": 0.05}
BASIC = {"coulomb": 1.3, "viscous": 0.7, "offset": 0.1, "armature": 0.2}


def bam_of(values):
    terms = {term: Quantity(value, 0.01) for term, value in values.items()}
    model = "-".join(term for term in values if not term.endswith("_speed")) or "none"
    result = made.whole(joints={"j5": JointEstimate(model, terms)})
    return json.loads(params_json_text(result))["joints"]["j5"]["bam"]


@pytest.mark.parametrize(
    ("number", "more"),
    [
        ("m1", {}),
        ("m2", STRIBECK),
        ("m3", {"load": 0.06}),
        ("m4", {**STRIBECK, "load": 0.06}),
    ],
)
def test_bam_gets_its_own_model_and_names(number, more):
    bam = bam_of({**BASIC, **more})
    assert bam["model"] == number
    assert set(bam) - {"model"} == IN_BAM["m1"] | IN_BAM[number]
    assert (bam["friction_base"], bam["friction_viscous"], bam["armature"]) == (
        1.3,
        0.7,
        0.2,
    )
    assert bam.get("load_friction_base", 0.03) == pytest.approx(0.03)
    # A curve that BAM has not is that of the file.
    bam = bam_of({**BASIC, "sqrt": 0.4})
    assert (bam["model"], bam["friction_base"], bam["friction_viscous"]) == (
        "m1",
        0.45,
        0.25,
    )


def test_every_formula_is_the_column_of_its_term():
    assert set(FORMULAS) == set(TERMS) - {"armature"}
    qd = np.linspace(-1.0, 1.0, 9)
    load = np.linspace(-3.0, 5.0, 9)
    known = {
        f"{term}_speed": bent.default_speed for term, bent in NONLINEAR_TERMS.items()
    }
    functions = {
        name: getattr(np, name) for name in ("sign", "sqrt", "abs", "exp", "tanh")
    }
    for term, formula in FORMULAS.items():
        value = eval(formula, {**functions, **known, "qd": qd, "load": load})
        np.testing.assert_allclose(
            value * np.ones(9), TERMS[term](qd, qd, load), rtol=1e-12
        )


def test_a_payload_stands_between_the_link_without_and_with_it():
    result = payload(known_mass=2.0, torque_scale={"j5": Quantity(1.02, 0.003)})
    content = content_of(result, payload_cards(result.body, result.payload.flange))
    told = content["payload"]
    assert (content["question"], content["mass"]) == ("payload", 2.0)
    assert [told[key]["mass"] for key in ("body", "link", "total")] == [1.2, 0.8, 2.0]
    assert (told["flange"]["name"], told["flange"]["in_body"]) == (
        "site 'flange'",
        "link6",
    )
    assert told["recordings"] == {"empty": ["a.csv"], "loaded": ["b.csv", "c.csv"]}
    assert told["scatter"][0]["mass"] == 1.19 and len(told["cards"]) > 5
    assert content["known_to"] == pytest.approx(0.01 / 1.2)
    assert (told["known_mass"], told["torque_scale"]["j5"]["value"]) == (2.0, 1.02)
    of_body = told["body"]
    assert of_body["standard_errors"]["m"] == of_body["standard_errors"]["mass"]
    assert of_body["standard_errors"]["m"] == pytest.approx(0.01)
    assert of_body["standard_errors_noise"]["m"] == pytest.approx(0.006)
    assert of_body["error_budget"]["torque scale"]["m"] == pytest.approx(0.008)
    assert of_body["standard_errors"]["com_z"] == pytest.approx(
        load_errors(made.body())[3]
    )
    content = content_of(payload(made.body(shown=False)))
    assert content["payload"]["body"]["standard_errors"]["Ixx"] is None
    assert content["payload"]["body"]["source"]["Ixx"] == "from_model"
    assert not content["valid"]["all_identified"]
    impossible = content_of(payload(made.body(-1.0)))
    assert (
        not impossible["valid"]["physically_consistent"]
        and impossible["known_to"] is None
    )
