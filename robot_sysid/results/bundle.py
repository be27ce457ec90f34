"""A written model with its meshes and textures in one folder, which can be sent to somebody."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import mujoco

from robot_sysid.errors import ExportError, InputError
from robot_sysid.interrupts import held_back
from robot_sysid.mjcf.assets import bundled_text, find_assets
from robot_sysid.mjcf.documents import read_document
from robot_sysid.model.compilation import compile_model
from robot_sysid.records.atomic_files import draft_folder, only_run_in
from robot_sysid.results.verification import compiled_again, require_same_model

BUNDLE_NAME, ASSETS = "bundle", "assets"
"""Folder in the output folder, and the folder in it that meshes and textures go to."""


def write_bundle(model: Path, folder: Path) -> Path:
    """Copy a written model and all files it refers to into a folder, and load it from there.

    Args:
        folder: its output folder; an earlier bundle in it is replaced.

    Returns:
        The model in the bundle.

    Raises:
        ExportError: it refers to another model, or the copy does not load as the same model.
        InputError: a file cannot be copied, or another run has the folder.
    """
    place = folder / BUNDLE_NAME
    try:
        with only_run_in(folder), draft_folder(place) as draft, draft_folder(place) as earlier:
            text, names = _bundled(model, f"{ASSETS}/")
            (draft / ASSETS).mkdir()
            for source, name in names.items():
                shutil.copyfile(source, draft / name)
            (draft / model.name).write_bytes(text)
            same = compile_model(model).mj_model, compiled_again(draft / model.name).mj_model
            require_same_model(*same, {})
            _put_in_place(draft, place, earlier / BUNDLE_NAME)
    except OSError as error:
        raise InputError(f"--bundle: cannot write {place}: {error.strerror or error}") from None
    return place / model.name


def _put_in_place(draft: Path, place: Path, earlier: Path) -> None:
    """Move a finished folder to its place, and what stands there out of the way."""
    with held_back():
        if os.path.lexists(place):
            os.replace(place, earlier)
        os.replace(draft, place)


def model_in_memory(model: Path) -> Any:
    """Return a model and all files it refers to as a ``mujoco.MjSpec`` that needs no files.

    Raises:
        ExportError: it refers to another model, or this MuJoCo is older than 3.2.
    """
    if not hasattr(mujoco, "MjSpec"):
        raise ExportError(f"a spec needs MuJoCo 3.2 or later, not {mujoco.__version__}; use save()")
    text, names = _bundled(model, "")
    assets = {name: path.read_bytes() for path, name in names.items()}
    return mujoco.MjSpec.from_string(text.decode("utf-8"), assets=assets)


def _bundled(model: Path, folder: str) -> tuple[bytes, dict[Path, str]]:
    """Return (the text of a model that stands beside its assets, file to its name there)."""
    document = read_document(model)
    assets = find_assets(document)
    if any(asset.node.tag == "model" for asset in assets):
        raise ExportError(
            "--bundle: the model attaches other model files (<model file=...>), which a bundle "
            "cannot hold; send the folders as they are"
        )
    names: dict[Path, str] = {}
    for path in dict.fromkeys(asset.path for asset in assets if asset.path is not None):
        # Two files never get one name, not even on a disk that knows no capital letters.
        taken, number, name = {other.lower() for other in names.values()}, 1, path.name
        while f"{folder}{name}".lower() in taken:
            number += 1
            name = f"{path.stem}_{number}{path.suffix}"
        names[path] = f"{folder}{name}"
    return bundled_text(document, names), names
