"""XML text and where its elements stand in it, so that a file can be edited without rewriting it.

An XML library that writes a parsed tree back loses the quoting and line breaks inside tags. Here
the tree only tells *what* to change; the change itself is made in the bytes of the original file.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from xml.parsers import expat

_START_TAG = re.compile(rb"""<[^\s/>]+(?:[^>"']|"[^"]*"|'[^']*')*>""")
_ATTRIBUTE = re.compile(rb"""([^\s=/<>"']+)(\s*=\s*)("[^"]*"|'[^']*')""")
_TAG_NAME = re.compile(rb"<([^\s/>]+)")
_ESCAPES = {"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;"}
_ESCAPED = str.maketrans({**_ESCAPES, "\t": "&#9;", "\n": "&#10;", "\r": "&#13;"})


@dataclass(frozen=True)
class Span:
    """Byte offsets of one element and of what lies between its tags; for ``<a/>`` both its end."""

    start: int
    inner_start: int
    inner_end: int
    end: int

    @property
    def is_empty_tag(self) -> bool:
        """Whether the element is written as ``<a/>``."""
        return self.inner_start == self.end


@dataclass(frozen=True)
class Edit:
    """Replace text[start:end] by ``replacement``."""

    start: int
    end: int
    replacement: bytes


def masked_comments(text: bytes) -> bytes:
    """Return the text with the dashes inside comments replaced, every offset unchanged.

    MuJoCo's reader accepts ``--`` inside a comment, which strict XML parsers refuse.
    """
    pieces, position = [], 0
    while (start := text.find(b"<!--", position)) >= 0:
        end = text.find(b"-->", start + 4)
        if end < 0:  # a search for each further comment would take the square of the length
            break
        pieces += [text[position : start + 4], text[start + 4 : end].replace(b"-", b"~")]
        position = end
    return b"".join([*pieces, text[position:]])


def element_spans(text: bytes) -> tuple[Span, ...]:
    """Return the span of every element of a well-formed UTF-8 text, in document order."""
    starts: list[int] = []
    closings: dict[int, int] = {}
    open_elements: list[int] = []
    parser = expat.ParserCreate("utf-8")

    def opened(name: str, attributes: dict[str, str]) -> None:
        open_elements.append(len(starts))
        starts.append(parser.CurrentByteIndex)

    def closed(name: str) -> None:
        closings[open_elements.pop()] = parser.CurrentByteIndex

    parser.StartElementHandler = opened
    parser.EndElementHandler = closed
    parser.Parse(masked_comments(text), True)
    return tuple(_span(text, start, closings[i]) for i, start in enumerate(starts))


def _span(text: bytes, start: int, closing: int) -> Span:
    match = _START_TAG.match(text, start)
    assert match is not None
    if match.group().endswith(b"/>"):
        return Span(start, match.end(), match.end(), match.end())
    return Span(start, match.end(), closing, text.index(b">", closing) + 1)


def quoted(value: str) -> str:
    """Return the value of an attribute in quotes; the standard library's way loads HTTP and SSL."""
    return f'"{value.translate(_ESCAPED)}"'


def set_attribute(text: bytes, span: Span, name: str, value: str) -> Edit:
    """Return the edit that gives an element's start tag the attribute name="value"."""
    written = quoted(value).encode()
    found = _attribute(text, span, name)
    if found is not None:
        return Edit(found.start(3), found.end(3), written)
    end = span.inner_start - (2 if span.is_empty_tag else 1)
    while text[end - 1 : end].isspace():
        end -= 1
    return Edit(end, end, b" " + name.encode() + b"=" + written)


def remove_attribute(text: bytes, span: Span, name: str) -> Edit | None:
    """Return the edit that removes an attribute with the space before it; None if absent."""
    found = _attribute(text, span, name)
    if found is None:
        return None
    start = found.start()
    while text[start - 1 : start].isspace():
        start -= 1
    return Edit(start, found.end(), b"")


def insert_child(text: bytes, span: Span, child: bytes) -> Edit:
    """Return the edit that puts text first into an element."""
    if not span.is_empty_tag:
        return Edit(span.inner_start, span.inner_start, child)
    opened = text[span.start : span.end - 2].rstrip() + b">"
    name = _TAG_NAME.match(opened)
    assert name is not None
    return Edit(span.start, span.end, opened + child + b"</" + name.group(1) + b">")


def append_child(text: bytes, span: Span, child: str) -> Edit:
    """Return the edit that puts lines of text last into an element, indented one step deeper."""
    indent = line_break(text) + indentation(text, span.start)
    lines = b"".join(indent + b"  " + line.encode() for line in child.split("\n"))
    if span.is_empty_tag:
        return insert_child(text, span, lines + indent)
    end = len(text[span.inner_start : span.inner_end].rstrip()) + span.inner_start
    return Edit(end, end, lines + (indent if end == span.inner_end else b""))


def _attribute(text: bytes, span: Span, name: str) -> re.Match[bytes] | None:
    matches = _ATTRIBUTE.finditer(text, span.start, span.inner_start)
    return next((m for m in matches if m.group(1) == name.encode()), None)


def apply_edits(text: bytes, edits: Iterable[Edit], start: int = 0, end: int = -1) -> bytes:
    """Return text[start:end] with the edits that lie in it made; edits must not overlap."""
    end = len(text) if end < 0 else end
    pieces, position = [], start
    for edit in sorted(edits, key=lambda e: (e.start, e.end)):
        if edit.start < position:
            raise ValueError(f"overlapping edits at byte {edit.start}")
        pieces += [text[position : edit.start], edit.replacement]
        position = edit.end
    return b"".join([*pieces, text[position:end]])


def indentation(text: bytes, position: int) -> bytes:
    """Return the white space between the start of the line and ``position`` (empty if text)."""
    lead = text[text.rfind(b"\n", 0, position) + 1 : position]
    return lead if not lead.strip() else b""


def line_break(text: bytes) -> bytes:
    """Return the line ending the text uses."""
    return b"\r\n" if b"\r\n" in text else b"\n"
