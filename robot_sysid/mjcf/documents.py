"""Model files as XML: safe reading, where each element stands, which kind and what is included.

Includes are resolved the way MuJoCo does: relative to the main file's folder, else relative to the
including file's; the children of the included root take the place of the ``<include>``.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.parsers import expat

from lxml import etree

from robot_sysid.errors import InputError, ModelError
from robot_sysid.records.atomic_files import require_utf8

_ENCODING = re.compile(rb"^\s*<\?xml[^>]*encoding\s*=\s*[\"']([A-Za-z0-9._-]+)[\"']")
_KINDS = {"mujoco": "mjcf", "robot": "urdf"}
_SUFFIXES = (".xml", ".mjcf", ".urdf")
_DEEPEST = 50
_START_TAG = re.compile(rb"""<[^\s/>]+(?:[^>"']|"[^"]*"|'[^']*')*>""")


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
class SourceFile:
    """One XML file.

    Attributes:
        text: the same as UTF-8 without byte order mark.
        elements: all its elements in document order, the root first.
        includes: index of an ``<include>`` in ``elements`` to the file it brings in.
    """

    path: Path
    raw: bytes
    text: bytes
    elements: tuple[Any, ...]
    includes: Mapping[int, SourceFile]

    @property
    def root(self) -> Any:
        """The root element."""
        return self.elements[0]

    @property
    def is_utf8(self) -> bool:
        """Whether the file on disk is UTF-8, which is how MuJoCo reads every file."""
        try:
            self.raw.decode("utf-8")
        except UnicodeDecodeError:
            return False
        return True

    @cached_property
    def index(self) -> Mapping[Any, int]:
        """Element to its place in ``elements``."""
        return {element: i for i, element in enumerate(self.elements)}

    @cached_property
    def spans(self) -> tuple[Span, ...]:
        """Where each element stands in ``text``."""
        return element_spans(self.text)


@dataclass(frozen=True)
class Node:
    """An element of the expanded model."""

    file: SourceFile
    element: Any

    @property
    def tag(self) -> str:
        """Tag without namespace."""
        return local_name(self.element)

    def get(self, name: str, default: str | None = None) -> str | None:
        """Return an attribute's value."""
        return self.element.get(name, default)

    def children(self) -> Iterator[Node]:
        """Yield the child elements, those of included files in place of the ``<include>``."""
        for child in self.element.iterchildren(etree.Element):
            included = self.file.includes.get(self.file.index[child])
            if included is None:
                yield Node(self.file, child)
            else:
                yield from Node(included, included.root).children()

    def walk(self) -> Iterator[Node]:
        """Yield this element and all below it in document order."""
        yield self
        for child in self.children():
            yield from child.walk()

    @property
    def span(self) -> Span:
        """Where it stands in the text of its file."""
        return self.file.spans[self.file.index[self.element]]

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

    def holds(self, other: Node) -> bool:
        """Tell whether an element is this one or below it."""
        return any(node.element is other.element for node in self.walk())


@dataclass(frozen=True)
class ModelDocument:
    """A model file with everything it includes.

    Attributes:
        kind: "mjcf" or "urdf".
        files: the main file and the included ones, in the order MuJoCo reads them.
    """

    main: SourceFile
    kind: str
    files: tuple[SourceFile, ...]

    @property
    def path(self) -> Path:
        """Absolute path of the main file."""
        return self.main.path

    @property
    def folder(self) -> Path:
        """Folder of the main file."""
        return self.main.path.parent

    @property
    def root(self) -> Node:
        """Root of the expanded model."""
        return Node(self.main, self.main.root)

    @property
    def sha256(self) -> str:
        """SHA-256 of the main file's bytes followed by those of the included files."""
        return hashlib.sha256(b"".join(file.raw for file in self.files)).hexdigest()

    def walk(self) -> Iterator[Node]:
        """Yield all elements of the expanded model in document order."""
        return self.root.walk()

    def settings(self, tag: str) -> list[Node]:
        """Return the elements of MuJoCo's settings with a tag, the one that counts most last.

        Those of a URDF stand in its ``<mujoco>`` part.
        """
        tops = self.tagged("mujoco") if self.kind == "urdf" else [self.root]
        return [node for top in tops for node in top.children() if node.tag == tag]

    def tagged(self, tag: str) -> list[Node]:
        """Return the children of the root with a tag."""
        return [node for node in self.root.children() if node.tag == tag]

    def compilers(self) -> list[Node]:
        """Return the compiler elements."""
        return self.settings("compiler")


def local_name(element: Any) -> str:
    """Return an element's tag without its namespace."""
    return str(etree.QName(element).localname)


def read_document(path: Path) -> ModelDocument:
    """Read a model file and what it includes.

    Args:
        path: an MJCF (root ``<mujoco>``) or URDF (root ``<robot>``) file.

    Raises:
        InputError: the file is missing, a folder or unreadable.
        ModelError: it is not XML, only a fragment of a model, or an include fails.
    """
    known: dict[Path, SourceFile] = {}
    main = _read(Path(path).absolute(), known)
    document = ModelDocument(main, _KINDS.get(local_name(main.root), ""), tuple(known.values()))
    _check_is_whole_model(document)
    return document


def _check_is_whole_model(document: ModelDocument) -> None:
    name, advice = document.path, "pass the main model file, the one that includes this one"
    if not document.kind:
        tag = local_name(document.main.root)
        raise ModelError(
            f"{name} is a fragment, not a whole model: its root is <{tag}>, expected <mujoco> "
            f"(MJCF) or <robot> (URDF); {advice}"
        )
    if document.kind == "mjcf" and not document.tagged("worldbody"):
        raise ModelError(f"{name} is a fragment, not a whole model: no <worldbody>; {advice}")
    if document.kind == "urdf" and not document.tagged("link"):
        xacro = any("xacro" in str(uri) for uri in document.main.root.nsmap.values())
        hint = "run xacro on it first" if xacro else advice
        raise ModelError(f"{name} is a fragment, not a whole model: no <link>; {hint}")


def _read(path: Path, known: dict[Path, SourceFile], depth: int = 0) -> SourceFile:
    """Return a file with its includes, and note each with its real path, the main file first."""
    raw = _read_bytes(path)
    text = _as_utf8(raw, path)
    elements = tuple(_parse(text, path).iter(etree.Element))
    includes: dict[int, SourceFile] = {}
    file = known[path.resolve()] = SourceFile(path, raw, text, elements, includes)
    for i, element in enumerate(elements):
        if local_name(element) == "include" and local_name(elements[0]) != "robot":
            includes[i] = _read_include(file, element, known, depth + 1)
    return file


def _read_include(
    above: SourceFile, element: Any, known: dict[Path, SourceFile], depth: int
) -> SourceFile:
    where = f"{above.path}, line {element.sourceline}"
    name = element.get("file")
    if not name:
        raise ModelError(f"{where}: <include> without a file attribute")
    main = next(iter(known.values()))
    folders = (main.path.parent, above.path.parent)
    candidates = (folder / name.replace("\\", "/") for folder in folders)
    path = next((path for path in candidates if os.path.isfile(path)), None)
    if path is None:
        raise ModelError(f"{where}: included file {name} not found (looked in {above.path.parent})")
    if path.resolve() in known:
        raise ModelError(
            f"{where}: {name} is included twice or includes itself; each file may be included once"
        )
    if depth > _DEEPEST:
        raise ModelError(f"{where}: includes are nested more than {_DEEPEST} deep")
    included = _read(path, known, depth)
    if next(included.root.iterchildren(etree.Element), None) is None:
        raise ModelError(f"{where}: included file {name} is empty")
    return included


def _read_bytes(path: Path) -> bytes:
    require_utf8(path)
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise InputError(f"{path} is a pipe or a device; pass a model file")
        return path.read_bytes()
    except IsADirectoryError:
        raise InputError(f"{path} is a folder; pass a model file (MJCF .xml or .urdf)") from None
    except FileNotFoundError:
        known = path.suffix.lower() in _SUFFIXES
        hint = "" if known else " (Expected an XML model file: .xml, .mjcf or .urdf)"
        raise InputError(f"model file {path} not found; check the path{hint}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot read model file {path}: {reason}") from None


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


def _parse(text: bytes, path: Path) -> Any:
    if text.find(b"<!ENTITY", max(0, text.find(b"<!DOCTYPE"))) >= 0 and b"<!DOCTYPE" in text:
        raise ModelError(
            f"{path} declares XML entities, which a model file does not need and which can hide an "
            "attack; remove its <!DOCTYPE ...>"
        )
    xml = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, encoding="utf-8")
    try:
        return etree.fromstring(masked_comments(text), xml)
    except etree.XMLSyntaxError as error:
        reason = " ".join(str(error.msg).split())
        raise ModelError(f"Expected an XML model file, but {path} is not XML: {reason}") from None


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
