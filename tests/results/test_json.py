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
from robot_sysid.dynamics.friction import BENT, TERMS
from robot_sysid.results.cards import load_errors, payload_cards
from robot_sysid.results.json import FORMULAS, export_params_json, params_json_text
from robot_sysid.results.record import Figure, JointEstimate, Verdict
from tests.support import results as made
from tests.support.model_files import random_theta
from tests.support.results import FRICTION, VALUES, estimate, found, itself, payload, theta_in
from tests.support.schemas import schema

SPECIFIED = [
    *("joint_name", "mass", "center_of_mass_moment", "inertia_tensor", "coulomb_friction"),
    *("viscous_friction", "rmse", "condition_number", "n_base_params"),
]


def content_of(result, cards=(), notes=()):
    text = params_json_text(result, cards, notes)
    content = json.loads(text, parse_constant=pytest.fail)
    jsonschema.validate(content, schema("params"), jsonschema.Draft202012Validator)
    return content


@pytest.mark.parametrize("result", [found(), made.whole(), payload(), itself()])
def test_one_schema_holds_the_answer_to_every_question(result):
    content = content_of(result)
    assert list(content)[: len(SPECIFIED) + 1] == ["schema_version", *SPECIFIED]
    assert list(content) == schema("params")["required"]
    for wrong in ({**content, "weight": 1.0}, {k: v for k, v in content.items() if k != "links"}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, schema("params"))


def test_the_specified_keys_hold_the_terminal_link():
    content = content_of(found())
    assert list(content["inertia_tensor"]) == ["Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz"]
    figures = [content[key] for key in ("mass", "coulomb_friction", "viscous_friction", "rmse")]
    assert figures == [2.0, 0.4, 0.1, 0.03]
    assert (content["condition_number"], content["n_base_params"]) == (50.0, 12)
    assert (content["schema_version"], content["question"]) == (4, "link")
    assert content["known_to"] == pytest.approx(1e-3)


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


def test_it_says_where_each_value_comes_from_and_what_the_run_was():
    content = content_of(found(made.without_mass(), reasons=("why",), verdict=Verdict.TOO_WEAK))
    assert content["parameter_source"]["m"] == content["links"][0]["source"]["m"] == "from_model"
    assert content["parameter_source"]["viscous[j6]"] == "identified"
    assert content["model"] == {"path": "arm.xml", "sha256": "ab"}
    assert content["valid"] == {
        "physically_consistent": True,
        "all_identified": False,
        "trustworthy": False,
    }
    assert (content["status"], content["reasons"]) == ("TOO_WEAK", ["why"])
    assert content["unidentifiable_combinations"] == ["mass"] and content["known_to"] is None
    assert (content["source"], content["seed"]) == ("log arm.csv", None)


def test_the_models_own_simulation_has_no_more_than_that():
    content = content_of(itself())
    assert (content["source"], content["seed"]) == ("simulation of the model itself", 1)
    assert [content["duration"], content["sample_rate"]] == [15.0, 1000.0]
    empty = ("file", "payload", "base_parameters", "standard_errors", "known_to", "rollout")
    assert [content[key] for key in empty] == [None] * len(empty)
    assert content["links"] == [] and content["joints"] == {}


def test_without_friction_the_two_are_null():
    bare = estimate(names=(*spatial.PARAMETER_NAMES, *(f"{n}x" for n in FRICTION)))
    content = content_of(found(bare, joints={}))
    assert content["coulomb_friction"] is None and content["viscous_friction"] is None


def test_what_is_not_finite_is_null_everywhere():
    result = made.without_mass()
    seen = replace(result.identifiability, condition_number=np.inf)
    result = replace(result, identifiability=seen, rmse=np.float64("nan"))
    content = content_of(found(result, sensors={"zero[j6]": Figure(0.0, np.nan)}))
    assert content["condition_number"] is None and content["rmse"] is None
    assert content["standard_errors"]["m"] is None
    assert content["standard_errors"]["hz"] == pytest.approx(2e-4)
    held = {"value": 0.0, "standard_error": None, "interval": [None, None]}
    assert content["sensors"] == {"zero[j6]": held}
    errors = content["links"][0]["standard_errors"]
    assert errors["mass"] is None and errors["com_x"] is None and errors["Ixx"] > 0.0


def test_notes_of_the_writer_stand_behind_those_of_the_result():
    assert content_of(found(notes=("a note",)), notes=("another",))["notes"] == [
        *("a note", "another")
    ]


def test_a_link_stands_beside_the_models_and_the_files():
    first, last = content_of(made.whole())["links"]
    assert (first["name"], first["joint"], last["name"]) == ("link5", "j5", "link6")
    masses = [last[key]["mass"] for key in ("model", "in_the_file")]
    assert [last["mass"], *masses] == pytest.approx([2.0, 1.0, 1.8])
    assert first["in_the_file"]["mass"] == pytest.approx(3.0)
    assert last["error_budget"]["links"]["m"] == pytest.approx(0.8 * 2e-3)
    massless = made.model_file(thetas=np.array([np.zeros(10), made.THETA]))
    assert content_of(made.whole(file=massless))["links"][0]["in_the_file"] is None
    assert content_of(found())["links"][0]["in_the_file"] is None


