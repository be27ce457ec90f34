"""Assets are found where MuJoCo finds them; a model moved elsewhere compiles to the same thing.

What would end, stop or fill the process is refused before MuJoCo sees it.
"""

from __future__ import annotations

import os
import struct
import sys
import zlib

import mujoco
import pytest

from robot_sysid.errors import InputError, ModelError
from robot_sysid.mjcf import assets as assets_module
from robot_sysid.mjcf.assets import (
    check_assets,
    find_assets,
    refuse_hazards,
    relocated_text,
)
from robot_sysid.mjcf.documents import Edits, read_document, reference
from robot_sysid.model.compilation import compile_model
from tests.support import urdf
from tests.support.model_files import (
    LFS_POINTER,
    TETRAHEDRON,
    assert_model_refused,
    write_files,
)
from tests.support.releases import since

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
    target.write_bytes(relocated_text(Edits(read_document(source)), target.parent))
    assert sizes(target) == sizes(source)


def test_in_its_own_folder_nothing_changes(tmp_path):
    files = {"m.xml": CASES["meshdir"]["m.xml"], "d & e/m.obj": TETRAHEDRON}
    source = write_files(tmp_path, files)
    assert relocated_text(Edits(read_document(source)), tmp_path) == source.read_bytes()


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
    moved = relocated_text(Edits(read_document(tmp_path / "m.xml")), tmp_path / "out")
    assert moved.decode() == "<mujoco><size/><!-- é --><worldbody/></mujoco>"


def meshed_model(compiler: str, file: str = "m.obj") -> str:
    return f"<mujoco>{compiler}{MESH.format(file)}{USE}</mujoco>"


def test_the_users_mesh_folder_replaces_that_of_the_file(tmp_path):
    text = meshed_model("<compiler meshdir='d'/>", "s/m.obj").replace(
        "<asset>", "<asset><texture name='t' file='t.png'/>"
    )
    files = {"m.xml": text, "d/s/m.obj": "", "mine/m.obj": "", "mine/t.png": ""}
    document = read_document(write_files(tmp_path, files))
    paths = {a.name: a.path for a in find_assets(document, tmp_path / "mine")}
    assert paths == {
        "s/m.obj": tmp_path / "mine/m.obj",
        "t.png": tmp_path / "mine/t.png",
    }
    check_assets(document, tmp_path / "mine")


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
        with pytest.raises(InputError, match=f"m.{suffix} is a pointer of Git LFS"):
            compile_model(tmp_path / name)


LEAF = '<body name="b"><geom size=".1"/></body>'


def model(folder, name, assets="", bodies=LEAF):
    path = folder / name
    text = f"<mujoco><asset>{assets}</asset><worldbody>{bodies}</worldbody></mujoco>"
    path.write_text(text, encoding="utf-8")
    return path


def attaching(folder, name, *files):
    assets = "".join(
        f'<model name="m{k}" file="{file}"/>' for k, file in enumerate(files)
    )
    bodies = "".join(
        f'<frame><attach model="m{k}" body="b" prefix="{name[0]}{k}"/></frame>'
        for k in range(len(files))
    )
    return model(folder, name, assets, LEAF + bodies)


@pytest.mark.parametrize(
    "ring", [("a.xml",), ("a.xml", "c.xml"), ("a.xml", "c.xml", "d.xml")]
)
def test_a_model_that_attaches_itself_is_refused(tmp_path, ring):
    """MuJoCo ends the process over it."""
    for name, following in zip(ring, (*ring[1:], ring[0])):
        attaching(tmp_path, name, following)
    assert_model_refused("attaches itself by way of a.xml", tmp_path / "a.xml")


@since(3, 3)
def test_a_model_may_be_attached_more_than_once(tmp_path):
    model(tmp_path, "leaf.xml")
    attaching(tmp_path, "c.xml", "leaf.xml")
    attaching(tmp_path, "d.xml", "leaf.xml")
    path = attaching(tmp_path, "a.xml", "c.xml", "d.xml")
    assert compile_model(path).kind == "mjcf"


