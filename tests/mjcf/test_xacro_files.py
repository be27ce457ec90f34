"""Xacro files as people have them: macros, arguments, and packages of a ROS that is not there."""

from __future__ import annotations

import sys
from xml.sax.saxutils import quoteattr

import pytest
from numpy.testing import assert_array_equal

from rigs.files import urdf
from rigs.files.model_files import write_files
from rigs.files.refusals import refused
from robot_sysid.errors import ModelError
from robot_sysid.mjcf import xacro_process
from robot_sysid.mjcf.documents import read_document
from robot_sysid.parser import load_robot_model

NAMESPACE = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="r">'
MACRO = f"""{NAMESPACE}<xacro:property name="mass" value="${{2 * 0.75}}"/>
<xacro:macro name="arm_link" params="name">
  <link name="${{name}}">{urdf.inertial(mass="${mass}")}</link>
</xacro:macro></robot>"""
LINKS = ("l1", "l2")
EXPANDED = urdf.robot(urdf.serial(dict.fromkeys(LINKS, urdf.inertial(mass=1.5))))
FILE = "arm_description/urdf/arm.urdf.xacro"


def xacro_of(include="macro.xacro", argument='<xacro:arg name="far" default="0.2"/>'):
    """Return the xacro file of the arm EXPANDED, whose links are made by an included macro."""
    text = EXPANDED.replace('<robot name="r">', NAMESPACE + argument)
    for name in LINKS:
        link = urdf.link(name, urdf.inertial(mass=1.5))
        assert link in text
        text = text.replace(link, f'<xacro:arm_link name="{name}"/>')
    text = text.replace('xyz="0 0 0.2"', 'xyz="0 0 $(arg far)"')
    return text.replace(
        argument, f"{argument}<xacro:include filename={quoteattr(include)}/>"
    )


def written(folder, text, macro="arm_description/urdf/macro.xacro"):
    manifest = "<package><name>its_name</name></package>"
    files = {macro: MACRO, FILE: text, "arm_description/package.xml": manifest}
    write_files(folder, files)
    return folder / FILE


INCLUDES = [
    ("macro.xacro", "arm_description/urdf/macro.xacro"),
    ("$(find arm_description)/urdf/macro.xacro", "arm_description/urdf/macro.xacro"),
    ("$(find its_name)/urdf/macro.xacro", "arm_description/urdf/macro.xacro"),
    ("$(find other)/macro.xacro", "other/macro.xacro"),
]


@pytest.mark.parametrize(("include", "macro"), INCLUDES)
def test_a_xacro_is_the_urdf_that_it_expands_to(tmp_path, capfd, include, macro):
    pytest.importorskip("xacro")
    robot = load_robot_model(written(tmp_path, xacro_of(include), macro))
    plain = load_robot_model(write_files(tmp_path, {"plain.urdf": EXPANDED}))
    assert robot.kind == "urdf" and robot.joint_names == plain.joint_names
    assert_array_equal(robot.thetas, plain.thetas)
    assert_array_equal(robot.mj_model.body_pos, plain.mj_model.body_pos)
    text = read_document(robot.path).text()
    assert b"xacro:" not in text.replace(b"xmlns:xacro", b"") and b"${" not in text
    assert capfd.readouterr() == ("", "")


def test_the_hash_is_that_of_included_files_too(tmp_path):
    pytest.importorskip("xacro")
    path = written(tmp_path, xacro_of())
    before = read_document(path).sha256
    assert read_document(path).sha256 == before
    macro = path.with_name("macro.xacro")
    macro.write_text(MACRO.replace("0.75", "0.76"))
    assert read_document(path).sha256 != before


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (xacro_of(argument="<!---->"), "Undefined substitution argument far; mend the"),
        (xacro_of("$(find gone)/x.xacro"), "no folder above it holds package gone"),
        (xacro_of("gone.xacro"), "No such file or directory"),
        (xacro_of().replace("$(arg far)", "${far"), "far"),
        (xacro_of().replace("xacro:arm_link", "xacro:leg"), "leg"),
    ],
)
def test_what_xacro_refuses_is_one_line_with_the_file(tmp_path, capfd, text, message):
    pytest.importorskip("xacro")
    with refused(rf"xacro cannot expand .*arm\.urdf\.xacro.*{message}", ModelError):
        read_document(written(tmp_path, text))
    assert capfd.readouterr() == ("", "")


