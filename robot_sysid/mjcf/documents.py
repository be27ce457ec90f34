"""Model files as XML: safe reading, where each element stands, which kind and what is included.

Includes are resolved the way MuJoCo does: relative to the main file's folder, else relative to the
including file's; the children of the included root take the place of the ``<include>``.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

from robot_sysid.errors import InputError, ModelError, error_text
from robot_sysid.records.file_access import refuse_special_file, require_utf8

_ENCODING = re.compile(rb"^\s*<\?xml[^>]*encoding\s*=\s*[\"']([A-Za-z0-9._-]+)[\"']")
_KINDS = {"mujoco": "mjcf", "robot": "urdf"}
SUFFIXES = (".xml", ".mjcf", ".urdf")
_DEEPEST = 50
"""Includes in one another; no model at hand has more than three."""
_DEEPEST_ELEMENT = 256
"""Elements in one another, as libxml2 allows them; Python's own stack ends at 1000."""
LARGEST_FILE = 100_000_000
MOST_ELEMENTS = 20_000
"""Bytes of a file, and elements with all includes: the largest arm at hand has 317, and MuJoCo
takes 12 s for 10 000 bodies."""
_START_TAG = re.compile(rb"""<[^\s/>]+(?:[^>"']|"[^"]*"|'[^']*')*>""")


@dataclass(eq=False)
class SourceFile:
    """One XML file: its bytes on disk, the same as UTF-8 without byte order mark, and all its
    elements in document order, the root first.
    """

    path: Path
    raw: bytes
    text: bytes
    elements: list[Node] = field(default_factory=list)

    @property
    def is_utf8(self) -> bool:
        """Whether the file on disk is UTF-8, which is how MuJoCo reads every file."""
        return self.raw.decode("utf-8", "ignore").encode("utf-8") == self.raw

    @property
    def includes(self) -> list[Node]:
        """Its elements whose place another file takes."""
        return [node for node in self.elements if node.included is not None]


@dataclass(eq=False)
class Node:
    """An element of the expanded model.

    Attributes:
        tag: without namespace.
        start, end: where it begins and ends in the text of its file [bytes].
        inner_start, inner_end: what lies between its tags; for ``<a/>`` both its end.
        written: the elements in it as they stand in the file.
        included: the file that takes its place, if it is an ``<include>``.
    """

    file: SourceFile
    tag: str
    attributes: dict[str, str]
    line: int
    start: int
    inner_start: int
    inner_end: int
    end: int
    written: list[Node] = field(default_factory=list)
    included: SourceFile | None = None

    def get(self, name: str) -> str | None:
        """Return an attribute's value."""
        return self.attributes.get(name)

    @property
    def is_empty_tag(self) -> bool:
        """Whether it is written as ``<a/>``."""
        return self.inner_start == self.end

    def children(self) -> Iterator[Node]:
        """Yield the elements in it, those of included files in place of the ``<include>``."""
        for child in self.written:
            if child.included is None:
                yield child
            else:
                yield from child.included.elements[0].children()

    def walk(self) -> Iterator[Node]:
        """Yield this element and all below it in document order."""
        yield self
        for child in self.children():
            yield from child.walk()

    def child(self, *tags: str) -> Node | None:
        """Return the first child with a tag, of that one the first with the next tag, and so on."""
        found: Node | None = self
        for tag in tags:
            children = () if found is None else found.children()
            found = next((child for child in children if child.tag == tag), None)
        return found

    def inner(self, *path: str) -> str | None:
        """Return an attribute, the last one named, of the child with these tags."""
        *tags, name = path
        node = self.child(*tags)
        return None if node is None else node.get(name)


@dataclass(frozen=True)
class ModelDocument:
    """A model file of a kind ("mjcf" or "urdf"), and what it includes in MuJoCo's order."""

    kind: str
    files: tuple[SourceFile, ...]

    @property
    def main(self) -> SourceFile:
        """The file that was asked for."""
        return self.files[0]

    @property
    def path(self) -> Path:
        """Absolute path of the main file."""
        return self.main.path

    @property
    def root(self) -> Node:
        """Root of the expanded model."""
        return self.main.elements[0]

    @property
    def sha256(self) -> str:
        """SHA-256 of the main file's bytes followed by those of the included files."""
        return hashlib.sha256(b"".join(file.raw for file in self.files)).hexdigest()

    def walk(self, *tags: str) -> Iterator[Node]:
        """Yield the elements of the expanded model in document order, those with some tags."""
        return (node for node in self.root.walk() if not tags or node.tag in tags)

    def tagged(self, tag: str) -> list[Node]:
        """Return the children of the root with a tag."""
        return [node for node in self.root.children() if node.tag == tag]

    def settings(self, tag: str) -> list[Node]:
        """Return the elements of MuJoCo's settings with a tag, the one that counts most last.

        Those of a URDF stand in its ``<mujoco>`` part.
        """
        tops = self.tagged("mujoco") if self.kind == "urdf" else [self.root]
        return [node for top in tops for node in top.children() if node.tag == tag]


def read_document(path: Path) -> ModelDocument:
    """Read a model file, MJCF (root ``<mujoco>``) or URDF (``<robot>``), and what it includes;
    ModelError where it is not XML, only a fragment of a model, or an include fails.
    """
    known: dict[Path, SourceFile] = {}
    root = _read(Path(path).absolute(), known).elements[0]
    document = ModelDocument(_KINDS.get(root.tag, ""), tuple(known.values()))
    needed = {"mjcf": "worldbody", "urdf": "link"}.get(document.kind)
    advice = "pass the main model file, the one that includes this one"
    if needed is None:
        fault = f"its root is <{root.tag}>, expected <mujoco> (MJCF) or <robot> (URDF)"
    elif not document.tagged(needed):
        fault = f"no <{needed}>"
        if any("xacro" in f"{key} {value}" for key, value in root.attributes.items()):
            advice = "run xacro on it first"
    else:
        return document
    raise ModelError(
        f"{document.path} is a fragment, not a whole model: {fault}; {advice}"
    )


