"""URDF text as MuJoCo can compile it: mesh paths found, links kept apart, what is missing dropped.

Nothing that enters the dynamics is dropped: a mesh goes only where the link has its own
``<inertial>`` or the mesh is only drawn.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid import spatial
from robot_sysid.errors import ModelError
from robot_sysid.modelfile import markup
from robot_sysid.modelfile.documents import ModelDocument, local_name
from robot_sysid.modelfile.inertial_text import urdf_inertial_about_com
from robot_sysid.modelfile.markup import Edit
from robot_sysid.modelfile.urdf_meshes import MeshUse, mesh_uses, settings_edits, urdf_compilers
from robot_sysid.records import Array

MINIMUM_MASS = 1e-6
MINIMUM_INERTIA = 1e-9
_SETTINGS = {"fusestatic": "false", "strippath": "false"}


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
    edits += _level_inertials(document)
    if with_minimum:
        _add_minimum_inertia(document, edits, notes)
    return markup.apply_edits(document.main.text, edits), tuple(notes)


def _use_absolute_meshes(
    document: ModelDocument, mesh_dir: Path | None, edits: list[Edit], notes: list[str]
) -> None:
    file, dropped = document.main, {}
    from_geometry = any(c.get("inertiafromgeom") == "true" for c in urdf_compilers(document))
    for use in mesh_uses(document, mesh_dir):
        if use.is_usable:
            path = str(use.path)
            edits.append(markup.set_attribute(file.text, file.span(use.element), "filename", path))
        elif use.shape not in dropped:
            _check_can_drop(document, use, from_geometry)
            span = file.span(use.shape)
            # Line numbers in MuJoCo's messages must stay those of the file.
            lines = file.text[span.start : span.end].count(b"\n")
            edits.append(Edit(span.start, span.end, b"\n" * lines))
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
        "the dynamics do not change, because these links have their own <inertial>; a written "
        "model still names them, so MuJoCo by itself loads it only once they are there, in a "
        "format it reads"
    ]


def _add_minimum_inertia(document: ModelDocument, edits: list[Edit], notes: list[str]) -> None:
    found = dict(minimum_inertia_edits(document))
    edits += found.values()
    if found:
        links = ", ".join(f"'{name}'" for name in found)
        notes.append(
            f"moving link {links} has no mass or inertia, which MuJoCo refuses; it was "
            f"given {MINIMUM_MASS:g} kg and {MINIMUM_INERTIA:g} kg m^2"
        )


def minimum_inertia_edits(document: ModelDocument) -> Iterator[tuple[str, Edit]]:
    """Yield (name of a moving link that weighs nothing, the edit that gives it a minimum)."""
    file = document.main
    for link in _moving_links_without_mass(document):
        inertial = link.find("{*}inertial")
        span = file.span(link)
        if inertial is not None:
            old = file.span(inertial)
            edit = Edit(old.start, old.end, _minimum(_mass(link)))
        elif span.is_empty_tag:
            opened = file.text[span.start : span.end - 2].rstrip() + b">"
            tag = b"</" + str(link.tag).encode() + b">"
            edit = Edit(span.start, span.end, opened + _minimum(0.0) + tag)
        else:
            edit = Edit(span.inner_start, span.inner_start, _minimum(0.0))
        yield str(link.get("name")), edit


def _minimum(mass: float) -> bytes:
    inertia = MINIMUM_INERTIA * np.eye(3)
    return urdf_inertial_about_com(max(mass, MINIMUM_MASS), np.zeros(3), inertia).encode()


def link_inertias(document: ModelDocument) -> dict[str, tuple[float, Array, Array]]:
    """Return link name to (mass, centre of mass (3,), inertia about it (3, 3) in link axes)."""
    found = {}
    for link in document.main.root.iterchildren("{*}link"):
        inertial = link.find("{*}inertial")
        inertia = inertial.find("{*}inertia") if inertial is not None else None
        if inertia is None:
            continue
        origin = inertial.find("{*}origin")
        com = _floats(origin, "xyz")
        rotation = spatial.rotation_from_rpy(*_floats(origin, "rpy"))
        six = [float(inertia.get(n) or 0.0) for n in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")]
        matrix = rotation @ spatial.symmetric_from_six(np.array(six)) @ rotation.T
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
