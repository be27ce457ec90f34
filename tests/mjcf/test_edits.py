"""Edits in the bytes of an XML file touch nothing else."""

from __future__ import annotations

import pytest

from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.edits import Edits

WORLD = "<worldbody/>"
TEXT = """<?xml version='1.0'?>
<!-- <fake/> -- dashes --><mujoco x = '1>2' y="3"><b/><c
   z='4' ><d >t</d ></c  ><!----><worldbody/></mujoco>
"""


def document_of(tmp_path, text):
    path = tmp_path / "m.xml"
    path.write_bytes(text.encode())
    return read_document(path)


@pytest.mark.parametrize(
    ("element", "name", "value", "before", "after"),
    [
        (0, "x", "5", "'1>2'", '"5"'),
        (0, "new", 'a&"<', 'y="3"', 'y="3" new="a&amp;&quot;&lt;"'),
        (1, "q", "1", "<b/>", '<b q="1"/>'),
        (2, "z", "9", "'4'", '"9"'),
        (0, "x", None, " x = '1>2'", ""),
        (0, "no", None, "", ""),
    ],
)
def test_an_attribute_is_changed_and_nothing_else(
    tmp_path, element, name, value, before, after
):
    document = document_of(tmp_path, TEXT)
    edits = Edits(document)
    edits.set(list(document.walk())[element], name, value)
    assert edits.text().decode() == TEXT.replace(before, after, 1)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("\n  <a x='1'/>\n", "\n  <a x='1'>\n    <n>\n    </n>\n  </a>\n"),
        ("\n  <a>\n    <b/>\n  </a>", "\n  <a>\n    <b/>\n    <n>\n    </n>\n  </a>"),
        ("\n  <a><b/></a>", "\n  <a><b/>\n    <n>\n    </n>\n  </a>"),
        ("\r\n  <a></a>", "\r\n  <a>\r\n    <n>\r\n    </n>\r\n  </a>"),
        ("<!-- 1 -- 2 --><a/>", "<!-- 1 -- 2 --><a>\n  <n>\n  </n>\n</a>"),
    ],
)
def test_lines_are_put_last_and_one_step_deeper(tmp_path, text, expected):
    document = document_of(tmp_path, f"<mujoco>{text}{WORLD}</mujoco>")
    edits = Edits(document)
    edits.append(next(document.walk("a")), "<n>", "</n>")
    assert edits.text().decode() == f"<mujoco>{expected}{WORLD}</mujoco>"
