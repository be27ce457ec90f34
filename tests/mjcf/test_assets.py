"""Assets are found where MuJoCo finds them; a model moved elsewhere compiles to the same thing."""

from __future__ import annotations

import mujoco
import pytest

from rigs.files import urdf
from rigs.files.model_files import LFS_POINTER, TETRAHEDRON, make_pipe, write_files
from rigs.files.refusals import refused
from robot_sysid.mjcf.assets import find_assets, relocate
from robot_sysid.mjcf.documents import read_document, reference
from robot_sysid.model.compilation import compile_model

MESH = "<asset><mesh name='m' file='{}'/></asset>"
USE = "<worldbody><body><geom type='mesh' mesh='m'/></body></worldbody>"
CASES = {
    "no folder named": {
        "m.xml": f"<mujoco>{MESH.format('m.obj')}{USE}</mujoco>",
        "m.obj": "",
    },
    "meshdir": {
        "m.xml": f"<mujoco><compiler meshdir='d &amp; e'/>{MESH.format('m.obj')}{USE}</mujoco>",
        "d & e/m.obj": "",
    },
    "assetdir and strippath": {
        "m.xml": "<mujoco><compiler assetdir='d' strippath='true'/>"
        f"{MESH.format('away/m.obj')}{USE}</mujoco>",
        "d/m.obj": "",
    },
    "two compilers": {
        "m.xml": "<mujoco><compiler assetdir='no'/><compiler meshdir='d'/>"
        f"{MESH.format('m.obj')}{USE}</mujoco>",
        "d/m.obj": "",
    },
    "folder named in an include": {
        "m.xml": "<mujoco><include file='s/a.xml'/></mujoco>",
        "s/a.xml": f"<mujoco><compiler meshdir='d'/>{MESH.format('m.obj')}{USE}</mujoco>",
        "d/m.obj": "",
    },
    "include in an include": {
        "m.xml": f"<mujoco><include file='s/a.xml'/>{MESH.format('m.obj')}</mujoco>",
        "s/a.xml": "<mujoco><include file='s/b.xml'/></mujoco>",
        "s/b.xml": f"<mujoco>{USE}</mujoco>",
        "m.obj": "",
    },
}


def moved_text(source, folder):
    document = read_document(source)
    relocate(document, folder)
    return document.text()


def sizes(path) -> tuple:
    mj_model = mujoco.MjModel.from_xml_path(str(path))
    return mj_model.nbody, mj_model.nmesh, mj_model.body_mass.tobytes()


@pytest.mark.parametrize("files", CASES.values(), ids=CASES.keys())
@pytest.mark.parametrize("folder", ["out", "out/deep er", "s", "."])
def test_it_loads_from_its_new_folder(tmp_path, files, folder):
    files = {name: text or TETRAHEDRON for name, text in files.items()}
    source = write_files(tmp_path / "in", files)
    target = tmp_path / "in" / folder / "copy.xml"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(moved_text(source, target.parent))
    assert sizes(target) == sizes(source)


def test_in_its_own_folder_nothing_changes(tmp_path):
    files = {"m.xml": CASES["meshdir"]["m.xml"], "d & e/m.obj": TETRAHEDRON}
    source = write_files(tmp_path, files)
    assert moved_text(source, tmp_path) == read_document(source).text()


def test_absolute_names_need_no_folder(tmp_path):
    text = f"<mujoco>{MESH.format(tmp_path / 'm.obj')}{USE}</mujoco>"
    source = write_files(tmp_path / "in", {"m.xml": text, "../m.obj": TETRAHEDRON})
    assert moved_text(source, tmp_path) == read_document(source).text()


def test_behind_a_symbolic_link_the_path_is_absolute(tmp_path):
    (tmp_path / "real" / "deep").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "real" / "deep")
    target = tmp_path / "file"
    assert reference(target, tmp_path / "link") == str(target)
    assert reference(target, tmp_path / "real") == "../file"


def test_an_included_file_that_is_not_utf8_takes_its_place(tmp_path):
    fragment = "<?xml version='1.0' encoding='latin-1'?><mujoco><!-- é --></mujoco>"
    (tmp_path / "part.xml").write_bytes(
        fragment.replace("<!--", "<size/><!--").encode("latin-1")
    )
    main = "<mujoco><include file='part.xml'/><worldbody/></mujoco>"
    (tmp_path / "m.xml").write_text(main)
    moved = moved_text(tmp_path / "m.xml", tmp_path / "out")
    assert moved.decode() == "<mujoco><size/><!-- é --><worldbody/></mujoco>\n"


def meshed_model(compiler: str, file: str = "m.obj") -> str:
    return f"<mujoco>{compiler}{MESH.format(file)}{USE}</mujoco>"


def test_the_users_mesh_folder_replaces_that_of_the_file(tmp_path):
    text = meshed_model("<compiler meshdir='d'/>", "s/m.obj").replace(
        "<asset>", "<asset><texture name='t' file='t.png'/>"
    )
    files = {"m.xml": text, "d/s/m.obj": "", "mine/m.obj": "", "mine/t.png": ""}
    document = read_document(write_files(tmp_path, files), tmp_path / "mine")
    paths = {a.name: a.path for a in find_assets(document)}
    assert paths == {
        "s/m.obj": tmp_path / "mine/m.obj",
        "t.png": tmp_path / "mine/t.png",
    }


@pytest.mark.parametrize("suffix", ["obj", "stl", "msh"])
def test_a_mesh_that_is_a_pointer_of_lfs_is_named(tmp_path, suffix):
    files = {
        "a.xml": meshed_model("", f"m.{suffix}"),
        "a.urdf": urdf.robot(
            urdf.serial({"l1": urdf.inertial() + urdf.mesh("collision", f"m.{suffix}")})
        ),
        f"m.{suffix}": LFS_POINTER,
    }
    write_files(tmp_path, files)
    for name in ("a.xml", "a.urdf"):
        with refused(f"m.{suffix} is a pointer of Git LFS"):
            compile_model(tmp_path / name)


def test_a_pipe_in_the_place_of_a_mesh_is_not_waited_for(tmp_path):
    make_pipe(tmp_path / "m.obj")
    path = write_files(tmp_path, {"m.xml": meshed_model("")})
    with refused("m.obj is a pipe or a device"):
        compile_model(path)
