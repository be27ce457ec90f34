"""Model file -> compiled MuJoCo model, quietly: MuJoCo's warnings become notes, its errors ours.

MuJoCo before 3.14 finds the principal axes of a full inertia matrix to about six digits. A URDF
cannot state them any other way, so its compiled inertias are replaced by accurate ones. What would
make MuJoCo wait for ever, end the process or eat the memory is refused by ``mjcf.hazards``.
"""

from __future__ import annotations

import contextlib
import locale
import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from html import unescape
from pathlib import Path
from typing import Any, Union
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from robot_sysid.errors import ModelError, error_text
from robot_sysid.mjcf.assets import check_assets, relocated_text
from robot_sysid.mjcf.documents import Edits, ModelDocument, read_document
from robot_sysid.mjcf.hazards import refuse_hazards
from robot_sysid.mjcf.urdf import (
    LARGEST,
    compilable_urdf,
    link_inertias,
    velocity_limits,
)
from robot_sysid.model.inertia import inertia_about_com
from robot_sysid.records import Array
from robot_sysid.records.messages import Progress

# RuntimeError is what the bindings make of an exception of C++, such as one for want of memory.
FAILURES = (ValueError, RuntimeError, mujoco.FatalError, mujoco.UnexpectedError)
_NAME = re.compile(r"(?:Element name|Object name =) ?'?([^',\n]+)")
_LINE = re.compile(r"line(?: =)? (\d+)")
_MUST_BE_FINITE = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_pos",
    "body_quat",
    "jnt_pos",
    "jnt_axis",
    "qpos0",
    "dof_damping",
    "dof_armature",
    "dof_frictionloss",
)


@dataclass(frozen=True)
class CompiledModel:
    """A compiled model file ("mjcf" or "urdf"), what had to be assumed or was warned of, the hash
    of all its bytes, includes too, and the speed limits that a URDF states [rad/s or m/s].
    """

    mj_model: Any
    notes: tuple[str, ...]
    sha256: str
    kind: str
    velocity_limits: Mapping[str, float] = field(default_factory=dict)


