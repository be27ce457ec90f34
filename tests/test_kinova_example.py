"""The Kinova example: published geometry and inertials, meshes, scripts."""

import importlib
import re
import sys

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rigs.files.places import EXAMPLE
from robot_sysid.model.bodies import body_theta

MODELS = ("kinova_fullinertia_guess.xml", "kinova_fullinertia.xml")
MUJOCO = tuple(int(part) for part in mujoco.__version__.split(".")[:2])
README_THETA = [
    *(0.789160, -0.000047, 0.009093, 0.120437),
    *(0.024382, 0.000001, 0.000009, 0.024312, -0.001638, 0.000551),
]
# MuJoCo before 3.14 finds principal axes to six digits (of at most 0.03 kg m^2), then to rounding.
COMPILED = 1e-14 if MUJOCO >= (3, 14) else 3e-8
NUMBER = re.compile(r"-?\d+\.?\d*(?:e[-+]?\d+)?")

sys.path.insert(0, str(EXAMPLE))
SCRIPTS = "shapes gen3 links make_model validate_regressor validate_identification "
SCRIPTS += "validate_measurements validate_uncertainty"
modules = map(importlib.import_module, SCRIPTS.split())
shapes, gen3, links, make_model, validate_regressor, *others = modules
validate_identification, validate_measurements, validate_uncertainty = others
sys.path.remove(str(EXAMPLE))


def load(file):
    return mujoco.MjModel.from_xml_path(str(EXAMPLE / "model" / file))


def theta_of(model, body):
    return body_theta(model, model.body(body).id)


def at(model, qpos):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("file", MODELS)
def test_joints_stand_at_the_published_heights_and_turn_in_the_published_sense(file):
    data = at(load(file), np.zeros(7))
    heights = [0.15643, 0.28481, 0.49519, 0.70557, 0.91400, 1.01993, 1.12586]
    assert_allclose(data.xanchor[:, 2], heights, atol=2e-5)
    assert_allclose(data.site("flange").xpos[2], 1.18739, atol=2e-5)
    assert_allclose(data.site("flange").xpos[1], -0.0249, atol=1e-4)
    down = [0, 0, -1]
    sideways = [0, 1, 0]
    expected = [down, sideways, down, sideways, down, sideways, down]
    assert_allclose(data.xaxis, expected, atol=1e-12)
    outwards = data.site("flange").xpos - data.body("link6").xpos
    assert_allclose(data.body("link6").xmat.reshape(3, 3).T @ outwards, gen3.FLANGE)


def test_the_guess_has_the_terminal_link_of_the_readme():
    assert_allclose(theta_of(load(MODELS[0]), "link6"), README_THETA, atol=COMPILED)


def test_the_true_tool_is_the_sum_of_its_parts():
    """Mass and centre of mass by the lever rule along the flange direction, worked by hand."""
    theta = theta_of(load(MODELS[1]), "link6")
    masses = np.array([0.43504643, 0.6632, 2 * 0.05645, 0.306])
    heights = np.array(
        [0.03437502, 0.061525 + 0.03232, 0.061525 + 0.115, 0.061525 + 0.145]
    )
    assert_allclose(theta[0], masses.sum(), rtol=1e-12)
    assert_allclose(theta[3], masses @ heights, rtol=1e-12)


@pytest.mark.parametrize("file", MODELS)
def test_home_is_reachable_free_and_held_within_the_nominal_torques(file):
    model = load(file)
    assert at(model, np.zeros(7)).ncon == 0
    data = at(model, model.key("home").qpos)
    assert data.ncon == 0
    limited = model.jnt_limited.astype(bool)
    assert list(limited) == [False, True, False, True, False, True, False]
    assert np.all(np.abs(data.qpos[limited]) < model.jnt_range[limited, 1])
    limits = model.actuator_forcerange[:, 1]
    assert_array_equal(limits, [39, 39, 39, 39, 9, 9, 9])
    assert np.all(np.abs(data.qfrc_bias) < 0.5 * limits)


@pytest.mark.parametrize(
    "variant", make_model.variants(), ids=lambda variant: variant.file
)
def test_committed_models_are_what_the_script_writes(variant):
    committed = (EXAMPLE / "model" / variant.file).read_text(encoding="utf-8")
    written = make_model.model_xml(variant)
    assert NUMBER.sub("#", committed) == NUMBER.sub("#", written)
    old_numbers = np.array(NUMBER.findall(committed), dtype=float)
    new_numbers = np.array(NUMBER.findall(written), dtype=float)
    assert_allclose(old_numbers, new_numbers, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("name", sorted(links.link_meshes()))
def test_committed_meshes_are_what_the_script_writes(name, tmp_path):
    shapes.write_stl(tmp_path / "again.stl", links.link_meshes()[name])
    committed = shapes.read_stl(EXAMPLE / "model" / "meshes" / f"{name}.stl")
    written = shapes.read_stl(tmp_path / "again.stl")
    assert_allclose(committed, written, atol=2.0 * shapes.GRID)
    assert shapes.volume(committed) > 1e-6


@pytest.mark.parametrize(
    ("script", "message"),
    [
        (validate_regressor, "regressor agrees with MuJoCo"),
        (validate_identification, "4 of 4 exact cases are exact"),
        pytest.param(validate_uncertainty, "all limits hold", marks=pytest.mark.slow),
        pytest.param(validate_measurements, "all limits hold", marks=pytest.mark.slow),
    ],
)
def test_scripts_find_what_they_are_about(script, message, capsys, monkeypatch):
    assert script.main() == 0
    assert message in capsys.readouterr().out
