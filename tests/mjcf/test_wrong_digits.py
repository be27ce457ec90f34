"""One wrong number of an inertia is found, and a possible inertia is left alone."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from rigs.files import urdf
from rigs.files.refusals import refused
from robot_sysid import spatial
from robot_sysid.errors import ModelError
from robot_sysid.mjcf.wrong_digits import is_possible, nearest_possible, wrong_number
from robot_sysid.parser import load_robot_model

LINK = np.array([0.0095, 2e-4, -3e-4, 0.131, 1e-4, 0.1285])
"""A slender link of 2.3 kg and 0.39 m, like a UR5e's forearm."""
HOUSING = np.array([0.0071, -4e-4, 2e-4, 0.0064, 8e-4, 0.0034])
"""The housing of a joint, of 1.9 kg and 0.12 m."""


@pytest.mark.parametrize("place", [0, 3, 5])
@pytest.mark.parametrize("factor", [1e3, 1e-3, 1e6, -1.0])
@pytest.mark.parametrize(
    "right, mass, length", [(LINK, 2.3, 0.39), (HOUSING, 1.9, 0.12)]
)
def test_a_moment_with_a_wrong_power_of_ten_or_sign_is_found(
    right, mass, length, place, factor
):
    stated = right.copy()
    stated[place] *= factor
    if is_possible(spatial.symmetric_from_six(stated)):
        pytest.skip("a body may have it")
    wrong = wrong_number(stated, mass, length)
    assert wrong.name == ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")[place]
    assert wrong.right == pytest.approx(right[place], rel=1e-9)
    words = wrong.describe("link 'arm'")
    size = (
        "the wrong sign"
        if factor < 0.0
        else f"some {max(factor, 1 / factor):.0f} times"
    )
    assert words.startswith(wrong.name) and size in words and "link 'arm'" in words


def test_a_product_that_is_far_too_large_is_named():
    stated = LINK * np.array([1, 1e3, 1, 1, 1, 1])
    assert wrong_number(stated, 2.3, 0.39).name == "ixy"


def test_two_wrong_numbers_are_none():
    assert wrong_number(LINK * [1e3, 1, 1, -1, 1, 1], 2.3, 0.39) is None


@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_the_nearest_inertia_is_possible_and_no_other_is_nearer(numbers):
    inertia = spatial.symmetric_from_six(np.array(numbers))
    nearest = nearest_possible(inertia)

    def second(matrix):
        return 0.5 * np.trace(matrix) * np.eye(3) - matrix

    if nearest is None:
        assert np.all(np.linalg.eigvalsh(second(inertia)) <= 0.0)
        return
    assert is_possible(nearest)
    distance = np.linalg.norm(second(nearest) - second(inertia))
    rng = np.random.default_rng(0)
    for scale in (1e-3, 1e-2, 0.1, 1.0):
        step = spatial.symmetric_from_six(scale * rng.normal(size=6))
        if is_possible(nearest + step):
            other = np.linalg.norm(second(nearest + step) - second(inertia))
            assert other > distance - 1e-3 * np.trace(second(nearest))


def load(folder, stated):
    moments = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), stated.tolist())
    text = " ".join(f'{name}="{value!r}"' for name, value in moments)
    inertial = (
        '<inertial><origin xyz="0 0 0.1"/><mass value="2.3"/>'
        f"<inertia {text}/></inertial>"
    )
    links = {"l0": urdf.inertial(), "l1": inertial, "l2": urdf.inertial()}
    return load_robot_model(urdf.write_arm(folder, links))


def test_a_urdf_gets_the_number_that_is_probably_right(tmp_path):
    right = load(tmp_path, LINK)
    assert right.notes == ()
    robot = load(tmp_path, LINK * [1, 1, 1, 1e3, 1, 1])
    assert_allclose(robot.links[1].theta, right.links[1].theta, rtol=1e-9)
    (note,) = robot.notes
    assert note.startswith(
        "iyy of link 'l1' (131) is probably some 1000 times too large"
    )


def test_a_urdf_with_two_wrong_numbers_gets_the_nearest_inertia(tmp_path):
    stated = LINK * [1e3, 1, 1, -1, 1, 1]
    robot = load(tmp_path, stated)
    assert "nearest possible ones are used" in robot.notes[0]
    _, _, inertia = spatial.com_from_theta(robot.links[1].theta)
    expected = nearest_possible(spatial.symmetric_from_six(stated))
    assert_allclose(inertia, expected, rtol=1e-6, atol=1e-6 * np.trace(expected))


def test_balanced_inertias_are_left_to_mujoco_where_no_number_explains_them(tmp_path):
    setting = '<mujoco><compiler balanceinertia="true"/></mujoco>'
    links = {f"l{k}": urdf.inertial(inertia="0.01 0.02 0.035") for k in range(2)}
    path = urdf.write_arm(tmp_path, links, setting)
    plain = mujoco.MjModel.from_xml_path(str(path))
    robot = load_robot_model(path)
    assert_array_equal(robot.mj_model.body("l1").inertia, plain.body("l1").inertia)


@pytest.mark.parametrize(
    "stated, name",
    [
        ('fullinertia=".0095 131 .1285 2e-4 -3e-4 1e-4"', "iyy of body 'arm'"),
        ('diaginertia="9.5 .131 .1285"', "ixx of body 'arm'"),
    ],
)
def test_an_mjcf_that_mujoco_refuses_is_told_the_number(tmp_path, stated, name):
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body name="arm"><joint name="a"/>'
        f'<inertial pos="0 0 .1" mass="2.3" {stated}/><body pos="0 0 .4"><joint name="b"/>'
        '<geom size=".05"/></body></body></worldbody></mujoco>'
    )
    with refused(f"inertia.*; {name}.* some 10+ times too large", ModelError):
        load_robot_model(path)
