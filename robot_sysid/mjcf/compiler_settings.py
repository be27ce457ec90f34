"""MJCF compiler settings that change inertias at compile time, and what to do about each."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import NoReturn

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf import markup
from robot_sysid.mjcf.documents import ModelDocument, Node
from robot_sysid.mjcf.markup import Edit
from robot_sysid.records import Array

ROUNDING = 1e-9
"""Relative difference that the check of the written model lets pass."""


def setting(document: ModelDocument, name: str) -> str | None:
    """Return a compiler attribute; the last one in the file counts."""
    values = [node.get(name) for node in document.compilers() if node.get(name)]
    return values[-1] if values else None


def bound_inertia(document: ModelDocument) -> float:
    """Return the smallest principal moment of inertia the compiler leaves alone [kg m^2]."""
    return _number(document, "boundinertia")


def _number(document: ModelDocument, name: str) -> float:
    """Return a compiler attribute as MuJoCo reads it, which takes hexadecimal numbers too."""
    text = setting(document, name) or "0"
    try:
        return float.fromhex(text) if "x" in text.lower() else float(text)
    except ValueError:
        _refuse(document, name, f"is {text!r}; write it as a decimal number")


def check_settings(
    document: ModelDocument, body: Node, theta: Array, gets_child: bool = False
) -> None:
    """Raise ExportError where the compiler would change what is written.

    Args:
        document: the model.
        body: what is written into.
        theta: (10,) what is written.
        gets_child: whether it goes into a new body that is welded to ``body``.
    """
    if _number(document, "settotalmass") > 0.0:
        _refuse(document, "settotalmass", "rescales the mass of every body; remove it")
    is_fused = setting(document, "fusestatic") == "true" and document.kind == "mjcf"
    if is_fused and (gets_child or _has_welded(body)):
        _refuse(document, "fusestatic", "merges bodies with the identified one; set it to false")
    mass, _, inertia = spatial.com_from_theta(theta)
    smallest = float(np.linalg.eigvalsh(inertia)[0])
    for name, value in (("boundmass", mass), ("boundinertia", smallest)):
        bound = _number(document, name)
        # A value that is at its bound but for rounding is written; the written model is checked.
        if bound > value * (1.0 + ROUNDING):
            change = f"raises the identified value {value:.9g} to {bound:g}"
            _refuse(document, name, f"{change}; lower it")


def inertia_from_geometry_edits(
    document: ModelDocument, written: Collection[Node]
) -> Iterator[tuple[Node, Edit]]:
    """Yield the edits that keep ``inertiafromgeom="true"`` from overriding what is written.

    The setting becomes "auto", which lets an ``<inertial>`` count; the other bodies lose the
    ``<inertial>`` that was ignored so far, so that their geoms still decide.
    """
    if setting(document, "inertiafromgeom") != "true":
        return
    for node in document.compilers():
        if node.get("inertiafromgeom"):
            span = node.file.span(node.element)
            yield node, markup.set_attribute(node.file.text, span, "inertiafromgeom", "auto")
    kept = {node.element for node in written}
    for body in (n for n in document.walk() if n.tag == "body" and n.element not in kept):
        children = list(body.children())
        if any(_is_geom(child) for child in children):
            for child in (c for c in children if c.tag == "inertial"):
                span = child.file.span(child.element)
                yield child, Edit(span.start, span.end, b"")


def _is_geom(node: Node) -> bool:
    if node.tag == "frame":
        return any(_is_geom(child) for child in node.children())
    return node.tag == "geom"


def _has_welded(body: Node) -> bool:
    children = [c for c in body.walk() if c.tag == "body" and c.element is not body.element]
    jointed = ("joint", "freejoint")
    return any(not any(c.tag in jointed for c in child.children()) for child in children)


def _refuse(document: ModelDocument, name: str, reason: str) -> NoReturn:
    raise ExportError(f"{document.path}: the compiler setting {name} {reason} to write the model")
