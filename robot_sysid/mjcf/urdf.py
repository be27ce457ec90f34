"""URDF text as MuJoCo can compile it, and as it must read in another folder.

Mesh paths are found, links kept apart, what is missing dropped; but nothing that enters the
dynamics is: a mesh goes only where the link has its own ``<inertial>`` or the mesh is only drawn.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ModelError
from robot_sysid.mjcf import markup
from robot_sysid.mjcf.documents import ModelDocument, local_name
from robot_sysid.mjcf.inertial import urdf_inertial_about_com
from robot_sysid.mjcf.markup import Edit
from robot_sysid.mjcf.relocation import reference, utf8_declaration
from robot_sysid.records import Array

MINIMUM_MASS = 1e-6
MINIMUM_INERTIA = 1e-9
_SETTINGS = {"fusestatic": "false", "strippath": "false"}


def compilable_urdf(
    document: ModelDocument, mesh_dir: Path | None = None, with_minimum: bool = False
) -> tuple[bytes, tuple[str, ...]]:
    """Return (text MuJoCo can compile, notes on what had to be changed).

    Args:
        with_minimum: give moving links without mass ``MINIMUM_MASS`` and ``MINIMUM_INERTIA``.

    Raises:
        ModelError: a mesh that determines a link's inertia is missing.
    """
    edits: list[Edit] = []
    notes: list[str] = []
    _use_absolute_meshes(document, mesh_dir, edits, notes)
    edits += settings_edits(document, _SETTINGS)
    edits += _level_inertials(document)
    found = dict(minimum_inertia_edits(document)) if with_minimum else {}
    edits += found.values()
    if found:
        links = ", ".join(f"'{name}'" for name in found)
        notes.append(
            f"moving link {links} has no mass, or no inertia, which MuJoCo refuses; where it has "
            f"none it was given {MINIMUM_MASS:g} kg and {MINIMUM_INERTIA:g} kg m^2"
        )
    return markup.apply_edits(document.main.text, edits), tuple(notes)


def _use_absolute_meshes(
    document: ModelDocument, mesh_dir: Path | None, edits: list[Edit], notes: list[str]
) -> None:
    file, dropped = document.main, {}
    from_geometry = any(c.get("inertiafromgeom") == "true" for c in document.compilers())
    for use in mesh_uses(document, mesh_dir):
        if use.is_usable:
            path = str(use.path)
            edits.append(markup.set_attribute(file.text, file.span(use.element), "filename", path))
        elif use.shape not in dropped:
            has_inertial = use.link.find("{*}inertial") is not None and not from_geometry
            if local_name(use.shape) != "visual" and not has_inertial:
                raise _cannot_drop(document, use)
            span = file.span(use.shape)
            # Line numbers in MuJoCo's messages must stay those of the file.
            lines = file.text[span.start : span.end].count(b"\n")
            edits.append(Edit(span.start, span.end, b"\n" * lines))
            dropped[use.shape] = use
    # A shape is dropped whole, so the edits inside it must go with it.
    removed = [file.span(shape) for shape in dropped]
    edits[:] = [e for e in edits if not any(s.start < e.start < s.end for s in removed)]
    collisions = {u.name for u in dropped.values() if local_name(u.shape) == "collision"}
    if collisions:
        notes.append(
            "collision meshes that are missing or unreadable to MuJoCo were left out "
            f"({', '.join(sorted(collisions))}); "
            "the dynamics do not change, because these links have their own <inertial>; a written "
            "model still names them, so MuJoCo by itself loads it only once they are there, in a "
            "format it reads"
        )


def _cannot_drop(document: ModelDocument, use: MeshUse) -> ModelError:
    why = "not found" if use.path is None else f"in a format MuJoCo cannot read ({use.path.suffix})"
    return ModelError(
        f"{document.path}: collision mesh {use.name} of link '{use.link.get('name')}' is {why}, "
        "and the link has no <inertial> of its own; pass --mesh-dir FOLDER or add an <inertial>"
    )


def minimum_inertia_edits(document: ModelDocument) -> Iterator[tuple[str, Edit]]:
    """Yield (name of a moving link that weighs nothing, the edit that gives it a minimum)."""
    file = document.main
    for link in _moving_links_without_mass(document):
        inertial = link.find("{*}inertial")
        span = file.span(link)
        if inertial is not None:
            old = file.span(inertial)
            com = _floats(inertial.find("{*}origin"), "xyz")
            edit = Edit(old.start, old.end, _minimum(_mass(link), com))
        else:
            edit = markup.insert_child(file.text, span, _minimum(0.0, np.zeros(3)))
        yield str(link.get("name")), edit


def _minimum(mass: float, com: Array) -> bytes:
    inertia = MINIMUM_INERTIA * np.eye(3)
    return urdf_inertial_about_com(max(mass, MINIMUM_MASS), com, inertia).encode()


_LARGEST = 1e12  # squares of far larger numbers overflow


def link_inertias(document: ModelDocument) -> dict[str, tuple[float, Array, Array]]:
    """Return link name to (mass, centre of mass (3,), inertia about it (3, 3) in link axes)."""
    from scipy.spatial.transform import Rotation

    found = {}
    for link in document.main.root.iterchildren("{*}link"):
        inertial = link.find("{*}inertial")
        inertia = inertial.find("{*}inertia") if inertial is not None else None
        if inertia is None:
            continue
        origin = inertial.find("{*}origin")
        com = _floats(origin, "xyz")
        # Rz(yaw) Ry(pitch) Rx(roll): about the fixed axes, x first.
        rotation = Rotation.from_euler("xyz", _floats(origin, "rpy")).as_matrix()
        six = [float(inertia.get(n) or 0.0) for n in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")]
        matrix = rotation @ spatial.symmetric_from_six(np.array(six)) @ rotation.T
        if not np.all(np.abs([*matrix.ravel(), *com]) <= _LARGEST):
            raise ValueError(f"the inertial of link {link.get('name')} is none that an arm has")
        found[str(link.get("name"))] = (_mass(link), com, matrix)
    return found


def velocity_limits(document: ModelDocument) -> dict[str, float]:
    """Return joint name to the speed limit it states [rad/s or m/s]; MuJoCo drops these."""
    found = {}
    for joint in document.main.root.iterchildren("{*}joint"):
        limit = joint.find("{*}limit")
        text = None if limit is None else limit.get("velocity")
        with contextlib.suppress(ValueError):
            value = float(text or "")
            if value > 0.0 and math.isfinite(value):
                found[str(joint.get("name"))] = value
    return found


def _floats(element: Any, name: str) -> Array:
    text = element.get(name) if element is not None else None
    return np.array([float(word) for word in text.split()]) if text else np.zeros(3)


def _level_inertials(document: ModelDocument) -> Iterator[Edit]:
    """Turn inertias into link axes: MuJoCo 3.3 ignores the ``rpy`` of an inertial."""
    inertias, file = link_inertias(document), document.main
    for link in document.main.root.iterchildren("{*}link"):
        inertial = link.find("{*}inertial")
        origin = inertial.find("{*}origin") if inertial is not None else None
        if np.any(_floats(origin, "rpy")) and not _lacks_inertia(link):
            span = file.span(inertial)
            lines = b"\n" * file.text[span.start : span.end].count(b"\n")
            text = urdf_inertial_about_com(*inertias[str(link.get("name"))])
            yield Edit(span.start, span.end, text.encode() + lines)


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


READABLE_MESHES = (".stl", ".obj", ".msh")
_SCHEME = re.compile(r"^(package|model|file)://")


@dataclass(frozen=True)
class MeshUse:
    """A ``<mesh filename>`` in a ``<visual>`` or ``<collision>``; no path if it was not found."""

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


def settings_edits(
    document: ModelDocument, settings: Mapping[str, str], line_break: bytes = b"", beside: str = ""
) -> list[Edit]:
    """Return the edits that set MuJoCo's compiler attributes in a URDF; its meshdir goes.

    Args:
        settings: attribute to value; nothing is set where there are none.
        beside: an element to add to the ``<mujoco>`` part, of which MuJoCo reads one only.
    """
    file, compilers, edits = document.main, document.compilers(), []
    for compiler in compilers if settings else ():
        span = file.span(compiler.element)
        edits += [markup.set_attribute(file.text, span, n, v) for n, v in settings.items()]
        removal = markup.remove_attribute(file.text, span, "meshdir")
        edits += [removal] if removal else []
    attributes = "".join(f' {name}="{value}"' for name, value in settings.items())
    new = (f"<compiler{attributes}/>" if attributes and not compilers else "") + beside
    part = file.root.find("{*}mujoco")
    if new and part is not None:
        edits.append(markup.insert_child(file.text, file.span(part), new.encode()))
    elif new:
        place = file.spans[0].inner_start
        edits.append(Edit(place, place, line_break + f"<mujoco>{new}</mujoco>".encode()))
    return edits


def relocated_urdf(
    document: ModelDocument,
    folder: Path,
    mesh_dir: Path | None,
    extra: Collection[Edit],
    setting: str = "",
) -> bytes:
    """Return the UTF-8 text of a URDF as it must read in another folder.

    Mesh names that can be found become paths from that folder; the others stay as they are.

    ``setting``: an element to add to its ``<mujoco>`` part.
    """
    return _with_mesh_names(document, mesh_dir, extra, partial(reference, folder=folder), setting)


def _with_mesh_names(
    document: ModelDocument,
    mesh_dir: Path | None,
    extra: Collection[Edit],
    named: Callable[[Path], str],
    setting: str = "",
) -> bytes:
    file, edits, nested = document.main, list(extra), False
    for use in mesh_uses(document, mesh_dir):
        name = use.name if use.path is None else named(use.path)
        nested |= "/" in name
        if name != use.name:
            edits.append(markup.set_attribute(file.text, file.span(use.element), "filename", name))
    # MuJoCo before 3.7 drops the folders of a URDF's mesh names unless told otherwise.
    compiler = {"strippath": "false"} if nested else {}
    line = markup.line_break(file.text) + b"  "
    # First, so that a comment stays beside the element that it is about.
    edits[:0] = settings_edits(document, compiler, line, setting)
    return utf8_declaration(markup.apply_edits(file.text, edits))


def bundled_urdf(document: ModelDocument, names: Mapping[Path, str]) -> bytes:
    """Return the text of a URDF that stands beside copies of its meshes, see ``bundled_text``."""
    return _with_mesh_names(document, None, (), lambda path: names[path])
