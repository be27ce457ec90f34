"""Asset files are found where MuJoCo finds them, and the missing one is named."""

from __future__ import annotations

import mujoco
import pytest

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.assets import check_assets, find_assets
from robot_sysid.mjcf.documents import read_document
from tests.support.model_files import TETRAHEDRON, write_files

USE = "<worldbody><body><geom type='mesh' mesh='m'/></body></worldbody>"
MESH = "<asset><mesh name='m' file='{}'/></asset>" + USE


def model(compiler: str, file: str = "m.obj") -> str:
    return f"<mujoco>{compiler}{MESH.format(file)}</mujoco>"


def included(compiler: str = "", where: str = "s/a.xml") -> str:
    return f"<mujoco>{compiler}<include file='{where}'/></mujoco>"


PLACES = [
    ({"m.xml": model("")}, "m.obj"),
    ({"m.xml": model("<compiler meshdir='d'/>")}, "d/m.obj"),
    ({"m.xml": model("<compiler assetdir='d'/>")}, "d/m.obj"),
    ({"m.xml": model("<compiler assetdir='no' meshdir='d'/>")}, "d/m.obj"),
    ({"m.xml": model("<compiler meshdir='d'/><compiler assetdir='e'/>")}, "e/m.obj"),
    ({"m.xml": model("<compiler assetdir='e'/><compiler meshdir='d'/>")}, "d/m.obj"),
    ({"m.xml": model("<compiler meshdir='d'/>", "s/m.obj")}, "d/s/m.obj"),
    ({"m.xml": model("<compiler meshdir='d' strippath='true'/>", "s/m.obj")}, "d/m.obj"),
    ({"m.xml": included(), "s/a.xml": model("")}, "m.obj"),
    ({"m.xml": included("<compiler meshdir='d'/>"), "s/a.xml": model("")}, "d/m.obj"),
    ({"m.xml": included(), "s/a.xml": model("<compiler meshdir='d'/>")}, "d/m.obj"),
]


@pytest.mark.parametrize(("files", "place"), PLACES)
def test_a_mesh_is_found_where_mujoco_finds_it(tmp_path, files, place):
    path = write_files(tmp_path, {**files, place: TETRAHEDRON})
    mujoco.MjModel.from_xml_path(str(path))
    assert [asset.path for asset in find_assets(read_document(path))] == [tmp_path / place]


def test_a_file_beside_the_including_one_comes_last(tmp_path):
    path = write_files(tmp_path, {"m.xml": included(), "s/a.xml": model(""), "s/m.obj": "x"})
    assert find_assets(read_document(path))[0].path == tmp_path / "s" / "m.obj"
    write_files(tmp_path, {"m.obj": "x"})
    assert find_assets(read_document(path))[0].path == tmp_path / "m.obj"


@pytest.mark.parametrize(
    ("asset", "kind"),
    [
        ("<texture name='t' file='t.png'/>", "texture"),
        ("<texture name='t' type='cube' fileright='t.png'/>", "texture"),
        ("<hfield name='h' size='1 1 1 1' file='t.png'/>", "hfield"),
        ("<skin name='s' file='t.png'/>", "skin"),
        ("<model name='s' file='t.png'/>", "model"),
    ],
)
def test_every_kind_of_file_is_seen_and_named(tmp_path, asset, kind):
    text = f"<mujoco><asset>{asset}</asset><worldbody/></mujoco>"
    document = read_document(write_files(tmp_path, {"m.xml": text}))
    with pytest.raises(ModelError, match=f"{kind} file t.png not found .looked in") as caught:
        check_assets(document)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def test_the_users_mesh_folder_replaces_that_of_the_file(tmp_path):
    text = model("<compiler meshdir='d'/>", "s/m.obj").replace(
        "<asset>", "<asset><texture name='t' file='t.png'/>"
    )
    files = {"m.xml": text, "d/s/m.obj": "", "mine/m.obj": "", "mine/t.png": ""}
    document = read_document(write_files(tmp_path, files))
    found = {a.name: a.path for a in find_assets(document, tmp_path / "mine")}
    assert found == {"s/m.obj": tmp_path / "mine/m.obj", "t.png": tmp_path / "mine/t.png"}
    check_assets(document, tmp_path / "mine")
