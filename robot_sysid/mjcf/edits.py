"""Edits of a model's files, and the text that they make: its own, but for what is edited."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

from robot_sysid.mjcf import markup
from robot_sysid.mjcf.documents import ModelDocument, Node, SourceFile
from robot_sysid.mjcf.markup import Edit

_OLD_COMMENT = re.compile(rb"<!--\s*System ID:(?:(?!-->).)*-->\s*\Z", re.DOTALL)
_DECLARED_ENCODING = re.compile(rb"""\A(<\?xml[^>]*encoding\s*=\s*["'])[^"']*(["'])""")


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
        self.lead = markup.line_break(document.main.text) + b"  "
        self.inlined: set[Path] = set()
        self._edits: dict[Path, list[Edit]] = defaultdict(list)

    def add(self, node: Node, edit: Edit) -> None:
        """Add an edit in the file of an element."""
        self._edits[node.file.path].append(edit)

    def set(self, node: Node, name: str, value: str | None) -> None:
        """Give an element an attribute, or take it away where the value is None."""
        text = node.file.text
        if value is not None:
            self.add(node, markup.set_attribute(text, node.span, name, value))
        elif (removal := markup.remove_attribute(text, node.span, name)) is not None:
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
            attributes = "".join(f" {name}={markup.quoted(v)}" for name, v in values.items())
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
        between = markup.line_break(text) + markup.indentation(text, start)
        self.add(node, Edit(old.start() if old else start, start, comment.encode() + between))

    def text(self) -> bytes:
        """Return the text, whose XML declaration, if it has one, says that it is UTF-8."""
        main = self.document.main
        text = markup.apply_edits(main.text, [*self._settings_edits(), *self._all_edits(main)])
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
            yield markup.insert_child(part.file.text, part.span, b"".join(new))
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
                text = markup.apply_edits(included.text, edits, *ends).strip()
                yield Edit(span.start, span.end, text)
            else:
                name = reference(included.path, self.folder)
                yield markup.set_attribute(file.text, span, "file", name)

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
