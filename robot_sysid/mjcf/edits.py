"""Edits of a model's files, and the text that they make: its own, but for what is edited.

An XML library that writes a parsed tree back loses the quoting and line breaks inside tags. Here
the tree only tells *what* to change; the change itself is made in the bytes of the original file.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from robot_sysid.mjcf.documents import ModelDocument, Node, SourceFile

_OLD_COMMENT = re.compile(rb"<!--\s*System ID:(?:(?!-->).)*-->\s*\Z", re.DOTALL)
_DECLARED_ENCODING = re.compile(rb"""\A(<\?xml[^>]*encoding\s*=\s*["'])[^"']*(["'])""")
_ATTRIBUTE = re.compile(rb"""([^\s=/<>"']+)(\s*=\s*)("[^"]*"|'[^']*')""")
_TAG_NAME = re.compile(rb"<[^\s/>]+")
_ESCAPES = {"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;"}
_ESCAPED = str.maketrans(
    {**_ESCAPES, **{c: f"&#{ord(c)};" for c in "\t\n\r\x85\u2028\u2029"}}
)


class Edit(NamedTuple):
    """Replace text[start:end] by ``new``."""

    start: int
    end: int
    new: bytes


class Edits:
    """Collects edits file by file and writes the main file out.

    An included file takes the place of its ``<include>`` where it is edited.

    Attributes:
        settings: elements to add to MuJoCo's settings, which in a URDF stand in ``<mujoco>``.
        lead: what comes before them.
        folder: where the text will live; None makes the paths of includes absolute.
        inlined: further included files whose text must take the place of their ``<include>``.
    """

    def __init__(self, document: ModelDocument) -> None:
        self.document = document
        self.folder: Path | None = None
        self.settings: list[str] = []
        self.lead = line_break(document.main.text) + b"  "
        self.inlined: set[SourceFile] = set()
        self._edits: dict[SourceFile, list[Edit]] = defaultdict(list)

    def set(self, node: Node, name: str, value: str | None) -> None:
        """Give an element an attribute, or take it away where the value is None."""
        for edit in _attribute_edit(node, name, value):
            self._edits[node.file].append(edit)

    def set_path(self, node: Node, name: str, value: str | None) -> None:
        """Do the same with an attribute that is a path, where it is not the same one already."""
        old = node.get(name)
        if (
            value is None
            or old is None
            or os.path.normpath(old) != os.path.normpath(value)
        ):
            self.set(node, name, value)

    def set_compiler(self, values: Mapping[str, str]) -> None:
        """Set attributes of the compiler: in a URDF of every one, which lose their meshdir."""
        compilers = self.document.settings("compiler")
        is_urdf = self.document.kind == "urdf"
        for node in compilers if is_urdf else compilers[:1]:
            for name, value in values.items():
                self.set(node, name, value)
            if is_urdf:
                self.set(node, "meshdir", None)
        if not compilers:
            self.settings.insert(0, f"<compiler{attributes(values)}/>")

    def put_inertial(self, body: Node, inertial: str, own_line: bool = True) -> None:
        """Give a body or link this inertial, in place of its old one, or else first."""
        old = body.child("inertial")
        if old is not None:
            self.replace(old, inertial)
        else:
            lead = (
                _own_line(body) + b"  " if own_line and not body.is_empty_tag else b""
            )
            self._edits[body.file].append(_first_in(body, lead + inertial.encode()))

    def append(self, node: Node, *lines: str) -> None:
        """Put lines of text last into an element, indented one step deeper."""
        text = node.file.text
        indent = _own_line(node)
        added = b"".join(indent + b"  " + line.encode() for line in lines)
        end = len(text[node.inner_start : node.inner_end].rstrip()) + node.inner_start
        edit = Edit(end, end, added + (indent if end == node.inner_end else b""))
        if node.is_empty_tag:
            edit = _first_in(node, added + indent)
        self._edits[node.file].append(edit)

    def replace(self, node: Node, new: str, keep_lines: bool = False) -> None:
        """Put text in the place of an element, with as many line breaks where that is wanted."""
        lines = node.file.text.count(b"\n", node.start, node.end) if keep_lines else 0
        self._edits[node.file].append(
            Edit(node.start, node.end, new.encode() + b"\n" * lines)
        )

    def comment(self, node: Node, comment: str) -> None:
        """Put a comment before an element, in place of an older one of this program."""
        old = _OLD_COMMENT.search(node.file.text[: node.start])
        # What follows the comment repeats the element's own indentation.
        new = comment.encode() + _own_line(node)
        self._edits[node.file].append(
            Edit(old.start() if old else node.start, node.start, new)
        )

    def text(self) -> bytes:
        """Return the text, whose XML declaration, if it has one, says that it is UTF-8."""
        main = self.document.main
        text = _edited(main.text, [*self._settings_edits(), *self._all_edits(main)])
        return _DECLARED_ENCODING.sub(rb"\1utf-8\2", text, count=1)

    def _settings_edits(self) -> Iterator[Edit]:
        """Yield the edit that adds the settings; MuJoCo reads one ``<mujoco>`` of a URDF only."""
        root = self.document.root
        new = [each.encode() for each in self.settings]
        if not new:
            return
        if self.document.kind != "urdf":
            yield _first_in(root, b"".join(self.lead + each for each in new))
        elif (part := root.child("mujoco")) is not None:
            yield _first_in(part, b"".join(new))
        else:
            yield _first_in(
                root, self.lead + b"<mujoco>" + b"".join(new) + b"</mujoco>"
            )

    def _all_edits(self, file: SourceFile) -> list[Edit]:
        """Return the edits of a file, those of its includes among them."""
        edits = list(self._edits.get(file, ()))
        for node in file.includes:
            included = node.included
            assert included is not None
            if self._must_inline(included):
                root = included.elements[0]
                inner = _edited(included.text, self._all_edits(included), root)
                edits.append(Edit(node.start, node.end, inner.strip()))
            else:
                edits += _attribute_edit(
                    node, "file", reference(included.path, self.folder)
                )
        return edits

    def _must_inline(self, file: SourceFile) -> bool:
        below = (node.included for node in file.includes)
        return file in {*self.inlined, *self._edits} or any(
            self._must_inline(included) for included in below if included is not None
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


def attributes(values: Mapping[str, str]) -> str:
    """Return attributes as an element has them; the standard library's way loads HTTP and SSL."""
    return "".join(
        f' {name}="{value.translate(_ESCAPED)}"' for name, value in values.items()
    )


def _attribute_edit(node: Node, name: str, value: str | None) -> Iterator[Edit]:
    """Yield the edit, if one is needed, that gives an element an attribute; None takes it away."""
    text = node.file.text
    end = node.inner_start - (2 if node.is_empty_tag else 1)
    matches = _ATTRIBUTE.finditer(text, node.start, node.inner_start)
    found = next((m for m in matches if m.group(1) == name.encode()), None)
    new = b"" if value is None else attributes({name: value}).encode()
    if found is not None and value is not None:
        yield Edit(found.start(3), found.end(3), new[len(name) + 2 :])
    elif found is not None:
        yield Edit(len(text[: found.start()].rstrip()), found.end(), new)
    elif value is not None:
        end = len(text[:end].rstrip())
        yield Edit(end, end, new)


def _first_in(node: Node, child: bytes) -> Edit:
    """Return the edit that puts text first into an element."""
    if not node.is_empty_tag:
        return Edit(node.inner_start, node.inner_start, child)
    opened = node.file.text[node.start : node.end - 2].rstrip() + b">"
    name = _TAG_NAME.match(opened)
    assert name is not None
    return Edit(node.start, node.end, opened + child + b"</" + name.group()[1:] + b">")


def _edited(text: bytes, edits: Iterable[Edit], inside: Node | None = None) -> bytes:
    """Return a text, or what lies in one of its elements, with edits made that do not overlap."""
    position, end = (inside.inner_start, inside.inner_end) if inside else (0, len(text))
    pieces = []
    for edit in sorted(edits, key=lambda edit: edit[:2]):
        if edit.start < position:
            raise ValueError(f"overlapping edits at byte {edit.start}")
        pieces += [text[position : edit.start], edit.new]
        position = edit.end
    return b"".join([*pieces, text[position:end]])


def _own_line(node: Node) -> bytes:
    """Return a line break with the white space that stands before an element, if only that does."""
    text = node.file.text
    lead = text[text.rfind(b"\n", 0, node.start) + 1 : node.start]
    return line_break(text) + (b"" if lead.strip() else lead)


def line_break(text: bytes) -> bytes:
    """Return the line ending the text uses."""
    return b"\r\n" if b"\r\n" in text else b"\n"
