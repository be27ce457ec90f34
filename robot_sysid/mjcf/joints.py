"""The joints of a model file and their servos, and the edits that give them other numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from itertools import islice

from robot_sysid.errors import ExportError
from robot_sysid.mjcf import markup
from robot_sysid.mjcf.documents import ModelDocument, Node
from robot_sysid.mjcf.edits import Edits
from robot_sysid.mjcf.inertial import MULTIPLIERS, find_named, number, setting
from robot_sysid.mjcf.write_back import ActuatorChange, JointChange

_IN_URDF = {"damping": "damping", "frictionloss": "friction"}
_TAGS = ("joint", "freejoint")


def write_joint(edits: Edits, change: JointChange) -> None:
    """Give a joint its new numbers.

    Raises:
        ExportError: the joint is not written out in the file, a URDF cannot hold the number, or a
            joint with it would drive itself.
    """
    document = edits.document
    further = {"nonlinear damping": min(change.polynomial)} if change.polynomial else {}
    for name, value in {**change.numbers, **further}.items():
        if not 0.0 <= value < math.inf:
            raise ExportError(
                f"joint '{change.label}' cannot get {name} {value:.4g}: it would drive itself, or "
                "is no number"
            )
    node = find_joint(document, change.label)
    if document.kind == "urdf":
        _write_urdf(edits, node, change)
        return
    for name, value in change.numbers.items():
        # Nonlinear damping stands behind the linear one; where none was found the model's stays.
        beyond = (node.get(name) or "").split()[1:]
        if name == "damping" and change.polynomial is not None:
            beyond = [number(each) for each in change.polynomial]
        edits.set(node, name, " ".join([number(value), *beyond]))
    if change.spring is not None:
        stiffness, rest = change.spring
        in_degrees = node.get("type") != "slide" and setting(document, "angle") != "radian"
        edits.set(node, "stiffness", number(stiffness))
        edits.set(node, "springref", number(math.degrees(rest) if in_degrees else rest))


def write_actuator(edits: Edits, change: ActuatorChange) -> None:
    """Give a position actuator its new gains; ExportError where the file does not write it out."""
    document = edits.document
    written = (node for section in document.tagged("actuator") for node in section.children())
    node = next(islice(written, change.actuator, None), None)
    kp, kv = number(change.stiffness), number(change.damping)
    attributes = {
        "position": {"kp": kp, "kv": kv},
        "general": {"gainprm": kp, "biasprm": f"0 -{kp} -{kv}"},
    }.get("" if node is None else node.tag)
    if node is None or attributes is None:
        raise ExportError(
            f"{document.path}: actuator number {change.actuator} is not written out in the file as "
            "a <position> or <general> element; write it out"
        )
    if change.delay is not None:
        attributes |= {"delay": number(change.delay), "nsample": str(change.samples)}
        attributes["interp"] = "linear"
    for name, value in attributes.items():
        edits.set(node, name, value)


def _write_urdf(edits: Edits, node: Node, change: JointChange) -> None:
    if change.armature is not None:
        raise ExportError(
            f"{edits.document.path}: a URDF cannot hold the rotor inertia of joint "
            f"'{change.label}'; convert the model to MJCF first"
        )
    values = {_IN_URDF[name]: number(value) for name, value in change.numbers.items()}
    old = node.child("dynamics")
    if old is not None:
        for name, value in values.items():
            edits.set(old, name, value)
    elif values:
        attributes = "".join(f' {name}="{value}"' for name, value in values.items())
        new = f"<dynamics{attributes}/>"
        edits.add(node, markup.append_child(node.file.text, node.span, new))


def find_joint(document: ModelDocument, label: str) -> Node:
    """Return the ``<joint>`` of a compiled joint.

    Args:
        label: the joint's name, or "#3" for the nameless joint with MuJoCo id 3.

    Raises:
        ExportError: it is not written out in the file, or a <replicate> repeats it.
    """
    joints = list(_joints(document))
    found = find_named(document, joints, "joint", label)
    by_number = re.fullmatch(r"#(\d+)", label)
    multipliers = [node for node in document.walk() if node.tag in MULTIPLIERS]
    if found is None and by_number and document.kind == "mjcf" and not multipliers:
        found = next(islice(joints, int(by_number.group(1)), None), None)
    if found is None or any(node.holds(found) for node in multipliers):
        raise ExportError(
            f"{document.path}: joint '{label}' is not written out in the file (it comes from an "
            "attached, repeated or generated part); write it out, with a name"
        )
    return found


def _joints(document: ModelDocument) -> Iterator[Node]:
    """Yield the joints in the order in which MuJoCo numbers them: those of a body before those of
    the bodies in it."""
    if document.kind == "urdf":
        yield from document.tagged("joint")
    for world in document.tagged("worldbody"):
        for body in (n for n in world.walk() if n.tag in ("worldbody", "body", *MULTIPLIERS)):
            yield from (node for node in _without_frames(body) if node.tag in _TAGS)


def _without_frames(body: Node) -> Iterator[Node]:
    """Yield a body's children, those of a ``<frame>`` in its place."""
    for child in body.children():
        yield from _without_frames(child) if child.tag == "frame" else (child,)