@contextmanager
def captured_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings in the list yielded, instead of on stderr and in a log file."""
    messages: list[str] = []
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(
        lambda message: messages.append(" ".join(str(message).split()))
    )
    try:
        yield messages
    finally:
        mujoco.set_mju_user_warning(previous)


@contextmanager
def warnings_as_notes(progress: Progress) -> Iterator[None]:
    """Tell at the end what MuJoCo warned of meanwhile, each warning once."""
    with captured_warnings() as warnings:
        yield
    for warning in dict.fromkeys(warnings):
        progress.note(f"MuJoCo warns: {warning}")


def compile_model(path: Path, mesh_dir: Path | None = None) -> CompiledModel:
    """Compile an MJCF or URDF file; what cannot be read or compiled is one line of an error.

    A mesh folder replaces the file's own (and, in a URDF, its packages).
    """
    document = read_document(path)
    if mesh_dir is not None and not os.path.isdir(mesh_dir):
        fault = "is not a folder" if os.path.exists(mesh_dir) else "does not exist"
        raise ModelError(f"mesh folder {mesh_dir} {fault}; check --mesh-dir")
    point = locale.localeconv()["decimal_point"]
    if point != ".":  # MuJoCo would end the numbers of an OBJ mesh at their points
        remedy = "call locale.setlocale(locale.LC_NUMERIC, 'C') first"
        raise ModelError(
            f"a locale that has {point!r} for a decimal point spoils OBJ meshes; {remedy}"
        )
    refuse_hazards(document, mesh_dir)
    with captured_warnings() as warnings:
        if document.is_urdf:
            mj_model, notes = _compile_urdf(document, mesh_dir)
        else:
            mj_model = _compile_mjcf(document, mesh_dir)
            notes = ()
    if _CACHE is not None and mujoco.mj_getCacheCapacity(_CACHE) == 0:
        # The last model that was read is kept too, all that was read of it: let it be a small one.
        mujoco.MjModel.from_xml_string("<mujoco/>")
    _check_values(mj_model, document)
    said = tuple(dict.fromkeys(f"MuJoCo warns: {text}" for text in warnings))
    kind = "urdf" if document.is_urdf else "mjcf"
    speeds = velocity_limits(document) if document.is_urdf else {}
    return CompiledModel(mj_model, notes + said, document.sha256, kind, speeds)


_CACHE = mujoco.mj_getCache() if hasattr(mujoco, "mj_getCache") else None


@contextmanager
def meshes_not_kept() -> Iterator[None]:
    """Keep nothing of the meshes of models that are compiled meanwhile, against reading them again.

    It is four times the compiled model: 250 MB of an arm of 62 MB.
    """
    before = None if _CACHE is None else mujoco.mj_getCacheCapacity(_CACHE)
    try:
        if before is not None:
            mujoco.mj_setCacheCapacity(_CACHE, 0)
        yield
    finally:
        if before is not None:
            mujoco.mj_setCacheCapacity(_CACHE, before)


def _compile_mjcf(document: ModelDocument, mesh_dir: Path | None) -> Any:
    try:
        if mesh_dir is None and all(file.is_utf8 for file in document.files):
            return mujoco.MjModel.from_xml_path(str(document.path))
        text = relocated_text(Edits(document), None, mesh_dir)
        return mujoco.MjModel.from_xml_string(text.decode())
    except FAILURES as error:
        # Asked only now, so that MuJoCo's own rules decide what is missing.
        check_assets(document, mesh_dir)
        raise ModelError(_one_line(document, error)) from None


def _compile_urdf(
    document: ModelDocument, mesh_dir: Path | None
) -> tuple[Any, tuple[str, ...]]:
    for with_minimum in (False, True):
        try:
            text, notes = compilable_urdf(document, mesh_dir, with_minimum)
        except (ValueError, TypeError) as error:
            raise ModelError(
                f"{document.path}: a number cannot be read: {error}"
            ) from None
        try:
            mj_model = mujoco.MjModel.from_xml_string(text.decode())
            break
        except FAILURES as error:
            if with_minimum or "mjMINVAL" not in str(error):
                raise ModelError(_one_line(document, error)) from None
    restore_exact_inertias(mj_model, link_inertias(document))
    return mj_model, notes


_BALANCE = (
    ": no body has such moments of inertia; correct them, or let MuJoCo do it with "
    '<compiler balanceinertia="true"/> in <mujoco> (in a URDF, a <mujoco> in its <robot>)'
)


def _one_line(document: ModelDocument, error: BaseException) -> str:
    text = str(error).strip()
    first = re.sub(
        r"^(XML )?Error: ", "", text.splitlines()[0] if text else "unknown error"
    )
    name = _NAME.search(text)
    line = _LINE.search(text)
    where = [f"'{name.group(1).strip()}'"] if name and name.group(1).strip() else []
    where += [f"line {line.group(1)}"] if line and line.group(1) != "0" else []
    place = f" ({', '.join(where)})" if where else ""
    remedy = _BALANCE if "balanceinertia" in first else ""
    return f"MuJoCo cannot compile {document.path}: {first}{place}{remedy}"


def _check_values(mj_model: Any, document: ModelDocument) -> None:
    held = {name: getattr(mj_model, name) for name in _MUST_BE_FINITE}
    for name, values in {**held, "gravity": mj_model.opt.gravity}.items():
        largest = float(np.max(np.abs(values), initial=0.0))
        if not np.isfinite(largest):
            raise ModelError(
                f"{document.path} contains a value that is not a number ({name})"
            )
        if largest > LARGEST:
            raise ModelError(
                f"{document.path} contains a value no arm has ({name} {largest:g})"
            )


_SAME_TRACE = 1e-9
"""Relative difference of traces that six-digit axes leave: turning keeps the trace."""
_ALREADY_EXACT = 1e-13
"""Relative difference from the stated inertia that rounding alone makes."""


def restore_exact_inertias(
    mj_model: Any, inertias: Mapping[str, tuple[float, Array, Array]]
) -> None:
    """Give compiled bodies, in place, the inertia that their links state (``link_inertias``), where
    MuJoCo's differs by inaccuracy; what a compiler setting changed on purpose is left alone.
    """
    changed = False
    for name, (_, _, inertia) in inertias.items():
        body = mujoco.mj_name2id(mj_model, int(mujoco.mjtObj.mjOBJ_BODY), name)
        moments, axes = np.linalg.eigh(inertia)
        # balanceinertia keeps the trace too, and only touches what breaks the triangle inequality.
        if body <= 0 or moments[0] + moments[1] < moments[2]:
            continue
        size = float(np.trace(inertia))
        compiled = inertia_about_com(mj_model, body)
        turned = abs(float(np.trace(compiled)) - size) <= _SAME_TRACE * size
        if turned and np.max(np.abs(compiled - inertia)) > _ALREADY_EXACT * size:
            mj_model.body_inertia[body] = moments
            axes = axes if np.linalg.det(axes) > 0.0 else -axes
            mujoco.mju_mat2Quat(mj_model.body_iquat[body], axes.ravel())
            changed = True
    if changed:
        mujoco.mj_setConst(mj_model, mujoco.MjData(mj_model))


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
