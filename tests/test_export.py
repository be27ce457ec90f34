"""All results of a run are written or none, and never beside another run's; params.json has every
specified key, full precision, strict JSON and one schema."""

from __future__ import annotations

import copy
import hashlib
import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid import export as module
from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import NONLINEAR_TERMS, TERMS
from robot_sysid.errors import InputError
from robot_sysid.export import (
    FORMULAS,
    RESULT_NAMES,
    export_params_json,
    params_json_text,
    save,
)
from robot_sysid.parser import load_robot_model
from robot_sysid.records import InertialParameters
from robot_sysid.results.cards import load_errors, payload_cards
from robot_sysid.results.record import JointEstimate, Quantity, Verdict
from tests.results.test_written_model import checkpoints, payload_of, result_of
from tests.support import results as made
from tests.support.command_line import files_in
from tests.support.model_files import ARM, random_theta, write_files
from tests.support.schemas import schema

THETA = random_theta(np.random.default_rng(1), 2.0)
EARLIER = {name: f"an earlier {name}" for name in (*RESULT_NAMES, "report_data.npz")}
OTHERS = {
    "trajectory.json": "a plan",
    "trajectory.csv": "its samples",
    "notes.txt": "mine",
}


@pytest.fixture
def robot(tmp_path):
    return load_robot_model(write_files(tmp_path / "in", {"m.xml": ARM}), joint="j2")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def save_result(robot, result, out, **options):
    return save(result, out, checkpoints(robot), **options)


def heavier(robot):
    return result_of(robot, robot.prior.theta + THETA)


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_whole_way_from_a_result(robot, out):
    output = save_result(robot, heavier(robot), out)
    assert [path.name for path in output.files] == ["updated_model.xml", "params.json"]
    assert (output.notes, output.damiao, output.failure) == ((), None, None)
    reloaded = load_robot_model(output.files[0], joint="j2")
    np.testing.assert_allclose(
        reloaded.prior.theta, robot.prior.theta + THETA, rtol=0, atol=1e-12
    )
    assert "RMSE 0.000100 Nm" in output.files[0].read_text()
    content = json.loads(output.files[1].read_text())
    assert content["mass"] == robot.prior.mass + 2.0
    assert (
        output.result_hash == hashlib.sha256(output.files[1].read_bytes()).hexdigest()
    )


def test_a_payload_has_a_card_beside_the_model(robot, out):
    payload = payload_of(robot, THETA)
    output = save_result(robot, result_of(robot, payload=payload), out, as_body="load")
    assert names_in(out) == ["params.json", "payload_card.txt", "updated_model.xml"]
    model = load_robot_model(out / "updated_model.xml", joint="j2").mj_model
    assert model.body("load").mass == pytest.approx(2.0, rel=1e-12)
    card = (out / "payload_card.txt").read_text()
    assert card.startswith(
        "Payload of 2.00000 ± 0.00010 kg, identified with m.xml from 1 empty and 2"
    )
    assert json.loads((out / "params.json").read_text())["payload"]["cards"]
    assert output.failure is None


def test_torques_that_were_weighed_with_a_known_mass_go_into_no_model(robot, out):
    payload = replace(payload_of(robot, THETA), known_mass=2.0)
    assert save_result(robot, result_of(robot, payload=payload), out).failure is None
    assert names_in(out) == ["params.json"]


@pytest.mark.parametrize("with_payload", [False, True])
def test_a_result_that_is_not_trusted_gets_a_params_json_alone(
    robot, out, with_payload
):
    payload = payload_of(robot, THETA) if with_payload else None
    doubtful = result_of(
        robot, payload=payload, verdict=Verdict.TOO_WEAK, reasons=("so light",)
    )
    output = save_result(robot, doubtful, out)
    assert names_in(out) == ["params.json"]
    omission = "no model and no card were" if with_payload else "no model was"
    assert output.failure.startswith(
        f"{omission} written: so light; {Verdict.TOO_WEAK.value[:30]}"
    )


def test_a_file_that_is_not_the_model_in_memory_gets_no_new_model(robot, out):
    other = copy.copy(robot.mj_model)
    other.body_mass[robot.body_id - 1] *= 1.5
    changed = replace(
        robot, mj_model=other, prior=InertialParameters(robot.prior.theta)
    )
    output = save_result(changed, heavier(changed), out)
    assert "differs from the original in body_mass" in output.failure
    assert names_in(out) == ["params.json"]


