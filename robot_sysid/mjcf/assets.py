"""The files that a model refers to, and its text for another folder, where it still finds them.

MuJoCo's rule: ``folder of the main file / meshdir (or texturedir) / file``; for an element that an
include brought in, the folder of the file it is written in comes next. Meshes of a URDF are looked
up as ROS does.

An include is kept, with its path rewritten, when the included file needs no folder itself: no
further include, no file reference, no ``meshdir``, and is UTF-8. Otherwise its text takes its
place, because MuJoCo would look for those files relative to the new main file.

Models that MuJoCo must not read, at which it would wait for ever, end the process, take hours or
eat the memory, are refused by their text and by the first bytes of their files.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import BinaryIO

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.documents import (
    SUFFIXES,
    Edits,
    ModelDocument,
    Node,
    SourceFile,
    read_document,
    reference,
)
from robot_sysid.records.file_access import refuse_special_file

_CUBE_SIDES = ("fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
"""Attributes of a texture that name the files of a cube's sides."""
_FILE_ATTRIBUTES = {
    **dict.fromkeys(("mesh", "hfield", "skin", "flexcomp", "model"), ("file",)),
    "texture": ("file", *_CUBE_SIDES),
}
"""Tag of an MJCF element to its attributes that name a file."""
_SCHEME = re.compile(r"^(package|model|file)://")
"""Begin of a mesh's file name that is a URI."""
_FOLDERS = ("assetdir", "meshdir", "texturedir")
"""Attributes of MuJoCo's <compiler> that name a folder of assets."""
_FOLDER_SETTINGS = (*_FOLDERS, "strippath")
"""Attributes of MuJoCo's <compiler> that determine where assets are found."""


@dataclass(frozen=True)
class AssetFolders:
    """Where MuJoCo looks for assets.

    Attributes:
        mesh, texture: absolute path of the folder of meshes, and of that of textures.
        strip: whether MuJoCo drops the folders in the names of files.
        is_override: whether the user said where meshes are.
    """

    mesh: Path
    texture: Path
    strip: bool
    is_override: bool


@dataclass(frozen=True)
class Asset:
    """One reference to a file.

    Attributes:
        node, attribute: the element and its attribute with the reference.
        name: the reference as written.
        path: the file; None if it was not found.
        searched: the folders in which it was looked for.
    """

    node: Node
    attribute: str
    name: str
    path: Path | None
    searched: tuple[Path, ...]


def asset_folders(
    document: ModelDocument, mesh_dir: Path | None = None
) -> AssetFolders:
    """Return where the assets of an MJCF document are; ``mesh_dir`` replaces its meshdir.

    It also replaces a texturedir that is no folder. Of several settings the last one counts.
    """
    mesh = "."
    texture = "."
    strip = "false"
    for compiler in document.settings("compiler"):
        common = compiler.get("assetdir")
        mesh = compiler.get("meshdir") or common or mesh
        texture = compiler.get("texturedir") or common or texture
        strip = compiler.get("strippath") or strip
    meshes = _join(document.path.parent, mesh)
    textures = _join(document.path.parent, texture)
    if mesh_dir is not None:
        meshes = Path(mesh_dir).absolute()
        textures = textures if os.path.isdir(textures) else meshes
    return AssetFolders(meshes, textures, strip.lower() == "true", mesh_dir is not None)


def find_assets(
    document: ModelDocument, mesh_dir: Path | None = None
) -> tuple[Asset, ...]:
    """Return every file reference of a document, with the file where there is one.

    In a URDF, ``package://``, ``model://`` and plain names are looked up in ``mesh_dir``, then in
    the file's folder and every folder above it, with and without the package's name.
    """
    folders = asset_folders(document, mesh_dir)
    assets = []
    for node, attribute in _references(document):
        name = node.get(attribute) or ""
        plain_name = name.replace("\\", "/")
        candidates: Iterator[Path] = iter(())
        if name and document.is_urdf:
            candidates = _urdf_candidates(document, mesh_dir, plain_name)
        elif name:
            candidates = _mjcf_candidates(document, folders, node, plain_name)
        paths = list(dict.fromkeys(candidates))
        path = next(filter(os.path.isfile, paths), None)
        searched = tuple(dict.fromkeys(path.parent for path in paths))
        assets.append(Asset(node, attribute, name, path, searched))
    return tuple(assets)


