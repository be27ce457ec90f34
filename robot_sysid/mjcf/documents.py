"""Model files as XML: read safely, with the byte range of each element, and edited in place.

Includes are resolved as MuJoCo does: relative to the main file's folder, else relative to the
including file's; the children of the included root take the place of the ``<include>``.

An XML library that writes a parsed tree back loses the quoting and the line breaks inside tags, and
knows no byte offsets: lxml changes every eighth line of the model files at hand. Here the tree
tells which element to change, and ``Edits`` changes the bytes of the original file.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

from robot_sysid.errors import InputError, ModelError, error_text
from robot_sysid.records.file_access import refuse_special_file, require_utf8

_ENCODING = re.compile(rb"^\s*<\?xml[^>]*encoding\s*=\s*[\"']([A-Za-z0-9._-]+)[\"']")
"""XML declaration with the encoding that it states."""
SUFFIXES = (".xml", ".mjcf", ".urdf")
"""Ends of the names of model files."""
_MAX_INCLUDE_DEPTH = 50
"""Largest depth of nested includes; no model at hand has more than three."""
_MAX_ELEMENT_DEPTH = 256
"""Largest depth of nested elements, that of libxml2; Python's own stack ends at 1000."""
LARGEST_FILE = 100_000_000
"""Size up to which a file is read [bytes]."""
MAX_ELEMENTS = 20_000
"""Elements of a model with all includes: the largest arm at hand has 317, and MuJoCo takes 12 s for
10 000 bodies."""
_START_TAG = re.compile(rb"""<[^\s/>]+(?:[^>"']|"[^"]*"|'[^']*')*>""")


@dataclass(eq=False)
class SourceFile:
    """One XML file.

    Attributes:
        raw: its bytes on disk.
        text: its bytes as UTF-8 without byte order mark.
        elements: all elements in document order, the root first.
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
    def includes(self) -> list[tuple[Node, SourceFile]]:
        """Its ``<include>`` elements, each with the file that takes its place."""
        return [(node, node.included) for node in self.elements if node.included]


@dataclass(eq=False)
class Node:
    """An element of the expanded model.

    Attributes:
        file: the file that it is written in.
        tag: its name without namespace.
        attributes: name to value, as the file has them.
        line: number of the line it begins in, from 1.
        start, end: where it begins and ends in the text of its file [bytes].
        inner_start, inner_end: range between its tags [bytes]; for ``<a/>`` both are ``end``.
        own_children: the elements in it as they stand in the file, ``<include>`` not expanded.
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
    own_children: list[Node] = field(default_factory=list)
    included: SourceFile | None = None

    def get(self, name: str) -> str | None:
        """Return an attribute's value; None where the element has none of that name."""
        return self.attributes.get(name)

    @property
    def is_self_closing(self) -> bool:
        """Whether it is written as ``<a/>``."""
        return self.inner_start == self.end

    def children(self) -> Iterator[Node]:
        """Yield the elements in it, those of included files in place of the ``<include>``."""
        for child in self.own_children:
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
        """Return the element at a path of tags below this one, the first of each tag; else None."""
        if not tags:
            return self
        tag, *tags_below = tags
        for node in self.children():
            if node.tag == tag:
                return node.child(*tags_below)
        return None

    def child_attribute(self, *path: str) -> str | None:
        """Return an attribute of the ``child`` at a path of tags, whose last item names it."""
        *tags, name = path
        node = self.child(*tags)
        return None if node is None else node.get(name)


@dataclass(frozen=True)
class ModelDocument:
    """A model file, URDF or else MJCF, with the files it includes behind it in MuJoCo's order."""

    is_urdf: bool
    files: tuple[SourceFile, ...]

    @property
    def main(self) -> SourceFile:
        """The file that was read, not one of its includes."""
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
        """Yield the elements of the expanded model in document order; with tags only these."""
        return (node for node in self.root.walk() if not tags or node.tag in tags)

    def root_children(self, tag: str) -> list[Node]:
        """Return the children of the root with a tag."""
        return [node for node in self.root.children() if node.tag == tag]

    def settings(self, tag: str) -> list[Node]:
        """Return the elements of MuJoCo's settings with a tag; the last one counts most.

        Those of a URDF stand in its ``<mujoco>`` element.
        """
        if not self.is_urdf:
            return self.root_children(tag)
        children = chain(*map(Node.children, self.root_children("mujoco")))
        return [node for node in children if node.tag == tag]


