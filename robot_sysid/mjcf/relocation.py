"""A model's text for another folder, so that it still finds the files it refers to.

An include is kept, with its path rewritten, when the included file needs no folder itself: no
further include, no file reference, no ``meshdir``, and is UTF-8. Otherwise its text takes its
place, because MuJoCo would look for those files relative to the new main file.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path

from robot_sysid.mjcf.assets import Asset, AssetFolders, asset_folders, find_assets
from robot_sysid.mjcf.documents import ModelDocument, Node, local_name
from robot_sysid.mjcf.edits import Edits, reference

_FOLDER_ATTRIBUTES = ("assetdir", "meshdir", "texturedir", "strippath")


def relocated_text(edits: Edits, folder: Path | None, mesh_dir: Path | None = None) -> bytes:
    """Return the UTF-8 text of an edited document as it must read in another folder.

    References that can be found name the file as seen from there; the others stay as they are.

    Args:
        folder: where the text will live; None makes every path absolute and inlines all includes.
    """
    document, edits.folder = edits.document, folder
    assets = find_assets(document, mesh_dir)
    if document.kind == "urdf":
        return _with_names(
            edits, [(a, reference(a.path, folder) if a.path else None) for a in assets]
        )
    needing = {asset.node.file.path for asset in assets}
    for file in document.files:
        compilers = (each for each in file.elements if local_name(each) == "compiler")
        sets_folder = any(each.get(a) for each in compilers for a in _FOLDER_ATTRIBUTES)
        needs_folder = file.includes or sets_folder or file.path in needing
        if folder is None or not file.is_utf8 or needs_folder:
            edits.inlined.add(file.path)
    folders = asset_folders(document, mesh_dir)
    _move_folders(edits, folders, {asset.node.tag for asset in assets})
    return _with_names(edits, [(a, _new_name(a, folders, folder)) for a in assets])


def bundled_text(document: ModelDocument, names: Mapping[Path, str]) -> bytes:
    """Return the UTF-8 text of a document that stands alone beside copies of its assets.

    Args:
        document: the model; all that it includes is inlined.
        names: asset file to its copy's path, relative to the text.
    """
    edits = Edits(document)
    edits.inlined = {file.path for file in document.files}
    for node in document.compilers() if document.kind == "mjcf" else ():
        for name in _FOLDER_ATTRIBUTES:
            edits.set(node, name, None)
    return _with_names(
        edits, [(a, names[a.path] if a.path else None) for a in find_assets(document)]
    )


def _with_names(edits: Edits, assets: Collection[tuple[Asset, str | None]]) -> bytes:
    """Return the text with these names for its files; None keeps the one that is there."""
    for asset, name in assets:
        if name is not None:
            edits.set_path(asset.node, asset.attribute, name)
    if edits.document.kind == "urdf" and any("/" in (name or a.name) for a, name in assets):
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
    if asset.path == Path(os.path.normpath(base / asset.name.replace("\\", "/"))):
        return asset.name
    return reference(asset.path, base if folder is not None else None)


def _move_folders(edits: Edits, folders: AssetFolders, tags: set[str]) -> None:
    """Make the compiler elements name the asset folders as seen from the new place."""
    ours = {"meshdir": folders.mesh, "texturedir": folders.texture}
    places = {name: reference(place, edits.folder) for name, place in ours.items()}
    compilers = edits.document.compilers()
    for node in compilers:
        for name, value in _new_folder_attributes(node, places).items():
            edits.set_path(node, name, value)
    needed = {"meshdir"} if tags - {"texture", "model"} else set()
    needed |= {"texturedir"} if "texture" in tags else set()
    named = {n for node in compilers for n in needed if node.get(n) or node.get("assetdir")}
    missing = {name: places[name] for name in sorted(needed - named) if places[name] != "."}
    if missing:
        edits.set_compiler(missing)


def _new_folder_attributes(node: Node, places: Mapping[str, str]) -> dict[str, str | None]:
    """Return what a compiler element's folder attributes become; None removes one."""
    values: dict[str, str | None] = {name: places[name] for name in places if node.get(name)}
    if (node.get("strippath") or "").lower() == "true":
        values["strippath"] = "false"
    if node.get("assetdir"):
        # meshdir and texturedir may have to differ now, so both are named.
        values.update({"assetdir": None, **places})
    return values
