"""A compiled body is found again in the text."""

from __future__ import annotations

import mujoco
import pytest

from robot_sysid.compiled.composite import body_label
from robot_sysid.errors import ExportError
from robot_sysid.modelfile.body_search import find_body
from robot_sysid.modelfile.documents import read_document
from tests.model_files import urdf_link, urdf_robot, write_files

# Each body carries its MuJoCo id as mass of its only geom.
NAMELESS = """<mujoco><include file="a.xml"/><worldbody>
<body><geom size="1" mass="3"/><frame><body><geom size="1" mass="4"/></body></frame></body>
<frame pos="1 0 0"><body><geom size="1" mass="5"/></body></frame></worldbody></mujoco>"""
INCLUDED = """<mujoco><worldbody><body><geom size="1" mass="1"/>
<body name="b"><geom size="1" mass="2"/></body></body></worldbody></mujoco>"""


def test_nameless_bodies_are_counted_as_mujoco_counts(tmp_path):
    path = write_files(tmp_path, {"m.xml": NAMELESS, "a.xml": INCLUDED})
    mj_model, document = mujoco.MjModel.from_xml_path(str(path)), read_document(path)
    for number in range(1, mj_model.nbody):
        node = find_body(document, body_label(mj_model, number))
        geom = next(child for child in node.children() if child.tag == "geom")
        assert float(geom.get("mass")) == mj_model.body_mass[number] == number


@pytest.mark.parametrize(
    ("content", "label", "message"),
    [
        ("<body name='a'/>", "b", "'b' is not written out in the file"),
        ("<body name='a'/><body name='a'/>", "a", "'a' stands in the file 2 times"),
        ("<replicate count='2'><body name='a'/></replicate>", "a", "repeated by a <replicate>"),
        ("<replicate count='2'><body/></replicate><body/>", "#3", "past a <replicate>"),
        ("<body><attach model='x' body='y' prefix='z'/></body><body/>", "#4", "past a <attach>"),
        ("<body/>", "#2", "no body number #2"),
    ],
)
def test_what_is_not_written_out_is_one_line(tmp_path, content, label, message):
    text = f"<mujoco><worldbody>{content}</worldbody></mujoco>"
    with pytest.raises(ExportError, match=message) as caught:
        find_body(read_document(write_files(tmp_path, {"m.xml": text})), label)
    assert "\n" not in str(caught.value)


def test_multipliers_behind_the_body_do_not_matter(tmp_path):
    text = "<mujoco><worldbody><body pos='1 0 0'/><replicate count='2'><body/></replicate>"
    path = write_files(tmp_path, {"m.xml": text + "</worldbody></mujoco>"})
    assert find_body(read_document(path), "#1").get("pos") == "1 0 0"


def test_a_link_is_found_by_name(tmp_path):
    text = urdf_robot(urdf_link("a"), urdf_link("b"))
    assert find_body(read_document(write_files(tmp_path, {"m": text})), "b").get("name") == "b"