def read_document(path: Path) -> ModelDocument:
    """Read a model file, MJCF (root ``<mujoco>``) or URDF (``<robot>``), and what it includes.

    ModelError where it is not XML, only a fragment of a model, or an include fails.
    """
    files: dict[Path, SourceFile] = {}
    root = _read(Path(path).absolute(), files).elements[0]
    document = ModelDocument(root.tag == "robot", tuple(files.values()))
    required = {"mujoco": "worldbody", "robot": "link"}.get(root.tag)
    if required and document.root_children(required):
        return document
    fault = f"its root is <{root.tag}>, expected <mujoco> (MJCF) or <robot> (URDF)"
    advice = "pass the main model file, the one that includes this one"
    if required:
        fault = f"no <{required}>"
        if "xacro" in str(root.attributes):
            advice = "run xacro on it first"
    raise ModelError(
        f"{document.path} is a fragment, not a whole model: {fault}; {advice}"
    )


def _read(path: Path, files: dict[Path, SourceFile], depth: int = 0) -> SourceFile:
    """Return a file with its includes; all are added to ``files``, by their real path, in order.

    ``depth``: number of includes that the file stands in. ModelError where one cannot be read.
    """
    raw = _read_bytes(path)
    n_elements = sum(len(earlier.elements) for earlier in files.values())
    file = SourceFile(path, raw, _as_utf8(raw, path))
    files[path.resolve()] = file
    _parse(file, MAX_ELEMENTS - n_elements)
    # MuJoCo knows no includes in a URDF.
    if file.elements[0].tag != "robot":
        for node in file.elements:
            if node.tag == "include":
                node.included = _read_include(node, files, depth + 1)
    return file


def _read_include(node: Node, files: dict[Path, SourceFile], depth: int) -> SourceFile:
    """Return the file that an ``<include>`` names, with its own includes, or raise ModelError.

    Args:
        files: all files read so far by their real path, the main file first; those read are added.
        depth: number of includes that this one stands in, itself counted.
    """
    including = node.file.path
    name = node.get("file")
    location = f"{including}, line {node.line}"
    if not name:
        raise ModelError(f"{location}: <include> without a file attribute")
    main = next(iter(files.values())).path
    plain_name = name.replace("\\", "/")
    candidates = (main.parent / plain_name, including.parent / plain_name)
    path = next(filter(os.path.isfile, candidates), None)
    if path is None:
        raise ModelError(
            f"{location}: included file {name} not found (looked in {including.parent})"
        )
    if path.resolve() in files:
        raise ModelError(
            f"{location}: {name} is included twice or includes itself; include it once"
        )
    if depth > _MAX_INCLUDE_DEPTH:
        raise ModelError(
            f"{location}: includes are nested more than {_MAX_INCLUDE_DEPTH} deep"
        )
    included = _read(path, files, depth)
    if not included.elements[0].own_children:
        raise ModelError(f"{location}: included file {name} is empty")
    return included


def _read_bytes(path: Path) -> bytes:
    """Return a model file's content; ModelError for too large a file, else InputError."""
    require_utf8(path)
    refuse_special_file(path, "pass a model file")
    try:
        if path.stat().st_size > LARGEST_FILE:
            fault = f"more than the {LARGEST_FILE / 1e6:g} MB of a model file"
            raise ModelError(
                f"{path} has {fault}; pass one, and keep meshes in files of their own"
            )
        return path.read_bytes()
    except IsADirectoryError:
        raise InputError(
            f"{path} is a folder; pass a model file (MJCF .xml or .urdf)"
        ) from None
    except FileNotFoundError:
        hint = " (Expected an XML model file: .xml, .mjcf or .urdf)"
        hint = "" if path.suffix.lower() in SUFFIXES else hint
        raise InputError(f"model file {path} not found; check the path{hint}") from None
    except (OSError, ValueError) as error:
        fault = error_text(error)
        raise InputError(f"cannot read model file {path}: {fault}") from None


