"""A model file's own text with other inertias, joint numbers, gravity, and a new body where wanted.

Comments and order stay; paths are rewritten so that it loads from its new folder.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from lxml import etree
from lxml.builder import E

from robot_sysid import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.assets import relocate
from robot_sysid.mjcf.documents import (
    OWN_COMMENT,
    ModelDocument,
    Node,
    append,
    get,
    put_comment,
    put_inertial,
    read_document,
)
from robot_sysid.mjcf.inertial import (
    format_number,
    format_numbers,
    mjcf_inertial,
    urdf_inertial_about_com,
)
from robot_sysid.mjcf.urdf import (
    drop_unused_axes,
    give_minimum,
    mend_inertias,
    raise_inertias,
    weld_floating,
)
from robot_sysid.records import Array, Flange

RANGES = {"forcerange": "forcelimited", "actuatorfrcrange": "actuatorfrclimited"}
"""Attribute with a largest torque to both sides to the one that makes it act."""


@dataclass(frozen=True)
class BodyChange:
    """New inertia for a body, or a new body.

    Attributes:
        label: the body's name, or "#7" for the nameless body with MuJoCo id 7.
        body_id: MuJoCo's id of the body, by which the written model is verified; of a new body that
            of the one it is fixed to.
        theta: (10,) its parameters in its own frame; zeros empty it.
        addition: further text for the comment that is written beside the inertia.
        flange: where a new body is fixed to the terminal one; None for a body of the file.
    """

    label: str
    body_id: int
    theta: Array
    addition: str = ""
    flange: Flange | None = None


@dataclass(frozen=True)
class ElementChange:
    """New numbers of an element that is no body.

    Attributes:
        kind: "joint"; "rotor", that of a URDF's joint; "actuator"; or "tendon", a fixed one, which
            is a motor that turns several joints.
        owner: name of the joint; MuJoCo's id of an actuator or tendon, None for a tendon that the
            file does not have yet.
        numbers: new values by their name in MJCF: "armature" (rotor inertia at the joint, of a URDF
            that of its "rotor"), "damping" and "frictionloss" (viscous and Coulomb friction), and
            "stiffness" and "springyield" of a spring that is dry friction; "frictionloss" of an
            actuator is that of a DC motor, and 0; of a position actuator, before its gear, "kp"
            and "kv", with which it makes kp (ctrl - q) - kv qd, and "forcerange", its largest
            force to both sides; "solimpfriction" of a joint, how firmly its dry friction holds. A
            <position> has no kv before MuJoCo 3.1.
        coefficients: joint name to speed of the tendon per speed of that joint.
        further: new damping per speed squared and cubed; None leaves the file's.
    """

    kind: str
    owner: Any
    numbers: Mapping[str, float]
    coefficients: Mapping[str, float] = field(default_factory=dict)
    further: tuple[float, float] | None = None


@dataclass(frozen=True)
class ModelChange:
    """All changes of a model.

    Attributes:
        bodies: those that get a new inertia, new ones last.
        rmse: residual of the identification, for the comments [N m].
        elements: what else gets new numbers.
        gravity: (3,) new gravity in the world frame [m/s^2]; None leaves the file's.
        principal: whether inertias are written as principal moments and axes, not as full matrix.
    """

    bodies: tuple[BodyChange, ...]
    rmse: float
    elements: tuple[ElementChange, ...] = ()
    gravity: Array | None = None
    principal: bool = False


def changed_model_text(
    source: Path, change: ModelChange, folder: Path, mesh_dir: Path | None = None
) -> bytes:
    """Return the text of a model file with a change made, for the folder where it will live.

    Included files take the place of their ``<include>``. In a URDF, moving links without mass get a
    minimum of it.

    Args:
        source: the model file, which stays as it is.
        change: what is changed.
        folder: where the text will live; its paths are relative to this folder.
        mesh_dir: the user's mesh folder, if any.

    Raises:
        ExportError: the file does not contain an element itself (see ``find_element``).
    """
    document = read_document(source, mesh_dir)
    if document.is_urdf:
        weld_floating(document)
    for element in change.elements:
        write_element(document, element, change.rmse)
    written = []
    for body in change.bodies:
        if body.flange is None:
            node = find_element(document, "body", body.label)
        else:
            node = _add_body(document, body.label, body.flange)
        _state_origin(node, f"body '{body.label}'", change.rmse, body.addition)
        text = mjcf_inertial(body.theta, change.principal)
        if document.is_urdf:
            text = urdf_inertial_about_com(*spatial.com_from_theta(body.theta))
        put_inertial(node, text)
        written.append(node)
    if change.gravity is not None:
        _write_gravity(document, change.gravity)
    if document.is_urdf:
        # MuJoCo has to load the text by itself, so links get what compilation gave them.
        drop_unused_axes(document)
        give_minimum(document, excluded=written)
        mend_inertias(document, excluded=written)
        raise_inertias(document, excluded=written)
    else:
        # "true" overrides every <inertial>.
        for node in document.settings("compiler"):
            if node.get("inertiafromgeom") == "true":
                node.set("inertiafromgeom", "auto")
    relocate(document, folder)
    return document.text()


def _state_origin(node: Node, subject: str, rmse: float, addition: str = "") -> None:
    """Put the XML comment before an element that a subject, such as "body 'hand'", was identified.

    Args:
        node: the element.
        subject: what its numbers are those of.
        rmse: residual of the identification [N m].
        addition: further text; "" for none.
    """
    residual = f"{rmse:.3g}" if 0.0 < rmse < 1e-6 else f"{rmse:.6f}"
    text = f"{OWN_COMMENT} {subject} identified with RMSE {residual} Nm"
    text += f"; {addition}" if addition else ""
    # A name may hold ends of lines, and dashes that would end the comment.
    put_comment(node, f" {re.sub('-(?=-)', '- ', ' '.join(text.split()))} ")


def _add_body(document: ModelDocument, name: str, flange: Flange) -> Node:
    """Add an empty body at a flange, in a URDF with a fixed joint, and return its element.

    ExportError where its name is empty or taken.
    """
    joint_name = f"{name}_joint"
    carrier = find_element(document, "body", flange.terminal)
    nodes = document.root.iter("body", "link", "joint")
    taken = {"world", *(node.get("name") for node in nodes)}
    is_text = name.strip() and name.isprintable()
    if not is_text or not taken.isdisjoint((name, joint_name)):
        raise ExportError(
            f"{document.path}: the new body cannot be called '{name}', because that name is empty "
            "or taken; choose another"
        )
    position = format_numbers(flange.translation)
    if document.is_urdf:
        # All links of a URDF stand side by side.
        angles = format_numbers(spatial.roll_pitch_yaw(flange.rotation))
        joint = E.joint(
            E.parent(link=flange.terminal),
            E.child(link=name),
            E.origin(xyz=position, rpy=angles),
            name=joint_name,
            type="fixed",
        )
        link = E.link(name=name)
        append(document.root, link, joint)
    else:
        turn = format_numbers(spatial.quaternion(flange.rotation))
        link = E.body(name=name, pos=position, quat=turn)
        append(carrier, link)
    return link


# MuJoCo's own, where a model states none [m/s^2].
_DEFAULT_GRAVITY = "0 0 -9.81"


def _write_gravity(document: ModelDocument, gravity: Array) -> None:
    """Give a model another gravity; MuJoCo reads the ``<option>`` in a URDF's ``<mujoco>``.

    ExportError where the file switches gravity off.

    Args:
        document: the model file.
        gravity: (3,) in the world frame [m/s^2].
    """
    for flag in document.settings("option/flag"):
        if flag.get("gravity") == "disable":
            fault = '<flag gravity="disable"/> switches gravity off; remove it'
            raise ExportError(f"{document.path}: {fault}")
    # The last option that states it counts, in whichever file it stands.
    if not document.settings("option"):
        document.add_setting(E.option())
    options = document.settings("option")
    stating = [option for option in options if option.get("gravity")]
    changed = (stating or options)[-1]
    old = changed.get("gravity", _DEFAULT_GRAVITY)
    reason = f"in place of {old}, because the arm does not stand as the file said"
    put_comment(changed, f" {OWN_COMMENT} gravity {reason} ")
    changed.set("gravity", format_numbers(gravity))


def write_element(document: ModelDocument, change: ElementChange, rmse: float) -> None:
    """Give an element its new numbers; nonlinear damping stays behind linear one, or is new.

    Args:
        document: the model file.
        change: the numbers.
        rmse: residual of the identification, for a tendon's comment [N m].

    Raises:
        ExportError: a number is negative or not finite, or the file does not contain the element
            itself (see ``find_element``).
    """
    motor = f"motor that turns {' and '.join(change.coefficients)}"
    owner = f"the {motor}" if change.coefficients else f"{change.kind} '{change.owner}'"
    numbers = dict(change.numbers)
    for name, value in numbers.items():
        if not 0.0 <= value < math.inf:
            raise ExportError(
                f"{owner} cannot get {name} {value:.4g}: it would drive itself, or is no number"
            )
    if change.kind == "rotor":
        _write_rotor(document, change.owner, numbers["armature"])
        return
    if change.kind == "joint":
        node = find_element(document, "joint", change.owner)
    elif change.owner is None:
        node = _add_tendon(document, change.coefficients)
    else:
        node = _numbered_element(document, change)
    if change.coefficients:
        _state_origin(node, motor, rmse)
    if document.is_urdf:
        joint = node
        node = joint.find("dynamics")
        if node is None:
            node = E.dynamics()
            append(joint, node)
    if change.kind == "actuator" and "frictionloss" in numbers:
        del numbers["frictionloss"]
        _take_bristles(document, node, change.owner)
    if node.tag == "general" and "kp" in numbers:
        kp = format_number(numbers.pop("kp"))
        kv = format_number(numbers.pop("kv", 0.0))
        node.attrib.update({"gainprm": kp, "biasprm": f"0 -{kp} -{kv}"})
    for name, value in numbers.items():
        text = format_number(value)
        if name == "kv":
            # A <position> states its damping itself or by a ratio, not both.
            node.attrib.pop("dampratio", None)
        if name in RANGES:
            text = f"-{text} {text}"
            node.set(RANGES[name], "true")
        if name == "solimpfriction":
            # Behind both ends of its impedance are the numbers of the way between them.
            further_numbers = (node.get(name) or "").split()[2:]
            text = " ".join([text, text, *further_numbers])
        if name == "damping" and change.kind != "actuator":
            nonlinear = (node.get(name) or "").split()[1:]
            if change.further is not None:
                is_any = any(change.further)
                nonlinear = [*map(format_number, change.further)] if is_any else []
            text = " ".join([text, *nonlinear])
        is_renamed = node.tag == "dynamics" and name == "frictionloss"
        node.set("friction" if is_renamed else name, text)


# Attribute of a <general> that is a DC motor to the places of its dry friction in it.
_BRISTLES = {"dynprm": slice(5, 7), "biasprm": slice(3, 6)}


def _take_bristles(document: ModelDocument, node: Node, actuator: int) -> None:
    """Take the dry friction from a DC motor (id), in place, with the state of its bristles.

    ExportError where it is stated for a class of actuators.
    """
    if node.tag == "dcmotor":
        node.set("lugre", "0 0 0 0 0")
        return
    for name, places in _BRISTLES.items():
        numbers = (node.get(name) or "").split()
        if len(numbers) <= places.start:
            raise ExportError(
                f"{document.path}: the LuGre friction of actuator number {actuator} is not written "
                f"out in the file ({name}); write it out"
            )
        count = len(numbers[places])
        numbers[places] = ["0"] * count
        node.set(name, " ".join(numbers))
    states = node.get("actdim")
    if states is not None:
        node.set("actdim", str(int(states) - 1))


# Namespace of Drake's elements, which state the rotor of an actuator in a URDF.
_DRAKE = "http://drake.mit.edu"


def _write_rotor(document: ModelDocument, joint: str, rotor: float) -> None:
    """State a joint's rotor inertia [kg m^2] in its transmission of a URDF, which may be a new one.

    The transmission's reduction n stays: the rotor before the gear has rotor / n^2.
    """
    for transmission in document.root.findall("transmission"):
        actuator = transmission.find("actuator")
        if get(transmission.find("joint"), "name") == joint and actuator is not None:
            break
    else:
        actuator = E.actuator(E.mechanicalReduction("1"), name=f"{joint}_motor")
        transmission = E.transmission(
            E.type("transmission_interface/SimpleTransmission"),
            E.joint(name=joint),
            actuator,
            name=f"{joint}_transmission",
        )
        append(document.root, transmission)
    text = actuator.findtext("mechanicalReduction") or "1"
    ratio = abs(float(text)) or 1.0
    for name, value in (("rotor_inertia", rotor / ratio**2), ("gear_ratio", ratio)):
        tag = f"{{{_DRAKE}}}{name}"
        node = actuator.find(tag)
        if node is None:
            node = etree.Element(tag, nsmap={"drake": _DRAKE})
            append(actuator, node)
        node.set("value", format_number(value))


def _add_tendon(document: ModelDocument, coefficients: Mapping[str, float]) -> Node:
    """Add a fixed tendon over joints, by name with the tendon's speed per speed of each."""
    node = E.fixed()
    for joint, coefficient in coefficients.items():
        node.append(E.joint(joint=joint, coef=format_number(coefficient)))
    sections = document.root.findall("tendon")
    if not sections:
        sections = [E.tendon()]
        append(document.root, *sections)
    append(sections[-1], node)
    return node


