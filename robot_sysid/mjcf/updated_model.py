"""A model file's own text with other inertias, joint numbers, gravity, and a new body where wanted.

Comments, order and white space stay; paths are rewritten so that it loads from its new folder.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice, takewhile
from pathlib import Path

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf import inertial
from robot_sysid.mjcf.assets import relocated_text
from robot_sysid.mjcf.documents import (
    Edits,
    ModelDocument,
    Node,
    attributes,
    read_document,
)
from robot_sysid.mjcf.inertial import (
    WriteBack,
    mjcf_inertial,
    number,
    numbers,
    urdf_inertial_about_com,
)
from robot_sysid.mjcf.urdf import give_minimum
from robot_sysid.records import Array


@dataclass(frozen=True)
class BodyChange:
    """New inertia for a body, called "#7" where it has no name, and more words for its comment."""

    label: str
    body_id: int
    plan: WriteBack
    addition: str | None = None


@dataclass(frozen=True)
class JointChange:
    """New numbers for a joint; None leaves what the file says.

    Attributes:
        label: the joint's name, or "#3" for the nameless joint with id 3.
        armature: rotor inertia seen at the joint [kg m^2 or kg]; a URDF cannot hold it.
        damping, frictionloss: viscous and Coulomb friction [N m s/rad, N m or N s/m, N].
        polynomial: damping beyond the linear one, of qd abs(qd) and of qd^3; MuJoCo 3.7 and later.
    """

    label: str
    armature: float | None = None
    damping: float | None = None
    frictionloss: float | None = None
    polynomial: tuple[float, float] | None = None
    words: str = ""

    @property
    def numbers(self) -> dict[str, float]:
        """What is to be written, by its name in MJCF."""
        values = {
            name: getattr(self, name)
            for name in ("armature", "damping", "frictionloss")
        }
        return {
            name: float(value) for name, value in values.items() if value is not None
        }


@dataclass(frozen=True)
class TendonChange:
    """A motor that turns several joints, as a fixed tendon over them.

    Attributes:
        tendon: its MuJoCo id, or that which a new one gets; ``is_new`` tells which.
        coefficients: joint to speed of the tendon per speed of that joint.
        numbers: new ones, by their name in MJCF: "armature", "damping", "frictionloss".
    """

    tendon: int
    is_new: bool
    coefficients: Mapping[str, float]
    numbers: Mapping[str, float]
    words: str = ""


@dataclass(frozen=True)
class ActuatorChange:
    """New gains for a position actuator, by its MuJoCo id."""

    actuator: int
    stiffness: float
    damping: float


@dataclass(frozen=True)
class WeldedBody:
    """A body of its own, fixed to one of the file's.

    Its frame in the carrier's, (3, 3) and (3,) [m], and theta (10,) in its own frame.
    """

    name: str
    carrier: str
    rotation: Array
    translation: Array
    theta: Array
    words: str = ""


@dataclass(frozen=True)
class ModelChange:
    """All that is written into a model; the residual [N m] is for the comments, gravity [m/s^2] in
    the world frame, and ``principal`` as in ``inertial.mjcf_inertial``.
    """

    bodies: tuple[BodyChange, ...]
    rmse: float
    joints: tuple[JointChange, ...] = ()
    welded: WeldedBody | None = None
    actuators: tuple[ActuatorChange, ...] = ()
    tendons: tuple[TendonChange, ...] = ()
    gravity: tuple[float, float, float] | None = None
    principal: bool = False


def changed_model_text(
    source: Path, change: ModelChange, folder: Path, mesh_dir: Path | None = None
) -> bytes:
    """Return the text of a model file with a change made, for the folder where it will live.

    Of an MJCF with includes, the included files that lead to something changed, and those that
    contain paths, take the place of their ``<include>``; the others stay included. ExportError
    where something is not written out in the file, or a setting of it changes inertias.
    """
    edits = Edits(read_document(source))
    written = _write_bodies(edits, change)
    for joint in change.joints:
        write_joint(edits, joint)
    for actuator in change.actuators:
        write_actuator(edits, actuator)
    for tendon in change.tendons:
        _write_tendon(edits, tendon, change.rmse)
    if change.welded is not None:
        _weld(edits, change.welded, change)
    if change.gravity is not None:
        _write_gravity(edits, change.gravity, change.rmse)
    if edits.document.kind == "urdf":
        # Also what was added to get it compiled: MuJoCo has to load the text by itself.
        give_minimum(edits, but=written)
    else:
        inertial.let_inertials_count(edits, written)
    return relocated_text(edits, folder, mesh_dir)


def _write_bodies(edits: Edits, change: ModelChange) -> list[Node]:
    document = edits.document
    written = list[Node]()
    for body in change.bodies:
        found = find_element(document, "body", body.label)
        theta = body.plan.theta
        inertial.check_settings(document, found, theta)
        addition = "; ".join(filter(None, (body.addition, body.plan.note)))
        edits.comment(found, _comment(f"body '{body.label}'", change.rmse, addition))
        edits.put_inertial(found, _inertial(document, theta, change.principal))
        lumped = [
            find_element(document, "body", other.name) for other in body.plan.lumped
        ]
        for other in lumped:
            edits.put_inertial(
                other, _inertial(document, np.zeros(10), change.principal)
            )
        written += [found, *lumped]
    return written


def _inertial(document: ModelDocument, theta: Array, principal: bool) -> str:
    if document.kind == "urdf":
        return urdf_inertial_about_com(*spatial.com_from_theta(theta))
    return mjcf_inertial(theta, principal)


def _comment(what: str, rmse: float, addition: str) -> str:
    """Return the comment that says what was identified, of which body, say."""
    words = f"System ID: {what} identified with {inertial.rmse_words(rmse)}"
    words += f"; {addition}" if addition else ""
    # A name may hold ends of lines, and dashes that would end the comment.
    return f"<!-- {re.sub('-(?=-)', '- ', ' '.join(words.split()))} -->"


def _weld(edits: Edits, body: WeldedBody, change: ModelChange) -> None:
    """Add the new body of a change."""
    document = edits.document
    joint = f"{body.name}_joint"
    carrier = find_element(document, "body", body.carrier)
    inertial.check_settings(document, carrier, body.theta, gets_child=True)
    is_urdf = document.kind == "urdf"
    taken = {
        "world",
        *(node.get("name") or "" for node in document.walk("body", "link")),
    }
    joints = {node.get("name") for node in document.walk("joint")}
    if not body.name.strip() or body.name in taken or (is_urdf and joint in joints):
        listed = ", ".join(sorted(filter(None, taken)))
        raise ExportError(
            f"{document.path}: the new body cannot be called '{body.name}', because that name is "
            f"empty or taken; bodies of the model: {listed}"
        )
    comment = _comment(f"body '{body.name}'", change.rmse, body.words)
    own = _inertial(document, body.theta, change.principal)
    name = attributes({"name": body.name})
    place = numbers(body.translation)
    if is_urdf:
        # All links of a URDF stand side by side.
        parent = attributes({"link": body.carrier})
        child = attributes({"link": body.name})
        turn = numbers(spatial.roll_pitch_yaw(body.rotation))
        fixed = (
            f'<joint{attributes({"name": joint})} type="fixed"><parent{parent}/>'
            f'<child{child}/><origin xyz="{place}" rpy="{turn}"/></joint>'
        )
        edits.append(document.root, comment, f"<link{name}>{own}</link>", fixed)
    else:
        pose = f'pos="{place}" quat="{numbers(spatial.quaternion(body.rotation))}"'
        edits.append(carrier, comment, f"<body{name} {pose}>", f"  {own}", "</body>")


_MUJOCOS_OWN = "0 0 -9.81"


def _write_gravity(
    edits: Edits, gravity: tuple[float, float, float], rmse: float
) -> None:
    """Give a model another gravity; MuJoCo reads the ``<option>`` in a URDF's ``<mujoco>`` part."""
    options = edits.document.settings("option")
    flags = (
        node for option in options for node in option.children() if node.tag == "flag"
    )
    if any(flag.get("gravity") == "disable" for flag in flags):
        fault = '<flag gravity="disable"/> switches gravity off; remove it'
        raise ExportError(f"{edits.document.path}: {fault}")
    if not np.all(np.isfinite(gravity)):
        raise ExportError(f"gravity cannot be written as {gravity}: it is no vector")
    stating = [option for option in options if option.get("gravity")]
    before = (stating[-1].get("gravity") if stating else None) or _MUJOCOS_OWN
    words = f"in place of {before}, because the arm does not stand as the file said"
    comment = _comment("gravity", rmse, words)
    text = numbers(np.asarray(gravity))
    if not options:
        edits.settings += [comment, f'<option gravity="{text}"/>']
        return
    # The last one that states it counts, in whichever file it stands.
    node = (stating or options)[-1]
    edits.comment(node, comment)
    edits.set(node, "gravity", text)


