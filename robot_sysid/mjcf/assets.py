"""The files that a model refers to, and its tree for another folder, where it still finds them.

MuJoCo's rule: ``folder of the main file / meshdir (or texturedir) / file``; for an element that an
include brought in, the folder of the file it is written in comes next. Meshes of a URDF are looked
up as ROS does.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.documents import ModelDocument, Node, reference
from robot_sysid.records.file_access import refuse_special_file
from robot_sysid.wording import option_name

# Elements of an MJCF that may refer to a file.
_FILE_TAGS = ("mesh", "hfield", "skin", "flexcomp", "model", "texture")
# Attributes of a texture that name the files of a cube's sides.
_CUBE_SIDES = ("fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
# Begin of a mesh's file name that is a URI.
_SCHEME = re.compile(r"^(package|model|file)://")
# Attributes of MuJoCo's <compiler> that determine where assets are found.
_FOLDER_SETTINGS = ("assetdir", "meshdir", "texturedir", "strippath")


@dataclass(frozen=True)
class Asset:
    """One reference to a file.

    Attributes:
        node, attribute: the element and its attribute with the reference.
        name: the reference as written, with / between folders.
        path: the file; None if it was not found.
    """

    node: Node
    attribute: str
    name: str
    path: Path | None


def find_assets(document: ModelDocument) -> list[Asset]:
    """Return every file reference of a document, with the file where there is one.

    InputError where that is a pipe, a device, or a pointer of Git LFS.

    In a URDF, ``package://``, ``model://`` and plain names are looked up in ``mesh_dir``, then in
    the file's folder and every folder above it, with and without the package's name.
    """
    tags = ("mesh",) if document.is_urdf else _FILE_TAGS
    attributes = ("filename",) if document.is_urdf else ("file", *_CUBE_SIDES)
    assets = []
    for node in document.root.iter(*tags):
        for attribute in filter(node.get, attributes):
            name = node.get(attribute).replace("\\", "/")
            if document.is_urdf:
                candidates = _urdf_candidates(document, name)
            else:
                candidates = _mjcf_candidates(document, node, name)
            # A pipe is found, too, so that it can be refused.
            paths = (
                p for p in candidates if os.path.exists(p) and not os.path.isdir(p)
            )
            path = next(paths, None)
            if path is not None:
                refuse_special_file(path)
            assets.append(Asset(node, attribute, name, path))
    return assets


def refuse_missing_assets(document: ModelDocument) -> None:
    """Raise ModelError naming the first file that an MJCF document needs and that is missing."""
    for asset in find_assets(document):
        if asset.path is None:
            raise ModelError(
                f"{document.path}: {asset.node.tag} file {asset.name} not found; check the path, "
                f"or pass {option_name('mesh_dir', 'FOLDER')}"
            )


def _asset_folder(document: ModelDocument, tag: str) -> Path:
    """Return the absolute folder that an MJCF's names of files in elements of a tag start from.

    Its ``mesh_dir`` replaces the meshdir of the document, and a texturedir that is no folder.
    """
    if tag == "model":
        return document.path.parent
    setting = "texturedir" if tag == "texture" else "meshdir"
    name = document.compiler_setting("assetdir", setting) or "."
    folder = _join(document.path.parent, name)
    if tag == "texture" and os.path.isdir(folder):
        return folder
    return document.mesh_dir or folder


def _mjcf_candidates(document: ModelDocument, node: Node, name: str) -> Iterator[Path]:
    """Yield where a file of an MJCF document may be, the first choice first.

    Args:
        node: the element that refers to the file.
        name: the reference, with / between folders.
    """
    is_model = node.tag == "model"
    if document.compiler_setting("strippath") == "true" and not is_model:
        name = Path(name).name
    yield _join(_asset_folder(document, node.tag), name)
    if document.mesh_dir is not None and not is_model:
        # People keep textures beside the meshes, and drop sub-folders when they move both.
        yield _join(document.mesh_dir, name)
        yield document.mesh_dir / Path(name).name
    elif node in document.sources:
        yield _join(document.sources[node].parent, name)


def _join(folder: Path, name: str) -> Path:
    """Return the path of a file in a folder, links not followed; of an absolute name, that path."""
    return Path(os.path.normpath(folder / name.replace("\\", "/")))


def _urdf_candidates(document: ModelDocument, name: str) -> Iterator[Path]:
    """Yield where a mesh of a URDF may be, the first choice first.

    ``name``: the reference, with / between folders, such as "package://arm/meshes/link1.stl".
    """
    scheme = _SCHEME.match(name)
    path = Path(name[scheme.end() :] if scheme else name)
    if scheme and scheme.group(1) == "file":
        path = Path("/") / path
    # Behind a scheme, the first folder is the name of a package.
    in_package = Path(*path.parts[1:])
    folder = document.mesh_dir
    if folder is not None:
        yield from (folder / path, folder / in_package, folder / path.name)
    main_folder = document.path.parent
    folder = main_folder / (document.compiler_setting("meshdir") or ".")
    yield from (folder / path, folder / path.name)
    yield main_folder / path
    if scheme:
        for folder in (main_folder, *main_folder.parents):
            yield from (folder / path, folder / in_package)
    yield main_folder / path.name


def relocate(document: ModelDocument, folder: Path | None) -> None:
    """Make a document find its files from another folder; those not found keep their names.

    Args:
        document: one that was read from its own folder.
        folder: where its text will live; None makes every path absolute.
    """
    # Name of a folder setting to its value in the new folder.
    settings = {}
    for asset in find_assets(document):
        start = folder
        if not document.is_urdf and asset.node.tag != "model":
            old_folder = _asset_folder(document, asset.node.tag)
            if not os.path.isabs(asset.name):
                setting = "texturedir" if asset.node.tag == "texture" else "meshdir"
                settings[setting] = reference(old_folder, folder)
            if asset.path == _join(old_folder, asset.name):
                continue
            start = old_folder if folder else None
        if asset.path is not None:
            asset.node.set(asset.attribute, reference(asset.path, start))
    if document.is_urdf:
        names = [mesh.get("filename", "") for mesh in document.root.iter("mesh")]
        if any("/" in name for name in names):
            # MuJoCo before 3.7 drops the folders of a URDF's mesh names unless told otherwise.
            document.set_compiler({"strippath": "false"})
        return
    settings = {name: path for name, path in settings.items() if path != "."}
    for node in document.settings("compiler"):
        for name in {*_FOLDER_SETTINGS} - {*settings}:
            node.attrib.pop(name, None)
    if settings:
        document.set_compiler(settings)
