"""Find the text of a compiled body: by name, or by counting where it has none."""

from __future__ import annotations

import re
from collections.abc import Iterator

from robot_sysid.errors import ExportError
from robot_sysid.modelfile.documents import ModelDocument, Node

_MULTIPLIERS = ("replicate", "attach", "composite", "flexcomp")


def find_body(document: ModelDocument, label: str) -> Node:
    """Return the ``<body>`` (MJCF) or ``<link>`` (URDF) of a compiled body.

    Args:
        document: the model.
        label: the body's name, or "#7" for the nameless body with MuJoCo id 7.

    Raises:
        ExportError: it is not written out in the file.
    """
    wanted = "link" if document.kind == "urdf" else "body"
    named = [n for n in document.walk() if n.tag == wanted and n.get("name") == label]
    if len(named) > 1:
        raise ExportError(f"{document.path}: body '{label}' stands in the file {len(named)} times")
    node = named[0] if named else _by_number(document, label)
    repeated = [n for n in _replicates(document) if _contains(n, node)]
    if repeated:
        raise ExportError(
            f"{document.path}: body '{label}' is repeated by a <replicate>, so its inertia cannot "
            "be changed alone; write its copies out"
        )
    return node


def _by_number(document: ModelDocument, label: str) -> Node:
    number = re.fullmatch(r"#(\d+)", label)
    if number is None or document.kind == "urdf":
        raise ExportError(
            f"{document.path}: body '{label}' is not written out in the file (it comes from an "
            "attached or generated part); identify the attached model file by itself, or write "
            "the body out"
        )
    # MuJoCo numbers bodies depth first, and <frame> adds none.
    left = int(number.group(1))
    for node in _bodies_and_multipliers(document):
        if node.tag in _MULTIPLIERS:
            raise ExportError(
                f"{document.path}: cannot count up to the nameless body {label} past a "
                f"<{node.tag}>; give the body a name"
            )
        left -= 1
        if left == 0:
            return node
    raise ExportError(f"{document.path}: no body number {label} in the file; give it a name")


def _bodies_and_multipliers(document: ModelDocument) -> Iterator[Node]:
    for section in document.root.children():
        if section.tag == "worldbody":
            yield from (n for n in section.walk() if n.tag in ("body", *_MULTIPLIERS))


def _replicates(document: ModelDocument) -> Iterator[Node]:
    return (node for node in document.walk() if node.tag == "replicate")


def _contains(outer: Node, inner: Node) -> bool:
    return any(node.element is inner.element for node in outer.walk())
