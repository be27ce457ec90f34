"""A bundle stands alone: it loads as the same model wherever it is put."""

from __future__ import annotations

import shutil

import mujoco
import pytest

from robot_sysid.errors import ExportError
from robot_sysid.results import verification
from robot_sysid.results.model import write_bundle
from robot_sysid.results.verification import require_same_model
from tests.support import urdf
from tests.support.command_line import files_in
from tests.support.places import EXAMPLE, GUESS

STL = EXAMPLE / "model" / "meshes" / "gripper.stl"
MESHES = """
<mujoco>
  <compiler meshdir="parts" strippath="false"/>
  <include file="more.xml"/>
  <asset><mesh name="a" file="left/part.stl"/><mesh name="b" file="right/part.stl"/></asset>
  <worldbody>
    <body name="arm"><joint name="turn"/><geom type="mesh" mesh="a"/>
      <body><joint/><geom type="mesh" mesh="b"/></body>
    </body>
  </worldbody>
</mujoco>
"""


def moved(bundle, tmp_path):
    """The bundle's model in another place, everything else gone."""
    place = tmp_path / "elsewhere"
    shutil.move(bundle.parent, place)
    return mujoco.MjModel.from_xml_path(str(place / bundle.name))


def test_two_meshes_of_one_name_and_an_include(tmp_path):
    source = tmp_path / "source"
    for side in ("left", "right"):
        (source / "parts" / side).mkdir(parents=True)
        shutil.copy(STL, source / "parts" / side / "part.stl")
    (source / "more.xml").write_text("<mujoco><option timestep='0.001'/></mujoco>")
    (source / "updated_model.xml").write_text(MESHES)
    before = mujoco.MjModel.from_xml_path(str(source / "updated_model.xml"))
    bundle = write_bundle(source / "updated_model.xml", tmp_path)
    assert bundle == tmp_path / "bundle" / "updated_model.xml"
    shutil.rmtree(source)
    require_same_model(before, moved(bundle, tmp_path), {})


def test_a_second_bundle_replaces_the_first_even_where_that_is_a_link(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").touch()
    (tmp_path / "bundle").symlink_to(tmp_path / "mine")
    write_bundle(write(tmp_path / "first.xml", "<mujoco><worldbody/></mujoco>"), tmp_path)
    assert (tmp_path / "mine" / "file").is_file()
    bundle = write_bundle(GUESS, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"bundle", "first.xml", "mine"}
    assert {path.name for path in bundle.parent.iterdir()} == {GUESS.name, "assets"}


def test_a_bundle_that_fails_leaves_the_old_one(tmp_path, monkeypatch):
    first = write(tmp_path / "first.xml", "<mujoco><worldbody/></mujoco>")
    bundle = write_bundle(first, tmp_path)
    before = files_in(tmp_path)
    monkeypatch.setattr(verification, "compiled_again", lambda path: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_bundle(GUESS, tmp_path)
    assert files_in(tmp_path) == before
    assert bundle.is_file()


def write(path, text):
    path.write_text(text)
    return path


MESH = urdf.mesh("collision", "package://thing/meshes/part.stl")
URDF = urdf.robot(urdf.serial({"arm": urdf.inertial() + MESH}))


def test_a_urdf_takes_its_meshes_along(tmp_path):
    meshes = tmp_path / "thing" / "meshes"
    meshes.mkdir(parents=True)
    shutil.copy(STL, meshes / "part.stl")
    bundle = write_bundle(write(tmp_path / "thing" / "updated_model.urdf", URDF), tmp_path)
    shutil.rmtree(tmp_path / "thing")
    assert moved(bundle, tmp_path).nmesh >= 1


def test_a_model_that_attaches_others_is_refused_and_leaves_nothing(tmp_path):
    (tmp_path / "other.xml").write_text("<mujoco><worldbody><body name='b'/></worldbody></mujoco>")
    text = "<mujoco><asset><model name='o' file='other.xml'/></asset><worldbody/></mujoco>"
    model = write(tmp_path / "updated_model.xml", text)
    with pytest.raises(ExportError, match="attaches other model files"):
        write_bundle(model, tmp_path)
    assert not list(tmp_path.glob("*bundle*"))
