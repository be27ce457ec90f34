"""The files that a model refers to: meshes, textures, other models.

MuJoCo's rule: ``folder of the main file / meshdir (or texturedir) / file``; for an element that an
include brought in, the folder of the file it is written in comes next. What a URDF names is sought
as ROS does.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.documents import ModelDocument, Node

_CUBE_SIDES = ("fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
_ATTRIBUTES: dict[str, tuple[str, ...]] = dict.fromkeys(
    ("mesh", "hfield", "skin", "flexcomp", "model"), ("file",)
)
SHAPES = ("visual", "collision")
_SCHEME = re.compile(r"^(package|model|file)://")
_ATTRIBUTES["texture"] = ("file", *_CUBE_SIDES)


@dataclass(frozen=True)
class AssetFolders:
    """Where MuJoCo looks for assets; ``mesh_overridden``: the user said where meshes are."""

    mesh: Path
    texture: Path
    strip: bool
    mesh_overridden: bool


@dataclass(frozen=True)
class Asset:
    """One reference to a file; its path is None if it was not found."""

    node: Node
    attribute: str
    name: str
    path: Path | None
    looked_in: tuple[Path, ...]


def asset_folders(document: ModelDocument, mesh_dir: Path | None = None) -> AssetFolders:
    """Return where the assets of an MJCF document are; ``mesh_dir`` replaces its meshdir."""
    mesh = texture = "."
    strip = False
    for compiler in document.compilers():
        both = compiler.get("assetdir")
        mesh = compiler.get("meshdir") or both or mesh
        texture = compiler.get("texturedir") or both or texture
        strip = (compiler.get("strippath") or str(strip)).lower() == "true"
    base = document.folder
    chosen = _joined(base, mesh) if mesh_dir is None else Path(mesh_dir).absolute()
    textures = _joined(base, texture)
    if mesh_dir is not None and not os.path.isdir(textures):
        textures = chosen
    return AssetFolders(chosen, textures, strip, mesh_dir is not None)


def find_assets(document: ModelDocument, mesh_dir: Path | None = None) -> tuple[Asset, ...]:
    """Return every file reference of a document, resolved.

    In a URDF, ``package://``, ``model://`` and plain names are looked up in ``mesh_dir``, then in
    the file's folder and every folder above it, with and without the package's name.
    """
    if document.kind == "urdf":
        shapes = (node for link in document.tagged("link") for node in link.children())
        meshes = (n for shape in shapes if shape.tag in SHAPES for n in shape.walk())
        named = [(n, n.get("filename") or "") for n in meshes if n.tag == "mesh"]
        return tuple(
            Asset(node, "filename", name, find_mesh(document, name, mesh_dir), ())
            for node, name in named
        )
    folders = asset_folders(document, mesh_dir)
    return tuple(
        _resolve(document, folders, node, attribute, node.get(attribute) or "")
        for node in document.walk()
        for attribute in _ATTRIBUTES.get(node.tag, ())
        if node.get(attribute)
    )


def check_assets(document: ModelDocument, mesh_dir: Path | None = None) -> None:
    """Raise ModelError naming the first file an MJCF document needs that does not exist."""
    for asset in find_assets(document, mesh_dir):
        if asset.path is None:
            looked = ", ".join(str(folder) for folder in asset.looked_in)
            remedy = "check the path" if asset.node.tag == "model" else "pass --mesh-dir FOLDER"
            raise ModelError(
                f"{document.path}: {asset.node.tag} file {asset.name} not found "
                f"(looked in {looked}); {remedy}"
            )


def _resolve(
    document: ModelDocument, folders: AssetFolders, node: Node, attribute: str, name: str
) -> Asset:
    wanted = name.replace("\\", "/")
    if folders.strip and node.tag != "model":
        wanted = Path(wanted).name
    tried = tuple(dict.fromkeys(_candidates(document, folders, node, wanted)))
    path = next((p for p in tried if os.path.isfile(p)), None)
    return Asset(node, attribute, name, path, tuple(dict.fromkeys(p.parent for p in tried)))


def _candidates(
    document: ModelDocument, folders: AssetFolders, node: Node, name: str
) -> Iterator[Path]:
    own = {"model": document.folder, "texture": folders.texture}
    yield _joined(own.get(node.tag, folders.mesh), name)
    if folders.mesh_overridden and node.tag != "model":
        # People keep textures beside the meshes, and drop sub-folders when they move both.
        yield _joined(folders.mesh, name)
        yield folders.mesh / Path(name).name
    elif node.file is not document.main:
        yield _joined(node.file.path.parent, name)


def _joined(folder: Path, name: str) -> Path:
    """Join without following links; an absolute name wins."""
    return Path(os.path.normpath(folder / name.replace("\\", "/")))


def find_mesh(document: ModelDocument, name: str, mesh_dir: Path | None = None) -> Path | None:
    """Return the file a URDF mesh name means, or None."""
    if not name:
        return None
    candidates = _mesh_candidates(document, name.replace("\\", "/"), mesh_dir)
    return next((path for path in candidates if os.path.isfile(path)), None)


def _mesh_candidates(document: ModelDocument, name: str, mesh_dir: Path | None) -> Iterator[Path]:
    scheme = _SCHEME.match(name)
    rest = Path(name[scheme.end() :] if scheme else name)
    if scheme and scheme.group(1) == "file":
        rest = Path("/") / rest
    inside = Path(*rest.parts[1:])
    if mesh_dir is not None:
        folder = Path(mesh_dir).absolute()
        yield from (folder / rest, folder / inside, folder / rest.name)
    own = document.folder
    for setting in document.compilers():
        own_meshes = own / (setting.get("meshdir") or ".")
        yield from (own_meshes / rest, own_meshes / rest.name)
    yield own / rest
    if scheme:
        for folder in (own, *own.parents):
            yield from (folder / rest, folder / inside)
    yield own / rest.name
