"""URDF text as MuJoCo can compile it, and as it must read in another folder.

Mesh paths are found, links kept apart, what is missing dropped; but nothing that enters the
dynamics is: a mesh goes only where the link has its own ``<inertial>`` or the mesh is only drawn.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ModelError
from robot_sysid.mjcf import markup
from robot_sysid.mjcf.assets import SHAPES, Asset, find_assets
from robot_sysid.mjcf.documents import ModelDocument, Node
from robot_sysid.mjcf.edits import Edits
from robot_sysid.mjcf.inertial import urdf_inertial_about_com
from robot_sysid.records import Array

READABLE_MESHES = (".stl", ".obj", ".msh")
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
    edits = Edits(document)
    # Line numbers in MuJoCo's messages must stay those of the file.
    edits.lead = b""
    notes = list(_use_absolute_meshes(edits, mesh_dir))
    edits.set_compiler(_SETTINGS)
    _level_inertials(edits)
    found = give_minimum(edits) if with_minimum else []
    if found:
        links = ", ".join(f"'{name}'" for name in found)
        notes.append(
            f"moving link {links} has no mass, or no inertia, which MuJoCo refuses; where it has "
            f"none it was given {MINIMUM_MASS:g} kg and {MINIMUM_INERTIA:g} kg m^2"
        )
    return edits.text(), tuple(notes)


def _use_absolute_meshes(edits: Edits, mesh_dir: Path | None) -> Iterator[str]:
    """Name all meshes by their place; leave out shapes whose mesh is not usable. Yields notes."""
    document, collisions = edits.document, set()
    from_geometry = any(c.get("inertiafromgeom") == "true" for c in document.compilers())
    uses = find_assets(document, mesh_dir)
    shapes = [(link, node) for link in document.tagged("link") for node in link.children()]
    for link, shape in shapes:
        meshes = [use for use in uses if shape.tag in SHAPES and shape.holds(use.node)]
        unusable = [mesh for mesh in meshes if not _is_usable(mesh)]
        for mesh in meshes if not unusable else ():
            edits.set(mesh.node, "filename", str(mesh.path))
        if unusable and shape.tag == "collision":
            if link.child("inertial") is None or from_geometry:
                raise _cannot_drop(document, link, unusable[0])
            collisions.add(unusable[0].name)
        if unusable:
            edits.replace(shape, "", keep_lines=True)
    if collisions:
        yield (
            "collision meshes that are missing or unreadable to MuJoCo were left out "
            f"({', '.join(sorted(collisions))}); "
            "the dynamics do not change, because these links have their own <inertial>; a written "
            "model still names them, so MuJoCo by itself loads it only once they are there, in a "
            "format it reads"
        )


def _is_usable(mesh: Asset) -> bool:
    """Whether the file exists in a format MuJoCo reads."""
    return mesh.path is not None and mesh.path.suffix.lower() in READABLE_MESHES


def _cannot_drop(document: ModelDocument, link: Node, mesh: Asset) -> ModelError:
    unreadable = "" if mesh.path is None else mesh.path.suffix
    why = f"in a format MuJoCo cannot read ({unreadable})" if mesh.path else "not found"
    return ModelError(
        f"{document.path}: collision mesh {mesh.name} of link '{link.get('name')}' is {why}, "
        "and the link has no <inertial> of its own; pass --mesh-dir FOLDER or add an <inertial>"
    )


def give_minimum(edits: Edits, but: Collection[str | None] = ()) -> list[str]:
    """Give moving links that weigh nothing a minimum, but for some; returns their names."""
    found = [
        link for link in _moving_links_without_mass(edits.document) if link.get("name") not in but
    ]
    for link in found:
        com = _floats(_inner(link, "inertial", "origin"), "xyz")
        inertia = MINIMUM_INERTIA * np.eye(3)
        minimum = urdf_inertial_about_com(max(_mass(link), MINIMUM_MASS), com, inertia)
        old = link.child("inertial")
        if old is not None:
            edits.replace(old, minimum)
        else:
            edits.add(link, markup.insert_child(link.file.text, link.span, minimum.encode()))
    return [str(link.get("name")) for link in found]


_LARGEST = 1e12  # squares of far larger numbers overflow


def link_inertias(document: ModelDocument) -> dict[str, tuple[float, Array, Array]]:
    """Return link name to (mass, centre of mass (3,), inertia about it (3, 3) in link axes)."""
    from scipy.spatial.transform import Rotation

    found = {}
    for link in document.tagged("link"):
        inertia, origin = _inner(link, "inertial", "inertia"), _inner(link, "inertial", "origin")
        if inertia is None:
            continue
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
    for joint in document.tagged("joint"):
        limit = joint.child("limit")
        text = None if limit is None else limit.get("velocity")
        with contextlib.suppress(ValueError):
            value = float(text or "")
            if value > 0.0 and math.isfinite(value):
                found[str(joint.get("name"))] = value
    return found


def _inner(link: Node, *tags: str) -> Node | None:
    """Return the first child of the first child ... with these tags."""
    found: Node | None = link
    for tag in tags:
        found = None if found is None else found.child(tag)
    return found


def _floats(node: Node | None, name: str) -> Array:
    text = node.get(name) if node is not None else None
    return np.array([float(word) for word in text.split()]) if text else np.zeros(3)


def _level_inertials(edits: Edits) -> None:
    """Turn inertias into link axes: MuJoCo 3.3 ignores the ``rpy`` of an inertial."""
    inertias = link_inertias(edits.document)
    for link in edits.document.tagged("link"):
        inertial, origin = link.child("inertial"), _inner(link, "inertial", "origin")
        if inertial and np.any(_floats(origin, "rpy")) and not _lacks_inertia(link):
            text = urdf_inertial_about_com(*inertias[str(link.get("name"))])
            edits.replace(inertial, text, keep_lines=True)


def _moving_links_without_mass(document: ModelDocument) -> Iterator[Node]:
    links = {link.get("name"): link for link in document.tagged("link")}
    joints = document.tagged("joint")
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


def _lacks_inertia(link: Node) -> bool:
    if link.child("inertial") is None:
        return link.child("collision") is None
    inertia, names = _inner(link, "inertial", "inertia"), ("ixx", "iyy", "izz")
    diagonal = [] if inertia is None else [float(inertia.get(n) or 0.0) for n in names]
    return _mass(link) <= 0.0 or max(diagonal, default=0.0) <= 0.0


def _mass(link: Node) -> float:
    mass = _inner(link, "inertial", "mass")
    try:
        return float(mass.get("value") or 0.0) if mass is not None else 0.0
    except ValueError:
        return 0.0


def _end(joint: Node, which: str) -> str | None:
    end = joint.child(which)
    return end.get("link") if end is not None else None
