"""Model files as XML trees: read safely, includes in their places, changed and written back.

Includes are resolved as MuJoCo does: relative to the main file's folder, else relative to the
including file's; the children of the included root take the place of the ``<include>``. A file that
is written back keeps comments, order and attributes; white space inside tags and around the root
may change.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lxml import etree

from robot_sysid.errors import InputError, ModelError, error_text
from robot_sysid.mjcf.size import refuse_bytes, refuse_large
from robot_sysid.mjcf.xacro_files import expand_xacro, is_xacro
from robot_sysid.records.file_access import refuse_special_file, require_utf8

Node = Any
"""An element of lxml's tree; its tag has no namespace unless it has a prefix."""
SUFFIXES = (".xml", ".mjcf", ".urdf", ".xacro")
"""Ends of the names of model files."""
# A comment: its begin, its text and its end.
_COMMENT = re.compile(r"(<!--)(.*?)(-->|\Z)", re.DOTALL)
# A character that nobody uses, in the place of each dash inside a comment.
_MASK = "\ue000"
# First bytes of a file to its encoding, by a mark of their order or by those of "<" or "<?"; the
# longer ones come first, as those of UTF-32 begin with those of UTF-16.
_BEGINNINGS = {
    b"\0\0\xfe\xff": "utf-32",
    b"\xff\xfe\0\0": "utf-32",
    b"\0\0\0<": "utf-32-be",
    b"<\0\0\0": "utf-32-le",
    b"\xfe\xff": "utf-16",
    b"\xff\xfe": "utf-16",
    b"\0<": "utf-16-be",
    b"<\0": "utf-16-le",
    b"\x4c\x6f\xa7\x94": "cp037",
}
# The encoding that a file's first line declares, in ASCII.
_DECLARED = re.compile(
    rb"\s*<\?xml[^>]*?\bencoding\s*=\s*[\"']([A-Za-z][A-Za-z0-9._-]{,40})[\"']"
)
_ESCAPE = b"\x1b"
_UTF8 = "utf-8-sig"
OWN_COMMENT = "System ID:"
"""Begin of the comments that this program writes."""


@dataclass(eq=False)
class ModelDocument:
    """A model file, URDF or else MJCF, with what it includes; its tree may be changed.

    Attributes:
        path: absolute path of the main file, the one that was read.
        mesh_dir: the user's folder of its meshes, absolute; None where the file's own holds.
        root: root of the tree.
        contents: path of the main file and of each included one to its bytes, in MuJoCo's order.
        sources: element of an included file to the path of that file.
    """

    path: Path
    mesh_dir: Path | None
    root: Node = None
    contents: dict[Path, bytes] = field(default_factory=dict)
    sources: dict[Node, Path] = field(default_factory=dict)

    @property
    def is_urdf(self) -> bool:
        """Whether it is a URDF."""
        return bool(self.root.tag == "robot")

    @property
    def is_utf8(self) -> bool:
        """Whether its files are UTF-8, which is how MuJoCo reads every file."""
        return all(_encoding(raw) == _UTF8 for raw in self.contents.values())

    @property
    def sha256(self) -> str:
        """SHA-256 of the main file's bytes followed by those of the included files."""
        return hashlib.sha256(b"".join(self.contents.values())).hexdigest()

    def settings(self, tag: str) -> list[Node]:
        """Return the elements of MuJoCo's settings with a tag or path; the last one counts most.

        Those of a URDF stand in its ``<mujoco>`` element.
        """
        return self.root.findall(f"mujoco/{tag}" if self.is_urdf else tag)

    def compiler_setting(self, *names: str) -> str | None:
        """Return the last value of any of some attributes of MuJoCo's <compiler>; None for none."""
        value = None
        for node in self.settings("compiler"):
            for name in names:
                value = node.get(name) or value
        return value

    def add_setting(self, node: Node) -> None:
        """Put an element first among MuJoCo's settings, which in a URDF stand in ``<mujoco>``."""
        parent = self.root
        if self.is_urdf:
            # MuJoCo reads one <mujoco> of a URDF only.
            parent = self.root.find("mujoco")
            if parent is None:
                parent = etree.Element("mujoco")
                insert(self.root, 0, parent)
        insert(parent, 0, node)

    def set_compiler(self, values: Mapping[str, str]) -> None:
        """Set attributes of each <compiler>, or add one; that of a URDF loses its meshdir."""
        compilers = self.settings("compiler")
        if not compilers:
            compilers = [etree.Element("compiler")]
            self.add_setting(compilers[0])
        for node in compilers:
            node.attrib.update(values)
            if self.is_urdf:
                node.attrib.pop("meshdir", None)

    def text(self) -> bytes:
        """Return the tree as UTF-8 text, with a declaration and the line ends of the main file."""
        source = _file_text(self.contents[self.path], self.path)
        text = etree.tostring(
            self.root.getroottree(),
            encoding="UTF-8",
            xml_declaration=source.startswith("<?xml"),
        )
        text = text.replace(_MASK.encode(), b"-") + b"\n"
        return text.replace(b"\n", b"\r\n") if "\r\n" in source else text