def _require_resistance(owner: str, numbers: Mapping[str, float]) -> None:
    """Raise ExportError unless friction and rotor inertia are finite and not negative."""
    for name, value in numbers.items():
        if not 0.0 <= value < math.inf:
            fault = (
                f"cannot get {name} {value:.4g}: it would drive itself, or is no number"
            )
            raise ExportError(f"{owner} {fault}")


def write_joint(edits: Edits, change: JointChange) -> None:
    """Give a joint its new numbers, or raise ExportError where the file cannot hold them."""
    document = edits.document
    is_urdf = edits.document.kind == "urdf"
    further = {"nonlinear damping": min(change.polynomial)} if change.polynomial else {}
    _require_resistance(f"joint '{change.label}'", {**change.numbers, **further})
    node = find_element(document, "joint", change.label)
    written = {name: number(value) for name, value in change.numbers.items()}
    if is_urdf:
        if "frictionloss" in written:
            written["friction"] = written.pop("frictionloss")
        old = node.child("dynamics")
        if old is None:
            if written:
                edits.append(node, f"<dynamics{attributes(written)}/>")
            return
        node = old
    elif "damping" in written:
        # Nonlinear damping stands behind the linear one; where none was found the model's stays.
        beyond = (node.get("damping") or "").split()[1:]
        beyond = (
            beyond
            if change.polynomial is None
            else [number(n) for n in change.polynomial]
        )
        written["damping"] = " ".join([written["damping"], *beyond])
    for name, text in written.items():
        edits.set(node, name, text)


