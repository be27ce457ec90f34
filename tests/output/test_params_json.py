"""params.json: every specified key, full precision, strict JSON, and the same bits read back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics import spatial
from robot_sysid.output.params_json import export_params_json, params_json_text
from robot_sysid.records import (
    DataOrigin,
    Estimate,
    Identifiability,
    Identification,
    InertialParameters,
    Source,
    Status,
)
from tests.support.model_files import random_theta
from tests.support.results import theta_in

FRICTION = ("coulomb[j6]", "viscous[j6]")


def identification(theta=None, friction=(0.4, 0.1), **changes):
    theta = random_theta(np.random.default_rng(0)) if theta is None else theta
    names = (*spatial.PARAMETER_NAMES, *FRICTION[: len(friction)])
    seen = Identifiability(11, 12, 1234.5, 5.5, (False,) + (True,) * (len(names) - 1), ("mass",))
    values = np.append(theta, friction)
    estimate = Estimate(names, values, seen, 1e-4, {"j5": 1e-4, "j6": 2e-5}, Status.OK)
    fields = {
        "model_path": Path("arm.xml"),
        "model_sha256": "ab",
        "joint_name": "j6",
        "body_name": "link6",
        "joint_names": ("j5", "j6"),
        "prior": InertialParameters(0.5 * theta),
        "estimate": estimate,
        "torques": "chain",
        "data": DataOrigin(Source.ITSELF, "", 15.0, 1000.0, 42),
        "versions": {"mujoco": "3.3.7"},
        "notes": ("a note",),
    }
    return Identification(**{**fields, **changes})


def test_the_specified_keys_come_first_in_their_order():
    content = json.loads(params_json_text(identification()))
    specified = [
        "joint_name",
        "mass",
        "center_of_mass_moment",
        "inertia_tensor",
        "coulomb_friction",
        "viscous_friction",
        "rmse",
        "condition_number",
        "n_base_params",
    ]
    assert [key for key in content if key in specified] == specified
    assert list(content["inertia_tensor"]) == ["Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz"]
    assert (content["coulomb_friction"], content["viscous_friction"]) == (0.4, 0.1)
    assert content["n_base_params"] == 11 and content["schema_version"] == 3


def test_it_says_where_each_value_comes_from_and_what_the_run_was():
    content = json.loads(params_json_text(identification()))
    assert content["parameter_source"]["m"] == "from_model"
    assert content["parameter_source"]["viscous[j6]"] == "identified"
    assert content["model"] == {"path": "arm.xml", "sha256": "ab"}
    assert content["prior"]["mass"] == 0.5 * content["mass"]
    assert content["valid"] == {
        "physically_consistent": True,
        "all_identified": False,
        "trustworthy": True,
    }
    assert (content["status"], content["unidentifiable_combinations"]) == ("OK", ["mass"])
    assert content["rmse_per_joint"] == {"j5": 1e-4, "j6": 2e-5}


@given(seed=st.integers(0, 2**32 - 1))
def test_reading_back_gives_the_same_bits(tmp_path_factory, seed):
    theta = random_theta(np.random.default_rng(seed))
    path = tmp_path_factory.mktemp("p") / "params.json"
    export_params_json(identification(theta), path)
    np.testing.assert_array_equal(theta_in(path), theta)
    content = json.loads(path.read_text())
    _, com, about_com = spatial.com_from_theta(theta)
    np.testing.assert_array_equal(content["center_of_mass"], com)
    six = list(content["inertia_about_com"].values())
    np.testing.assert_array_equal(six, spatial.six_from_symmetric(about_com))


def test_without_friction_the_two_are_null():
    content = json.loads(params_json_text(identification(friction=())))
    assert content["coulomb_friction"] is None and content["viscous_friction"] is None


def test_it_says_what_the_data_was():
    content = json.loads(params_json_text(identification()))
    assert content["source"] == "simulation of the model itself"
    figures = [content[key] for key in ("seed", "duration", "sample_rate")]
    assert figures == [42, 15.0, 1000.0]
    log = DataOrigin(Source.LOG, "a.csv, b.csv", 30.0, 500.0)
    content = json.loads(params_json_text(identification(data=log)))
    assert (content["source"], content["seed"]) == ("log a.csv, b.csv", None)


def test_what_is_not_finite_is_null_everywhere():
    result = identification()
    seen = replace(result.estimate.identifiability, condition_number=np.inf)
    estimate = replace(
        result.estimate,
        identifiability=seen,
        rmse=np.float64("nan"),
        standard_errors=np.append(np.inf, np.ones(11)),
    )
    gravity = np.array([np.nan, 0.0, -9.81])
    text = params_json_text(replace(result, estimate=estimate, gravity=gravity))
    content = json.loads(text, parse_constant=pytest.fail)
    assert content["condition_number"] is None and content["rmse"] is None
    assert content["standard_errors"]["m"] is None and content["standard_errors"]["hx"] == 1.0
    assert content["gravity"] == [None, 0.0, -9.81]


def test_notes_of_the_writer_stand_behind_those_of_the_result():
    content = json.loads(params_json_text(identification(), ("another", "and one")))
    assert content["notes"] == ["a note", "another", "and one"]
