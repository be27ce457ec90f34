"""Edits in the bytes of an XML file touch nothing else."""

from __future__ import annotations

import pytest
from lxml import etree

from robot_sysid.mjcf.documents import element_spans, masked_comments
from robot_sysid.mjcf.edits import (
    Edit,
    append_child,
    apply_edits,
    indentation,
    remove_attribute,
    set_attribute,
)

TEXT = b"""<?xml version='1.0'?>
<!-- <fake/> -- dashes --><a x = '1>2' y="3"><b/><c
   z='4' ><d >t</d ></c  ><!----></a>
"""


def spelled(text: bytes) -> list[bytes]:
    return [text[span.start : span.end] for span in element_spans(text)]


def test_spans_are_the_elements_in_document_order():
    assert spelled(TEXT)[1:] == [b"<b/>", b"<c\n   z='4' ><d >t</d ></c  >", b"<d >t</d >"]
    assert spelled(TEXT)[0] == TEXT[TEXT.index(b"<a ") :].strip()


def test_inner_text_lies_between_the_tags():
    span = element_spans(TEXT)[3]
    assert TEXT[span.inner_start : span.inner_end] == b"t"
    assert element_spans(TEXT)[1].is_empty_tag


def test_masking_keeps_every_offset_and_makes_comments_legal():
    masked = masked_comments(TEXT)
    assert len(masked) == len(TEXT)
    assert etree.fromstring(masked).tag == "a"


@pytest.mark.parametrize(
    ("element", "name", "value", "expected"),
    [
        (0, "x", "5", b'<a x = "5" y'),
        (0, "new", 'a&"<', b'y="3" new="a&amp;&quot;&lt;">'),
        (1, "q", "1", b'<b q="1"/>'),
        (2, "z", "9", b'<c\n   z="9" >'),
    ],
)
def test_set_attribute_changes_only_that_attribute(element, name, value, expected):
    edit = set_attribute(TEXT, element_spans(TEXT)[element], name, value)
    changed = apply_edits(TEXT, [edit])
    assert expected in changed
    assert len(changed) == len(TEXT) - (edit.end - edit.start) + len(edit.replacement)


def test_remove_attribute_takes_its_space_along():
    edit = remove_attribute(TEXT, element_spans(TEXT)[0], "x")
    assert edit is not None and b"<a y=" in apply_edits(TEXT, [edit])
    assert remove_attribute(TEXT, element_spans(TEXT)[0], "no") is None


def test_edits_of_a_part_and_overlaps():
    assert apply_edits(b"0123456789", [Edit(4, 6, b"x")], 3, 8) == b"3x67"
    with pytest.raises(ValueError, match="overlapping"):
        apply_edits(b"0123456789", [Edit(2, 5, b""), Edit(4, 6, b"")])


def test_indentation_is_white_space_only():
    assert indentation(b"a\n  <b/>", 4) == b"  "
    assert indentation(b"a\n x <b/>", 5) == b""


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"<r>\n  <a x='1'/>\n</r>", b"<r>\n  <a x='1'>\n    <n>\n    </n>\n  </a>\n</r>"),
        (
            b"<r>\n  <a>\n    <b/>\n  </a></r>",
            b"<r>\n  <a>\n    <b/>\n    <n>\n    </n>\n  </a></r>",
        ),
        (b"<r>\n  <a><b/></a></r>", b"<r>\n  <a><b/>\n    <n>\n    </n>\n  </a></r>"),
        (b"<r>\r\n  <a></a></r>", b"<r>\r\n  <a>\r\n    <n>\r\n    </n>\r\n  </a></r>"),
        (b"<r><!-- 1 -- 2 --><a/></r>", b"<r><!-- 1 -- 2 --><a>\n  <n>\n  </n>\n</a></r>"),
    ],
)
def test_a_child_is_put_last_and_one_step_deeper(text, expected):
    span = element_spans(text)[1]
    assert apply_edits(text, [append_child(text, span, "<n>\n</n>")]) == expected
