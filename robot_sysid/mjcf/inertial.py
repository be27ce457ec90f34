"""Numbers and inertias as model files state them, and what compiler settings change of them."""

from __future__ import annotations

from collections.abc import Collection
from typing import NoReturn

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.documents import ModelDocument, Node
from robot_sysid.mjcf.edits import Edits, attributes
from robot_sysid.records import Array

_SMALLEST_NORMAL = float(np.finfo(float).tiny)


def mjcf_inertial(theta: Array, principal: bool = False) -> str:
    """Return MJCF for theta (10,), in the body frame about its origin, exact to the last digit.

    With principal moments and axes, where asked for, instead of the full matrix, whose axes MuJoCo
    before 3.14 finds to six digits only.
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


def urdf_inertial_about_com(mass: float, com: Array, inertia: Array) -> str:
    """Return URDF for a mass, centre of mass (3,) and inertia about it (3, 3) in link axes."""
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    moments = dict(zip(names, map(number, spatial.six_from_symmetric(inertia))))
    return (
        f'<inertial><origin xyz="{numbers(com)}" rpy="0 0 0"/><mass value="{float(mass)!r}"/>'
        f"<inertia{attributes(moments)}/></inertial>"
    )


def numbers(values: Array) -> str:
    """Return numbers with all their digits, separated by spaces."""
    return " ".join(map(number, values))


def number(value: float) -> str:
    """Return a number with all its digits."""
    # Also turns -0.0 into 0.0; MuJoCo 3.3 refuses to read denormal numbers.
    return repr(float(value)) if abs(value) >= _SMALLEST_NORMAL else "0.0"


def rmse_words(rmse: float) -> str:
    """Return how a comment states the residual [N m] of the identification that it is of."""
    return (
        f"RMSE {rmse:.6f} Nm" if rmse == 0.0 or rmse >= 1e-6 else f"RMSE {rmse:.3g} Nm"
    )


_ROUNDING = 1e-9
"""Relative difference that the check of the written model lets pass (``results.verification``)."""


def setting(document: ModelDocument, name: str) -> str | None:
    """Return a compiler attribute; the last one in the file counts."""
    values = [
        node.get(name) for node in document.settings("compiler") if node.get(name)
    ]
    return values[-1] if values else None


def setting_number(document: ModelDocument, name: str) -> float:
    """Return a compiler attribute that is a number, 0 where there is none."""
    text = setting(document, name) or "0"
    try:
        return float(text)
    except ValueError:
        _refuse(document, name, f"is {text!r}; write it as a decimal number")


def check_settings(
    document: ModelDocument, body: Node, theta: Array, gets_child: bool = False
) -> None:
    """Raise ExportError where the compiler would change theta (10,) as it is written, of a body or
    of a child that it gets.
    """
    if setting_number(document, "settotalmass") > 0.0:
        _refuse(document, "settotalmass", "rescales the mass of every body; remove it")
    is_fused = setting(document, "fusestatic") == "true" and document.kind == "mjcf"
    below = (node for node in body.walk() if node.tag == "body" and node is not body)
    welded = (not (node.child("joint") or node.child("freejoint")) for node in below)
    if is_fused and (gets_child or any(welded)):
        _refuse(
            document,
            "fusestatic",
            "merges bodies with the identified one; set it to false",
        )
    mass, _, inertia = spatial.com_from_theta(theta)
    smallest = float(np.linalg.eigvalsh(inertia)[0])
    for name, value in (("boundmass", mass), ("boundinertia", smallest)):
        bound = setting_number(document, name)
        # A value that is at its bound but for rounding is written; the written model is checked.
        if bound > value * (1.0 + _ROUNDING):
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
    for node in document.settings("compiler"):
        if node.get("inertiafromgeom"):
            edits.set(node, "inertiafromgeom", "auto")
    for body in document.walk("body"):
        old = body.child("inertial")
        if (
            old is not None
            and body not in written
            and any(map(_is_geom, body.children()))
        ):
            edits.replace(old, "")


def _is_geom(node: Node) -> bool:
    return node.tag == "geom" or (
        node.tag == "frame" and any(map(_is_geom, node.children()))
    )


def _refuse(document: ModelDocument, name: str, reason: str) -> NoReturn:
    raise ExportError(
        f"{document.path}: the compiler setting {name} {reason} to write the model"
    )