def _numbered_element(document: ModelDocument, change: ElementChange) -> Node:
    """Return the element of a tendon or actuator, which the file itself must contain.

    MuJoCo's id counts the children of all sections from 0. ExportError where there are no more, or
    the element cannot hold the numbers.
    """
    children = document.root.iterfind(f"{change.kind}/*")
    node = next(islice(children, change.owner, None), None)
    is_actuator = change.kind == "actuator"
    tags = ("position", "pid", "general") if is_actuator else ("fixed",)
    fault = " as a <fixed>"
    if is_actuator:
        fault = ", or gets gains and is no <position>, <pid> or <general>"
    is_any = is_actuator and "kp" not in change.numbers
    if node is None or not (is_any or node.tag in tags):
        raise ExportError(
            f"{document.path}: {change.kind} number {change.owner} is not written out in the file"
            f"{fault}; write it out"
        )
    return node


# Elements that make bodies which are not written out.
_MULTIPLIERS = ("replicate", "attach", "composite", "flexcomp")


def find_element(document: ModelDocument, element: str, label: str) -> Node:
    """Return the element of a compiled body or joint, which the file itself must contain.

    ExportError where it is a nameless joint, or comes from an element that makes bodies, such as
    ``<replicate>``.

    Args:
        element: "body", which is a ``<link>`` in a URDF, or "joint".
        label: its name, or "#7" for the nameless body with MuJoCo id 7.
    """
    path = f"worldbody//{element}"
    if document.is_urdf:
        path = "link" if element == "body" else "joint"
    has_multiplier = next(document.root.iter(*_MULTIPLIERS), None) is not None
    is_numbered = element == "body" and not has_multiplier
    for number, node in enumerate(document.root.iterfind(path), 1):
        name = node.get("name") or (f"#{number}" if is_numbered else None)
        is_made = next(node.iterancestors(*_MULTIPLIERS), None) is not None
        if name == label and not is_made:
            return node
    raise ExportError(
        f"{document.path}: {element} '{label}' is not written out in the file (it has no name, or "
        "comes from an attached, repeated or generated part); write it out, with a name"
    )