def _references(document: ModelDocument) -> Iterator[tuple[Node, str]]:
    """Yield the elements that refer to a file, and the attribute that names it."""
    if not document.is_urdf:
        for node in document.walk(*_FILE_ATTRIBUTES):
            names = filter(node.get, _FILE_ATTRIBUTES[node.tag])
            yield from product([node], names)
        return
    for _, shape in urdf_shapes(document):
        meshes = [node for node in shape.walk() if node.tag == "mesh"]
        yield from product(meshes, ["filename"])


def urdf_shapes(document: ModelDocument) -> Iterator[tuple[Node, Node]]:
    """Yield (link, its visual or collision element) for all shapes of a URDF."""
    for link in document.root_children("link"):
        for shape in link.children():
            if shape.tag in ("visual", "collision"):
                yield link, shape


def check_assets(document: ModelDocument, mesh_dir: Path | None = None) -> None:
    """Raise InputError naming the first file a document needs that is missing or a pointer of LFS.

    A URDF does without the missing ones.
    """
    for asset in find_assets(document, mesh_dir):
        if asset.path is not None:
            refuse_special_file(asset.path)
        elif not document.is_urdf:
            listed = ", ".join(map(str, asset.searched))
            is_model = asset.node.tag == "model"
            remedy = "check the path" if is_model else "pass --mesh-dir FOLDER"
            raise ModelError(
                f"{document.path}: {asset.node.tag} file {asset.name} not found "
                f"(looked in {listed}); {remedy}"
            )


def _mjcf_candidates(
    document: ModelDocument, folders: AssetFolders, node: Node, name: str
) -> Iterator[Path]:
    """Yield where a file of an MJCF document may be, the first choice first.

    Args:
        folders: where the document's assets are.
        node: the element that refers to the file.
        name: the reference, with / between folders.
    """
    if node.tag == "model":
        yield _join(document.path.parent, name)
    else:
        name = Path(name).name if folders.strip else name
        yield _join(folders.texture if node.tag == "texture" else folders.mesh, name)
        if folders.is_override:
            # People keep textures beside the meshes, and drop sub-folders when they move both.
            yield _join(folders.mesh, name)
            yield folders.mesh / Path(name).name
            return
    if node.file is not document.main:
        yield _join(node.file.path.parent, name)


def _join(folder: Path, name: str) -> Path:
    """Return the path of a file in a folder, links not followed; of an absolute name, that path."""
    return Path(os.path.normpath(folder / name.replace("\\", "/")))


def _urdf_candidates(
    document: ModelDocument, mesh_dir: Path | None, name: str
) -> Iterator[Path]:
    """Yield where a mesh of a URDF may be, the first choice first.

    ``name``: the reference, with / between folders, such as "package://arm/meshes/link1.stl".
    """
    scheme = _SCHEME.match(name)
    path = Path(name[scheme.end() :] if scheme else name)
    if scheme and scheme.group(1) == "file":
        path = Path("/") / path
    # Behind a scheme, the first folder is the name of a package.
    in_package = Path(*path.parts[1:])
    if mesh_dir is not None:
        folder = Path(mesh_dir).absolute()
        yield from (folder / path, folder / in_package, folder / path.name)
    main_folder = document.path.parent
    for setting in document.settings("compiler"):
        folder = main_folder / (setting.get("meshdir") or ".")
        yield from (folder / path, folder / path.name)
    yield main_folder / path
    if scheme:
        for folder in (main_folder, *main_folder.parents):
            yield from (folder / path, folder / in_package)
    yield main_folder / path.name


