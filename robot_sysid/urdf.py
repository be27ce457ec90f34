"""URDF text as MuJoCo can compile it: mesh paths found, links kept apart, what is missing dropped.

Nothing that enters the dynamics is dropped: a mesh goes only where the link has its own
``<inertial>`` or the mesh is only drawn.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robot_sysid import markup
from robot_sysid.documents import ModelDocument, local_name
from robot_sysid.errors import ModelError
from robot_sysid.markup import Edit

READABLE_MESHES = (".stl", ".obj", ".msh")
MINIMUM_MASS = 1e-6
MINIMUM_INERTIA = 1e-9
_SCHEME = re.compile(r"^(package|model|file)://")
_SETTINGS = {"fusestatic": "false", "strippath": "false"}


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
    for setting in _compilers(document):
        own_meshes = own / (setting.get("meshdir") or ".")
        yield from (own_meshes / rest, own_meshes / rest.name)
    yield own / rest
    if scheme:
        for folder in (own, *own.parents):
            yield from (folder / rest, folder / inside)
    yield own / rest.name


def compilable_urdf(
    document: ModelDocument, mesh_dir: Path | None = None, with_minimum: bool = False
) -> tuple[bytes, tuple[str, ...]]:
    """Return (text MuJoCo can compile, notes on what had to be changed).

    Args:
        document: the URDF.
        mesh_dir: where the user says the meshes are.
        with_minimum: give moving links without mass ``MINIMUM_MASS`` and ``MINIMUM_INERTIA``.

    Raises:
        ModelError: a mesh that determines a link's inertia is missing.
    """
    edits: list[Edit] = []
    notes: list[str] = []
    _use_absolute_meshes(document, mesh_dir, edits, notes)
    edits += settings_edits(document, _SETTINGS)
    if with_minimum:
        _add_minimum_inertia(document, edits, notes)
    return markup.apply_edits(document.main.text, edits), tuple(notes)


def settings_edits(document: ModelDocument, settings: Mapping[str, str]) -> list[Edit]:
    """Return the edits that set MuJoCo's compiler attributes in a URDF; its meshdir goes."""
    file = document.main
    compilers = _compilers(document)
    if not compilers:
        attributes = "".join(f' {name}="{value}"' for name, value in settings.items())
        place = file.spans[0].inner_start
        addition = f"<mujoco><compiler{attributes}/></mujoco>".encode()
        return [Edit(place, place, addition)]
    edits = []
    for element in compilers:
        span = file.span(element)
        edits += [markup.set_attribute(file.text, span, n, v) for n, v in settings.items()]
        removal = markup.remove_attribute(file.text, span, "meshdir")
        edits += [removal] if removal else []
    return edits


def _compilers(document: ModelDocument) -> list[Any]:
    root = document.main.root
    return [c for m in root.iterchildren("{*}mujoco") for c in m.iterchildren("{*}compiler")]


def _use_absolute_meshes(
    document: ModelDocument, mesh_dir: Path | None, edits: list[Edit], notes: list[str]
) -> None:
    file, dropped = document.main, {}
    from_geometry = any(c.get("inertiafromgeom") == "true" for c in _compilers(document))
    for use in mesh_uses(document, mesh_dir):
        if use.is_usable:
            path = str(use.path)
            edits.append(markup.set_attribute(file.text, file.span(use.element), "filename", path))
        elif use.shape not in dropped:
            _check_can_drop(document, use, from_geometry)
            span = file.span(use.shape)
            edits.append(Edit(span.start, span.end, b""))
            dropped[use.shape] = use
    # A shape is dropped whole, so the edits inside it must go with it.
    removed = [file.span(shape) for shape in dropped]
    inside = [e for e in edits if any(s.start < e.start < s.end for s in removed)]
    edits[:] = [e for e in edits if e not in inside]
    notes += _dropped_notes(list(dropped.values()))


