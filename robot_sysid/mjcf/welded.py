"""A new body, welded to one of a model file's: a payload that stays a body of its own."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.mjcf import markup
from robot_sysid.mjcf.changes import WeldedBody
from robot_sysid.mjcf.documents import ModelDocument, Node
from robot_sysid.mjcf.inertial import (
    comment_text,
    find_body,
    mjcf_inertial,
    numbers,
    urdf_inertial,
)
from robot_sysid.mjcf.markup import Edit


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
        f"<body name={quoteattr(body.name)} {place}>",
        f"  {mjcf_inertial(body.theta, principal)}",
        "</body>",
    ]


def _urdf_lines(body: WeldedBody) -> list[str]:
    name, carrier = quoteattr(body.name), quoteattr(body.carrier)
    turn = numbers(spatial.roll_pitch_yaw(body.rotation))
    return [
        f"<link name={name}>{urdf_inertial(body.theta)}</link>",
        f'<joint name={quoteattr(joint_name(body.name))} type="fixed"><parent link={carrier}/>'
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