def relocated_text(
    edits: Edits, folder: Path | None, mesh_dir: Path | None = None
) -> bytes:
    """Return the UTF-8 text of an edited document as it must read in another folder.

    References to files that were not found stay as they are.

    Args:
        edits: the edits so far; those of paths are added, ``folder`` and ``inlined`` are set.
        folder: where the text will live; None makes every path absolute and inlines all includes.
        mesh_dir: folder of the meshes; default as the file says.
    """
    document = edits.document
    edits.folder = folder
    assets = find_assets(document, mesh_dir)
    if document.is_urdf:
        names = [reference(a.path, folder) if a.path else None for a in assets]
        return _rename_files(edits, assets, names)
    tags = set()
    for asset in assets:
        tags.add(asset.node.tag)
        edits.inlined.add(asset.node.file)
    for file in document.files:
        if folder is None or _needs_folder(file):
            edits.inlined.add(file)
    folders = asset_folders(document, mesh_dir)
    _move_folders(edits, folders, tags)
    names = [_relocated_name(asset, folders, folder) for asset in assets]
    return _rename_files(edits, assets, names)


def _needs_folder(file: SourceFile) -> bool:
    """Return whether a file can only be read from where it lies, so that it has to be inlined.

    It names other files relative to its folder, or its encoding is not UTF-8, as the text of an
    inlined copy is.
    """
    if not file.is_utf8 or file.includes:
        return True
    for node in file.elements:
        if node.tag == "compiler" and any(map(node.get, _FOLDER_SETTINGS)):
            return True
    return False


def bundled_text(document: ModelDocument, names: Mapping[Path, str]) -> bytes:
    """Return the UTF-8 text of a document, all includes inlined, beside copies of its assets.

    ``names``: path of an asset to that of its copy, relative to the text. An MJCF's folder settings
    are removed, as MuJoCo would put them before the copies' paths; those of a URDF are removed with
    its other compiler settings (``Edits.set_compiler``).
    """
    edits = Edits(document)
    edits.inlined = set(document.files)
    if not document.is_urdf:
        for node in document.settings("compiler"):
            for name in _FOLDER_SETTINGS:
                edits.set(node, name, value=None)
    assets = find_assets(document)
    copies = [names[a.path] if a.path else None for a in assets]
    return _rename_files(edits, assets, copies)


def _rename_files(
    edits: Edits, assets: Collection[Asset], names: Collection[str | None]
) -> bytes:
    """Return the text of the edited document with new references to files.

    ``names``: new reference of each asset, None to keep the old one; they are added to ``edits``.
    """
    has_folder = False
    for asset, name in zip(assets, names):
        has_folder |= "/" in (name or asset.name)
        if name is not None:
            edits.set_path(asset.node, asset.attribute, name)
    if edits.document.is_urdf and has_folder:
        # MuJoCo before 3.7 drops the folders of a URDF's mesh names unless told otherwise.
        edits.set_compiler({"strippath": "false"})
    return edits.text()


def _relocated_name(
    asset: Asset, folders: AssetFolders, folder: Path | None
) -> str | None:
    """Return how a document that is moved refers to an asset; None for one that was not found.

    It is relative to the folder of meshes or textures, for an attached model to the document's new
    folder. A reference that is right already stays.

    Args:
        folders: where the document's assets are.
        folder: the document's new folder; None makes the reference absolute.
    """
    if asset.path is None:
        return None
    if asset.node.tag == "model":
        return reference(asset.path, folder)
    asset_folder = folders.texture if asset.node.tag == "texture" else folders.mesh
    if asset.path == _join(asset_folder, asset.name):
        return asset.name
    return reference(asset.path, asset_folder if folder is not None else None)


