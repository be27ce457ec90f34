"""The meshes of a URDF: where they are, and how the file refers to them from another folder."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robot_sysid.modelfile import markup
from robot_sysid.modelfile.documents import ModelDocument
from robot_sysid.modelfile.markup import Edit
from robot_sysid.modelfile.relocation import reference, utf8_declaration

READABLE_MESHES = (".stl", ".obj", ".msh")
_SCHEME = re.compile(r"^(package|model|file)://")


@dataclass(frozen=True)
class MeshUse:
    """A ``<mesh filename>`` in a URDF.

    Attributes:
        element: the mesh element.
        link: the link it belongs to.
        shape: the ``<visual>`` or ``<collision>`` around it.
        name: the file name as written.
        path: the file; None if it was not found.
    """

    element: Any
    link: Any
    shape: Any
    name: str
    path: Path | None

    @property
    def is_usable(self) -> bool:
        """Whether the file exists in a format MuJoCo reads."""
        return self.path is not None and self.path.suffix.lower() in READABLE_MESHES


def mesh_uses(document: ModelDocument, mesh_dir: Path | None = None) -> tuple[MeshUse, ...]:
    """Return every mesh reference of a URDF, resolved.

    ``package://``, ``model://`` and plain names are looked up in ``mesh_dir``, then in the file's
    folder and every folder above it, with and without the package's name.
    """
    uses = []
    for link in document.main.root.iterchildren("{*}link"):
        for shape in link.iterchildren("{*}visual", "{*}collision"):
            for mesh in shape.iter("{*}mesh"):
                name = mesh.get("filename") or ""
                path = find_mesh(document, name, mesh_dir)
                uses.append(MeshUse(mesh, link, shape, name, path))
    return tuple(uses)


def find_mesh(document: ModelDocument, name: str, mesh_dir: Path | None = None) -> Path | None:
    """Return the file a URDF mesh name means, or None."""
    if not name:
        return None
    candidates = _mesh_candidates(document, name.replace("\\", "/"), mesh_dir)
    return next((path for path in candidates if path.is_file()), None)


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
    for setting in urdf_compilers(document):
        own_meshes = own / (setting.get("meshdir") or ".")
        yield from (own_meshes / rest, own_meshes / rest.name)
    yield own / rest
    if scheme:
        for folder in (own, *own.parents):
            yield from (folder / rest, folder / inside)
    yield own / rest.name


def settings_edits(
    document: ModelDocument, settings: Mapping[str, str], line_break: bytes = b""
) -> list[Edit]:
    """Return the edits that set MuJoCo's compiler attributes in a URDF; its meshdir goes.

    Args:
        document: the URDF.
        settings: attribute to value.
        line_break: what to put before a new element.
    """
    file = document.main
    compilers = urdf_compilers(document)
    if not compilers:
        attributes = "".join(f' {name}="{value}"' for name, value in settings.items())
        place = file.spans[0].inner_start
        addition = f"<mujoco><compiler{attributes}/></mujoco>".encode()
        return [Edit(place, place, line_break + addition)]
    edits = []
    for element in compilers:
        span = file.span(element)
        edits += [markup.set_attribute(file.text, span, n, v) for n, v in settings.items()]
        removal = markup.remove_attribute(file.text, span, "meshdir")
        edits += [removal] if removal else []
    return edits


def urdf_compilers(document: ModelDocument) -> list[Any]:
    """Return the compiler elements of the ``<mujoco>`` part of a URDF."""
    root = document.main.root
    return [c for m in root.iterchildren("{*}mujoco") for c in m.iterchildren("{*}compiler")]


def relocated_urdf(
    document: ModelDocument, folder: Path, mesh_dir: Path | None, extra: Collection[Edit]
) -> bytes:
    """Return the UTF-8 text of a URDF as it must read in another folder.

    Mesh names that can be found become paths from that folder; the others stay as they are.

    Args:
        document: the URDF.
        folder: where the text will live.
        mesh_dir: the user's mesh folder, if any.
        extra: further edits.
    """
    file, edits, nested = document.main, list(extra), False
    for use in mesh_uses(document, mesh_dir):
        name = use.name if use.path is None else reference(use.path, folder)
        nested |= "/" in name
        if name != use.name:
            edits.append(markup.set_attribute(file.text, file.span(use.element), "filename", name))
    if nested:
        # MuJoCo before 3.7 drops the folders of a URDF's mesh names unless told otherwise.
        line = markup.line_break(file.text) + b"  "
        edits += settings_edits(document, {"strippath": "false"}, line)
    return utf8_declaration(markup.apply_edits(file.text, edits))
