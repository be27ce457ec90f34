"""What in a model file would make MuJoCo wait for ever, end the process or eat the memory."""

from __future__ import annotations

import math
import os
from pathlib import Path

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.assets import Asset, find_assets
from robot_sysid.mjcf.documents import ModelDocument, Node, read_document

MOST_CELLS = 5e7
"""Largest height field, texture or block of user data that is worth its memory, in numbers."""
MOST_COPIES = 3000
"""Copies of a part; MuJoCo takes the square of their number, a minute for 20 000."""
_CELLS = {
    "hfield": ("nrow", "ncol"),
    "texture": ("width", "height"),
    "numeric": ("size",),
    "user": ("dim",),
}
_COPIED = ("replicate", "composite", "flexcomp")
_MODELS = (".xml", ".mjcf", ".urdf")


def refuse_hazards(document: ModelDocument, mesh_dir: Path | None = None) -> None:
    """Refuse an MJCF document that MuJoCo must not even be shown.

    Raises:
        ModelError: it refers to a pipe or device, attaches itself, asks for a huge field or for
            copies without end, or has the name of a class with a format in it.
    """
    for node in document.walk():
        _refuse_huge(document, node)
        _refuse_format(document, node)
    _refuse_copies(document, document.root, 1.0)
    _refuse_attached(document, mesh_dir, (), set())


def _refuse_huge(document: ModelDocument, node: Node) -> None:
    cells = math.prod(_count(node, name) for name in _CELLS.get(node.tag, ()))
    if node.tag == "size":
        cells = max([_bytes(node) / 100.0, *(_count(node, n) for n in node.element.attrib)])
    if cells > MOST_CELLS:
        raise ModelError(
            f"{document.path}: a {node.tag} of {cells:.3g} cells; at most "
            f"{MOST_CELLS:.0e} are read, and identification needs none of them"
        )


def _refuse_format(document: ModelDocument, node: Node) -> None:
    """Refuse the name of a class that MuJoCo, where it is unknown, takes for a format of printf."""
    if "%" in (node.get("class") or ""):
        raise ModelError(
            f"{document.path}: the class {node.get('class')!r} of a {node.tag} has a % in its "
            "name, over which MuJoCo may end the process; rename it"
        )


def _refuse_copies(document: ModelDocument, node: Node, times: float) -> None:
    """Refuse what is repeated too often, a part of repeated parts included."""
    if node.tag in _COPIED:
        times *= max(1.0, _count(node, "count"))
    if times > MOST_COPIES:
        raise ModelError(
            f"{document.path}: a {node.tag} makes {times:.3g} copies; at most {MOST_COPIES} are "
            "read, and identification needs none of them"
        )
    for child in node.children():
        _refuse_copies(document, child, times)


def _bytes(node: Node) -> float:
    """Return the memory that a <size> asks for: a number with K, M, G, T, P or E behind it."""
    text = (node.get("memory") or "0").strip()
    power = "KMGTPE".find(text[-1:].upper()) + 1
    try:
        return float(text[: -1 if power else None]) * 1024.0**power
    except ValueError:
        return 0.0


def _count(node: Node, name: str) -> float:
    """Return the product of an attribute's numbers; zero for none, of which MuJoCo will speak."""
    try:
        return math.prod(float(word) for word in (node.get(name) or "0").split())
    except ValueError:
        return 0.0


def _refuse_attached(
    document: ModelDocument, mesh_dir: Path | None, above: tuple[Path, ...], known: set[Path]
) -> None:
    """Refuse special files, and models that attach one of those ``above`` them."""
    own = document.path.resolve()
    for asset in find_assets(document, mesh_dir):
        _refuse_special(document, asset)
        if asset.node.tag != "model" or asset.path is None:
            continue
        attached = asset.path.resolve()
        if attached in (*above, own):
            raise ModelError(f"{document.path} attaches itself by way of {asset.name}; take it out")
        if attached not in known and attached.suffix.lower() in _MODELS:
            _refuse_attached(read_document(attached), None, (*above, own), known)
            known.add(attached)


def _refuse_special(document: ModelDocument, asset: Asset) -> None:
    if asset.path is not None:
        return
    for folder in asset.looked_in:
        path = folder / Path(asset.name.replace("\\", "/")).name
        if os.path.exists(path) and not os.path.isdir(path):
            raise ModelError(f"{document.path}: {path} is not a file but a pipe or a device")
