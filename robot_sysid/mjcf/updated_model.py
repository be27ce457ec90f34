"""A model file's own text with other inertias, joint numbers, gravity, and a new body where wanted.

Comments, order and white space stay; paths are rewritten so that it loads from its new folder.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.assets import relocated_text
from robot_sysid.mjcf.documents import ModelDocument, Node, read_document
from robot_sysid.mjcf.edits import Edits, quoted
from robot_sysid.mjcf.inertial import (
    MULTIPLIERS,
    check_settings,
    comment_text,
    find_body,
    find_named,
    let_inertials_count,
    mjcf_inertial,
    number,
    numbers,
    setting,
    urdf_inertial,
    write_inertial,
)
from robot_sysid.mjcf.urdf import give_minimum
from robot_sysid.mjcf.write_back import ActuatorChange, JointChange, ModelChange, WeldedBody


def changed_model_text(
    source: Path, change: ModelChange, folder: Path, mesh_dir: Path | None = None
) -> bytes:
    """Return the text of a model file with a change made.

    Of an MJCF with includes, the included files that lead to something changed, and those that
    contain paths, take the place of their ``<include>``; the others stay included.

    Args:
        folder: where the text will live.
        mesh_dir: the user's mesh folder, if any.

    Raises:
        ExportError: a body or joint is not written out in the file, a name is taken, or a setting
            of the file changes inertias when it is compiled.
    """
    edits = Edits(read_document(source))
    written = _write_bodies(edits, change)
    for joint in change.joints:
        write_joint(edits, joint)
    for actuator in change.actuators:
        write_actuator(edits, actuator)
    if change.welded is not None:
        weld(edits, change.welded, change)
    if change.gravity is not None:
        write_gravity(edits, change.gravity, change.rmse)
    if edits.document.kind == "urdf":
        # Also what was added to get it compiled: MuJoCo has to load the text by itself.
        give_minimum(edits, but={body.get("name") for body in written})
    else:
        let_inertials_count(edits, written)
    return relocated_text(edits, folder, mesh_dir)


def _write_bodies(edits: Edits, change: ModelChange) -> list[Node]:
    document, principal, written = edits.document, change.principal, []
    for body in change.bodies:
        found, theta = find_body(document, body.label), body.plan.theta
        check_settings(document, found, theta)
        lumped = [find_body(document, other.name) for other in body.plan.lumped]
        edits.comment(found, comment_text(f"body '{body.label}'", change.rmse, body.comment))
        for node, parameters in ((found, theta), *((other, 0.0 * theta) for other in lumped)):
            is_urdf = document.kind == "urdf"
            text = urdf_inertial(parameters) if is_urdf else mjcf_inertial(parameters, principal)
            write_inertial(edits, node, text)
        written += [found, *lumped]
    return written


def weld(edits: Edits, body: WeldedBody, change: ModelChange) -> None:
    """Add the new body of a change."""
    document = edits.document
    carrier = find_body(document, body.carrier)
    check_settings(document, carrier, body.theta, gets_child=True)
    _check_name(document, body.name)
    comment = comment_text(f"body '{body.name}'", change.rmse, body.words)
    if document.kind == "urdf":
        # All links of a URDF stand side by side.
        place, lines = document.root, [comment, *_urdf_lines(body)]
    else:
        turn = numbers(spatial.quaternion(body.rotation))
        pose = f'pos="{numbers(body.translation)}" quat="{turn}"'
        inertial = f"  {mjcf_inertial(body.theta, change.principal)}"
        lines = [comment, f"<body name={quoted(body.name)} {pose}>", inertial, "</body>"]
        place = carrier
    edits.append(place, "\n".join(lines))


def _urdf_lines(body: WeldedBody) -> list[str]:
    name, carrier = quoted(body.name), quoted(body.carrier)
    turn = numbers(spatial.roll_pitch_yaw(body.rotation))
    return [
        f"<link name={name}>{urdf_inertial(body.theta)}</link>",
        f'<joint name={quoted(joint_name(body.name))} type="fixed"><parent link={carrier}/>'
        f'<child link={name}/><origin xyz="{numbers(body.translation)}" rpy="{turn}"/></joint>',
    ]


def joint_name(body: str) -> str:
    """Return what the fixed joint of a URDF's new link is called."""
    return f"{body}_joint"


def _check_name(document: ModelDocument, name: str) -> None:
    bodies = {n.get("name") for n in document.walk() if n.tag in ("body", "link")} | {"world"}
    joints = {n.get("name") for n in document.walk() if n.tag == "joint"}
    is_urdf = document.kind == "urdf"
    if not name.strip() or name in bodies or (is_urdf and joint_name(name) in joints):
        raise ExportError(
            f"{document.path}: the new body cannot be called '{name}', because that name is empty "
            f"or taken; bodies of the model: {', '.join(sorted(str(b) for b in bodies if b))}"
        )


_MUJOCOS_OWN = "0 0 -9.81"


def write_gravity(edits: Edits, gravity: tuple[float, float, float], rmse: float) -> None:
    """Give a model another gravity; MuJoCo reads the ``<option>`` in a URDF's ``<mujoco>`` part.

    Args:
        gravity: in the model's world frame [m/s^2].
        rmse: of the identification [N m], for the comment.
    """
    options = edits.document.settings("option")
    flags = [node for option in options for node in option.children() if node.tag == "flag"]
    if any(flag.get("gravity") == "disable" for flag in flags):
        raise ExportError(
            f'{edits.document.path}: <flag gravity="disable"/> switches gravity off, so that the '
            "identified one would do nothing; remove it"
        )
    if not np.all(np.isfinite(gravity)):
        raise ExportError(f"gravity cannot be written as {gravity}: it is no vector")
    stating = [option for option in options if option.get("gravity")]
    before = (stating[-1].get("gravity") if stating else None) or _MUJOCOS_OWN
    words = f"in place of {before}, because the arm does not stand as the file said"
    comment, text = comment_text("gravity", rmse, words), numbers(np.asarray(gravity))
    if not options:
        edits.settings += [comment, f'<option gravity="{text}"/>']
        return
    # The last one that states it counts, in whichever file it stands.
    node = (stating or options)[-1]
    edits.comment(node, comment)
    edits.set(node, "gravity", text)


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
        edits.append(node, f"<dynamics{attributes}/>")


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
    """Yield the joints in MuJoCo's order: those of a body before those of the bodies in it."""
    if document.kind == "urdf":
        yield from document.tagged("joint")
    for world in document.tagged("worldbody"):
        for body in (n for n in world.walk() if n.tag in ("worldbody", "body", *MULTIPLIERS)):
            yield from (node for node in _without_frames(body) if node.tag in _TAGS)


def _without_frames(body: Node) -> Iterator[Node]:
    for child in body.children():
        yield from _without_frames(child) if child.tag == "frame" else (child,)
