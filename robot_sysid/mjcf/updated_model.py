"""A model file's own text with the terminal body's ``<inertial>`` replaced.

Comments, order and white space stay; paths are rewritten so that it loads from its new folder.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from robot_sysid.mjcf import markup
from robot_sysid.mjcf.compiler_settings import check_settings, inertia_from_geometry_edits
from robot_sysid.mjcf.documents import ModelDocument, Node, read_document
from robot_sysid.mjcf.inertial import (
    comment_edit,
    find_body,
    inertial_edit,
    mjcf_inertial,
    urdf_inertial,
)
from robot_sysid.mjcf.markup import Edit
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
    """Return the text of a model file with the terminal body's inertia replaced.

    Of an MJCF with includes, the included files that lead to a changed body, and those that
    contain paths, take the place of their ``<include>``; the others stay included.

    Args:
        source: the model file.
        body: name of the terminal body, or "#7" for the nameless body with id 7.
        plan: what to write.
        rmse: of the identification [N m], for the comment.
        folder: where the text will live.
        mesh_dir: the user's mesh folder, if any.
        principal: see ``inertial.mjcf_inertial``.

    Raises:
        ExportError: the body is not written out in the file, or a setting of the file changes
            inertias when it is compiled.
    """
    document = read_document(source)
    terminal = find_body(document, body)
    check_settings(document, terminal, plan.theta)
    lumped = [find_body(document, other.name) for other in plan.lumped]
    edits = [(terminal, comment_edit(terminal, body, rmse, plan.note))]
    if document.kind == "urdf":
        edits += _urdf_edits(document, terminal, lumped, plan.theta)
        return relocated_urdf(document, folder, mesh_dir, [edit for _, edit in edits])
    edits += _mjcf_edits(terminal, lumped, plan.theta, principal)
    edits += inertia_from_geometry_edits(document, [terminal, *lumped])
    by_file = _by_file(edits)
    return relocated_text(document, folder, mesh_dir, by_file, by_file.keys())


def _mjcf_edits(
    terminal: Node, lumped: Sequence[Node], theta: Array, principal: bool
) -> list[tuple[Node, Edit]]:
    empty = mjcf_inertial(0.0 * theta)
    written = [inertial_edit(terminal, mjcf_inertial(theta, principal))]
    return written + [inertial_edit(body, empty) for body in lumped]


def _urdf_edits(
    document: ModelDocument, terminal: Node, lumped: Sequence[Node], theta: Array
) -> list[tuple[Node, Edit]]:
    empty = urdf_inertial(0.0 * theta)
    written = [inertial_edit(terminal, urdf_inertial(theta))]
    written += [inertial_edit(body, empty) for body in lumped]
    changed = {body.get("name") for body in (terminal, *lumped)}
    # What was added to get the model compiled stays in it: MuJoCo has to load it by itself.
    minimum = minimum_inertia_edits(document)
    return written + [(document.root, edit) for name, edit in minimum if name not in changed]


def _by_file(edits: Collection[tuple[Node, Edit]]) -> dict[Path, list[markup.Edit]]:
    grouped: dict[Path, list[markup.Edit]] = {}
    for node, edit in edits:
        grouped.setdefault(node.file.path, []).append(edit)
    return grouped
