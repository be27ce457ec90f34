"""The identified parameters as files: params.json and the updated model.

The updated model is the input's own text with the terminal body's ``<inertial>`` replaced, so
comments, order and white space stay. Paths are rewritten so that it loads from its new folder.
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
from robot_sysid.mjcf.write_back import WriteBack, plan_write_back
from robot_sysid.output.params_json import export_params_json, params_json_text, read_params_json
from robot_sysid.records import Array, Identification, SubtreeBody
from robot_sysid.records.atomic_files import write_whole

__all__ = [
    "export_params_json",
    "export_updated_model",
    "export_updated_xml",
    "params_json_text",
    "plan_write_back",
    "read_params_json",
    "updated_model_text",
]


def export_updated_model(
    identification: Identification,
    bodies: Sequence[SubtreeBody],
    destination: Path,
    mesh_dir: Path | None = None,
    principal: bool = False,
) -> WriteBack:
    """Write the model with the identified terminal link, and return what went into which body.

    Args:
        identification: the result.
        bodies: the terminal body and all below it, as the model describes them.
        destination: file to write; its folder is created.
        mesh_dir: the user's mesh folder, if any.
        principal: see ``inertial_text.mjcf_inertial``.

    Raises:
        ExportError: the link cannot be written into this model; says why.
        InputError: the file cannot be written.
    """
    estimate = identification.estimate
    plan = plan_write_back(estimate.inertial.theta, bodies)
    source, label = identification.model_path, identification.body_name
    export_updated_xml(source, label, plan, estimate.rmse, destination, mesh_dir, principal)
    return plan


def export_updated_xml(
    source: Path,
    body: str,
    plan: WriteBack,
    rmse: float,
    destination: Path,
    mesh_dir: Path | None = None,
    principal: bool = False,
) -> None:
    """Write an MJCF or URDF file with one body's inertia replaced; see ``updated_model_text``."""
    folder = destination.absolute().parent
    text = updated_model_text(source, body, plan, rmse, folder, mesh_dir, principal)
    write_whole(destination, text)


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
        principal: see ``inertial_text.mjcf_inertial``.

    Raises:
        ExportError: the body is not written out in the file, or a setting of the file changes
            inertias when it is compiled.
    """
    document = read_document(source)
    terminal = find_body(document, body)
    check_settings(document, terminal, plan.theta)
    folded = [find_body(document, other.name) for other in plan.folded]
    edits = [(terminal, comment_edit(terminal, body, rmse, plan.note))]
    if document.kind == "urdf":
        edits += _urdf_edits(document, terminal, folded, plan.theta)
        return relocated_urdf(document, folder, mesh_dir, [edit for _, edit in edits])
    edits += _mjcf_edits(terminal, folded, plan.theta, principal)
    edits += inertia_from_geometry_edits(document, [terminal, *folded])
    by_file = _by_file(edits)
    return relocated_text(document, folder, mesh_dir, by_file, by_file.keys())


def _mjcf_edits(
    terminal: Node, folded: Sequence[Node], theta: Array, principal: bool
) -> list[tuple[Node, Edit]]:
    empty = mjcf_inertial(0.0 * theta)
    written = [inertial_edit(terminal, mjcf_inertial(theta, principal))]
    return written + [inertial_edit(body, empty) for body in folded]


def _urdf_edits(
    document: ModelDocument, terminal: Node, folded: Sequence[Node], theta: Array
) -> list[tuple[Node, Edit]]:
    empty = urdf_inertial(0.0 * theta)
    written = [inertial_edit(terminal, urdf_inertial(theta))]
    written += [inertial_edit(body, empty) for body in folded]
    changed = {body.get("name") for body in (terminal, *folded)}
    # What was added to get the model compiled stays in it: MuJoCo has to load it by itself.
    minimum = minimum_inertia_edits(document)
    return written + [(document.root, edit) for name, edit in minimum if name not in changed]


def _by_file(edits: Collection[tuple[Node, Edit]]) -> dict[Path, list[markup.Edit]]:
    grouped: dict[Path, list[markup.Edit]] = {}
    for node, edit in edits:
        grouped.setdefault(node.file.path, []).append(edit)
    return grouped
