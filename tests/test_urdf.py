"""URDF as MuJoCo can compile it; what must not be dropped is an error."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid import spatial
from robot_sysid.errors import ModelError
from robot_sysid.modelfile.documents import read_document
from robot_sysid.modelfile.urdf import compilable_urdf, link_inertias
from tests.model_files import (
    urdf_inertial,
    urdf_joint,
    urdf_link,
    urdf_mesh,
    urdf_robot,
    write_files,
)


def arm(tmp_path, content, *more):
    parts = (urdf_link("base"), urdf_link("l1", content), urdf_joint("base", "l1"), *more)
    return read_document(write_files(tmp_path, {"m.urdf": urdf_robot(*parts)}))


def test_line_numbers_stay_those_of_the_file(tmp_path):
    content = urdf_inertial(rpy="0.1 0 0").replace("><", ">\n<")
    content += urdf_mesh("collision", "gone.stl").replace("><", ">\n<")
    text, _ = compilable_urdf(arm(tmp_path, content))
    assert text.count(b"\n") == (tmp_path / "m.urdf").read_bytes().count(b"\n")


def test_a_missing_collision_mesh_is_left_out_where_the_link_has_an_inertial(tmp_path):
    text, notes = compilable_urdf(arm(tmp_path, urdf_inertial() + urdf_mesh("collision", "x.stl")))
    assert b"<collision>" not in text
    assert len(notes) == 1 and "x.stl" in notes[0]


@pytest.mark.parametrize("setting", ["", '<mujoco><compiler inertiafromgeom="true"/></mujoco>'])
def test_a_mesh_that_makes_the_inertia_must_be_there(tmp_path, setting):
    content = urdf_mesh("collision", "x.stl") + (urdf_inertial() if setting else "")
    with pytest.raises(ModelError, match=r"collision mesh x.stl of link 'l1' is not found"):
        compilable_urdf(arm(tmp_path, content, setting))


def test_what_is_only_drawn_is_left_out_in_silence(tmp_path):
    text, notes = compilable_urdf(arm(tmp_path, urdf_inertial() + urdf_mesh("visual", "x.dae")))
    assert b"<visual>" not in text and notes == ()


@pytest.mark.parametrize(
    ("content", "given"),
    [
        ("", True),
        (urdf_inertial(mass=0.0, inertia="0 0 0"), True),
        (urdf_inertial(mass=2.0, inertia="0 0 0"), True),
        (urdf_inertial(), False),
    ],
)
def test_the_minimum_goes_to_moving_links_without_inertia(tmp_path, content, given):
    text, notes = compilable_urdf(arm(tmp_path, content), with_minimum=True)
    assert (b'ixx="1e-09"' in text) == given
    assert [("'l1'" in note) for note in notes] == [True] * given
    if "2.0" in content:
        assert b'<mass value="2.0"/>' in text


def test_a_link_whose_mass_is_welded_to_it_needs_no_minimum(tmp_path):
    more = (urdf_link("tool", urdf_inertial()), urdf_joint("l1", "tool", "fixed"))
    assert compilable_urdf(arm(tmp_path, "", *more), with_minimum=True)[1] == ()


def test_link_inertias_are_in_link_axes(tmp_path):
    mass, com, inertia = link_inertias(arm(tmp_path, urdf_inertial(2.0, "0.1 0.2 0.3")))["l1"]
    rotation = spatial.rotation_from_rpy(0.1, 0.2, 0.3)
    assert mass == 2.0
    np.testing.assert_array_equal(com, [0.1, 0.0, 0.0])
    expected = rotation @ np.diag([0.01, 0.02, 0.025]) @ rotation.T
    np.testing.assert_allclose(inertia, expected, rtol=0, atol=1e-16)