def _move_folders(edits: Edits, folders: AssetFolders, tags: set[str]) -> None:
    """Make one compiler element name the asset folders as seen from the document's new folder.

    References to assets are relative to these folders. ``strippath`` is switched off.

    Args:
        edits: of an MJCF document; ``edits.folder`` is its new folder.
        folders: where the assets are.
        tags: of the elements that refer to files; all but texture and model use the mesh folder.
    """
    compilers = edits.document.settings("compiler")
    uses_meshes = bool(tags - {"texture", "model"})
    new = {}
    for name, folder, is_used in (
        ("meshdir", folders.mesh, uses_meshes),
        ("texturedir", folders.texture, "texture" in tags),
    ):
        path = reference(folder, edits.folder)
        is_set = any(node.get(name) or node.get("assetdir") for node in compilers)
        if is_set or (is_used and path != "."):
            new[name] = path
    for index, node in enumerate(compilers):
        for name in _FOLDERS:
            # The first compiler element gets the folders, the others lose theirs.
            edits.set_path(node, name, None if index else new.get(name))
        # MuJoCo would drop the folders in the new references.
        if folders.strip and node.get("strippath"):
            edits.set(node, "strippath", "false")
    if new and not compilers:
        edits.set_compiler(new)


MAX_MEMORY = 4e8
"""Memory that textures, height fields, meshes and blocks of numbers may take in MuJoCo together
[bytes]: 66 million pixels; a plan, which copies the model, takes up to four times as much."""
MAX_COPIES = 3000
"""Most copies of an element; MuJoCo's time grows with their square, to a minute for 20 000."""
_NUMBER_BYTES = 16.0
"""Memory per number in MuJoCo [bytes]; this and the next four as measured with MuJoCo 4.0."""
_TEXEL_BYTES = 6.0
"""Memory per pixel of a texture: three colours in the compiler and in the model [bytes]."""
_HEIGHT_BYTES = 16.0
"""Memory per cell of a height field: four floats [bytes]."""
_MEMORY_RATIO = 2.0
"""Memory per byte of a file of any other form, and the least one of a mesh."""
_TRIANGLE_BYTES = 450.0
"""Memory per triangle of a mesh [bytes]: a quarter of what a plan takes, and three times what the
model keeps."""
_FEW_TRIANGLES = 20_000
"""An OBJ file is read line by line only where it may have more triangles."""
_LONGEST_LINE = 100_000
"""Length up to which a line of an OBJ file is cut into words [bytes]."""
_SIZE_ATTRIBUTES = {"hfield": ("nrow", "ncol"), "numeric": ("size",), "user": ("dim",)}
"""Tag to the attributes whose product is a count of numbers."""
_MULTIPLIERS = ("replicate", "composite", "flexcomp")  # elements that make copies
_PNG = b"\x89PNG\r\n\x1a\n"  # first bytes of a PNG file
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Colour type of a PNG file to its numbers per pixel."""
_DEFLATE_RATIO = 1032.0
"""Bytes that come out of one compressed byte at most."""
_STL_BYTES = 50.0
"""Bytes of a triangle in a binary STL file, the only kind that MuJoCo reads."""


def refuse_hazards(
    document: ModelDocument,
    mesh_dir: Path | None = None,
    attaching: tuple[Path, ...] = (),
    memory_of_models: dict[Path, float] | None = None,
) -> float:
    """Return the memory that MuJoCo takes for a model [bytes], or raise ModelError for a hazard.

    Hazards are more memory than ``MAX_MEMORY``, too many copies, a pipe, and a model that attaches
    itself. Attached models are counted by calls of this function with the last two arguments.

    Args:
        document: the model file.
        mesh_dir: folder of the meshes; default as the file says.
        attaching: the models that attach this one, which it may not attach itself.
        memory_of_models: attached model to its memory [bytes]; this function adds to it.
    """
    memory_of_models = {} if memory_of_models is None else memory_of_models
    main = document.path.resolve()
    # Name of an attached model to the number of its copies.
    n_attached = Counter[str]()
    # (memory [bytes], what takes it, in words).
    needs = []
    for node, copies in _walk_with_copies(document, document.root, copies=1.0):
        needs.append((_memory_of_node(node), f"<{node.tag}> in line {node.line}"))
        if node.tag == "attach":
            n_attached[node.get("model") or ""] += math.ceil(copies)
    for asset in find_assets(document, mesh_dir):
        if asset.path is None:
            name = Path(asset.name.replace("\\", "/")).name
            for folder in asset.searched:
                refuse_special_file(folder / name)
            continue
        path = asset.path.resolve()
        tag = asset.node.tag
        form = (asset.node.get("content_type") or path.suffix).lower()
        memory = _memory_of_file(path, tag, form) if os.access(path, os.R_OK) else 0.0
        if tag == "model" and path.suffix.lower() in SUFFIXES:
            if path in (*attaching, main):
                fault = f"attaches itself by way of {asset.name}; take it out"
                raise ModelError(f"{document.path} {fault}")
            if path not in memory_of_models:
                memory_of_models[path] = refuse_hazards(
                    read_document(path), None, (*attaching, main), memory_of_models
                )
            # MuJoCo holds the model itself beside its copies.
            count = 1 + n_attached[asset.node.get("name") or ""]
            memory = memory_of_models[path] * count
        needs.append((memory, asset.name))
    # Each use of a file is read anew; a URDF's uses of a mesh are one.
    counted = {*needs} if document.is_urdf else needs
    total = math.fsum(memory for memory, _ in counted)
    if total > MAX_MEMORY:
        check_assets(document, mesh_dir)
        raise ModelError(
            f"{document.path}: its textures, height fields, meshes and numbers take "
            f"{total / 1e9:.3g} GB when unpacked, more than the {MAX_MEMORY / 1e9:g} GB that are "
            f"read; make them smaller, or take them out (largest: {max(needs)[1]})"
        )
    return total


def _walk_with_copies(
    document: ModelDocument, node: Node, copies: float
) -> Iterator[tuple[Node, float]]:
    """Yield (element, number of its copies) for an element and all below it, or raise ModelError.

    ``copies``: of the element around it. Errors: a % in a class's name; more than ``MAX_COPIES``.
    """
    # MuJoCo takes the name of a class that it does not know for a format of printf.
    if "%" in (node.get("class") or ""):
        fault = f"the class {node.get('class')!r} of a {node.tag} has a % in its name; rename it"
        raise ModelError(f"{document.path}: {fault}")
    if node.tag in _MULTIPLIERS:
        copies *= max(1.0, _product(node.get("count")))
    if copies > MAX_COPIES:
        fault = f"a {node.tag} makes {copies:.3g} copies; at most {MAX_COPIES} are read"
        raise ModelError(f"{document.path}: {fault}")
    yield node, copies
    for child in node.children():
        yield from _walk_with_copies(document, child, copies)


def _memory_of_node(node: Node) -> float:
    """Return the memory that an element asks for by its numbers [bytes]."""
    if node.tag == "size":
        # What is reserved for a simulation is taken only as it is used: a tenth is counted.
        sizes = [0.1 * _reserved_bytes(node)]
        for name, value in node.attributes.items():
            if name != "memory":
                sizes.append(_NUMBER_BYTES * _product(value))
        return max(sizes)
    if node.tag == "texture":
        width = _product(node.get("width"))
        is_flat = node.get("type") == "2d"  # else a cube of six sides
        height = _product(node.get("height")) if is_flat else 6.0 * width
        return _TEXEL_BYTES * width * height
    # An element of any other tag has no attribute "", and a product of 0.
    names = _SIZE_ATTRIBUTES.get(node.tag, ("",))
    return _NUMBER_BYTES * math.prod(map(_product, map(node.get, names)))


def _reserved_bytes(node: Node) -> float:
    """Return the memory that a <size> reserves [bytes]: a number, K, M, G, T, P or E behind it."""
    text = (node.get("memory") or "0").strip()
    power = "KMGTPE".find(text[-1:].upper()) + 1
    return _product(text[: -1 if power else None]) * 1024.0**power


def _product(text: str | None) -> float:
    """Return the product of an attribute's numbers; 0 where it has none, of which MuJoCo warns."""
    try:
        return math.prod(map(float, (text or "0").split()))
    except ValueError:
        return 0.0


