"""The joints of a model file and their servos, and the edits that give them other numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from itertools import islice

from robot_sysid.errors import ExportError
from robot_sysid.mjcf import markup
from robot_sysid.mjcf.documents import ModelDocument, Node
from robot_sysid.mjcf.inertial import MULTIPLIERS, number, setting
from robot_sysid.mjcf.markup import Edit
from robot_sysid.mjcf.write_back import ActuatorChange, JointChange

_IN_URDF = {"damping": "damping", "frictionloss": "friction"}
_TAGS = ("joint", "freejoint")


def joint_edits(document: ModelDocument, change: JointChange) -> Iterator[tuple[Node, Edit]]:
    """Yield the edits that give a joint its new numbers.

    Raises:
        ExportError: the joint is not written out in the file, a URDF cannot hold the number, or a
            joint with it would drive itself.
    """
    further = {"nonlinear damping": min(change.polynomial)} if change.polynomial else {}
    for name, value in {**change.numbers, **further}.items():
        if not 0.0 <= value < math.inf:
            raise ExportError(
                f"joint '{change.label}' cannot get {name} {value:.4g}: it would drive itself, or "
                "is no number"
            )
    node = find_joint(document, change.label)
    if document.kind == "urdf":
        yield from _urdf_edits(document, node, change)
        return
    for name, value in change.numbers.items():
        span = node.file.span(node.element)
        # Nonlinear damping stands behind the linear one; where none was found the model's stays.
        beyond = (node.get(name) or "").split()[1:]
        if name == "damping" and change.polynomial is not None:
            beyond = [number(each) for each in change.polynomial]
        text = " ".join([number(value), *beyond])
        yield node, markup.set_attribute(node.file.text, span, name, text)
    yield from _spring_edits(document, node, change)


def _spring_edits(
    document: ModelDocument, node: Node, change: JointChange
) -> Iterator[tuple[Node, Edit]]:
    if change.spring is None:
        return
    stiffness, rest = change.spring
    in_degrees = node.get("type") != "slide" and setting(document, "angle") != "radian"
    place = math.degrees(rest) if in_degrees else rest
    for name, value in (("stiffness", stiffness), ("springref", place)):
        span = node.file.span(node.element)
        yield node, markup.set_attribute(node.file.text, span, name, number(value))


def actuator_edits(document: ModelDocument, change: ActuatorChange) -> Iterator[tuple[Node, Edit]]:
    """Yield the edits that give a position actuator its new gains."""
    sections = (node for node in document.root.children() if node.tag == "actuator")
    written = (node for section in sections for node in section.children())
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
        span = node.file.span(node.element)
        yield node, markup.set_attribute(node.file.text, span, name, value)


def _urdf_edits(
    document: ModelDocument, node: Node, change: JointChange
) -> Iterator[tuple[Node, Edit]]:
    if change.armature is not None:
        raise ExportError(
            f"{document.path}: a URDF cannot hold the rotor inertia of joint '{change.label}'; "
            "convert the model to MJCF first"
        )
    values = {_IN_URDF[name]: number(value) for name, value in change.numbers.items()}
    text, span = node.file.text, node.file.span(node.element)
    old = next((child for child in node.children() if child.tag == "dynamics"), None)
    if old is not None:
        place = old.file.span(old.element)
        for name, value in values.items():
            yield old, markup.set_attribute(text, place, name, value)
    elif values:
        attributes = "".join(f' {name}="{value}"' for name, value in values.items())
        yield node, markup.append_child(text, span, f"<dynamics{attributes}/>")


def find_joint(document: ModelDocument, label: str) -> Node:
    """Return the ``<joint>`` of a compiled joint.

    Args:
        label: the joint's name, or "#3" for the nameless joint with MuJoCo id 3.

    Raises:
        ExportError: it is not written out in the file, or a <replicate> repeats it.
    """
    joints = list(_joints(document))
    named = [node for node in joints if node.get("name") == label]
    by_number = re.fullmatch(r"#(\d+)", label)
    if len(named) > 1:
        raise ExportError(f"{document.path}: joint '{label}' stands in the file {len(named)} times")
    if not named and by_number and document.kind == "mjcf" and not _multipliers(document):
        named = joints[int(by_number.group(1)) :][:1]
    repeated = [n for n in _multipliers(document) if named and n.holds(named[0])]
    if not named or repeated:
        raise ExportError(
            f"{document.path}: joint '{label}' is not written out in the file (it comes from an "
            "attached, repeated or generated part); write it out, with a name"
        )
    return named[0]


def _joints(document: ModelDocument) -> Iterator[Node]:
    """Yield the joints in the order in which MuJoCo numbers them: those of a body before those of
    the bodies in it."""
    if document.kind == "urdf":
        yield from (node for node in document.root.children() if node.tag == "joint")
        return
    for section in document.root.children():
        if section.tag == "worldbody":
            yield from _of_body(section)


def _of_body(body: Node) -> Iterator[Node]:
    inside = list(_without_frames(body))
    yield from (node for node in inside if node.tag in _TAGS)
    for child in inside:
        if child.tag in ("body", *MULTIPLIERS):
            yield from _of_body(child)


def _without_frames(body: Node) -> Iterator[Node]:
    """Yield a body's children, those of a ``<frame>`` in its place."""
    for child in body.children():
        yield from _without_frames(child) if child.tag == "frame" else (child,)


def _multipliers(document: ModelDocument) -> list[Node]:
    return [node for node in document.walk() if node.tag in MULTIPLIERS]
