"""The files that a model refers to, and the model's text for another folder, where it still finds
them.

MuJoCo's rule: ``folder of the main file / meshdir (or texturedir) / file``; for an element that an
include brought in, the folder of the file it is written in comes next. Meshes of a URDF are looked
up as ROS does.

An include is kept, with its path rewritten, when the included file needs no folder itself: no
further include, no file reference, no ``meshdir``, and is UTF-8. Otherwise its text takes its
place, because MuJoCo would look for those files relative to the new main file.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.documents import Edits, ModelDocument, Node, SourceFile, reference

_CUBE_SIDES = ("fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
"""Attributes of a texture that name the files of a cube's sides."""
_FILE_ATTRIBUTES = {
    **dict.fromkeys(("mesh", "hfield", "skin", "flexcomp", "model"), ("file",)),
    "texture": ("file", *_CUBE_SIDES),
}
"""Tag of an MJCF element to its attributes that name a file."""
SHAPES = ("visual", "collision")
"""Tags of a URDF's elements that contain meshes."""
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
        strip: whether it drops the folders in the names of files.
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
    """Return where the assets of an MJCF document are; ``mesh_dir`` replaces its meshdir."""
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
            names = _FILE_ATTRIBUTES[node.tag]
            yield from ((node, name) for name in names if node.get(name))
        return
    for link in document.root_children("link"):
        for shape in link.children():
            nodes = shape.walk() if shape.tag in SHAPES else ()
            yield from ((node, "filename") for node in nodes if node.tag == "mesh")


def check_assets(document: ModelDocument, mesh_dir: Path | None = None) -> None:
    """Raise ModelError naming the first file an MJCF document needs that does not exist."""
    for asset in find_assets(document, mesh_dir):
        if asset.path is None:
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
    """Yield where a file of an MJCF document may be, the first choice first."""
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
    """Return a folder's file without following links; an absolute name wins."""
    return Path(os.path.normpath(folder / name.replace("\\", "/")))


def _urdf_candidates(
    document: ModelDocument, mesh_dir: Path | None, name: str
) -> Iterator[Path]:
    """Yield where a mesh of a URDF may be, the first choice first."""
    scheme = _SCHEME.match(name)
    path = Path(name[scheme.end() :] if scheme else name)
    if scheme and scheme.group(1) == "file":
        path = Path("/") / path
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

    None makes every path absolute and inlines all includes. References to files that were not found
    stay as they are.
    """
    document = edits.document
    edits.folder = folder
    assets = find_assets(document, mesh_dir)
    if document.is_urdf:
        paths = [reference(a.path, folder) if a.path else None for a in assets]
        return _rename_files(edits, assets, paths)
    for file in document.files:
        has_assets = any(asset.node.file is file for asset in assets)
        if folder is None or has_assets or _needs_folder(file):
            edits.inlined.add(file)
    folders = asset_folders(document, mesh_dir)
    _move_folders(edits, folders, {asset.node.tag for asset in assets})
    paths = [_relocated_name(asset, folders, folder) for asset in assets]
    return _rename_files(edits, assets, paths)


def _needs_folder(file: SourceFile) -> bool:
    """Return whether a file's includes, asset folders or encoding bind it to its folder."""
    if not file.is_utf8 or file.includes:
        return True
    compilers = [node for node in file.elements if node.tag == "compiler"]
    return any(any(map(node.get, _FOLDER_SETTINGS)) for node in compilers)


def bundled_text(document: ModelDocument, names: Mapping[Path, str]) -> bytes:
    """Return the UTF-8 text of a document, all includes inlined, beside copies of its assets.

    ``names`` has the path of each asset's copy, relative to the text.
    """
    edits = Edits(document)
    edits.inlined = set(document.files)
    if not document.is_urdf:
        for node in document.settings("compiler"):
            for name in _FOLDER_SETTINGS:
                edits.set(node, name, None)
    assets = find_assets(document)
    copies = [names[a.path] if a.path else None for a in assets]
    return _rename_files(edits, assets, copies)


def _rename_files(
    edits: Edits, assets: Collection[Asset], names: Collection[str | None]
) -> bytes:
    """Return the text with a new name for the file of each asset; None keeps the old one."""
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
    """Return an asset's name relative to its asset folder; a name that is right there stays."""
    asset_folder = folders.texture if asset.node.tag == "texture" else folders.mesh
    if asset.path is None:
        return None
    if asset.node.tag == "model":
        return reference(asset.path, folder)
    if asset.path == _join(asset_folder, asset.name):
        return asset.name
    return reference(asset.path, asset_folder if folder is not None else None)


def _move_folders(edits: Edits, folders: AssetFolders, tags: set[str]) -> None:
    """Make one compiler element name the asset folders as seen from the new place.

    ``tags``: of the elements that refer to files.
    """
    compilers = edits.document.settings("compiler")
    new: dict[str, str] = {}
    for name, folder, is_used in (
        ("meshdir", folders.mesh, bool(tags - {"texture", "model"})),
        ("texturedir", folders.texture, "texture" in tags),
    ):
        path = reference(folder, edits.folder)
        is_set = any(node.get(name) or node.get("assetdir") for node in compilers)
        if is_set or (is_used and path != "."):
            new[name] = path
    for index, node in enumerate(compilers):
        for name in _FOLDERS:
            # The first compiler element gets them, all others lose theirs.
            edits.set_path(node, name, None if index else new.get(name))
        if folders.strip and node.get("strippath"):
            edits.set(node, "strippath", "false")
    if new and not compilers:
        edits.set_compiler(new)
