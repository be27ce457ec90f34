"""A model file's own text with other inertias, joint numbers, gravity, and a new body where wanted.

Comments, order and white space stay; paths are rewritten so that it loads from its new folder.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf import markup
from robot_sysid.mjcf.documents import ModelDocument, Node, read_document
from robot_sysid.mjcf.inertial import (
    check_settings,
    comment_before,
    comment_edit,
    comment_text,
    find_body,
    inertia_from_geometry_edits,
    inertial_edit,
    mjcf_inertial,
    numbers,
    urdf_inertial,
)
from robot_sysid.mjcf.joints import actuator_edits, joint_edits
from robot_sysid.mjcf.markup import Edit, quoted
from robot_sysid.mjcf.relocation import relocated_text
from robot_sysid.mjcf.urdf import minimum_inertia_edits, relocated_urdf
from robot_sysid.mjcf.write_back import BodyChange, ModelChange, WeldedBody, WriteBack
from robot_sysid.records import Array


def updated_model_text(
    source: Path,
    body: str,
    plan: WriteBack,
    rmse: float,
    folder: Path,
    mesh_dir: Path | None = None,
    principal: bool = False,
) -> bytes:
    """Return the text of a model file with one body's inertia replaced.

    Args:
        body: name of the terminal body, or "#7" for the nameless body with id 7.
        rmse: of the identification [N m], for the comment.
        folder, mesh_dir, principal: as in ``changed_model_text``.
    """
    change = ModelChange((BodyChange(body, 0, plan),), rmse)
    return changed_model_text(source, change, folder, mesh_dir, principal)


def changed_model_text(
    source: Path,
    change: ModelChange,
    folder: Path,
    mesh_dir: Path | None = None,
    principal: bool = False,
) -> bytes:
    """Return the text of a model file with a change made.

    Of an MJCF with includes, the included files that lead to something changed, and those that
    contain paths, take the place of their ``<include>``; the others stay included.

    Args:
        principal: see ``inertial.mjcf_inertial``.

    Raises:
        ExportError: a body or joint is not written out in the file, a name is taken, or a setting
            of the file changes inertias when it is compiled.
    """
    document = read_document(source)
    edits, written = _edits(document, change, principal)
    lines: list[str] = []
    if change.gravity is not None:
        found, lines = gravity_edits(document, change.gravity, change.rmse)
        edits += found
    if document.kind == "urdf":
        # Also what was added to get it compiled: MuJoCo has to load the text by itself.
        changed = {body.get("name") for body in written}
        minimum = minimum_inertia_edits(document)
        plain = [edit for _, edit in edits]
        plain += [edit for name, edit in minimum if name not in changed]
        return relocated_urdf(document, folder, mesh_dir, plain, "".join(lines))
    if lines:
        place, start = document.main.spans[0].inner_start, markup.line_break(document.main.text)
        added = b"".join(start + b"  " + line.encode() for line in lines)
        edits.append((document.root, Edit(place, place, added)))
    edits += inertia_from_geometry_edits(document, written)
    by_file: dict[Path, list[Edit]] = {}
    for node, edit in edits:
        by_file.setdefault(node.file.path, []).append(edit)
    return relocated_text(document, folder, mesh_dir, by_file, by_file.keys())


def _edits(
    document: ModelDocument, change: ModelChange, principal: bool
) -> tuple[list[tuple[Node, Edit]], list[Node]]:
    """Return (the edits of bodies, joints and servos, the bodies that they write into)."""
    edits, written = [], []
    for body in change.bodies:
        found = find_body(document, body.label)
        check_settings(document, found, body.plan.theta)
        lumped = [find_body(document, other.name) for other in body.plan.lumped]
        edits.append((found, comment_edit(found, body.label, change.rmse, body.comment)))
        theta = body.plan.theta
        for node, parameters in ((found, theta), *((other, 0.0 * theta) for other in lumped)):
            edits.append(inertial_edit(node, _inertial(document, parameters, principal)))
        written += [found, *lumped]
    for joint in change.joints:
        edits += joint_edits(document, joint)
    for actuator in change.actuators:
        edits += actuator_edits(document, actuator)
    if change.welded is not None:
        carrier = find_body(document, change.welded.carrier)
        check_settings(document, carrier, change.welded.theta, gets_child=True)
        edits.append(welded_edit(document, change.welded, change.rmse, principal))
    return edits, written


def _inertial(document: ModelDocument, theta: Array, principal: bool) -> str:
    return urdf_inertial(theta) if document.kind == "urdf" else mjcf_inertial(theta, principal)


def welded_edit(
    document: ModelDocument, body: WeldedBody, rmse: float, principal: bool = False
) -> tuple[Node, Edit]:
    """Return the edit that adds a body, and the element whose file it is in.

    Args:
        rmse: of the identification [N m], for the comment.
        principal: see ``inertial.mjcf_inertial``.
    """
    _check_name(document, body.name)
    carrier = find_body(document, body.carrier)
    comment = comment_text(f"body '{body.name}'", rmse, body.words)
    if document.kind == "urdf":
        # All links of a URDF stand side by side.
        place, lines = document.root, [comment, *_urdf_lines(body)]
    else:
        turn = numbers(spatial.quaternion(body.rotation))
        pose = f'pos="{numbers(body.translation)}" quat="{turn}"'
        inertial = f"  {mjcf_inertial(body.theta, principal)}"
        lines = [comment, f"<body name={quoted(body.name)} {pose}>", inertial, "</body>"]
        place = carrier
    span = place.file.span(place.element)
    return place, markup.append_child(place.file.text, span, "\n".join(lines))


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


def gravity_edits(
    document: ModelDocument, gravity: tuple[float, float, float], rmse: float
) -> tuple[list[tuple[Node, Edit]], list[str]]:
    """Return (the edits that give a model another gravity, lines to add where it states none).

    Args:
        document: the model; MuJoCo reads the ``<option>`` in a URDF's ``<mujoco>`` part.
        gravity: in the model's world frame [m/s^2].
        rmse: of the identification [N m], for the comment.
    """
    options = document.settings("option")
    flags = [node for option in options for node in option.children() if node.tag == "flag"]
    if any(flag.get("gravity") == "disable" for flag in flags):
        raise ExportError(
            f'{document.path}: <flag gravity="disable"/> switches gravity off, so that the '
            "identified one would do nothing; remove it"
        )
    if not np.all(np.isfinite(gravity)):
        raise ExportError(f"gravity cannot be written as {gravity}: it is no vector")
    stating = [option for option in options if option.get("gravity")]
    before = (stating[-1].get("gravity") if stating else None) or _MUJOCOS_OWN
    words = f"in place of {before}, because the arm does not stand as the file said"
    comment = comment_text("gravity", rmse, words)
    text = numbers(np.asarray(gravity))
    if not options:
        return [], [comment, f'<option gravity="{text}"/>']
    # The last one that states it counts, in whichever file it stands.
    node = (stating or options)[-1]
    span = node.file.span(node.element)
    written = markup.set_attribute(node.file.text, span, "gravity", text)
    return [(node, comment_before(node, comment)), (node, written)], []
