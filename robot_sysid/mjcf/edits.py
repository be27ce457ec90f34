"""Edits of a model's files, and the text that they make: its own, but for what is edited.

An XML library that writes a parsed tree back loses the quoting and line breaks inside tags. Here
the tree only tells *what* to change; the change itself is made in the bytes of the original file.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from robot_sysid.mjcf.documents import ModelDocument, Node, SourceFile, Span

_OLD_COMMENT = re.compile(rb"<!--\s*System ID:(?:(?!-->).)*-->\s*\Z", re.DOTALL)
_DECLARED_ENCODING = re.compile(rb"""\A(<\?xml[^>]*encoding\s*=\s*["'])[^"']*(["'])""")
_ATTRIBUTE = re.compile(rb"""([^\s=/<>"']+)(\s*=\s*)("[^"]*"|'[^']*')""")
_TAG_NAME = re.compile(rb"<([^\s/>]+)")
_ESCAPES = {"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;"}
_ESCAPED = str.maketrans({**_ESCAPES, "\t": "&#9;", "\n": "&#10;", "\r": "&#13;"})


@dataclass(frozen=True)
class Edit:
    """Replace text[start:end] by ``replacement``."""

    start: int
    end: int
    replacement: bytes


class Edits:
    """Collects edits file by file and writes the main file out.

    An included file takes the place of its ``<include>`` where it is edited.

    Attributes:
        settings: elements to add to MuJoCo's settings, which in a URDF stand in ``<mujoco>``.
        lead: what comes before them.
        folder: where the text will live; None makes the paths of includes absolute.
        inlined: further included files whose text must take the place of their ``<include>``.
    """

    def __init__(self, document: ModelDocument, folder: Path | None = None) -> None:
        self.document, self.folder = document, folder
        self.settings: list[str] = []
        self.lead = line_break(document.main.text) + b"  "
        self.inlined: set[Path] = set()
        self._edits: dict[Path, list[Edit]] = defaultdict(list)

    def add(self, node: Node, edit: Edit) -> None:
        """Add an edit in the file of an element."""
        self._edits[node.file.path].append(edit)

    def insert(self, node: Node, child: bytes) -> None:
        """Put text first into an element."""
        self.add(node, insert_child(node.file.text, node.span, child))

    def append(self, node: Node, child: str) -> None:
        """Put lines of text last into an element."""
        self.add(node, append_child(node.file.text, node.span, child))

    def set(self, node: Node, name: str, value: str | None) -> None:
        """Give an element an attribute, or take it away where the value is None."""
        text = node.file.text
        if value is not None:
            self.add(node, set_attribute(text, node.span, name, value))
        elif (removal := remove_attribute(text, node.span, name)) is not None:
            self.add(node, removal)

    def set_path(self, node: Node, name: str, value: str | None) -> None:
        """Do the same with an attribute that is a path, where it is not the same one already."""
        old = node.get(name)
        if value is None or old is None or os.path.normpath(old) != os.path.normpath(value):
            self.set(node, name, value)

    def set_compiler(self, values: Mapping[str, str]) -> None:
        """Set attributes of the compiler: in a URDF of every one, which lose their meshdir."""
        compilers, is_urdf = self.document.compilers(), self.document.kind == "urdf"
        for node in compilers if is_urdf else compilers[:1]:
            for name, value in values.items():
                self.set(node, name, value)
            if is_urdf:
                self.set(node, "meshdir", None)
        if not compilers:
            attributes = "".join(f" {name}={quoted(v)}" for name, v in values.items())
            self.settings.insert(0, f"<compiler{attributes}/>")

    def replace(self, node: Node, new: str, keep_lines: bool = False) -> None:
        """Put text in the place of an element, with as many line breaks where that is wanted."""
        start, end = node.span.start, node.span.end
        lines = node.file.text[start:end].count(b"\n") if keep_lines else 0
        self.add(node, Edit(start, end, new.encode() + b"\n" * lines))

    def comment(self, node: Node, comment: str) -> None:
        """Put a comment before an element, in place of an older one of this program."""
        text, start = node.file.text, node.span.start
        old = _OLD_COMMENT.search(text[:start])
        # What follows the comment repeats the element's own indentation.
        between = line_break(text) + indentation(text, start)
        self.add(node, Edit(old.start() if old else start, start, comment.encode() + between))

    def text(self) -> bytes:
        """Return the text, whose XML declaration, if it has one, says that it is UTF-8."""
        main = self.document.main
        text = apply_edits(main.text, [*self._settings_edits(), *self._all_edits(main)])
        return _DECLARED_ENCODING.sub(rb"\1utf-8\2", text, count=1)

    def _settings_edits(self) -> Iterator[Edit]:
        """Yield the edit that adds the settings; MuJoCo reads one ``<mujoco>`` of a URDF only."""
        root, new = self.document.root, [each.encode() for each in self.settings]
        start = root.span.inner_start
        if not new:
            return
        if self.document.kind != "urdf":
            yield Edit(start, start, b"".join(self.lead + each for each in new))
        elif (part := root.child("mujoco")) is not None:
            yield insert_child(part.file.text, part.span, b"".join(new))
        else:
            yield Edit(start, start, self.lead + b"<mujoco>" + b"".join(new) + b"</mujoco>")

    def _all_edits(self, file: SourceFile) -> list[Edit]:
        return [*self._edits.get(file.path, ()), *self._include_edits(file)]

    def _include_edits(self, file: SourceFile) -> Iterator[Edit]:
        for i, included in file.includes.items():
            span = file.spans[i]
            if self._must_inline(included):
                inner, edits = included.spans[0], self._all_edits(included)
                ends = inner.inner_start, inner.inner_end
                yield Edit(span.start, span.end, apply_edits(included.text, edits, *ends).strip())
            else:
                yield set_attribute(file.text, span, "file", reference(included.path, self.folder))

    def _must_inline(self, file: SourceFile) -> bool:
        return file.path in {*self.inlined, *self._edits} or any(
            self._must_inline(included) for included in file.includes.values()
        )


def reference(target: Path, folder: Path | None) -> str:
    """Return how a file in ``folder`` refers to ``target``: relative where that is safe."""
    if folder is None:
        return target.as_posix()
    try:
        relative = os.path.relpath(target, folder)
    except ValueError:
        return target.as_posix()  # another drive
    # MuJoCo reduces ".." in the text of a path, the system in the folders themselves: behind a
    # symbolic link the two differ, and only an absolute path is right for both.
    if os.path.realpath(os.path.join(folder, relative)) != os.path.realpath(target):
        return target.as_posix()
    return Path(relative).as_posix()


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