def read_document(path: Path, mesh_dir: Path | None = None) -> ModelDocument:
    """Read a model file, MJCF (root ``<mujoco>``) or URDF (``<robot>``), and what it includes.

    ModelError where it is not XML, only a fragment of a model, or an include fails.

    Args:
        path: the file.
        mesh_dir: folder that replaces the file's own for meshes (and, in a URDF, its packages).
    """
    document = ModelDocument(path.absolute(), mesh_dir and Path(mesh_dir).absolute())
    root = _read(document.path, document)
    document.root = root
    if root.tag == "sdf":
        raise ModelError(
            f"{document.path} is SDF, Gazebo's format, which MuJoCo does not read: pass the URDF "
            "or xacro that it was made from, or an MJCF, as Gazebo's sdf2mjcf writes"
        )
    required = {"mujoco": "worldbody", "robot": "link"}.get(root.tag)
    if required and root.find(required) is not None:
        refuse_large(document.path, root, lambda path: _parse(_read_bytes(path), path))
        return document
    fault = f"its root is <{root.tag}>, expected <mujoco> (MJCF) or <robot> (URDF)"
    advice = "pass the main model file, the one that includes this one"
    if required:
        fault = f"no <{required}>"
    raise ModelError(
        f"{document.path} is a fragment, not a whole model: {fault}; {advice}"
    )


def _read(path: Path, document: ModelDocument) -> Node:
    """Return the root of a file with its includes in their places, which join the document.

    ModelError where one cannot be read.
    """
    raw = _read_bytes(path)
    refuse_bytes(path, len(raw) + sum(map(len, document.contents.values())))
    root = _parse(raw, path)
    if is_xacro(root):
        raw = expand_xacro(path, document.mesh_dir)
        root = _parse(raw, path)
    document.contents[path] = raw
    # MuJoCo knows no includes in a URDF.
    if root.tag == "robot":
        return root
    for include in list(root.iterdescendants("include")):
        included_path = _included_path(include, path, document)
        included = _read(included_path, document)
        for node in included.iter("*"):
            document.sources.setdefault(node, included_path)
        if included.find("*") is None:
            location = f"{path}, line {include.sourceline}"
            name = include.get("file")
            raise ModelError(f"{location}: included file {name} is empty")
        nodes = list(included)
        nodes[-1].tail = include.tail
        parent = include.getparent()
        index = parent.index(include)
        parent[index : index + 1] = nodes
    return root


def _included_path(include: Node, including: Path, document: ModelDocument) -> Path:
    """Return the path of the file that an ``<include>`` names, or raise ModelError.

    Args:
        including: the file that it stands in.
        document: with the files that were read so far.
    """
    name = include.get("file")
    location = f"{including}, line {include.sourceline}"
    if not name:
        raise ModelError(f"{location}: <include> without a file attribute")
    plain_name = name.replace("\\", "/")
    candidates = (document.path.parent / plain_name, including.parent / plain_name)
    path = next(filter(os.path.isfile, candidates), None)
    if path is None:
        raise ModelError(
            f"{location}: included file {name} not found (looked in {including.parent})"
        )
    if any(os.path.samefile(path, other) for other in document.contents):
        raise ModelError(
            f"{location}: {name} is included twice or includes itself; include it once"
        )
    return path


def _read_bytes(path: Path) -> bytes:
    """Return a model file's content, or raise InputError."""
    require_utf8(path)
    refuse_special_file(path, "pass a model file")
    try:
        refuse_bytes(path, path.stat().st_size)
        return path.read_bytes()
    except IsADirectoryError:
        raise InputError(
            f"{path} is a folder; pass a model file (MJCF .xml, .urdf or .xacro)"
        ) from None
    except FileNotFoundError:
        hint = " (Expected an XML model file: .xml, .mjcf, .urdf or .xacro)"
        hint = "" if path.suffix.lower() in SUFFIXES else hint
        raise InputError(f"model file {path} not found; check the path{hint}") from None
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot read model file {path}: {error_text(error)}"
        ) from None