def _check_can_drop(document: ModelDocument, use: MeshUse, from_geometry: bool) -> None:
    drawn_only = local_name(use.shape) == "visual"
    has_inertial = use.link.find("{*}inertial") is not None and not from_geometry
    if drawn_only or has_inertial:
        return
    why = "not found" if use.path is None else f"in a format MuJoCo cannot read ({use.path.suffix})"
    raise ModelError(
        f"{document.path}: collision mesh {use.name} of link '{use.link.get('name')}' is {why}, "
        "and the link has no <inertial> of its own; pass --mesh-dir FOLDER or add an <inertial>"
    )


def _dropped_notes(uses: list[MeshUse]) -> list[str]:
    collisions = [use for use in uses if local_name(use.shape) == "collision"]
    if not collisions:
        return []
    names = ", ".join(sorted({use.name for use in collisions}))
    return [
        f"collision meshes that are missing or unreadable to MuJoCo were left out ({names}); "
        "the dynamics do not change, because these links have their own <inertial>"
    ]


def _add_minimum_inertia(document: ModelDocument, edits: list[Edit], notes: list[str]) -> None:
    file, links = document.main, []
    for link in _moving_links_without_mass(document):
        inertial = link.find("{*}inertial")
        span = file.span(link)
        if inertial is not None:
            old = file.span(inertial)
            edits.append(Edit(old.start, old.end, _minimum(_mass(link))))
        elif span.is_empty_tag:
            opened = file.text[span.start : span.end - 2].rstrip() + b">"
            tag = b"</" + str(link.tag).encode() + b">"
            edits.append(Edit(span.start, span.end, opened + _minimum(0.0) + tag))
        else:
            edits.append(Edit(span.inner_start, span.inner_start, _minimum(0.0)))
        links.append(f"'{link.get('name')}'")
    if links:
        notes.append(
            f"moving link {', '.join(links)} has no mass or inertia, which MuJoCo refuses; it was "
            f"given {MINIMUM_MASS:g} kg and {MINIMUM_INERTIA:g} kg m^2"
        )


def _minimum(mass: float) -> bytes:
    value = f"{MINIMUM_INERTIA:g}"
    return (
        f'<inertial><mass value="{max(mass, MINIMUM_MASS)!r}"/><inertia ixx="{value}" '
        f'iyy="{value}" izz="{value}" ixy="0" ixz="0" iyz="0"/></inertial>'
    ).encode()


def _moving_links_without_mass(document: ModelDocument) -> Iterator[Any]:
    root = document.main.root
    links = {link.get("name"): link for link in root.iterchildren("{*}link")}
    joints = list(root.iterchildren("{*}joint"))
    for joint in joints:
        link = links.get(_end(joint, "child"))
        if joint.get("type") == "fixed" or link is None or not _lacks_inertia(link):
            continue
        welded = (
            links.get(_end(j, "child"))
            for j in joints
            if j.get("type") == "fixed" and _end(j, "parent") == link.get("name")
        )
        if not any(child is not None and _mass(child) > 0.0 for child in welded):
            yield link


def _lacks_inertia(link: Any) -> bool:
    inertial = link.find("{*}inertial")
    if inertial is None:
        return link.find("{*}collision") is None
    inertia = inertial.find("{*}inertia")
    names = ("ixx", "iyy", "izz")
    diagonal = [] if inertia is None else [float(inertia.get(n) or 0.0) for n in names]
    return _mass(link) <= 0.0 or max(diagonal, default=0.0) <= 0.0


def _mass(link: Any) -> float:
    mass = link.find("{*}inertial/{*}mass")
    try:
        return float(mass.get("value") or 0.0) if mass is not None else 0.0
    except ValueError:
        return 0.0


def _end(joint: Any, which: str) -> str | None:
    end = joint.find("{*}" + which)
    name = end.get("link") if end is not None else None
    return str(name) if name is not None else None
