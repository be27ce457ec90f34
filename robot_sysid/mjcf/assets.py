"""The files an MJCF model refers to - meshes, textures, other models - and where they are.

MuJoCo's rule: ``folder of the main file / meshdir (or texturedir) / file``; for an element that an
include brought in, the folder of the file it is written in comes next.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.documents import ModelDocument, Node

_CUBE_SIDES = ("fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
_ATTRIBUTES = {
    "mesh": ("file",),
    "hfield": ("file",),
    "skin": ("file",),
    "flexcomp": ("file",),
    "texture": ("file", *_CUBE_SIDES),
    "model": ("file",),
}


@dataclass(frozen=True)
class AssetFolders:
    """Where MuJoCo looks for assets.

    Attributes:
        mesh, texture: absolute folders.
        strip: whether folders in the file attributes are ignored.
        mesh_overridden: whether ``mesh`` came from the user instead of the file.
    """

    mesh: Path
    texture: Path
    strip: bool
    mesh_overridden: bool


@dataclass(frozen=True)
class Asset:
    """One reference to a file.

    Attributes:
        node: the element with the reference.
        attribute: the attribute that names the file.
        name: what the attribute says.
        path: the file; None if it was not found.
        looked_in: the folders that were tried.
    """

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
    """Return every file reference of an MJCF document, resolved."""
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
    if folders.strip and node.tag != "model":
        wanted = Path(name.replace("\\", "/")).name
    else:
        wanted = name.replace("\\", "/")
    tried = tuple(dict.fromkeys(_candidates(document, folders, node, wanted)))
    path = next((p for p in tried if os.path.isfile(p)), None)
    return Asset(node, attribute, name, path, tuple(dict.fromkeys(p.parent for p in tried)))


def _candidates(
    document: ModelDocument, folders: AssetFolders, node: Node, name: str
) -> Iterator[Path]:
    if node.tag == "model":
        yield _joined(document.folder, name)
    elif node.tag == "texture":
        yield _joined(folders.texture, name)
    else:
        yield _joined(folders.mesh, name)
    if folders.mesh_overridden and node.tag != "model":
        # People keep textures beside the meshes, and drop sub-folders when they move both.
        yield _joined(folders.mesh, name)
        yield folders.mesh / Path(name).name
    elif node.file is not document.main:
        yield _joined(node.file.path.parent, name)


def _joined(folder: Path, name: str) -> Path:
    """Join without following links; an absolute name wins."""
    return Path(os.path.normpath(folder / name.replace("\\", "/")))
