"""A written model with its meshes and textures in one folder, which can be sent to somebody."""

from __future__ import annotations

import errno
import filecmp
import os
import shutil
from collections.abc import Iterable
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
        with only_run_in(folder), draft_folder(place) as draft:
            text, names = _bundled(model, f"{ASSETS}/", place)
            (draft / ASSETS).mkdir()
            for source, name in names.items():
                shutil.copyfile(source, draft / name)
            (draft / model.name).write_bytes(text)
            same = compile_model(model).mj_model, compiled_again(draft / model.name).mj_model
            require_same_model(*same, {})
            _take_place(draft, place, [*names.values(), model.name])
    except OSError as error:
        raise InputError(f"--bundle: cannot write {place}: {error.strerror or error}") from None
    return place / model.name


def _take_place(draft: Path, place: Path, files: Iterable[str]) -> None:
    """Move files into a folder, the model last, and remove what else is there.

    At every instant the model that is there, old or new, finds its own meshes.
    """
    if place.is_symlink():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
    with held_back():
        (place / ASSETS).mkdir(parents=True, exist_ok=True)
        for name in files:
            os.replace(draft / name, place / name)
        kept = {place / ASSETS, *(place / name for name in files)}
        for path in sorted(set(place.rglob("*")) - kept, reverse=True):
            is_folder = path.is_dir() and not path.is_symlink()
            path.rmdir() if is_folder else path.unlink()


def model_in_memory(model: Path) -> Any:
    """Return a model and all files it refers to as a ``mujoco.MjSpec`` that needs no files.

    Raises:
        ExportError: it refers to another model, or this MuJoCo is older than 3.2.
    """
    if not hasattr(mujoco, "MjSpec"):
        raise ExportError(f"a spec needs MuJoCo 3.2 or later, not {mujoco.__version__}; use save()")
    text, names = _bundled(model, "", None)
    assets = {name: path.read_bytes() for path, name in names.items()}
    return mujoco.MjSpec.from_string(text.decode("utf-8"), assets=assets)


def _bundled(model: Path, folder: str, earlier: Path | None) -> tuple[bytes, dict[Path, str]]:
    """Return (the text of a model that stands beside its assets, file to its name there)."""
    document = read_document(model)
    assets = find_assets(document)
    if any(asset.node.tag == "model" for asset in assets):
        raise ExportError(
            "--bundle: the model attaches other model files (<model file=...>), which a bundle "
            "cannot hold; send the folders as they are"
        )
    names = _names((asset.path for asset in assets if asset.path is not None), folder, earlier)
    return bundled_text(document, names), names


def _names(paths: Iterable[Path], folder: str, earlier: Path | None) -> dict[Path, str]:
    """Return file to its place; two files, or one of an earlier bundle, never get one name."""
    names: dict[Path, str] = {}
    for path in paths:
        if path not in names:
            taken, count = {other.lower() for other in names.values()}, 1
            name = f"{folder}{path.name}"
            while name.lower() in taken or _differs(path, earlier, name):
                count += 1
                name = f"{folder}{path.stem}_{count}{path.suffix}"
            names[path] = name
    return names


def _differs(path: Path, earlier: Path | None, name: str) -> bool:
    if earlier is None or not os.path.lexists(earlier / name):
        return False
    return not ((earlier / name).is_file() and filecmp.cmp(path, earlier / name, shallow=False))
