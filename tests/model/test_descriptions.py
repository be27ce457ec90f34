"""Models by name, of a package that stands in for robot_descriptions."""

from __future__ import annotations

import sys

import pytest

import robot_sysid as rs
from tests.support import arms

PACKAGE = "robot_descriptions"
TEXT = arms.serial_arm((arms.Z, arms.Y), joint='range="-2 2"')
MODULES = {
    "__init__": "",
    "two_mj_description": "MJCF_PATH = r'{}'",
    "two_description": "URDF_PATH = r'{}'",
    "far_description": "raise OSError('no route\\nto host')",
    "raw_description": "XACRO_PATH = 'two.xacro'",
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Its folder; the working folder holds nothing else."""
    model, folder = tmp_path / "cache" / "two.xml", tmp_path / "site" / PACKAGE
    for path in (model, folder / "any"):
        path.parent.mkdir(parents=True)
    model.write_text(TEXT)
    for name, text in MODULES.items():
        (folder / f"{name}.py").write_text(text.format(model))
    monkeypatch.syspath_prepend(folder.parent)
    monkeypatch.chdir(tmp_path)
    for name in [PACKAGE, *(f"{PACKAGE}.{module}" for module in MODULES)]:
        monkeypatch.delitem(sys.modules, name, raising=False)
    return folder


def test_a_model_is_found_by_its_name_where_no_file_has_it(package, tmp_path):
    for name in ("two_mj_description", "two_description"):
        robot = rs.load_robot_model(name)
        assert robot.path == tmp_path / "cache" / "two.xml" and robot.n_joints == 2
    (tmp_path / "two_mj_description").write_text(TEXT)
    assert rs.load_robot_model("two_mj_description").path.name == "two_mj_description"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("tvo_mj_description", "no such model in .*did you mean two_mj_description"),
        ("far_description", "cannot fetch far_description: no route to host; check the network"),
        ("raw_description", "as Xacro only"),
        ("arm.xml", "arm.xml not found"),
    ],
)
def test_a_name_that_leads_nowhere_is_one_line(package, name, words):
    with pytest.raises(rs.InputError, match=words):
        rs.load_robot_model(name)


def test_without_the_package_it_is_said_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, PACKAGE, None)
    with pytest.raises(rs.InputError, match=r"pip install 'robot-sysid\[descriptions\]'"):
        rs.load_robot_model("ur5e_mj_description")
    with pytest.raises(rs.InputError, match="is a folder"):
        rs.load_robot_model(tmp_path)