def _as_utf8(raw: bytes, path: Path) -> bytes:
    """Return a file's bytes as UTF-8, or raise ModelError where they are not text.

    They are read as UTF-8, else in the declared encoding, else, with none declared, as UTF-16.
    """
    if not raw.strip():
        raise ModelError(f"Expected an XML model file, but {path} is empty")
    declared = _ENCODING.match(raw)
    other_encoding = declared.group(1).decode() if declared else "utf-16"
    for encoding in ("utf-8-sig", other_encoding):
        try:
            # MuJoCo tolerates white space before the declaration, strict parsers do not.
            return raw.decode(encoding).lstrip().encode("utf-8")
        except (UnicodeError, LookupError):
            continue
    raise ModelError(f"Expected an XML model file, but {path} is not text")


def _parse(file: SourceFile, max_elements: int) -> None:
    """Fill ``file.elements``, or raise ModelError for more than ``max_elements`` or bad XML."""
    text = file.text
    path = file.path
    doctype = text.find(b"<!DOCTYPE")
    if doctype >= 0 and b"<!ENTITY" in text[doctype:]:
        remedy = "which can hide an attack; remove its <!DOCTYPE ...>"
        raise ModelError(f"{path} declares XML entities, {remedy}")
    parser = expat.ParserCreate("utf-8")
    parents = list[Node]()

    def start_element(name: str, attributes: dict[str, str]) -> None:
        """Add an element to the file and to its parent."""
        start = parser.CurrentByteIndex
        line = parser.CurrentLineNumber
        tag = _START_TAG.match(text, start)
        if tag is None:
            raise expat.ExpatError(f"the tag <{name}> in line {line} does not end")
        if len(parents) == _MAX_ELEMENT_DEPTH:
            raise expat.ExpatError(
                f"elements are nested more than {_MAX_ELEMENT_DEPTH} deep"
            )
        if len(file.elements) >= max_elements:
            raise ModelError(
                f"{path}: more than the {MAX_ELEMENTS} elements that are read, "
                "includes counted; take out what is no arm"
            )
        end = tag.end()
        short_name = name.rpartition(":")[2]
        node = Node(file, short_name, attributes, line, start, end, end, end)
        file.elements.append(node)
        if parents:
            parents[-1].own_children.append(node)
        parents.append(node)

    def end_element(name: str) -> None:
        """Note where the innermost open element ends."""
        node = parents.pop()
        closing = parser.CurrentByteIndex
        if not text.endswith(b"/>", node.start, node.inner_start):
            node.inner_end = closing
            node.end = text.index(b">", closing) + 1

    parser.StartElementHandler = start_element
    parser.EndElementHandler = end_element
    try:
        parser.Parse(mask_comments(text), True)  # the whole text at once
    except expat.ExpatError as error:
        order = "; order: robot-sysid identify MODEL LOG, but robot-sysid log LOG MODEL"
        hint = "" if path.suffix.lower() in SUFFIXES else order
        raise ModelError(
            f"Expected an XML model file, but {path} is not XML: {error}{hint}"
        ) from None


def mask_comments(text: bytes) -> bytes:
    """Return the text with each dash inside a comment replaced by ~, every offset unchanged.

    MuJoCo's reader accepts ``--`` inside a comment, which strict XML parsers refuse.
    """
    pieces = []
    position = 0
    while (start := text.find(b"<!--", position)) >= 0:
        content_start = start + len(b"<!--")
        end = text.find(b"-->", content_start)
        # Without an end, the search for that of each further comment would read all the text again.
        if end < 0:
            break
        comment = text[content_start:end].replace(b"-", b"~")
        pieces += [text[position:content_start], comment]
        position = end
    return b"".join([*pieces, text[position:]])


_OLD_COMMENT = re.compile(rb"<!--\s*System ID:(?:(?!-->).)*-->\s*\Z", re.DOTALL)
_DECLARED_ENCODING = re.compile(rb"""\A(<\?xml[^>]*encoding\s*=\s*["'])[^"']*(["'])""")
_ATTRIBUTE = re.compile(rb"""([^\s=/<>"']+)(\s*=\s*)("[^"]*"|'[^']*')""")
_ESCAPES = {"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;"}
_ESCAPES.update({c: f"&#{ord(c)};" for c in "\t\n\r\x85\u2028\u2029"})
_ESCAPE_TABLE = str.maketrans(_ESCAPES)


