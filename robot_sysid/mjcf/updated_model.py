"""A model file's own text with other inertias, joint numbers, and a new body where one is wanted.

Comments, order and white space stay; paths are rewritten so that it loads from its new folder.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf import markup
from robot_sysid.mjcf.changes import BodyChange, ModelChange, WeldedBody
from robot_sysid.mjcf.compiler_settings import check_settings, inertia_from_geometry_edits
from robot_sysid.mjcf.documents import ModelDocument, Node, read_document
from robot_sysid.mjcf.inertial import (
    comment_edit,
    comment_text,
    find_body,
    inertial_edit,
    mjcf_inertial,
    numbers,
    urdf_inertial,
)
from robot_sysid.mjcf.joints import actuator_edits, joint_edits
from robot_sysid.mjcf.markup import Edit, quoted
from robot_sysid.mjcf.relocation import relocated_text
from robot_sysid.mjcf.urdf import minimum_inertia_edits, relocated_urdf
from robot_sysid.mjcf.write_back import WriteBack
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
        source: the model file.
        body: name of the terminal body, or "#7" for the nameless body with id 7.
        plan: what to write.
        rmse: of the identification [N m], for the comment.
        folder, mesh_dir, principal: as in ``changed_model_text``.

    Raises:
        ExportError: as there.
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
        source: the model file.
        change: what to write.
        folder: where the text will live.
        mesh_dir: the user's mesh folder, if any.
        principal: see ``inertial.mjcf_inertial``.

    Raises:
        ExportError: a body or joint is not written out in the file, a name is taken, or a setting
            of the file changes inertias when it is compiled.
    """
    document = read_document(source)
    edits, written = [], []
    for body in change.bodies:
        found = find_body(document, body.label)
        check_settings(document, found, body.plan.theta)
        lumped = [find_body(document, other.name) for other in body.plan.lumped]
        edits.append((found, comment_edit(found, body.label, change.rmse, body.comment)))
        edits += _inertials(document, found, body.plan.theta, lumped, principal)
        written += [found, *lumped]
    for joint in change.joints:
        edits += joint_edits(document, joint)
    for actuator in change.actuators:
        edits += actuator_edits(document, actuator)
    if change.welded is not None:
        carrier = find_body(document, change.welded.carrier)
        check_settings(document, carrier, change.welded.theta, gets_child=True)
        edits.append(welded_edit(document, change.welded, change.rmse, principal))
    if document.kind == "urdf":
        edits += _minimum_edits(document, written)
        return relocated_urdf(document, folder, mesh_dir, [edit for _, edit in edits])
    edits += inertia_from_geometry_edits(document, written)
    by_file = _by_file(edits)
    return relocated_text(document, folder, mesh_dir, by_file, by_file.keys())


def _inertials(
    document: ModelDocument, body: Node, theta: Array, lumped: Collection[Node], principal: bool
) -> Iterator[tuple[Node, Edit]]:
    """Yield the edits that give a body theta (10,) and the lumped ones nothing."""

    def text(parameters: Array) -> str:
        if document.kind == "urdf":
            return urdf_inertial(parameters)
        return mjcf_inertial(parameters, principal)

    yield inertial_edit(body, text(theta))
    for other in lumped:
        yield inertial_edit(other, text(0.0 * theta))


def _minimum_edits(
    document: ModelDocument, written: Collection[Node]
) -> Iterator[tuple[Node, Edit]]:
    """Yield what was added to get a URDF compiled: MuJoCo has to load the text by itself."""
    changed = {body.get("name") for body in written}
    for name, edit in minimum_inertia_edits(document):
        if name not in changed:
            yield document.root, edit


def _by_file(edits: Collection[tuple[Node, Edit]]) -> dict[Path, list[markup.Edit]]:
    grouped: dict[Path, list[markup.Edit]] = {}
    for node, edit in edits:
        grouped.setdefault(node.file.path, []).append(edit)
    return grouped


def welded_edit(
    document: ModelDocument, body: WeldedBody, rmse: float, principal: bool = False
) -> tuple[Node, Edit]:
    """Return the edit that adds a body, and the element whose file it is in.

    Args:
        document: the model.
        body: what to add.
        rmse: of the identification [N m], for the comment.
        principal: see ``inertial.mjcf_inertial``.

    Raises:
        ExportError: the name is taken, or the carrier is not written out in the file.
    """
    _check_name(document, body.name)
    carrier = find_body(document, body.carrier)
    comment = comment_text(body.name, rmse, body.words)
    if document.kind == "urdf":
        # All links of a URDF stand side by side.
        place, lines = document.root, [comment, *_urdf_lines(body)]
    else:
        place, lines = carrier, [comment, *_mjcf_lines(body, principal)]
    span = place.file.span(place.element)
    return place, markup.append_child(place.file.text, span, "\n".join(lines))


def _mjcf_lines(body: WeldedBody, principal: bool) -> list[str]:
    turn = numbers(spatial.quaternion(body.rotation))
    place = f'pos="{numbers(body.translation)}" quat="{turn}"'
    return [
        f"<body name={quoted(body.name)} {place}>",
        f"  {mjcf_inertial(body.theta, principal)}",
        "</body>",
    ]


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
