"""Models that a program holds, a ``MjSpec`` or ``MjModel`` of MuJoCo: as they are, and as files."""

from __future__ import annotations

import contextlib
import re
import tempfile
from html import unescape
from pathlib import Path
from typing import Any, Union
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from robot_sysid.errors import ModelError, error_text
from robot_sysid.model.compilation import FAILURES, CompiledModel, captured_warnings

InMemory = Union["mujoco.MjSpec", "mujoco.MjModel"]
_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []
"""Those of the files that were written; they go with the process."""
_WRITTEN: WeakKeyDictionary[Any, tuple[Path, Any]] = WeakKeyDictionary()
"""Model to its file, and to what MuJoCo makes of that."""
_COMPARED = (
    "body_mass",
    "body_ipos",
    "body_inertia",
    "body_pos",
    "qpos0",
    "jnt_axis",
    "jnt_range",
    "dof_damping",
    "dof_armature",
    "dof_frictionloss",
    "body_jntadr",
)
# MuJoCo writes six digits.
_SAME = 1e-4


def is_in_memory(model: Any) -> bool:
    """Tell whether something is a model of MuJoCo's."""
    return isinstance(model, mujoco.MjModel) or _is_spec(model)


def _is_spec(model: Any) -> bool:
    # Releases before 3.2 have none.
    return isinstance(model, getattr(mujoco, "MjSpec", ()))


def compiled_in_memory(model: Any) -> CompiledModel:
    """Return a model of MuJoCo's with all its digits; ModelError where it does not compile."""
    return CompiledModel(_compiled(model) if _is_spec(model) else model, (), "", "mjcf")


def file_of(model: Any) -> Path:
    """Return a file of a model of MuJoCo's, which is there as long as this process.

    MuJoCo writes it, with six digits of each number. Raises ModelError where it cannot.
    """
    _FOLDERS.append(tempfile.TemporaryDirectory(prefix="robot-sysid-"))
    folder = Path(_FOLDERS[-1].name)
    if _is_spec(model):
        return _file_of_spec(model, folder)
    with captured_warnings(), contextlib.suppress(*FAILURES):
        path = folder / "model.xml"
        mujoco.mj_saveLastXML(str(path), model)
        # MuJoCo's first releases write the last model that was loaded, whichever is asked for.
        again = None
        with contextlib.suppress(*FAILURES):  # of one whose meshes are elsewhere
            again = mujoco.MjModel.from_xml_path(str(path))
        bodies = {model.body(k).name for k in range(1, model.nbody)}
        names = bodies | {model.joint(k).name for k in range(model.njnt)}
        there = re.findall('\\bname="([^"]*)"', path.read_text(encoding="utf-8"))
        if (again is None or _alike(model, again)) and names - {""} <= {
            *map(unescape, there)
        }:
            _WRITTEN[model] = path, again
            return path
    path, again = _WRITTEN.get(model, (folder, None))
    if again is None or not _alike(model, again):
        raise ModelError(
            "a MjModel can be written only while it is the last that was loaded from XML; give its "
            "file, or the MjSpec that it was compiled from"
        )
    return path


def _file_of_spec(spec: Any, folder: Path) -> Path:
    _compiled(spec)
    assets = dict(spec.assets or {})
    for name, content in assets.items():
        place = folder / Path(name).name
        place.write_bytes(content if isinstance(content, bytes) else content.encode())
    own = {name: getattr(spec, name) for name in ("meshdir", "texturedir")}
    for name, value in own.items():
        setattr(
            spec,
            name,
            str(folder if assets else Path(spec.modelfiledir, value).absolute()),
        )
    try:
        text = spec.to_xml()
    finally:
        for name, value in own.items():
            setattr(spec, name, value)
    name = re.sub(r"[^\w-]+", "_", spec.modelname) or "model"
    path = folder / f"{name}.xml"
    path.write_text(text, encoding="utf-8")
    return path


def _compiled(spec: Any) -> Any:
    with captured_warnings():
        try:
            return spec.compile()
        except FAILURES as error:
            raise ModelError(
                f"MuJoCo cannot compile the MjSpec: {error_text(error)}"
            ) from None


def _alike(model: Any, other: Any) -> bool:
    """Tell whether two compiled models are the same arm to the digits that MuJoCo writes."""
    pairs = [(getattr(model, name), getattr(other, name)) for name in _COMPARED]
    return all(a.shape == b.shape and np.allclose(a, b, _SAME, 1e-9) for a, b in pairs)