def test_without_the_package_the_error_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    path = written(tmp_path, xacro_of())
    with pytest.raises(ModelError) as caught:
        read_document(path)
    sentence, command = str(caught.value).split("\n")
    assert "'xacro arm.urdf.xacro -o arm.urdf' writes" in sentence
    assert command.startswith("  pip install ") and "[xacro]" in command


def test_a_urdf_that_only_names_the_namespace_needs_no_package(tmp_path, monkeypatch):
    """As those that xacro wrote do, with comments of the xacro."""
    monkeypatch.setitem(sys.modules, "xacro", None)
    text = EXPANDED.replace('<robot name="r">', NAMESPACE)
    text = text.replace("<link", "<!-- <xacro:leg x='${y}'/> --><link", 1)
    robot = load_robot_model(write_files(tmp_path, {"arm.urdf": text}))
    assert robot.n_joints == len(LINKS)


def one_link(name, before=""):
    """A xacro file of one link, whose name is an expression."""
    return f"{NAMESPACE}{before}<link name={quoteattr(name)}/></robot>"


@pytest.mark.parametrize(
    "expression",
    [
        "().__class__",
        "[k.__subclasses__ for k in [1]]",
        "__import__",
        "(lambda: 1)",
        "[g.gi_frame for g in [1]]",
        "(x for x in [1])",
        "f.f_globals",
    ],
)
def test_an_expression_that_could_lead_out_is_refused(expression):
    with pytest.raises(xacro_process.RefusedError, match="is not one of numbers"):
        xacro_process.checked_expression(expression)


def test_what_robots_are_described_with_is_an_expression():
    for text in ("2 * pi / radians(180.0)", " 'a' + prefix ", "[x for x in d['a']]"):
        assert xacro_process.checked_expression(text) == text.strip()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (one_link("$(env HOME)"), r"variables of the environment are not read"),
        (one_link("$(eval 1)"), r"is not evaluated"),
        (one_link("$(find ..)"), r"'..' is no name of a package"),
        (
            one_link("${xacro.load_yaml('/proc/version')}"),
            "is no YAML file of the model",
        ),
        (one_link("${10**9 * [0]}"), "it takes more than there is"),
        (one_link("a", '<xacro:include filename="/dev/zero"/>'), "a pipe or a device"),
        pytest.param(
            one_link("${10**10**10}"), "more than 10 s", marks=pytest.mark.slow
        ),
    ],
)
def test_a_strangers_xacro_does_no_harm(tmp_path, capfd, text, message):
    pytest.importorskip("xacro")
    with refused(rf"xacro cannot expand .*arm\.urdf\.xacro.*{message}", ModelError):
        read_document(written(tmp_path, text))
    assert capfd.readouterr() == ("", "")


def test_yaml_of_the_own_package_is_read_and_variables_have_their_defaults(tmp_path):
    """As the descriptions of UR's and Franka's arms ask for."""
    pytest.importorskip("xacro")
    value = "${xacro.load_yaml('$(find arm_description)/config/masses.yaml')['far']}"
    argument = f'<xacro:property name="far" value="{value}"/>'
    text = xacro_of(argument=argument).replace("$(arg far)", "${far}")
    path = written(tmp_path, text.replace('name="r"', 'name="$(optenv HOME r)"'))
    write_files(tmp_path, {"arm_description/config/masses.yaml": "far: 0.2"})
    robot = load_robot_model(path)
    plain = load_robot_model(write_files(tmp_path, {"plain.urdf": EXPANDED}))
    assert_array_equal(robot.mj_model.body_pos, plain.mj_model.body_pos)
    assert read_document(path).root.get("name") == "r"
