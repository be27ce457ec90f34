"""The body whose inertia is replaced, found in the text, and its new ``<inertial>`` and comment;
what compiler settings would change of it.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from typing import NoReturn

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.documents import ModelDocument, Node
from robot_sysid.mjcf.edits import Edits, indentation, line_break
from robot_sysid.records import Array

_SMALLEST_NORMAL = float(np.finfo(float).tiny)


def mjcf_inertial(theta: Array, principal: bool = False) -> str:
    """Return MJCF for theta (10,), exact to the last digit.

    MuJoCo's ``fullinertia`` is about the CENTRE OF MASS, in the order xx yy zz xy xz yz.

    Args:
        theta: (10,) parameters in the body frame, inertia about its origin.
        principal: write principal moments and axes instead of the full matrix; MuJoCo before 3.14
            finds the axes of a full matrix to six digits only.
    """
    mass, com, inertia = spatial.com_from_theta(theta)
    head = f'<inertial pos="{numbers(com)}" mass="{float(mass)!r}"'
    if not np.any(theta):
        return f'{head} diaginertia="0 0 0"/>'
    if not principal:
        six = spatial.fullinertia_from_symmetric(inertia)
        return f'{head} fullinertia="{numbers(six)}"/>'
    moments, axes = np.linalg.eigh(inertia)
    first_two = numbers(axes[:, :2].T.ravel())
    return f'{head} xyaxes="{first_two}" diaginertia="{numbers(moments)}"/>'


def urdf_inertial(theta: Array) -> str:
    """Return URDF for theta (10,): origin at the centre of mass, axes of the link."""
    return urdf_inertial_about_com(*spatial.com_from_theta(theta))


def urdf_inertial_about_com(mass: float, com: Array, inertia: Array) -> str:
    """Return URDF for a mass, centre of mass (3,) and inertia about it (3, 3) in link axes."""
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    six = spatial.six_from_symmetric(inertia)
    moments = " ".join(f'{name}="{number(value)}"' for name, value in zip(names, six))
    return (
        f'<inertial><origin xyz="{numbers(com)}" rpy="0 0 0"/><mass value="{float(mass)!r}"/>'
        f"<inertia {moments}/></inertial>"
    )


def numbers(values: Array) -> str:
    """Return numbers with all their digits, separated by spaces."""
    return " ".join(number(value) for value in values)


def number(value: float) -> str:
    """Return a number with all its digits."""
    # Also turns -0.0 into 0.0; MuJoCo 3.3 refuses to read denormal numbers.
    return repr(float(value)) if abs(value) >= _SMALLEST_NORMAL else "0.0"


def write_inertial(edits: Edits, body: Node, inertial: str) -> None:
    """Give a body this inertial."""
    old = body.child("inertial")
    if old is not None:
        edits.replace(old, inertial)
        return
    text, span = body.file.text, body.span
    indent = line_break(text) + indentation(text, span.start) + b"  "
    edits.insert(body, (b"" if span.is_empty_tag else indent) + inertial.encode())


def comment_text(what: str, rmse: float, addition: str | None) -> str:
    """Return the comment that says what was identified, of which body, say."""
    words = f"System ID: {what} identified with {rmse_words(rmse)}"
    words += f"; {addition}" if addition else ""
    return f"<!-- {words.replace('--', '- -')} -->"


def rmse_words(rmse: float) -> str:
    """Return how a comment states the residual [N m] of the identification that it is of."""
    return f"RMSE {rmse:.6f} Nm" if rmse == 0.0 or rmse >= 1e-6 else f"RMSE {rmse:.3g} Nm"


MULTIPLIERS = ("replicate", "attach", "composite", "flexcomp")
"""Elements that make bodies which are not written out."""


def find_body(document: ModelDocument, label: str) -> Node:
    """Return the ``<body>`` (MJCF) or ``<link>`` (URDF) of a compiled body.

    Args:
        label: the body's name, or "#7" for the nameless body with MuJoCo id 7.

    Raises:
        ExportError: it is not written out in the file.
    """
    wanted = "link" if document.kind == "urdf" else "body"
    node = find_named(document, (n for n in document.walk() if n.tag == wanted), "body", label)
    node = node or _by_number(document, label)
    if any(n.tag == "replicate" and n.holds(node) for n in document.walk()):
        raise ExportError(
            f"{document.path}: body '{label}' is repeated by a <replicate>, so its inertia cannot "
            "be changed alone; write its copies out"
        )
    return node


def find_named(
    document: ModelDocument, nodes: Iterable[Node], kind: str, label: str
) -> Node | None:
    """Return the element with a name; ExportError where there are several."""
    same = [node for node in nodes if node.get("name") == label]
    if len(same) > 1:
        raise ExportError(f"{document.path}: {kind} '{label}' stands in the file {len(same)} times")
    return same[0] if same else None


def _by_number(document: ModelDocument, label: str) -> Node:
    wanted = re.fullmatch(r"#(\d+)", label)
    if wanted is None or document.kind == "urdf":
        raise ExportError(
            f"{document.path}: body '{label}' is not written out in the file (it comes from an "
            "attached or generated part); identify the attached model file by itself, or write "
            "the body out"
        )
    # MuJoCo numbers bodies depth first, and <frame> adds none.
    left = int(wanted.group(1))
    for node in (n for world in document.tagged("worldbody") for n in world.walk()):
        if node.tag in MULTIPLIERS:
            raise ExportError(
                f"{document.path}: cannot count up to the nameless body {label} past a "
                f"<{node.tag}>; give the body a name"
            )
        left -= node.tag == "body"
        if left == 0 and node.tag == "body":
            return node
    raise ExportError(f"{document.path}: no body number {label} in the file; give it a name")


ROUNDING = 1e-9
"""Relative difference that the check of the written model lets pass."""


def setting(document: ModelDocument, name: str) -> str | None:
    """Return a compiler attribute; the last one in the file counts."""
    values = [node.get(name) for node in document.compilers() if node.get(name)]
    return values[-1] if values else None


def setting_number(document: ModelDocument, name: str) -> float:
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
        theta: (10,) what is written.
        gets_child: whether it goes into a new body that is welded to ``body``.
    """
    if setting_number(document, "settotalmass") > 0.0:
        _refuse(document, "settotalmass", "rescales the mass of every body; remove it")
    is_fused = setting(document, "fusestatic") == "true" and document.kind == "mjcf"
    if is_fused and (gets_child or _has_welded(body)):
        _refuse(document, "fusestatic", "merges bodies with the identified one; set it to false")
    mass, _, inertia = spatial.com_from_theta(theta)
    smallest = float(np.linalg.eigvalsh(inertia)[0])
    for name, value in (("boundmass", mass), ("boundinertia", smallest)):
        bound = setting_number(document, name)
        # A value that is at its bound but for rounding is written; the written model is checked.
        if bound > value * (1.0 + ROUNDING):
            change = f"raises the identified value {value:.9g} to {bound:g}"
            _refuse(document, name, f"{change}; lower it")