def _memory_of_file(path: Path, tag: str, form: str) -> float:
    """Return the memory that a file takes in MuJoCo [bytes].

    Args:
        tag: of the element that refers to the file.
        form: its content type, such as "model/stl", or the end of its name, in lower case.
    """
    size = path.stat().st_size
    if tag == "mesh" and _MEMORY_RATIO * size <= MAX_MEMORY:
        triangles = _count_triangles(path, form)
        return max(_MEMORY_RATIO * size, _TRIANGLE_BYTES * triangles)
    with path.open("rb") as stream:
        # The signature, then a chunk with the size of the image.
        head = stream.read(26)
        is_png = head.startswith(_PNG) and len(head) == 26
        if not is_png or tag not in ("texture", "hfield") or size > MAX_MEMORY:
            # A file of heights holds each as a float of four bytes.
            return size * (_HEIGHT_BYTES / 4.0 if tag == "hfield" else _MEMORY_RATIO)
        width, height, depth, colour_type = struct.unpack(">IIBB", head[16:])
        # Bytes of a row: one that says how it is filtered, then pixels of ``depth`` bits a number.
        row = 1.0 + width * _CHANNELS.get(colour_type, 4) * depth / 8.0
        raw = height * row
        pixel_bytes = _TEXEL_BYTES if tag == "texture" else _HEIGHT_BYTES
        memory = max(2.0 * raw, width * height * pixel_bytes)
        # MuJoCo unpacks all data before it compares their size; twice as much and 1 MB is no fault.
        largest = _DEFLATE_RATIO * size
        if largest > MAX_MEMORY > memory and _unpacks_beyond(stream, 2.0 * raw + 1e6):
            return largest
        return memory


