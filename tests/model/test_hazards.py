"""Model files that would hang or end the process, or eat the memory, are refused unread."""

from __future__ import annotations

import os
import sys

import pytest

from robot_sysid.errors import ModelError
from robot_sysid.model.compilation import compile_model
from tests.support import arms
from tests.support.releases import since

LEAF = '<body name="b"><geom size=".1"/></body>'


def model(folder, name, assets="", bodies=LEAF):
    path = folder / name
    text = f"<mujoco><asset>{assets}</asset><worldbody>{bodies}</worldbody></mujoco>"
    path.write_text(text, encoding="utf-8")
    return path


def attaching(folder, name, *files):
    assets = "".join(f'<model name="m{k}" file="{file}"/>' for k, file in enumerate(files))
    bodies = "".join(
        f'<frame><attach model="m{k}" body="b" prefix="{name[0]}{k}"/></frame>'
        for k in range(len(files))
    )
    return model(folder, name, assets, LEAF + bodies)


@pytest.mark.parametrize("ring", [("a.xml",), ("a.xml", "c.xml"), ("a.xml", "c.xml", "d.xml")])
def test_a_model_that_attaches_itself_is_refused(tmp_path, ring):
    """MuJoCo ends the process over it."""
    for name, following in zip(ring, (*ring[1:], ring[0])):
        attaching(tmp_path, name, following)
    with pytest.raises(ModelError, match="attaches itself by way of a.xml"):
        compile_model(tmp_path / "a.xml")


@since(3, 3)
def test_a_model_may_be_attached_more_than_once(tmp_path):
    model(tmp_path, "leaf.xml")
    attaching(tmp_path, "c.xml", "leaf.xml")
    attaching(tmp_path, "d.xml", "leaf.xml")
    path = attaching(tmp_path, "a.xml", "c.xml", "d.xml")
    assert compile_model(path).kind == "mjcf"


@pytest.mark.skipif(sys.platform == "win32", reason="needs named pipes")
def test_a_mesh_that_is_a_pipe_is_refused(tmp_path):
    os.mkfifo(tmp_path / "shape.stl")
    path = model(tmp_path, "a.xml", '<mesh name="m" file="shape.stl"/>')
    with pytest.raises(ModelError, match="shape.stl is not a file but a pipe"):
        compile_model(path)


@pytest.mark.parametrize(
    "asset",
    [
        '<hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/>',
        '<texture name="t" type="2d" builtin="flat" width="90000" height="90000"/>',
    ],
)
def test_a_huge_field_is_refused(tmp_path, asset):
    with pytest.raises(ModelError, match="cells; at most"):
        compile_model(model(tmp_path, "a.xml", asset))


@pytest.mark.parametrize(
    "part",
    [
        '<replicate count="1000000" euler="0 0 1"><geom size=".1"/></replicate>',
        '<replicate count="100"><replicate count="100"><geom size=".1"/></replicate></replicate>',
        '<flexcomp name="f" type="grid" count="300 300 300" spacing=".1 .1 .1" radius=".1"/>',
    ],
)
def test_parts_repeated_without_end_are_refused(tmp_path, part):
    with pytest.raises(ModelError, match="copies; at most 3000"):
        compile_model(model(tmp_path, "a.xml", bodies=LEAF + part))


@pytest.mark.parametrize(
    "size", ['memory="900G"', 'nuserdata="2000000000"', 'nuser_body="100000000"']
)
def test_sizes_that_take_all_memory_are_refused(tmp_path, size):
    path = model(tmp_path, "a.xml")
    path.write_text(path.read_text().replace("<asset>", f"<size {size}/><asset>"))
    with pytest.raises(ModelError, match="cells; at most"):
        compile_model(path)


@since(3, 1, 6)
def test_sizes_that_models_have_are_read(tmp_path):
    path = model(tmp_path, "a.xml", bodies=LEAF + '<replicate count="20"><site/></replicate>')
    size = '<size/><size memory="64M" nkey="2" nuserdata="10"/><asset>'
    path.write_text(path.read_text().replace("<asset>", size))
    assert compile_model(path).mj_model.nsite == 20


def test_a_class_that_is_a_format_is_refused(tmp_path):
    """MuJoCo prints with it, and the process ends."""
    body = '<body><joint class="%s%n%d"/><geom size=".1"/></body>'
    with pytest.raises(ModelError, match="the class '%s%n%d' of a joint has a %"):
        compile_model(model(tmp_path, "a.xml", bodies=body))


def test_a_file_outside_is_read_and_only_named(tmp_path):
    secret = tmp_path / "secret.txt"
    secret.write_text("password: 1234")
    (tmp_path / "inside").mkdir()
    path = model(tmp_path / "inside", "a.xml", '<include file="../secret.txt"/>')
    with pytest.raises(ModelError, match="secret.txt is not XML") as caught:
        compile_model(path)
    assert "1234" not in str(caught.value) and secret.read_text() == "password: 1234"


def test_names_too_long_for_a_file_are_not_found(tmp_path):
    for part in ('<mesh name="m" file="{}"/>', '<include file="{}"/>'):
        with pytest.raises(ModelError, match="not found"):
            compile_model(model(tmp_path, "a.xml", part.format("a" * 5000)))


def test_a_field_of_no_number_is_left_to_mujoco(tmp_path):
    asset = '<hfield name="h" nrow="many" ncol="2" size="1 1 1 1"/>'
    with pytest.raises(ModelError, match="MuJoCo cannot compile"):
        compile_model(model(tmp_path, "a.xml", asset))


def test_gravity_that_no_planet_has_is_refused(tmp_path):
    path = tmp_path / "a.xml"
    path.write_text(arms.serial_arm((arms.Y,), option='gravity="0 0 -1e300"'), encoding="utf-8")
    with pytest.raises(ModelError, match=r"a value no arm has \(gravity 1e\+300\)"):
        compile_model(path)
