"""What in a model file would make MuJoCo wait for ever, end the process or eat the memory."""

from __future__ import annotations

from pathlib import Path

from robot_sysid.errors import ModelError
from robot_sysid.mjcf.assets import Asset, find_assets
from robot_sysid.mjcf.documents import ModelDocument, Node, read_document

MOST_CELLS = 5e7
"""Largest height field or texture that is worth its memory, in cells."""
_SIZES = {"hfield": ("nrow", "ncol"), "texture": ("width", "height")}
_MODELS = (".xml", ".mjcf", ".urdf")


def refuse_hazards(document: ModelDocument, mesh_dir: Path | None = None) -> None:
    """Refuse an MJCF document that MuJoCo must not even be shown.

    Raises:
        ModelError: it refers to a pipe or device, attaches itself, or asks for a huge field.
    """
    for node in document.walk():
        _refuse_huge(document, node)
    _refuse_attached(document, mesh_dir, (), set())


def _refuse_huge(document: ModelDocument, node: Node) -> None:
    try:
        rows, columns = (float(node.get(name) or 0.0) for name in _SIZES.get(node.tag, "  "))
    except ValueError:
        return  # MuJoCo says so in its own words
    if rows * columns > MOST_CELLS:
        raise ModelError(
            f"{document.path}: a {node.tag} of {rows * columns:.3g} cells; at most "
            f"{MOST_CELLS:.0e} are read, and identification needs none of them"
        )


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
        if path.exists() and not path.is_dir():
            raise ModelError(f"{document.path}: {path} is not a file but a pipe or a device")