def test_the_motor_trajectory_stands_beside_the_others_or_nothing_does(robot, out):
    def fail_halfway(file):
        file.write("half a file")
        raise InputError("no such motor")

    with pytest.raises(InputError, match="no such motor"):
        save_result(robot, heavier(robot), out, motor_file=fail_halfway)
    assert not out.exists()
    output = save_result(robot, heavier(robot), out, motor_file=lambda file: "a report")
    names = ["updated_model.xml", "damiao_trajectory.csv", "params.json"]
    assert [path.name for path in output.files] == names and output.damiao == "a report"
    assert names_in(out) == sorted(names)


def test_no_result_of_an_earlier_run_stays_and_nothing_else_goes(robot, out):
    write_files(
        out, {**EARLIER, **OTHERS, "bundle/m.xml": "sent", "params.json.bak": "mine"}
    )
    output = save_result(robot, heavier(robot), out)
    result_names = {"updated_model.xml", "params.json"}
    assert set(names_in(out)) == result_names | set(OTHERS) | {
        "bundle",
        "params.json.bak",
    }
    assert (out / "bundle" / "m.xml").read_text() == "sent"
    assert all((out / name).read_text() == text for name, text in OTHERS.items())
    assert all("an earlier" not in (out / name).read_text() for name in result_names)
    removed_names = sorted(set(RESULT_NAMES) - result_names)
    assert sorted(output.notes) == [
        f"{out / name} of an earlier run was removed" for name in removed_names
    ]


@pytest.mark.parametrize("case", ["not trusted", "does not fit", "refused"])
def test_an_old_model_goes_also_where_this_run_writes_none(robot, out, case):
    write_files(out, EARLIER)
    result = heavier(robot)
    options = {}
    if case == "not trusted":
        result = replace(result, verdict=Verdict.TOO_WEAK)
    elif case == "does not fit":
        result = result_of(robot, -robot.prior.theta)
    else:
        options = {"refused": "played worse"}
    output = save_result(robot, result, out, **options)
    assert (
        names_in(out) == ["params.json"] and len(output.notes) == len(RESULT_NAMES) - 1
    )
    assert ("not a possible rigid body" in output.failure) == (case == "does not fit")
    assert (
        json.loads((out / "params.json").read_text())["mass"]
        == result.estimate.inertial.mass
    )


def test_what_this_run_reads_stays_whatever_it_is_called(robot, out):
    log = "report_data.npz"
    text = '<mujoco><include file="servo.json"/><worldbody/></mujoco>'
    write_files(
        out,
        {
            "updated_model.xml": text,
            "servo.json": ARM,
            log: "a log",
            "payload_card.txt": "",
        },
    )
    robot_in_out = load_robot_model(out / "updated_model.xml", joint="j2")
    (out / "link").symlink_to(out, target_is_directory=True)
    output = save_result(
        robot_in_out,
        heavier(robot_in_out),
        out / "link",
        refused="no",
        inputs=[out / log],
    )
    names = ["link", "params.json", log, "servo.json", "updated_model.xml"]
    assert (
        names_in(out) == names
        and len(output.notes) == 1
        and "payload_card.txt" in output.notes[0]
    )


def test_a_run_that_ends_with_an_error_leaves_the_old_set(robot, out, monkeypatch):
    write_files(out, {**EARLIER, **OTHERS})
    old_files = files_in(out)

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, "payload_cards", interrupt)
        with pytest.raises(KeyboardInterrupt):
            save_result(robot, result_of(robot, payload=payload_of(robot, THETA)), out)
    assert files_in(out) == old_files


# ---- params.json

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


@pytest.mark.parametrize(
    "result", [made.found(), made.whole(), made.payload(), made.itself()]
)
def test_one_schema_holds_the_answer_to_every_question(result):
    content = content_of(result)
    assert list(content)[: len(SPECIFIED) + 1] == ["schema_version", *SPECIFIED]
    assert list(content) == schema("params")["required"]
    validator = jsonschema.Draft202012Validator(schema("params"))
    for invalid in (
        {**content, "weight": 1.0},
        {k: v for k, v in content.items() if k != "links"},
    ):
        assert not validator.is_valid(invalid)


@pytest.mark.parametrize("name", ["params", "servo"])
def test_a_schema_is_one(name):
    jsonschema.Draft202012Validator.check_schema(schema(name))


@given(seed=st.integers(0, 2**32 - 1))
def test_reading_back_gives_the_same_bits(tmp_path_factory, seed):
    theta = random_theta(np.random.default_rng(seed))
    path = tmp_path_factory.mktemp("p") / "params.json"
    export_params_json(
        made.found(made.estimate(values=np.append(theta, made.VALUES[10:]))), path
    )
    np.testing.assert_array_equal(made.theta_in(path), theta)
    content = json.loads(path.read_text())
    _, com, about_com = spatial.com_from_theta(theta)
    np.testing.assert_array_equal(content["center_of_mass"], com)
    six = list(content["inertia_about_com"].values())
    np.testing.assert_array_equal(six, spatial.six_from_symmetric(about_com))


