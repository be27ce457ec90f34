"""The files an MJCF model refers to (meshes, textures, other models), its text for another folder.

MuJoCo's rule: ``folder of the main file / meshdir (or texturedir) / file``; for an element that an
include brought in, the folder of the file it is written in comes next.

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
from robot_sysid.mjcf import markup
from robot_sysid.mjcf.documents import ModelDocument, Node, SourceFile, local_name
from robot_sysid.mjcf.markup import Edit, quoted

_CUBE_SIDES = ("fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
_ATTRIBUTES: dict[str, tuple[str, ...]] = dict.fromkeys(
    ("mesh", "hfield", "skin", "flexcomp", "model"), ("file",)
)
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


_FOLDER_ATTRIBUTES = ("assetdir", "meshdir", "texturedir", "strippath")
_DECLARED_ENCODING = re.compile(rb"""\A(<\?xml[^>]*encoding\s*=\s*["'])[^"']*(["'])""")
Edits = Mapping[Path, Collection[Edit]]


def relocated_text(
    document: ModelDocument,
    folder: Path | None,
    mesh_dir: Path | None = None,
    extra: Edits | None = None,
    inline: Collection[Path] = (),
) -> bytes:
    """Return the UTF-8 text of an MJCF document as it must read in another folder.

    Args:
        folder: where the text will live; None makes every path absolute and inlines all includes.
        inline: included files whose text must take the place of their ``<include>``.
    """
    assets = find_assets(document, mesh_dir)
    needing = {asset.node.file.path for asset in assets}
    inlined = set(inline)
    for file in document.files:
        compilers = (each for each in file.elements if local_name(each) == "compiler")
        sets_folder = any(each.get(a) for each in compilers for a in _FOLDER_ATTRIBUTES)
        needs_folder = file.includes or sets_folder or file.path in needing
        if folder is None or not file.is_utf8 or needs_folder:
            inlined.add(file.path)
    writer = _Writer(folder, inlined)
    for path, edits in (extra or {}).items():
        writer.add(path, edits)
    folders = asset_folders(document, mesh_dir)
    _move_assets(writer, assets, folders)
    _move_folders(writer, document, folders, {asset.node.tag for asset in assets})
    return utf8_declaration(writer.text(document.main))


def bundled_text(document: ModelDocument, names: Mapping[Path, str]) -> bytes:
    """Return the UTF-8 text of an MJCF document that stands alone beside copies of its assets.

    Args:
        document: the model; all that it includes is inlined.
        names: asset file to its copy's path, relative to the text.
    """
    writer = _Writer(None, {file.path for file in document.files})
    for asset in find_assets(document):
        if asset.path is not None:
            writer.set_attributes(asset.node, {asset.attribute: names[asset.path]})
    for node in document.compilers():
        writer.set_attributes(node, dict.fromkeys(_FOLDER_ATTRIBUTES))
    return utf8_declaration(writer.text(document.main))


def reference(target: Path, folder: Path | None) -> str:
    """Return how a file in ``folder`` refers to ``target``: relative where that is safe."""
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


class _Writer:
    """Collects edits per file and writes the main file out."""

    def __init__(self, folder: Path | None, inlined: set[Path]) -> None:
        self.folder, self._inlined = folder, inlined
        self._edits: dict[Path, list[Edit]] = {}

    def add(self, path: Path, edits: Collection[Edit | None]) -> None:
        self._edits.setdefault(path, []).extend(edit for edit in edits if edit is not None)

    def set_attributes(self, node: Node, values: Mapping[str, str | None]) -> None:
        """Set, or remove where None, the attributes of an element that differ."""
        text, span = node.file.text, node.file.span(node.element)
        for name, value in values.items():
            if value is None:
                self.add(node.file.path, [markup.remove_attribute(text, span, name)])
            elif not _same_path(node.get(name), value):
                self.add(node.file.path, [markup.set_attribute(text, span, name, value)])

    def insert_compiler(self, file: SourceFile, values: Mapping[str, str]) -> None:
        """Add a compiler element at the top of a file."""
        place = file.spans[0].inner_start
        attributes = "".join(f" {name}={quoted(value)}" for name, value in values.items())
        element = markup.line_break(file.text) + f"  <compiler{attributes}/>".encode()
        self.add(file.path, [Edit(place, place, element)])

    def text(self, file: SourceFile) -> bytes:
        return markup.apply_edits(file.text, self._all_edits(file))

    def _all_edits(self, file: SourceFile) -> list[Edit]:
        return [*self._edits.get(file.path, ()), *self._include_edits(file)]

    def _include_edits(self, file: SourceFile) -> Iterator[Edit]:
        for i, included in file.includes.items():
            span = file.spans[i]
            if self._must_inline(included):
                inner, edits = included.spans[0], self._all_edits(included)
                ends = inner.inner_start, inner.inner_end
                text = markup.apply_edits(included.text, edits, *ends).strip()
                yield Edit(span.start, span.end, text)
            else:
                name = reference(included.path, self.folder)
                yield markup.set_attribute(file.text, span, "file", name)

    def _must_inline(self, file: SourceFile) -> bool:
        return file.path in self._inlined or any(
            self._must_inline(included) for included in file.includes.values()
        )


def _same_path(old: str | None, new: str) -> bool:
    return old is not None and os.path.normpath(old) == os.path.normpath(new)


def _move_assets(writer: _Writer, assets: Collection[Asset], folders: AssetFolders) -> None:
    """Rewrite the references that are not simply "name inside the asset folder"."""
    for asset in assets:
        if asset.path is None:
            continue
        base = folders.texture if asset.node.tag == "texture" else folders.mesh
        if asset.node.tag == "model":
            name = reference(asset.path, writer.folder)
        elif asset.path == Path(os.path.normpath(base / asset.name.replace("\\", "/"))):
            continue
        else:
            name = reference(asset.path, base if writer.folder is not None else None)
        writer.set_attributes(asset.node, {asset.attribute: name})


def _move_folders(
    writer: _Writer, document: ModelDocument, folders: AssetFolders, tags: set[str]
) -> None:
    """Make the compiler elements name the asset folders as seen from the new place."""
    ours = {"meshdir": folders.mesh, "texturedir": folders.texture}
    places = {name: reference(place, writer.folder) for name, place in ours.items()}
    compilers = document.compilers()
    for node in compilers:
        writer.set_attributes(node, _new_folder_attributes(node, places))
    needed = {"meshdir"} if tags - {"texture", "model"} else set()
    needed |= {"texturedir"} if "texture" in tags else set()
    named = {n for node in compilers for n in needed if node.get(n) or node.get("assetdir")}
    missing = {name: places[name] for name in sorted(needed - named) if places[name] != "."}
    if missing and compilers:
        writer.set_attributes(compilers[0], missing)
    elif missing:
        writer.insert_compiler(document.main, missing)


def _new_folder_attributes(node: Node, places: Mapping[str, str]) -> dict[str, str | None]:
    """Return what a compiler element's folder attributes become; None removes one."""
    values: dict[str, str | None] = {name: places[name] for name in places if node.get(name)}
    if (node.get("strippath") or "").lower() == "true":
        values["strippath"] = "false"
    if node.get("assetdir"):
        # meshdir and texturedir may have to differ now, so both are named.
        values.update({"assetdir": None, **places})
    return values


def utf8_declaration(text: bytes) -> bytes:
    """Return UTF-8 text whose XML declaration, if it has one, says so."""
    return _DECLARED_ENCODING.sub(rb"\1utf-8\2", text, count=1)