@pytest.mark.parametrize(
    ("element", "message"),
    [
        (
            '<asset><hfield name="h" nrow="9e4" ncol="9e4" size="1 1 1 1"/></asset>',
            "take 130 GB when unpacked.*largest: <hfield> in line 1",
        ),
        ('<size memory="900G"/>', "largest: <size>"),
        ('<size nuser_body="100000000"/>', "take 1.6 GB"),
        (
            '<worldbody><replicate count="1000000"><site/></replicate></worldbody>',
            "at most 3000",
        ),
        (
            '<worldbody><replicate count="99"><frame><replicate count="99"><site/></replicate>'
            "</frame></replicate></worldbody>",
            "copies; at most 3000",
        ),
        (
            '<worldbody><geom class="%s%n%d" size=".1"/></worldbody>',
            "'%s%n%d' of a geom has a %",
        ),
        (
            '<asset><mesh name="m" file="shape.stl"/></asset>',
            "shape.stl is a pipe or a device",
        ),
        ('<option gravity="0 0 -1e300"/>', r"a value no arm has \(gravity 1e\+300\)"),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="needs named pipes")
def test_what_would_end_or_stop_the_process_is_refused(tmp_path, element, message):
    os.mkfifo(tmp_path / "shape.stl")
    path = model(tmp_path, "a.xml")
    path.write_text(path.read_text().replace("<asset>", f"{element}<asset>"))
    with pytest.raises(InputError, match=message):
        compile_model(path)


def png(width, height, content=b"\0", colours=2):
    """A PNG file's bytes; what its head says need not be what it holds."""
    head = struct.pack(">IIBBBBB", width, height, 8, colours, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(content, 9)), (b"IEND", b"")]
    chunks = (
        struct.pack(">I", len(c)) + k + c + struct.pack(">I", zlib.crc32(k + c))
        for k, c in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


TEXTURE = '<texture name="t{}" type="2d" file="a.png"/>'
LARGE = {
    "texture": (TEXTURE, (30_000, 30_000), "take 5.4 GB .*largest: a.png"),
    "height field": ('<hfield name="h" file="a.png" size="1 1 1 1"/>', (9000, 9000), "1.3 GB"),
    "together": ("".join(TEXTURE.format(k) for k in range(9)), (3000, 3000), "0.486 GB"),
    "sides of a cube": (
        '<texture name="t" fileup="a.png" filedown="a.png"/>', (6000, 6000), "0.432 GB",
    ),
    "made": ('<texture name="t" builtin="flat" width="4000"/>', (1, 1), "0.576 GB"),
    "mesh and numbers": (
        '<mesh name="m" file="m.obj"/><hfield name="h" nrow="4900" ncol="5000" size="1 1 1 1"/>',
        (1, 1), "0.412 GB",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LARGE)
def test_what_unpacks_to_too_much_together_is_refused_by_its_head(tmp_path, name):
    assets, size, message = LARGE[name]
    (tmp_path / "a.png").write_bytes(png(*size))
    with (tmp_path / "m.obj").open("wb") as mesh:
        mesh.truncate(10_000_000)
    assert_model_refused(message, model(tmp_path, "a.xml", assets))


VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
FACES = "f 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n"


@pytest.mark.parametrize(
    ("name", "content", "triangles"),
    [
        ("m.obj", VERTICES + FACES, 4),
        ("m.obj", (VERTICES + FACES).replace("\n", "\r"), 4),
        ("m.obj", VERTICES + 10_000 * FACES, 40_000),
        (
            "m.obj",
            VERTICES + 10_000 * FACES.replace(" ", "  ").replace("\n", " \r\n"),
            40_000,
        ),
        ("m.obj", 10_000 * (VERTICES + FACES), 40_000),
        ("m.obj", VERTICES + 15_000 * "f 1//1 2//1 3//1 4//1 1//1\n", 45_000),
        ("m.stl", "\0" * (80 + 4 + 50 * 12), 12),
        ("m.msh", "\0" * 12 + "\x07\0\0\0", 7),
        ("m.obj", "", 0),
    ],
)
def test_triangles_of_a_mesh_are_counted(tmp_path, name, content, triangles):
    path = tmp_path / name
    path.write_bytes(content.encode())
    assert assets_module._count_triangles(path, path.suffix) == pytest.approx(
        triangles, abs=2
    )


def test_a_mesh_of_too_many_triangles_is_refused(tmp_path, monkeypatch):
    """A plan with 1.6 million triangles, 13 MB of text, took 2.9 GB and a minute."""
    document = read_document(model(tmp_path, "a.xml", '<mesh name="m" file="m.obj"/>'))
    (tmp_path / "m.obj").write_text(VERTICES + 10_000 * FACES)
    assert refuse_hazards(document) == pytest.approx(450.0 * 40_000, rel=1e-4)
    monkeypatch.setattr(assets_module, "MAX_MEMORY", 1.7e7)
    with pytest.raises(ModelError, match="take 0.018 GB .*largest: m.obj"):
        refuse_hazards(document)


@pytest.mark.parametrize("times", [1, 6])
def test_what_is_attached_counts_each_time(tmp_path, times):
    (tmp_path / "a.png").write_bytes(png(400, 400, bytes(400 * 1201)))
    model(tmp_path, "b.xml", TEXTURE)
    path = attaching(tmp_path, "a.xml", *["b.xml"] * times)
    assert refuse_hazards(read_document(path)) == pytest.approx(
        times * 1.92e6, rel=0.01
    )


def test_an_image_that_unpacks_to_more_than_it_says_is_refused(tmp_path, monkeypatch):
    """MuJoCo would unpack 2 GB of 2 MB, and then see that they should have been 200 bytes."""
    monkeypatch.setattr(assets_module, "MAX_MEMORY", 1e6)
    path = model(tmp_path, "a.xml", TEXTURE)
    (tmp_path / "a.png").write_bytes(png(8, 8, bytes(3_000_000)))
    assert_model_refused("largest: a.png", path)
    (tmp_path / "a.png").write_bytes(png(300, 300, bytes(300 * 901)))
    assert compile_model(path).mj_model.ntex == 1