class Edit(NamedTuple):
    """Replacement of text[start:end] of one file by ``new``; offsets are in its unedited text."""

    start: int
    end: int
    new: bytes


class Edits:
    """Edits of a document's files, collected, and the main file's text with all of them made.

    An included file takes the place of its ``<include>`` where it is edited.

    Attributes:
        settings: elements to add to MuJoCo's settings, which in a URDF stand in ``<mujoco>``.
        settings_lead: white space before each of these settings.
        folder: where the text will live; None makes the paths of includes absolute.
        inlined: further included files whose text must take the place of their ``<include>``.
    """

    def __init__(self, document: ModelDocument) -> None:
        self.document = document
        self.folder: Path | None = None
        self.settings: list[str] = []
        self.settings_lead = f"{_line_break(document.main.text).decode()}  "
        self.inlined: set[SourceFile] = set()
        self._edits: dict[SourceFile, list[Edit]] = defaultdict(list)

    def set(self, node: Node, name: str, value: str | None) -> None:
        """Give an element an attribute, or remove it where the value is None."""
        self._edits[node.file] += _attribute_edits(node, name, value)

    def set_path(self, node: Node, name: str, value: str | None) -> None:
        """Give an element an attribute that is a path, unless it names that path already."""
        old = node.get(name)
        if (
            old is None
            or value is None
            or os.path.normpath(old) != os.path.normpath(value)
        ):
            self.set(node, name, value)

    def set_compiler(self, values: Mapping[str, str]) -> None:
        """Set attributes of the first <compiler>, or add one; in a URDF of all, without meshdir."""
        compilers = self.document.settings("compiler")
        is_urdf = self.document.is_urdf
        for node in compilers if is_urdf else compilers[:1]:
            for name, value in values.items():
                self.set(node, name, value)
            if is_urdf:
                self.set(node, "meshdir", value=None)
        if not compilers:
            self.settings.insert(0, f"<compiler{attribute_text(values)}/>")

    def put_inertial(self, body: Node, inertial: str, own_line: bool = True) -> None:
        """Put an ``<inertial>`` in place of a body's or link's old one, or else first in it.

        Args:
            own_line: whether a new one gets a line of its own.
        """
        old = body.child("inertial")
        if old is not None:
            self.replace(old, inertial)
            return
        lead = b""
        if own_line and not body.is_self_closing:
            lead = _indentation(body) + b"  "
        self._edits[body.file].append(_insert_first(body, lead + inertial.encode()))

    def append(self, node: Node, *lines: str) -> None:
        """Put lines of text last into an element, indented one step deeper."""
        # A line break with the white space before the element.
        indentation = _indentation(node)
        deeper = indentation.decode() + "  "
        added = (deeper + deeper.join(lines)).encode()
        content = node.file.text[node.inner_start : node.inner_end].rstrip()
        end = node.inner_start + len(content)
        if node.is_self_closing:
            edit = _insert_first(node, added + indentation)
        elif end == node.inner_end:
            edit = Edit(end, end, added + indentation)
        else:
            # The white space behind the content puts the end tag on a line of its own.
            edit = Edit(end, end, added)
        self._edits[node.file].append(edit)

    def replace(self, node: Node, new: str, keep_lines: bool = False) -> None:
        """Put text in an element's place; ``keep_lines`` adds as many line breaks as it had."""
        lines = node.file.text.count(b"\n", node.start, node.end) if keep_lines else 0
        edit = Edit(node.start, node.end, new.encode() + b"\n" * lines)
        self._edits[node.file].append(edit)

    def comment(self, node: Node, comment: str) -> None:
        """Put a comment before an element, in place of an older comment by this program."""
        old = _OLD_COMMENT.search(node.file.text[: node.start])
        start = old.start() if old else node.start
        # What follows the comment repeats the element's own indentation.
        new = comment.encode() + _indentation(node)
        self._edits[node.file].append(Edit(start, node.start, new))

    def text(self) -> bytes:
        """Return the text, whose XML declaration, if it has one, says that it is UTF-8."""
        main = self.document.main
        edits = [*self._settings_edits(), *self._file_edits(main)]
        text = _apply(edits, main.text, 0, len(main.text))
        return _DECLARED_ENCODING.sub(rb"\1utf-8\2", text, count=1)

    def _settings_edits(self) -> list[Edit]:
        """Return the edit that adds the settings, none for no settings."""
        root = self.document.root
        if not self.settings:
            return []
        lead = self.settings_lead
        if not self.document.is_urdf:
            text = lead + lead.join(self.settings)
            return [_insert_first(root, text.encode())]
        settings = "".join(self.settings)
        # MuJoCo reads one <mujoco> of a URDF only.
        extension = root.child("mujoco")
        if extension is not None:
            return [_insert_first(extension, settings.encode())]
        text = f"{lead}<mujoco>{settings}</mujoco>"
        return [_insert_first(root, text.encode())]

    def _file_edits(self, file: SourceFile) -> list[Edit]:
        """Return the edits of a file, among them those that inline or relocate its includes."""
        edits = list(self._edits.get(file, ()))
        for node, included in file.includes:
            if self._must_inline(included):
                root = included.elements[0]
                inner = self._file_edits(included)
                content = _apply(inner, included.text, root.inner_start, root.inner_end)
                edits.append(Edit(node.start, node.end, content.strip()))
            else:
                path = reference(included.path, self.folder)
                edits += _attribute_edits(node, "file", path)
        return edits

    def _must_inline(self, file: SourceFile) -> bool:
        """Return whether an included file, or one that it includes, is edited or inlined."""
        if file in self.inlined or file in self._edits:
            return True
        return any(self._must_inline(included) for _, included in file.includes)


