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
from robot_sysid.mjcf.assets import SHAPES, find_assets
from robot_sysid.mjcf.documents import Edits, ModelDocument, Node
from robot_sysid.mjcf.inertial import urdf_inertial_about_com
from robot_sysid.records import Array

_READABLE_MESHES = (".stl", ".obj", ".msh")
_MINIMUM_MASS = 1e-6
_MINIMUM_INERTIA = 1e-9
"""What a moving link gets that weighs nothing [kg, kg m^2]: MuJoCo refuses less than 1e-15."""
LARGEST = 1e12
"""Largest size of any number of an arm in SI units; squares of far larger ones overflow."""


def compilable_urdf(
    document: ModelDocument, mesh_dir: Path | None = None, with_minimum: bool = False
) -> tuple[bytes, tuple[str, ...]]:
    """Return (text MuJoCo can compile, notes on what had to be changed), or raise ModelError where
    a mesh that decides a link's inertia is missing; moving links without mass may get a minimum.
    """
    edits = Edits(document)
    # Line numbers in MuJoCo's messages must stay those of the file.
    edits.lead = b""
    notes = list(_use_absolute_meshes(edits, mesh_dir))
    edits.set_compiler({"fusestatic": "false", "strippath": "false"})
    inertias = link_inertias(document)
    for link in document.tagged("link"):
        inertial = link.child("inertial")
        turn = link.inner("inertial", "origin", "rpy")
        if inertial and np.any(_floats(turn)) and not _lacks_inertia(link):
            # MuJoCo 3.3 ignores the rpy of an inertial.
            text = urdf_inertial_about_com(*inertias[str(link.get("name"))])
            edits.replace(inertial, text, keep_lines=True)
    found = give_minimum(edits) if with_minimum else []
    if found:
        links = ", ".join(f"'{name}'" for name in found)
        notes.append(
            f"moving link {links} has no mass, or no inertia, which MuJoCo refuses; where it has "
            f"none it was given {_MINIMUM_MASS:g} kg and {_MINIMUM_INERTIA:g} kg m^2"
        )
    return edits.text(), tuple(notes)


def _use_absolute_meshes(edits: Edits, mesh_dir: Path | None) -> Iterator[str]:
    """Name all meshes by their place; leave out shapes whose mesh is not usable. Yields notes."""
    document = edits.document
    collisions = set()
    from_geometry = any(
        c.get("inertiafromgeom") == "true" for c in document.settings("compiler")
    )
    uses = {use.node: use for use in find_assets(document, mesh_dir)}
    shapes = [
        (link, node) for link in document.tagged("link") for node in link.children()
    ]
    for link, shape in shapes:
        meshes = [
            uses[node] for node in shape.walk() if shape.tag in SHAPES and node in uses
        ]
        # No suffix where there is no file.
        unusable = [
            u
            for u in meshes
            if (u.path or Path()).suffix.lower() not in _READABLE_MESHES
        ]
        for use in meshes if not unusable else ():
            edits.set(use.node, "filename", str(use.path))
        if not unusable:
            continue
        edits.replace(shape, "", keep_lines=True)
        if shape.tag == "collision":
            name = unusable[0].name
            path = unusable[0].path
            if link.child("inertial") is None or from_geometry:
                why = (
                    f"in a format MuJoCo cannot read ({path.suffix})"
                    if path
                    else "not found"
                )
                raise ModelError(
                    f"{document.path}: collision mesh {name} of link '{link.get('name')}' is "
                    f"{why}, and the link has no <inertial> of its own; pass --mesh-dir FOLDER or "
                    "add an <inertial>"
                )
            collisions.add(name)
    if collisions:
        yield (
            "collision meshes that are missing or unreadable to MuJoCo were left out "
            f"({', '.join(sorted(collisions))}), which changes no dynamics; a written model still "
            "names them, so MuJoCo by itself loads it only once they are there"
        )


def give_minimum(edits: Edits, but: Collection[Node] = ()) -> list[str]:
    """Give moving links that weigh nothing a minimum, but for some; returns their names."""
    found = [link for link in _massless_moving_links(edits.document) if link not in but]
    for link in found:
        com = _floats(link.inner("inertial", "origin", "xyz"))
        inertia = _MINIMUM_INERTIA * np.eye(3)
        minimum = urdf_inertial_about_com(max(_mass(link), _MINIMUM_MASS), com, inertia)
        edits.put_inertial(link, minimum, own_line=False)
    return [str(link.get("name")) for link in found]


def link_inertias(document: ModelDocument) -> dict[str, tuple[float, Array, Array]]:
    """Return link name to (mass, centre of mass (3,), inertia about it (3, 3) in link axes)."""
    from scipy.spatial.transform import Rotation

    found = {}
    for link in document.tagged("link"):
        inertia = link.child("inertial", "inertia")
        if inertia is None:
            continue
        com, turn = (
            _floats(link.inner("inertial", "origin", name)) for name in ("xyz", "rpy")
        )
        # Rz(yaw) Ry(pitch) Rx(roll): about the fixed axes, x first.
        rotation = Rotation.from_euler("xyz", turn).as_matrix()
        six = [
            float(inertia.get(n) or 0.0)
            for n in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        ]
        matrix = rotation @ spatial.symmetric_from_six(np.array(six)) @ rotation.T
        if not np.all(np.abs([*matrix.ravel(), *com]) <= LARGEST):
            raise ValueError(
                f"the inertial of link {link.get('name')} is none that an arm has"
            )
        found[str(link.get("name"))] = (_mass(link), com, matrix)
    return found


def velocity_limits(document: ModelDocument) -> dict[str, float]:
    """Return joint name to the speed limit it states [rad/s or m/s]; MuJoCo drops these."""
    found = {}
    for joint in document.tagged("joint"):
        with contextlib.suppress(ValueError):
            value = float(joint.inner("limit", "velocity") or "")
            if 0.0 < value < math.inf:
                found[str(joint.get("name"))] = value
    return found


def _floats(text: str | None) -> Array:
    return np.array([float(word) for word in text.split()]) if text else np.zeros(3)


def _massless_moving_links(document: ModelDocument) -> Iterator[Node]:
    links = {link.get("name"): link for link in document.tagged("link")}
    joints = document.tagged("joint")
    for joint in joints:
        link = links.get(joint.inner("child", "link"))
        if joint.get("type") == "fixed" or link is None or not _lacks_inertia(link):
            continue
        welded = (
            links.get(other.inner("child", "link"))
            for other in joints
            if other.get("type") == "fixed"
            and other.inner("parent", "link") == link.get("name")
        )
        if not any(child is not None and _mass(child) > 0.0 for child in welded):
            yield link


def _lacks_inertia(link: Node) -> bool:
    if link.child("inertial") is None:
        return link.child("collision") is None
    moments = (
        link.inner("inertial", "inertia", name) for name in ("ixx", "iyy", "izz")
    )
    return _mass(link) <= 0.0 or max(float(moment or 0.0) for moment in moments) <= 0.0


def _mass(link: Node) -> float:
    try:
        return float(link.inner("inertial", "mass", "value") or 0.0)
    except ValueError:
        return 0.0
