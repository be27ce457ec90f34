"""Numbers and inertias as model files state them, and what compiler settings change of them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.documents import Edits, ModelDocument, Node, attributes
from robot_sysid.records import Array, SubtreeBody

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


NOTHING = 1e-6
SLACK = 1e-10
MARGIN = 1e-11
"""Mass, relative to the link's, below which a difference is only rounding; how far, relative to its
size, a body may be from possible before it is refused; how far inside the possible it is written,
some 4e4 roundings, because MuJoCo refuses what these put outside."""
_MOMENTS = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0])


@dataclass(frozen=True)
class WriteBack:
    """What to write into the model.

    Attributes:
        theta: (10,) inertial parameters of the terminal body alone, in its own frame.
        lumped: the bodies whose inertia went into the terminal body and which weigh nothing now.
        inflated: by how much all moments of inertia are larger than identified [kg m^2].
        scaled, scale: the bodies on joints of their own of which only that part is left.
    """

    theta: Array
    lumped: tuple[SubtreeBody, ...] = ()
    note: str | None = None
    inflated: float = 0.0
    scaled: tuple[SubtreeBody, ...] = ()
    scale: float = 1.0

    def written(self, composite: Array) -> Array:
        """Return what an identified composite (10,) is in the written model."""
        return composite + self.inflated * _MOMENTS


def plan_write_back(
    composite: Array,
    bodies: Sequence[SubtreeBody],
    least_moment: float = 0.0,
    most_inflated: float = 0.0,
) -> WriteBack:
    """Share an identified composite among the bodies of the terminal link, or raise ExportError
    where it is no possible body itself, or nothing of the bodies on joints has room in it.

    Args:
        composite: (10,) of the terminal body and all below it, in the terminal body's frame.
        bodies: those bodies as the model describes them, the terminal body first.
        least_moment: smallest principal moment the file's compiler leaves alone [kg m^2].
        most_inflated: by how much all three moments may be inflated, because they are not known any
            better [kg m^2].
    """
    top = bodies[0]
    mass = float(composite[0])
    tolerance = (least_moment, most_inflated)
    lumped: tuple[SubtreeBody, ...] = ()
    scaled = lumped
    scale = 1.0
    beside = _sum(bodies[1:])
    if possible_body(composite - beside, mass, *tolerance) is None:
        below = [body for body in bodies[1:] if np.any(body.theta)]
        lumped = tuple(body for body in below if body.welded)
        hanging = tuple(body for body in below if not body.welded)
        beside = _sum(hanging)
        if possible_body(composite - beside, mass, *tolerance) is None:
            scale = _largest_scale(composite, beside)
            scaled = hanging
    rest = composite - scale * beside
    own = possible_body(rest, mass, *tolerance)
    if own is None or scale < NOTHING:
        fault = f"the identified parameters of body '{top.name}' are not a possible rigid body"
        raise ExportError(f"{fault}, so no model was written; use a longer motion")
    plan = WriteBack(own, lumped, None, float(own[4] - rest[4]), scaled, scale)
    return replace(plan, note="; ".join(_notes(top, plan)) or None)


def _sum(bodies: Sequence[SubtreeBody]) -> Array:
    return np.sum([np.zeros(10), *(body.theta for body in bodies)], axis=0)


def _largest_scale(composite: Array, hanging: Array) -> float:
    """Return the largest part, below 1, of bodies that leaves a possible rest; 0 for none."""
    # Possible bodies are a convex set: what leaves one is an interval that begins at nothing.
    low = 0.0
    high = 1.0
    for _ in range(60):  # down to the last digit
        middle = (low + high) / 2.0
        leaves_a_body = (
            possible_body(composite - middle * hanging, float(composite[0])) is not None
        )
        low, high = (middle, high) if leaves_a_body else (low, middle)
    return low


def _notes(above: SubtreeBody, plan: WriteBack) -> Iterator[str]:
    both = plan.lumped, plan.scaled
    emptied, lighter = (", ".join(f"'{b.name}'" for b in bodies) for bodies in both)
    if plan.lumped:
        yield (
            f"body '{above.name}' now holds the inertia of all that is rigidly attached to it; "
            f"{emptied} weigh nothing in the written model"
        )
    if plan.scaled:
        yield (
            f"{lighter} on joints of their own below body '{above.name}' left no possible body "
            "of what was identified of all of them, so their mass and inertia are "
            f"{plan.scale:.4g} of the model's in the written model"
        )
    moments = np.linalg.eigvalsh(spatial.com_from_theta(plan.theta)[2])
    if plan.inflated > SLACK * float(np.sum(moments)):  # by more than rounding
        yield (
            "the model file cannot hold moments of inertia as small as identified (its compiler "
            "settings, or what other bodies hold already), so all three are written "
            f"{plan.inflated:.2g} kg m^2 larger; that is less than their standard errors"
        )


def possible_body(
    theta: Array, scale: float, least_moment: float = 0.0, most_inflated: float = 0.0
) -> Array | None:
    """Return theta (10,), a difference of two bodies, moved inside the possible where rounding left
    it on the edge, or None. Beside ``scale``, the mass of the larger one [kg], what is tiny is
    nothing; the others as in ``plan_write_back``.
    """
    mass, com, inertia = spatial.com_from_theta(theta)
    size = float(np.trace(inertia)) / 2.0
    if not np.all(np.isfinite(theta)) or mass <= NOTHING * scale or size <= 0.0:
        return None
    # Second moments about the centre of mass: a body is possible when they are not negative.
    moments = np.linalg.eigvalsh(inertia)
    smallest = 1.0 - float(moments[-1]) / size
    # Adding s to each second moment adds 2 s to each moment of inertia.
    inflated = 2.0 * max(0.0, MARGIN - smallest) * size
    if most_inflated >= least_moment - float(moments[0]):
        inflated = max(inflated, least_moment - float(moments[0]))
    if inflated > max(2.0 * (SLACK + MARGIN) * size, most_inflated):
        return None
    return spatial.theta_from_com(mass, com, inertia + inflated * np.eye(3))