def let_inertials_count(edits: Edits, written: Collection[Node]) -> None:
    """Keep ``inertiafromgeom="true"`` from overriding what is written.

    The setting becomes "auto", which lets an ``<inertial>`` count; the other bodies lose the
    ``<inertial>`` that was ignored so far, so that their geoms still decide.
    """
    document = edits.document
    if setting(document, "inertiafromgeom") != "true":
        return
    for node in document.compilers():
        if node.get("inertiafromgeom"):
            edits.set(node, "inertiafromgeom", "auto")
    kept = {node.element for node in written}
    for body in (n for n in document.walk() if n.tag == "body" and n.element not in kept):
        children = list(body.children())
        if any(_is_geom(child) for child in children):
            for child in (c for c in children if c.tag == "inertial"):
                edits.replace(child, "")


def _is_geom(node: Node) -> bool:
    return node.tag == "geom" or (node.tag == "frame" and any(map(_is_geom, node.children())))


def _has_welded(body: Node) -> bool:
    children = [c for c in body.walk() if c.tag == "body" and c.element is not body.element]
    jointed = ("joint", "freejoint")
    return any(not any(c.tag in jointed for c in child.children()) for child in children)


def _refuse(document: ModelDocument, name: str, reason: str) -> NoReturn:
    raise ExportError(f"{document.path}: the compiler setting {name} {reason} to write the model")