def _count_triangles(path: Path, form: str) -> float:
    """Return how many triangles a mesh has; where they are few, a number that may be too large.

    ``form``: content type of the file, or the end of its name, in lower case: STL, MSH or else OBJ.
    """
    if form.endswith("stl"):
        return path.stat().st_size / _STL_BYTES
    content = path.read_bytes()
    if form.endswith("msh"):
        # The head are four integers, the last one the number of triangles.
        is_complete = len(content) >= 16
        return float(struct.unpack_from("<i", content, 12)[0]) if is_complete else 0.0
    # Faces begin with f; a face of k corners, each after a blank, is k - 2 triangles.
    lines = content.replace(b"\r", b"\n").replace(b"\t", b" ")
    first = max(0, lines.find(b"\nf"))
    at_most = lines.count(b" ", first) - 2 * lines.count(b"\nf", first)
    if at_most <= _FEW_TRIANGLES:
        return at_most
    count = 0
    for line in BytesIO(lines):
        if line.lstrip(b" ").startswith(b"f"):
            # A line is an f and k corners; of a long one all blanks are counted, at least k.
            is_short = len(line) < _LONGEST_LINE
            count += len(line.split()) - 3 if is_short else line.count(b" ")
        if _TRIANGLE_BYTES * count > 4.0 * MAX_MEMORY:
            break
    return count


def _unpacks_beyond(png: BinaryIO, limit: float) -> bool:
    """Return whether the data of a PNG file unpack to more than a limit [bytes].

    At most a megabyte more is unpacked; the position in the file changes.
    """
    unpacker = zlib.decompressobj()
    unpacked = 0
    png.seek(len(_PNG))
    # A chunk is its length, its type, its data and four bytes of their checksum.
    while unpacked <= limit and len(head := png.read(8)) == 8:
        length, chunk_type = struct.unpack(">I4s", head)
        packed = png.read(length) if chunk_type == b"IDAT" else b""
        png.seek(length - len(packed) + 4, os.SEEK_CUR)
        with contextlib.suppress(zlib.error):  # of which MuJoCo warns
            while packed and unpacked <= limit:
                unpacked += len(unpacker.decompress(packed, 1 << 20))
                packed = unpacker.unconsumed_tail
    return unpacked > limit
