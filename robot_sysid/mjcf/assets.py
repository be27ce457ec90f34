"""The files that a model refers to, and its tree for another folder, where it still finds them.

MuJoCo's rule: ``folder of the main file / meshdir (or texturedir) / file``; for an element that an
include brought in, the folder of the file it is written in comes next. Meshes of a URDF are looked
up as ROS does.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.documents import ModelDocument, Node, reference
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
_FOLDER_SETTINGS = ("assetdir", "meshdir", "texturedir", "strippath")
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
        # A pipe is found, too, so that it can be refused.
        found = (p for p in paths if os.path.exists(p) and not os.path.isdir(p))
        path = next(found, None)
        searched = tuple(dict.fromkeys(path.parent for path in paths))
        assets.append(Asset(node, attribute, name, path, searched))
    return tuple(assets)


def _references(document: ModelDocument) -> Iterator[tuple[Node, str]]:
    """Yield the elements that refer to a file, and the attribute that names it."""
    if not document.is_urdf:
        for node in document.root.iter(*_FILE_ATTRIBUTES):
            names = filter(node.get, _FILE_ATTRIBUTES[node.tag])
            yield from product([node], names)
        return
    for _, shape in urdf_shapes(document):
        yield from product(shape.iter("mesh"), ["filename"])


def urdf_shapes(document: ModelDocument) -> Iterator[tuple[Node, Node]]:
    """Yield (link, its visual or collision element) for all shapes of a URDF."""
    for link in document.root.findall("link"):
        for shape in link.iterchildren("visual", "collision"):
            yield link, shape


def refuse_special_assets(document: ModelDocument, mesh_dir: Path | None) -> None:
    """Raise InputError where a document refers to a pipe, a device, or a pointer of Git LFS."""
    for asset in find_assets(document, mesh_dir):
        if asset.path is not None:
            refuse_special_file(asset.path)


def refuse_missing_assets(document: ModelDocument, mesh_dir: Path | None) -> None:
    """Raise ModelError naming the first file that an MJCF document needs and that is missing."""
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
    if node in document.sources:
        yield _join(document.sources[node].parent, name)


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


def relocate(
    document: ModelDocument, folder: Path | None, mesh_dir: Path | None = None
) -> None:
    """Make a document find its files from another folder; those not found keep their names.

    Args:
        document: one that was read from its own folder.
        folder: where its text will live; None makes every path absolute.
        mesh_dir: folder of the meshes; default as the file says.
    """
    assets = find_assets(document, mesh_dir)
    if document.is_urdf:
        for asset in assets:
            if asset.path is not None:
                asset.node.set(asset.attribute, reference(asset.path, folder))
        if any("/" in asset.node.get(asset.attribute, "") for asset in assets):
            # MuJoCo before 3.7 drops the folders of a URDF's mesh names unless told otherwise.
            document.set_compiler({"strippath": "false"})
        return
    folders = asset_folders(document, mesh_dir)
    kinds = {a.node.tag for a in assets if not os.path.isabs(a.name)}
    values = {}
    for name, asset_folder, is_used in (
        ("meshdir", folders.mesh, kinds - {"texture", "model"}),
        ("texturedir", folders.texture, "texture" in kinds),
    ):
        path = reference(asset_folder, folder)
        if is_used and path != ".":
            values[name] = path
    _set_folders(document, values)
    for asset in assets:
        if asset.path is None:
            continue
        asset_folder = folders.texture if asset.node.tag == "texture" else folders.mesh
        if asset.node.tag == "model":
            asset.node.set(asset.attribute, reference(asset.path, folder))
        elif asset.path != _join(asset_folder, asset.name):
            # Relative to the folder of its kind.
            name = reference(asset.path, asset_folder if folder else None)
            asset.node.set(asset.attribute, name)


def _set_folders(document: ModelDocument, values: Mapping[str, str]) -> None:
    """Have one compiler element of an MJCF name the folders of assets, and drop none in names."""
    compilers = document.settings("compiler")
    for index, node in enumerate(compilers):
        for name in _FOLDER_SETTINGS:
            if name in values and index == 0:
                node.set(name, values[name])
            else:
                node.attrib.pop(name, None)
    if values and not compilers:
        document.set_compiler(values)
