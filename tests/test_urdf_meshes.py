"""URDF mesh names: every way of writing them leads to the file."""

from __future__ import annotations

import pytest

from robot_sysid.modelfile.documents import read_document
from robot_sysid.modelfile.urdf_meshes import find_mesh, mesh_uses, relocated_urdf
from tests.model_files import urdf_link, urdf_mesh, urdf_robot, write_files


def document(tmp_path, *parts, name="robots/arm.urdf"):
    return read_document(write_files(tmp_path, {name: urdf_robot(*parts, urdf_link("base"))}))


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("meshes/a.stl", "robots/meshes/a.stl"),
        ("package://pack/meshes/a.stl", "pack/meshes/a.stl"),
        ("package://pack/meshes/a.stl", "meshes/a.stl"),
        ("package://pack/meshes/a.stl", "robots/meshes/a.stl"),
        ("model://pack/meshes/a.stl", "pack/meshes/a.stl"),
        ("away/meshes/a.stl", "robots/a.stl"),
        ("meshes\\a.stl", "robots/meshes/a.stl"),
    ],
)
def test_a_mesh_is_found_in_the_folders_above(tmp_path, name, place):
    write_files(tmp_path, {place: ""})
    assert find_mesh(document(tmp_path), name) == tmp_path / place


def test_a_file_address_is_absolute(tmp_path):
    write_files(tmp_path, {"a.stl": ""})
    assert find_mesh(document(tmp_path), f"file://{tmp_path}/a.stl") == tmp_path / "a.stl"


@pytest.mark.parametrize("place", ["pack/meshes/a.stl", "meshes/a.stl", "a.stl"])
def test_the_users_mesh_folder_comes_first(tmp_path, place):
    write_files(tmp_path, {f"mine/{place}": "", "robots/meshes/a.stl": ""})
    found = find_mesh(document(tmp_path), "package://pack/meshes/a.stl", tmp_path / "mine")
    assert found == tmp_path / "mine" / place


def test_what_is_missing_or_unreadable_is_not_usable(tmp_path):
    write_files(tmp_path, {"robots/a.dae": "", "robots/b.STL": ""})
    shapes = [urdf_mesh("visual", name) for name in ("a.dae", "b.STL", "c.stl", "")]
    uses = mesh_uses(document(tmp_path, urdf_link("l", "".join(shapes))))
    assert [use.is_usable for use in uses] == [False, True, False, False]


def test_names_are_rewritten_where_the_file_exists_and_kept_elsewhere(tmp_path):
    write_files(tmp_path, {"pack/a.stl": ""})
    shapes = urdf_mesh("visual", "package://pack/a.stl") + urdf_mesh("visual", "gone.dae")
    text = relocated_urdf(document(tmp_path, urdf_link("l", shapes)), tmp_path / "out", None, [])
    assert b'filename="../pack/a.stl"' in text and b'filename="gone.dae"' in text
    assert b'<mujoco><compiler strippath="false"/></mujoco>' in text


def test_a_mesh_folder_of_the_file_goes_when_the_names_say_it_all(tmp_path):
    write_files(tmp_path, {"robots/m/a.stl": ""})
    setting = '<mujoco><compiler meshdir="m" strippath="true"/></mujoco>'
    link = urdf_link("l", urdf_mesh("collision", "a.stl"))
    text = relocated_urdf(document(tmp_path, setting, link), tmp_path / "out", None, [])
    assert b'<compiler strippath="false"/>' in text and b'"../robots/m/a.stl"' in text