def test_the_specified_keys_hold_the_terminal_link_and_the_others_what_the_run_was():
    content = content_of(made.found())
    figures = [
        content[key] for key in ("mass", "coulomb_friction", "viscous_friction", "rmse")
    ]
    assert figures == [2.0, 0.4, 0.1, 0.03]
    assert (content["condition_number"], content["n_base_params"]) == (50.0, 12)
    assert content["known_to"] == pytest.approx(1e-3) and content["question"] == "link"
    content = content_of(
        made.found(made.without_mass(), reasons=("why",), verdict=Verdict.TOO_WEAK)
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
    bare = made.estimate(
        names=(*spatial.PARAMETER_NAMES, *(f"{n}x" for n in made.FRICTION))
    )
    assert content_of(made.found(bare, joints={}))["viscous_friction"] is None
    content = content_of(made.itself())
    assert (content["source"], content["seed"]) == ("simulation of the model itself", 1)
    assert [content["duration"], content["sample_rate"]] == [15.0, 1000.0]


def test_what_is_not_finite_is_null_everywhere():
    result = made.without_mass()
    identifiability = replace(result.identifiability, condition_number=np.inf)
    result = replace(result, identifiability=identifiability, rmse=np.float64("nan"))
    content = content_of(
        made.found(result, sensors={"zero[j6]": Quantity(0.0, np.nan)})
    )
    assert content["condition_number"] is None and content["rmse"] is None
    assert content["standard_errors"]["m"] is None
    zero = {"value": 0.0, "standard_error": None, "interval": [None, None]}
    assert content["sensors"] == {"zero[j6]": zero}
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
    assert [
        joint["two_ways"][direction]["value"] for direction in ("forward", "backward")
    ] == [0.6, 0.4]
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
    speeds = {
        f"{term}_speed": curve.default_speed for term, curve in NONLINEAR_TERMS.items()
    }
    functions = {
        name: getattr(np, name) for name in ("sign", "sqrt", "abs", "exp", "tanh")
    }
    for term, formula in FORMULAS.items():
        value = eval(formula, {**functions, **speeds, "qd": qd, "load": load})
        np.testing.assert_allclose(
            value * np.ones(9), TERMS[term](qd, qd, load), rtol=1e-12
        )


def test_a_payload_stands_between_the_link_without_and_with_it():
    result = made.payload(known_mass=2.0, torque_scale={"j5": Quantity(1.02, 0.003)})
    content = content_of(result, payload_cards(result.body, result.payload.flange))
    payload_content = content["payload"]
    assert (content["question"], content["mass"]) == ("payload", 2.0)
    assert [payload_content[key]["mass"] for key in ("body", "link", "total")] == [
        1.2,
        0.8,
        2.0,
    ]
    assert (
        payload_content["flange"]["name"],
        payload_content["flange"]["in_body"],
    ) == ("site 'flange'", "link6")
    assert payload_content["recordings"] == {
        "empty": ["a.csv"],
        "loaded": ["b.csv", "c.csv"],
    }
    assert (
        payload_content["scatter"][0]["mass"] == 1.19
        and len(payload_content["cards"]) > 5
    )
    assert content["known_to"] == pytest.approx(0.01 / 1.2)
    assert (
        payload_content["known_mass"],
        payload_content["torque_scale"]["j5"]["value"],
    ) == (2.0, 1.02)
    of_body = payload_content["body"]
    assert of_body["standard_errors"]["m"] == of_body["standard_errors"]["mass"]
    assert of_body["standard_errors"]["m"] == pytest.approx(0.01)
    assert of_body["standard_errors_noise"]["m"] == pytest.approx(0.006)
    assert of_body["error_budget"]["torque scale"]["m"] == pytest.approx(0.008)
    assert of_body["standard_errors"]["com_z"] == pytest.approx(
        load_errors(made.body())[3]
    )
    content = content_of(made.payload(made.body(shown=False)))
    assert content["payload"]["body"]["standard_errors"]["Ixx"] is None
    assert content["payload"]["body"]["source"]["Ixx"] == "from_model"
    assert not content["valid"]["all_identified"]
    impossible = content_of(made.payload(made.body(-1.0)))
    assert (
        not impossible["valid"]["physically_consistent"]
        and impossible["known_to"] is None
    )