def test_the_file_is_told_by_its_errors_before_and_after():
    file = content_of(made.whole())["file"]
    assert file["torque_error"] == {"before": 0.27, "after": 0.0025}
    assert file["others"][0]["before"]["relative_error"] == 0.3
    assert file["others"][0]["after"]["rmse"] == 0.05
    assert (file["gravity"], file["kept"]) == ([0.0, 0.1, -9.8], ["rotor inertia"])
    unknown = content_of(made.whole(file=made.model_file(after=None, gravity=None)))["file"]
    assert unknown["torque_error"]["after"] is None and unknown["after"] is None


def test_a_joint_has_terms_intervals_and_both_directions():
    content = content_of(made.whole())
    joint = content["joints"]["j5"]
    low, high = joint["terms"]["coulomb"]["interval"]
    assert (low, high) == pytest.approx((0.5 - 1.96 * 5e-4, 0.5 + 1.96 * 5e-4))
    assert joint["two_ways"]["forward"]["value"] == 0.6
    assert joint["two_ways"]["backward"]["value"] == 0.4
    assert joint["in_the_file"]["viscous"]["value"] == 0.25
    assert joint["model"] == {"coulomb": 0.3, "viscous": 0.1, "armature": 0.0}
    assert joint["held_out_rmse_by_friction_model"] == {"coulomb-viscous": 0.03, "none": 0.4}
    assert content["couplings"]["j5+j6"]["terms"]["viscous"]["value"] == 0.05
    assert content["base_parameters"][1] == {
        "combination": "hx(link6)",
        "value": 0.02,
        "standard_error": 0.03,
        "essential": False,
    }


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


def bam_of(values, **changes):
    terms = {term: Figure(value, 0.01) for term, value in values.items()}
    model = "-".join(term for term in values if not term.endswith("_speed")) or "none"
    result = made.whole(joints={"j5": JointEstimate(model, terms)}, **changes)
    return content_of(result)["joints"]["j5"]["bam"]


@pytest.mark.parametrize(
    ("number", "more"),
    [("m1", {}), ("m2", STRIBECK), ("m3", {"load": 0.06}), ("m4", {**STRIBECK, "load": 0.06})],
)
def test_bam_gets_its_own_model_and_names(number, more):
    bam = bam_of({**BASIC, **more})
    assert bam["model"] == number
    assert set(bam) - {"model"} == IN_BAM["m1"] | IN_BAM[number]
    assert (bam["friction_base"], bam["friction_viscous"], bam["armature"]) == (1.3, 0.7, 0.2)
    if "load" in more:
        assert bam["load_friction_base"] == pytest.approx(0.03)


def test_a_curve_that_bam_has_not_is_that_of_the_file():
    bam = bam_of({**BASIC, "sqrt": 0.4})
    assert (bam["model"], bam["friction_base"], bam["friction_viscous"]) == ("m1", 0.45, 0.25)
    assert bam_of({**BASIC, "sqrt": 0.4}, file=None) is None
    assert bam_of({}) is None


def test_every_formula_is_the_column_of_its_term():
    assert set(FORMULAS) == set(TERMS) - {"armature"}
    qd, load = np.linspace(-1.0, 1.0, 9), np.linspace(-3.0, 5.0, 9)
    known = {f"{term}_speed": bent.usual for term, bent in BENT.items()}
    functions = {name: getattr(np, name) for name in ("sign", "sqrt", "abs", "exp", "tanh")}
    for term, formula in FORMULAS.items():
        value = eval(formula, {**functions, **known, "qd": qd, "load": load})
        np.testing.assert_allclose(value * np.ones(9), TERMS[term](qd, qd, load), rtol=1e-12)


def test_a_payload_stands_between_the_link_without_and_with_it():
    found = content_of(payload())
    told = found["payload"]
    assert (found["question"], found["mass"]) == ("payload", 2.0)
    assert [told[key]["mass"] for key in ("body", "link", "total")] == [1.2, 0.8, 2.0]
    assert (told["flange"]["name"], told["flange"]["in_body"]) == ("site 'flange'", "link6")
    assert told["recordings"] == {"empty": ["a.csv"], "loaded": ["b.csv", "c.csv"]}
    assert told["scatter"][0]["mass"] == 1.19 and told["cards"] == {}
    assert found["known_to"] == pytest.approx(0.01 / 1.2)


def test_errors_of_a_payload_are_whole_and_split_by_cause():
    told = content_of(payload())["payload"]["body"]
    assert told["standard_errors"]["m"] == told["standard_errors"]["mass"] == pytest.approx(0.01)
    assert told["standard_errors_noise"]["m"] == pytest.approx(0.006)
    assert told["error_budget"]["torque scale"]["m"] == pytest.approx(0.008)
    assert told["standard_errors"]["com_z"] == pytest.approx(load_errors(made.body())["com_z"])


def test_a_payload_that_is_not_seen_is_not_identified():
    content = content_of(payload(made.body(shown=False)))
    assert content["payload"]["body"]["standard_errors"]["Ixx"] is None
    assert content["payload"]["body"]["source"]["Ixx"] == "from_model"
    assert not content["valid"]["all_identified"]
    impossible = content_of(payload(made.body(-1.0)))
    assert not impossible["valid"]["physically_consistent"] and impossible["known_to"] is None


def test_cards_and_torque_scales_of_a_payload():
    scale = {"j5": Figure(1.02, 0.003)}
    result = payload(known_mass=2.0, torque_scale=scale)
    cards = payload_cards(result.asked, result.payload.flange, load_errors(result.body))
    told = content_of(result, cards)["payload"]
    assert len(told["cards"]) == len(cards) > 5
    assert (told["known_mass"], told["torque_scale"]["j5"]["value"]) == (2.0, 1.02)