def _read(path: Path, known: dict[Path, SourceFile], depth: int = 0) -> SourceFile:
    """Return a file with its includes, and note each with its real path, the main file first."""
    raw = _read_bytes(path)
    before = sum(len(file.elements) for file in known.values())
    file = known[path.resolve()] = SourceFile(path, raw, _as_utf8(raw, path))
    _parse(file, MOST_ELEMENTS - before)
    # MuJoCo knows no includes in a URDF.
    if file.elements[0].tag != "robot":
        for node in (each for each in file.elements if each.tag == "include"):
            node.included = _read_include(node, known, depth + 1)
    return file


def _read_include(node: Node, known: dict[Path, SourceFile], depth: int) -> SourceFile:
    above = node.file.path
    name = node.get("file")
    where = f"{above}, line {node.line}"
    if not name:
        raise ModelError(f"{where}: <include> without a file attribute")
    folders = (next(iter(known.values())).path.parent, above.parent)
    candidates = (folder / name.replace("\\", "/") for folder in folders)
    path = next((path for path in candidates if os.path.isfile(path)), None)
    if path is None:
        raise ModelError(
            f"{where}: included file {name} not found (looked in {above.parent})"
        )
    if path.resolve() in known:
        raise ModelError(
            f"{where}: {name} is included twice or includes itself; include it once"
        )
    if depth > _DEEPEST:
        raise ModelError(f"{where}: includes are nested more than {_DEEPEST} deep")
    included = _read(path, known, depth)
    if not included.elements[0].written:
        raise ModelError(f"{where}: included file {name} is empty")
    return included


def _read_bytes(path: Path) -> bytes:
    require_utf8(path)
    refuse_special_file(path, "pass a model file")
    try:
        if path.stat().st_size > LARGEST_FILE:
            most = f"more than the {LARGEST_FILE / 1e6:g} MB of a model file"
            raise ModelError(
                f"{path} has {most}; pass one, and keep meshes in files of their own"
            )
        return path.read_bytes()
    except IsADirectoryError:
        raise InputError(
            f"{path} is a folder; pass a model file (MJCF .xml or .urdf)"
        ) from None
    except FileNotFoundError:
        known = path.suffix.lower() in SUFFIXES
        hint = "" if known else " (Expected an XML model file: .xml, .mjcf or .urdf)"
        raise InputError(f"model file {path} not found; check the path{hint}") from None
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot read model file {path}: {error_text(error)}"
        ) from None


def _as_utf8(raw: bytes, path: Path) -> bytes:
    if not raw.strip():
        raise ModelError(f"Expected an XML model file, but {path} is empty")
    declared = _ENCODING.match(raw)
    for encoding in ("utf-8-sig", declared.group(1).decode() if declared else "utf-16"):
        try:
            # MuJoCo tolerates white space before the declaration, strict parsers do not.
            return raw.decode(encoding).lstrip().encode("utf-8")
        except (UnicodeError, LookupError):
            continue
    raise ModelError(f"Expected an XML model file, but {path} is not text")


def _parse(file: SourceFile, most: int) -> None:
    """Find the elements of a file, which may have so many."""
    text = file.text
    path = file.path
    if (
        text.find(b"<!ENTITY", max(0, text.find(b"<!DOCTYPE"))) >= 0
        and b"<!DOCTYPE" in text
    ):
        remedy = "which can hide an attack; remove its <!DOCTYPE ...>"
        raise ModelError(f"{path} declares XML entities, {remedy}")
    parser = expat.ParserCreate("utf-8")
    above = list[Node]()

    def opened(name: str, attributes: dict[str, str]) -> None:
        start = parser.CurrentByteIndex
        tag = _START_TAG.match(text, start)
        if tag is None or len(above) == _DEEPEST_ELEMENT:
            raise expat.ExpatError(
                f"elements are nested more than {_DEEPEST_ELEMENT} deep"
            )
        if len(file.elements) >= most:
            fault = f"more than the {MOST_ELEMENTS} elements that are read"
            raise ModelError(
                f"{path}: {fault}, includes counted; take out what is no arm"
            )
        name = name.rpartition(":")[2]
        line = parser.CurrentLineNumber
        end = tag.end()
        node = Node(file, name, attributes, line, start, end, end, end)
        file.elements.append(node)
        for parent in above[-1:]:
            parent.written.append(node)
        above.append(node)

    def closed(name: str) -> None:
        node = above.pop()
        closing = parser.CurrentByteIndex
        if not text.endswith(b"/>", node.start, node.inner_start):
            node.inner_end = closing
            node.end = text.index(b">", closing) + 1

    parser.StartElementHandler = opened
    parser.EndElementHandler = closed
    try:
        parser.Parse(masked_comments(text), True)
    except expat.ExpatError as error:
        raise ModelError(
            f"Expected an XML model file, but {path} is not XML: {error}"
        ) from None


def masked_comments(text: bytes) -> bytes:
    """Return the text with the dashes inside comments replaced, every offset unchanged.

    MuJoCo's reader accepts ``--`` inside a comment, which strict XML parsers refuse.
    """
    pieces = []
    position = 0
    while (start := text.find(b"<!--", position)) >= 0:
        end = text.find(b"-->", start + 4)
        if (
            end < 0
        ):  # a search for each further comment would take the square of the length
            break
        pieces += [
            text[position : start + 4],
            text[start + 4 : end].replace(b"-", b"~"),
        ]
        position = end
    return b"".join([*pieces, text[position:]])


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