def _write_tendon(edits: Edits, change: TendonChange, rmse: float) -> None:
    """Give a fixed tendon its new numbers, or add it; ExportError where the file cannot hold it."""
    document = edits.document
    joints = list(change.coefficients)
    what = f"motor that turns {' and '.join(joints)}"
    _require_resistance(f"the {what}", change.numbers)
    written = {name: number(value) for name, value in change.numbers.items()}
    comment = _comment(what, rmse, change.words)
    sections = document.tagged("tendon")
    if not change.is_new:
        nodes = (node for section in sections for node in section.children())
        node = next(islice(nodes, change.tendon, None), None)
        if node is None or node.tag != "fixed":
            fault = f"tendon number {change.tendon} is not written out in the file"
            raise ExportError(f"{document.path}: {fault} as a <fixed>; write it out")
        edits.comment(node, comment)
        for name, text in written.items():
            edits.set(node, name, text)
        return
    nameless = [joint for joint in joints if joint.startswith("#")]
    if nameless:
        fault = f"a tendon cannot refer to joint {nameless[0]}, which has no name; give it one"
        raise ExportError(f"{document.path}: {fault}")
    lines = [comment, f"<fixed{attributes(written)}>"]
    for joint, coefficient in change.coefficients.items():
        lines.append(
            f"  <joint{attributes({'joint': joint, 'coef': number(coefficient)})}/>"
        )
    lines.append("</fixed>")
    if sections:
        edits.append(sections[-1], *lines)
    else:
        edits.append(
            document.root, "<tendon>", *(f"  {line}" for line in lines), "</tendon>"
        )


def write_actuator(edits: Edits, change: ActuatorChange) -> None:
    """Give a position actuator its new gains; ExportError where the file does not write it out."""
    document = edits.document
    written = (
        node for section in document.tagged("actuator") for node in section.children()
    )
    node = next(islice(written, change.actuator, None), None)
    kp = number(change.stiffness)
    kv = number(change.damping)
    gains = {
        "position": {"kp": kp, "kv": kv},
        "general": {"gainprm": kp, "biasprm": f"0 -{kp} -{kv}"},
    }.get("" if node is None else node.tag)
    if node is None or gains is None:
        fault = f"actuator number {change.actuator} is not written out in the file"
        raise ExportError(
            f"{document.path}: {fault} as a <position> or <general>; write it out"
        )
    for name, value in gains.items():
        edits.set(node, name, value)


_MULTIPLIERS = ("replicate", "attach", "composite", "flexcomp")
"""Elements that make bodies which are not written out."""


def find_element(document: ModelDocument, kind: str, label: str) -> Node:
    """Return the element of a compiled "body" (a ``<link>`` in a URDF) or "joint" by its name, or
    "#7" for the nameless one with MuJoCo id 7; ExportError unless it is written out just once.
    """
    nodes = list(_in_order(document, kind))
    found = [n for n in nodes if n.get("name") == label and n.tag not in _MULTIPLIERS]
    if len(found) > 1:
        fault = f"{kind} '{label}' stands in the file {len(found)} times"
        raise ExportError(f"{document.path}: {fault}")
    by_number = re.fullmatch(r"#(\d+)", label)
    if by_number and not found and document.kind == "mjcf":
        # The world is body 0; behind a multiplier nobody knows the number.
        index = int(by_number[1]) - (kind == "body")
        counted = takewhile(lambda node: node.tag not in _MULTIPLIERS, nodes)
        found = list(islice(counted, index, index + 1)) if index >= 0 else []
    repeated = (node for top in document.walk(*_MULTIPLIERS) for node in top.walk())
    if not found or found[0] in repeated:
        raise ExportError(
            f"{document.path}: {kind} '{label}' is not written out in the file (it comes from an "
            "attached, repeated or generated part); write it out, with a name"
        )
    return found[0]


def _in_order(document: ModelDocument, kind: str) -> Iterator[Node]:
    """Yield bodies or joints as MuJoCo numbers them, and the elements that multiply bodies."""
    # Depth first, the joints of a body before those of the bodies in it; <frame> adds none.
    if document.kind == "urdf":
        yield from document.tagged("link" if kind == "body" else "joint")
    for node in (
        each for world in document.tagged("worldbody") for each in world.walk()
    ):
        if node.tag in _MULTIPLIERS or node.tag == kind == "body":
            yield node
        if kind == "joint" and node.tag in ("worldbody", "body", *_MULTIPLIERS):
            yield from (
                n for n in _without_frames(node) if n.tag in ("joint", "freejoint")
            )


def _without_frames(body: Node) -> Iterator[Node]:
    for child in body.children():
        yield from _without_frames(child) if child.tag == "frame" else (child,)