def _encoding(raw: bytes) -> str:
    """Return the encoding of a file's bytes: as its first bytes say, else UTF-8, else as its
    declaration says, or else Latin-1, as old programs write.

    UTF-8 is tried before what is declared: text in another encoding is hardly ever UTF-8, and a
    declaration may be that of the program that wrote an earlier version.
    """
    encodings = [name for start, name in _BEGINNINGS.items() if raw.startswith(start)]
    # In a file of 7-bit codes that change the alphabet, such as ISO-2022-JP.
    encodings += [] if _ESCAPE in raw else [_UTF8]
    encodings += [match[1].decode() for match in [_DECLARED.match(raw)] if match]
    for name in encodings:
        with contextlib.suppress(LookupError, UnicodeError):
            raw.decode(name)
            return name
    return "latin-1"


def _file_text(raw: bytes, path: Path) -> str:
    """Return a file's bytes as text; ModelError where there are none."""
    if not raw.strip():
        raise ModelError(f"Expected an XML model file, but {path} is empty")
    # MuJoCo tolerates white space before the declaration, strict parsers do not.
    return raw.decode(_encoding(raw)).lstrip("\ufeff").lstrip()


def _parse(raw: bytes, path: Path) -> Node:
    """Return the root of a file's tree, or raise ModelError where it is no XML.

    MuJoCo accepts ``--`` inside a comment and prefixes without a namespace, which strict parsers
    refuse.
    """
    text = _file_text(raw, path)
    if "<!ENTITY" in text.partition("<!DOCTYPE")[2]:
        remedy = "which can hide an attack; remove its <!DOCTYPE ...>"
        raise ModelError(f"{path} declares XML entities, {remedy}")
    masked = _COMMENT.sub(lambda m: m[1] + m[2].replace("-", _MASK) + m[3], text)
    parser = etree.XMLParser(
        encoding="utf-8", resolve_entities=False, no_network=True, recover=True
    )
    root = None
    try:
        root = etree.fromstring(masked.encode(), parser)
    except etree.XMLSyntaxError as error:
        fault = error.msg
    for entry in parser.error_log:
        if entry.domain_name != "NAMESPACE":
            root = None
            # Further lines show what the file contains.
            fault = f"{entry.message.splitlines()[0].strip()}, line {entry.line}"
            break
    if root is None:
        raise ModelError(f"Expected an XML model file, but {path} is not XML: {fault}")
    for node in root.iter("*"):
        if node.prefix is None and node.tag.startswith("{"):
            node.tag = node.tag.rpartition("}")[2]
    return root


def insert(parent: Node, index: int, node: Node) -> None:
    """Insert an element or comment among an element's children, indented as they are."""
    depth = len(list(parent.iterancestors()))
    if isinstance(node.tag, str):
        etree.indent(node, level=depth + 1)
    white_space = re.search(r"\n[ \t]*\Z", parent.text or "")
    node.tail = white_space and white_space[0]
    if 0 < index == len(parent):
        # What stood behind the last one ends the parent.
        last = parent[-1]
        node.tail, last.tail = last.tail, node.tail
    parent.insert(index, node)
    if len(parent) == 1:
        etree.indent(parent, level=depth)


def append(parent: Node, *nodes: Node) -> None:
    """Put elements and comments last into an element."""
    for node in nodes:
        insert(parent, len(parent), node)


def put_inertial(body: Node, text: str) -> None:
    """Put an ``<inertial>`` in place of a body's or link's old one, or else first in it."""
    new = etree.fromstring(text)
    old = body.find("inertial")
    if old is None:
        insert(body, 0, new)
    else:
        new.tail = old.tail
        body.replace(old, new)


def put_comment(node: Node, text: str) -> None:
    """Put a comment before an element, in place of an older comment by this program."""
    old = node.getprevious()
    if old is not None and old.tag is etree.Comment and OWN_COMMENT in old.text:
        old.text = text
    else:
        parent = node.getparent()
        insert(parent, parent.index(node), etree.Comment(text))


def get(node: Node | None, name: str) -> str | None:
    """Return an attribute's value; None where there is no element, or none of that name."""
    return None if node is None else node.get(name)


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