def reference(target: Path, folder: Path | None) -> str:
    """Return how a file in ``folder`` refers to ``target``: relative where that is safe.

    Absolute where the folder is None.
    """
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


def attribute_text(values: Mapping[str, str]) -> str:
    """Return attributes as text of a start tag, a blank before each, values escaped."""
    # xml.sax.saxutils, which escapes too, would load HTTP and SSL.
    pairs = values.items()
    return "".join(f' {name}="{v.translate(_ESCAPE_TABLE)}"' for name, v in pairs)


def _attribute_edits(node: Node, name: str, value: str | None) -> list[Edit]:
    """Return the edit that gives an element an attribute, or removes it where the value is None.

    The list is empty where there is nothing to remove.
    """
    text = node.file.text
    new = b"" if value is None else attribute_text({name: value}).encode()
    for match in _ATTRIBUTE.finditer(text, node.start, node.inner_start):
        if match.group(1) != name.encode():
            continue
        if value is None:
            start = len(text[: match.start()].rstrip())
            return [Edit(start, match.end(), b"")]
        _, _, quoted_value = new.partition(b"=")
        return [Edit(*match.span(3), quoted_value)]
    if value is None:
        return []
    closing = b"/>" if node.is_self_closing else b">"
    end = len(text[: node.inner_start - len(closing)].rstrip())
    return [Edit(end, end, new)]


def _insert_first(node: Node, content: bytes) -> Edit:
    """Return the edit that puts text first into an element; ``<a/>`` becomes ``<a>...</a>``."""
    if not node.is_self_closing:
        return Edit(node.inner_start, node.inner_start, content)
    start_tag = node.file.text[node.start : node.end - len(b"/>")].rstrip()
    end_tag = start_tag.split()[0].replace(b"<", b"</")
    return Edit(node.start, node.end, start_tag + b">" + content + end_tag + b">")


def _apply(edits: Iterable[Edit], text: bytes, start: int, end: int) -> bytes:
    """Return text[start:end] with its edits, in any order, made; ValueError where two overlap."""
    pieces = []
    for edit in sorted(edits, key=lambda edit: edit[:2]):
        if edit.start < start:
            raise ValueError(f"overlapping edits at byte {edit.start}")
        pieces += [text[start : edit.start], edit.new]
        start = edit.end
    return b"".join([*pieces, text[start:end]])


def _indentation(node: Node) -> bytes:
    """Return a line break with the white space that stands before an element, if only that does."""
    text = node.file.text
    lead = text[text.rfind(b"\n", 0, node.start) + 1 : node.start]
    return _line_break(text) + (b"" if lead.strip() else lead)


def _line_break(text: bytes) -> bytes:
    """Return the line ending that a text uses."""
    return b"\r\n" if b"\r\n" in text else b"\n"
