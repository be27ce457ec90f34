"""The files that a model refers to, and its text for another folder, so that it finds them there.

MuJoCo's rule: ``folder of the main file / meshdir (or texturedir) / file``; for an element that an
include brought in, the folder of the file it is written in comes next. What a URDF names is sought
as ROS does.

An include is kept, with its path rewritten, when the included file needs no folder itself: no
further include, no file reference, no ``meshdir``, and is UTF-8. Otherwise its text takes its
place, because MuJoCo would look for those files relative to the new main file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.documents import Edits, ModelDocument, Node, reference

_CUBE_SIDES = ("fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
_ATTRIBUTES: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("mesh", "hfield", "skin", "flexcomp", "model"), ("file",)),
    "texture": ("file", *_CUBE_SIDES),
}
SHAPES = ("visual", "collision")
_SCHEME = re.compile(r"^(package|model|file)://")
_FOLDERS = ("assetdir", "meshdir", "texturedir")


@dataclass(frozen=True)
class AssetFolders:
    """Where MuJoCo looks for assets; ``given``: the user said where meshes are."""

    mesh: Path
    texture: Path
    strip: bool
    given: bool


@dataclass(frozen=True)
class Asset:
    """One reference to a file; its path is None if it was not found."""

    node: Node
    attribute: str
    name: str
    path: Path | None
    looked_in: tuple[Path, ...]


def asset_folders(
    document: ModelDocument, mesh_dir: Path | None = None
) -> AssetFolders:
    """Return where the assets of an MJCF document are; ``mesh_dir`` replaces its meshdir."""
    mesh = "."
    texture = "."
    strip = "false"
    for compiler in document.settings("compiler"):
        both = compiler.get("assetdir")
        mesh = compiler.get("meshdir") or both or mesh
        texture = compiler.get("texturedir") or both or texture
        strip = compiler.get("strippath") or strip
    given = None if mesh_dir is None else Path(mesh_dir).absolute()
    meshes, textures = (_joined(document.path.parent, name) for name in (mesh, texture))
    if given is not None:
        meshes = given
        textures = textures if os.path.isdir(textures) else given
    return AssetFolders(meshes, textures, strip.lower() == "true", given is not None)


def find_assets(
    document: ModelDocument, mesh_dir: Path | None = None
) -> tuple[Asset, ...]:
    """Return every file reference of a document, resolved.

    In a URDF, ``package://``, ``model://`` and plain names are looked up in ``mesh_dir``, then in
    the file's folder and every folder above it, with and without the package's name.
    """
    candidates: Callable[[Node, str], Iterator[Path]]
    if document.kind == "urdf":
        shapes = (node for link in document.tagged("link") for node in link.children())
        inner = (
            node for shape in shapes if shape.tag in SHAPES for node in shape.walk()
        )
        uses = [(node, "filename") for node in inner if node.tag == "mesh"]
        candidates = partial(_in_packages, document, mesh_dir)
    else:
        every = (
            (node, name)
            for node in document.walk()
            for name in _ATTRIBUTES.get(node.tag, ())
        )
        uses = [(node, name) for node, name in every if node.get(name)]
        candidates = partial(_in_folders, document, asset_folders(document, mesh_dir))
    found = []
    for node, attribute in uses:
        name = node.get(attribute) or ""
        tried = dict.fromkeys(candidates(node, name.replace("\\", "/")) if name else ())
        path = next((path for path in tried if os.path.isfile(path)), None)
        looked_in = tuple(dict.fromkeys(path.parent for path in tried))
        found.append(Asset(node, attribute, name, path, looked_in))
    return tuple(found)


def check_assets(document: ModelDocument, mesh_dir: Path | None = None) -> None:
    """Raise ModelError naming the first file an MJCF document needs that does not exist."""
    for asset in find_assets(document, mesh_dir):
        if asset.path is None:
            looked = ", ".join(str(folder) for folder in asset.looked_in)
            remedy = (
                "check the path"
                if asset.node.tag == "model"
                else "pass --mesh-dir FOLDER"
            )
            raise ModelError(
                f"{document.path}: {asset.node.tag} file {asset.name} not found "
                f"(looked in {looked}); {remedy}"
            )


def _in_folders(
    document: ModelDocument, folders: AssetFolders, node: Node, name: str
) -> Iterator[Path]:
    """Yield where a file of an MJCF document may be."""
    if node.tag == "model":
        yield _joined(document.path.parent, name)
    else:
        name = Path(name).name if folders.strip else name
        yield _joined(folders.texture if node.tag == "texture" else folders.mesh, name)
        if folders.given:
            # People keep textures beside the meshes, and drop sub-folders when they move both.
            yield from (_joined(folders.mesh, name), folders.mesh / Path(name).name)
            return
    if node.file is not document.main:
        yield _joined(node.file.path.parent, name)


def _joined(folder: Path, name: str) -> Path:
    """Join without following links; an absolute name wins."""
    return Path(os.path.normpath(folder / name.replace("\\", "/")))


def _in_packages(
    document: ModelDocument, mesh_dir: Path | None, node: Node, name: str
) -> Iterator[Path]:
    """Yield where a mesh of a URDF may be."""
    scheme = _SCHEME.match(name)
    rest = Path(name[scheme.end() :] if scheme else name)
    if scheme and scheme.group(1) == "file":
        rest = Path("/") / rest
    inside = Path(*rest.parts[1:])
    if mesh_dir is not None:
        folder = Path(mesh_dir).absolute()
        yield from (folder / rest, folder / inside, folder / rest.name)
    own = document.path.parent
    for setting in document.settings("compiler"):
        own_meshes = own / (setting.get("meshdir") or ".")
        yield from (own_meshes / rest, own_meshes / rest.name)
    yield own / rest
    if scheme:
        for folder in (own, *own.parents):
            yield from (folder / rest, folder / inside)
    yield own / rest.name


def relocated_text(
    edits: Edits, folder: Path | None, mesh_dir: Path | None = None
) -> bytes:
    """Return the UTF-8 text of an edited document as it must read in another folder; None makes
    every path absolute and inlines all includes. References that cannot be found stay as they are.
    """
    document = edits.document
    edits.folder = folder
    assets = find_assets(document, mesh_dir)
    if document.kind == "urdf":
        return _renamed(
            edits, [(a, reference(a.path, folder) if a.path else None) for a in assets]
        )
    needing = {asset.node.file for asset in assets}
    for file in document.files:
        compilers = (node for node in file.elements if node.tag == "compiler")
        sets_folder = any(
            each.get(a) for each in compilers for a in (*_FOLDERS, "strippath")
        )
        if (
            folder is None
            or not file.is_utf8
            or file.includes
            or sets_folder
            or file in needing
        ):
            edits.inlined.add(file)
    folders = asset_folders(document, mesh_dir)
    _move_folders(edits, folders, {asset.node.tag for asset in assets})
    return _renamed(edits, [(a, _new_name(a, folders, folder)) for a in assets])


def bundled_text(document: ModelDocument, names: Mapping[Path, str]) -> bytes:
    """Return the UTF-8 text of a document, all includes inlined, beside copies of its assets:
    ``names`` gives each one's path relative to the text.
    """
    edits = Edits(document)
    edits.inlined = set(document.files)
    for node in document.settings("compiler") if document.kind == "mjcf" else ():
        for name in (*_FOLDERS, "strippath"):
            edits.set(node, name, None)
    return _renamed(
        edits, [(a, names[a.path] if a.path else None) for a in find_assets(document)]
    )


def _renamed(edits: Edits, assets: Collection[tuple[Asset, str | None]]) -> bytes:
    """Return the text with these names for its files; None keeps the one that is there."""
    for asset, name in assets:
        if name is not None:
            edits.set_path(asset.node, asset.attribute, name)
    if edits.document.kind == "urdf" and any(
        "/" in (name or a.name) for a, name in assets
    ):
        # MuJoCo before 3.7 drops the folders of a URDF's mesh names unless told otherwise.
        edits.set_compiler({"strippath": "false"})
    return edits.text()


def _new_name(asset: Asset, folders: AssetFolders, folder: Path | None) -> str | None:
    """Return how a file is named from the asset folder; it keeps a name that is right there."""
    base = folders.texture if asset.node.tag == "texture" else folders.mesh
    if asset.path is None:
        return None
    if asset.node.tag == "model":
        return reference(asset.path, folder)
    if asset.path == _joined(base, asset.name):
        return asset.name
    return reference(asset.path, base if folder is not None else None)


def _move_folders(edits: Edits, folders: AssetFolders, tags: set[str]) -> None:
    """Make one compiler element name the asset folders as seen from the new place."""
    used = {
        "meshdir": bool(tags - {"texture", "model"}),
        "texturedir": "texture" in tags,
    }
    compilers = edits.document.settings("compiler")
    named = {
        n for node in compilers for n in used if node.get(n) or node.get("assetdir")
    }
    places = dict(
        zip(used, (reference(f, edits.folder) for f in (folders.mesh, folders.texture)))
    )
    places = {n: p for n, p in places.items() if n in named or (used[n] and p != ".")}
    for number, node in enumerate(compilers):
        for name in _FOLDERS:
            edits.set_path(node, name, None if number else places.get(name))
        if folders.strip and node.get("strippath"):
            edits.set(node, "strippath", "false")
    if places and not compilers:
        edits.set_compiler(places)
