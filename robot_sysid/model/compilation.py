"""Compiled MuJoCo models: of a model file, or held by a program as ``MjSpec`` or ``MjModel``.

MuJoCo's warnings become notes and its errors ModelErrors. Before release 3.14 it finds the
principal axes of a full inertia matrix to about six digits. A URDF cannot state them any other way,
so its compiled inertias are replaced by accurate ones.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import locale
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Union

import mujoco
import numpy as np

from robot_sysid.errors import ModelError, error_text
from robot_sysid.mjcf.assets import find_assets, refuse_missing_assets, relocate
from robot_sysid.mjcf.documents import ModelDocument, read_document
from robot_sysid.mjcf.inertial import format_number, format_numbers
from robot_sysid.mjcf.urdf import (
    LARGEST,
    collide_as_drawn,
    give_minimum,
    link_inertias,
    links_without_mass,
    make_compilable,
    mimics,
    velocity_limits,
)
from robot_sysid.mjcf.wrong_digits import wrong_numbers_of
from robot_sysid.model.actuators import with_actuators_in_joints
from robot_sysid.model.bodies import inertia_about_com
from robot_sysid.model.dry_friction import with_dry_friction_in_joints
from robot_sysid.records import Array
from robot_sysid.records.drafts import temporary_folder
from robot_sysid.records.messages import Progress, printable
from robot_sysid.wording import option_name

# RuntimeError is what the bindings make of an exception of C++, such as one for want of memory.
FAILURES = (ValueError, RuntimeError, mujoco.FatalError, mujoco.UnexpectedError)
"""Exceptions by which MuJoCo refuses a model."""
# Elements whose numbers are of no arm.
_OF_PICTURES = {"light", "camera", "texture", "material"}
_NAN = re.compile(r"(?<!\S)[-+]?nan(?!\S)", re.IGNORECASE)
AXES_ERROR = 1e-2
"""Largest error of a compiled inertia, as a share of its trace, that comes of MuJoCo's principal
axes before release 3.14: these have about six digits, fewer where two moments are nearly equal."""
ALL_DIGITS = 17
"""Number of digits that a number of 64 bits needs to be read as the same one."""
_LONG_NUMBER = re.compile(r'(?<=[" ])-?\d+\.\d{12,}(?:e[-+]\d+)?(?=[" ])')
"""What MuJoCo writes with so many digits, between the spaces and quotes of an attribute."""
# Arrays of an MjModel whose numbers are checked.
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
    """A compiled model.

    Attributes:
        mj_model: MuJoCo's ``MjModel``, see ``in_joints``.
        notes: sentences for the user on what was assumed or warned of.
        sha256: hash of all bytes of its files, includes too; "" without files.
        kind: language of the file, "mjcf" or "urdf".
        velocity_limits: joint name to the speed limit that a URDF states [rad/s or m/s].
        mimics: joint name to that of the joint which a URDF says it follows.
        massless: names of the links of which a URDF states no mass.
    """

    mj_model: Any
    notes: tuple[str, ...] = ()
    sha256: str = ""
    kind: str = "mjcf"
    velocity_limits: Mapping[str, float] = field(default_factory=dict)
    mimics: Mapping[str, str] = field(default_factory=dict)
    massless: frozenset[str] = frozenset()


@contextlib.contextmanager
def captured_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings in the list yielded, instead of on stderr and in a log file.

    Each is a sentence for the user.
    """
    messages = []
    previous = mujoco.get_mju_user_warning()

    def collect(message: object) -> None:
        """Take a warning from MuJoCo, on one line."""
        messages.append(f"MuJoCo warns: {' '.join(str(message).split())}")

    mujoco.set_mju_user_warning(collect)
    try:
        yield messages
    finally:
        mujoco.set_mju_user_warning(previous)


@contextlib.contextmanager
def warnings_as_notes(progress: Progress) -> Iterator[None]:
    """Report MuJoCo's warnings of a block at its end, each of them once."""
    with captured_warnings() as warnings:
        yield
    progress.note(*dict.fromkeys(warnings))


def compile_model(
    model: Any, mesh_dir: Any = None, fix_base: bool = False
) -> CompiledModel:
    """Compile an MJCF or URDF file, or raise ModelError with one line on why not.

    Args:
        model: path of the file; an MjSpec or MjModel is taken with all its digits.
        mesh_dir: folder that replaces the file's own for meshes (and, in a URDF, its packages).
        fix_base: whether floating joints of a URDF that MuJoCo does not take are fixed.
    """
    if is_in_memory(model):
        mj_model = _compile_spec(model) if _is_spec(model) else model
        return CompiledModel(in_joints(mj_model))
    document = read_document(Path(model), mesh_dir)
    if mesh_dir is not None and not os.path.isdir(mesh_dir):
        raise ModelError(
            f"mesh folder {mesh_dir} is no folder; check {option_name('mesh_dir')}"
        )
    point = locale.localeconv()["decimal_point"]
    if point != ".":  # MuJoCo would end the numbers of an OBJ mesh at their points
        remedy = "call locale.setlocale(locale.LC_NUMERIC, 'C') first"
        raise ModelError(
            f"a locale that has {point!r} for a decimal point spoils OBJ meshes; {remedy}"
        )
    # Refuses pipes, for which MuJoCo would wait for ever.
    find_assets(document)
    massless = links_without_mass(document) if document.is_urdf else frozenset()
    with captured_warnings() as warnings:
        mj_model, notes = _compile(document, warnings, fix_base)
    _check_values(mj_model, document)
    return CompiledModel(
        in_joints(mj_model),
        (*notes, *dict.fromkeys(warnings)),
        document.sha256,
        "urdf" if document.is_urdf else "mjcf",
        velocity_limits(document),
        mimics(document),
        massless,
    )


def compile_as_drawn(model: Any, mesh_dir: Any = None) -> Any:
    """Return the ``MjModel`` of a URDF in which what is drawn of links without shapes is a shape.

    It has the same bodies. None where the model is no URDF, draws nothing of such links, or what it
    draws is no body that MuJoCo takes.
    """
    if is_in_memory(model):
        return None
    document = read_document(Path(model), mesh_dir)
    if not document.is_urdf:
        return None
    make_compilable(document, fix_base=True)
    if not collide_as_drawn(document):
        return None
    give_minimum(document)
    with captured_warnings(), contextlib.suppress(*FAILURES):
        return mujoco.MjModel.from_xml_string(document.text().decode())
    return None


def in_joints(mj_model: Any) -> Any:
    """Return a model whose joints and tendons have the rotors, damping and dry friction that its
    file states elsewhere; it takes the same torques while joints slide.
    """
    return with_dry_friction_in_joints(with_actuators_in_joints(mj_model))


def _compile(
    document: ModelDocument, warnings: Sequence[str], fix_base: bool
) -> tuple[Any, tuple[str, ...]]:
    """Return a document, which may be changed, compiled, and notes on what was changed.

    ModelError where it cannot be compiled. MuJoCo's warnings are added to ``warnings``. In a URDF,
    moving links without mass get a minimum, and moments of inertia that no body has are raised;
    other inertias are exact.
    """
    notes: tuple[str, ...] = ()
    inertias = {}
    is_changed = True
    if document.is_urdf:
        try:
            notes = make_compilable(document, fix_base)
            inertias = link_inertias(document)
        # Of a nan there are no eigenvalues; older NumPy has an error of its own for that.
        except (ValueError, TypeError, np.linalg.LinAlgError) as error:
            _refuse_stated_nan(document)
            raise ModelError(
                f"{document.path}: a number cannot be read: {error}"
            ) from None
    elif document.mesh_dir is not None or not document.is_utf8:
        relocate(document, folder=None)
    else:
        is_changed = False
    try:
        if is_changed:
            mj_model = mujoco.MjModel.from_xml_string(document.text().decode())
        else:
            mj_model = mujoco.MjModel.from_xml_path(str(document.path))
    except FAILURES as error:
        _refuse_nan(document, warnings)
        if not document.is_urdf:
            # Asked only now, so that MuJoCo's own rules decide what is missing.
            refuse_missing_assets(document)
        message = error_text(error)
        if is_changed:
            # The lines of the text are not those of the file.
            message = message.partition(", line")[0]
        message = "; ".join([message, *_wrong_inertias(document)])
        meshes = [asset.path for asset in find_assets(document) if asset.path]
        names = [name for mesh in meshes for name in (mesh.name, f"'{mesh.stem}'")]
        if document.is_urdf and any(name in message for name in names):
            message += (
                "; save the mesh as binary STL or OBJ, or remove the file: a link with an "
                "<inertial> needs none"
            )
        raise ModelError(f"MuJoCo cannot compile {document.path}: {message}") from None
    _refuse_nan(document, warnings)
    restore_exact_inertias(mj_model, inertias)
    return mj_model, notes


def _refuse_nan(document: ModelDocument, warnings: Sequence[str]) -> None:
    """Raise ModelError, with the place, where MuJoCo warns that it has read a nan.

    It takes a nan for what the file does not state, such as a centre of mass at the origin.
    """
    if any("'nan'" in warning.lower() for warning in warnings):
        _refuse_stated_nan(document)


def _refuse_stated_nan(document: ModelDocument) -> None:
    """Raise ModelError for the first nan of an arm in a file; a name may be one."""
    for element in document.root.iter("*"):
        for key, value in element.attrib.items():
            is_number = key != "name" and element.tag not in _OF_PICTURES
            if is_number and _NAN.search(value):
                path = document.sources.get(element, document.path)
                raise ModelError(
                    f"{path}, line {element.sourceline}: {key}={printable(value)!r:.60} of "
                    f"<{element.tag}> is no number; state what it is"
                )


def _wrong_inertias(document: ModelDocument) -> Iterator[str]:
    """Yield what is wrong with inertias of an MJCF that MuJoCo refuses."""
    if not document.is_urdf:
        yield from wrong_numbers_of(document)


def _check_values(mj_model: Any, document: ModelDocument) -> None:
    """Raise ModelError for numbers that are not finite, or larger than an arm's."""
    arrays = {name: getattr(mj_model, name) for name in _MUST_BE_FINITE}
    arrays["gravity"] = mj_model.opt.gravity
    for name, values in arrays.items():
        largest = np.max(np.abs(values), initial=0.0)
        # Also where it is no number.
        if not largest <= LARGEST:
            raise ModelError(
                f"{document.path} contains a value no arm has ({name} {largest:g})"
            )


def restore_exact_inertias(
    mj_model: Any, inertias: Mapping[str, tuple[float, Array, Array]]
) -> None:
    """Give compiled bodies, in place, the inertia that their links state.

    Only where MuJoCo's differs by inaccuracy; a change that a compiler setting made on purpose
    stays. ``inertias``: as ``urdf.link_inertias`` returns them.
    """
    for name, (_, _, inertia) in inertias.items():
        body = mujoco.mj_name2id(mj_model, int(mujoco.mjtObj.mjOBJ_BODY), name)
        moments, axes = np.linalg.eigh(inertia)
        if body <= 0:
            continue
        size = np.trace(inertia)
        compiled = inertia_about_com(mj_model, body)
        # Turning by axes of six digits keeps the trace.
        has_same_trace = abs(np.trace(compiled) - size) <= 1e-9 * size
        difference = np.max(np.abs(compiled - inertia))
        # More than rounding. balanceinertia keeps the trace too, but makes all three moments equal,
        # which inaccurate axes do not reach.
        is_inaccurate = 1e-13 * size < difference < AXES_ERROR * size
        if has_same_trace and is_inaccurate:
            # Rounding must not leave a flat body with moments that no body has.
            moments[2] = min(moments[2], moments[0] + moments[1])
            mj_model.body_inertia[body] = moments
            axes = axes if np.linalg.det(axes) > 0.0 else -axes
            mujoco.mju_mat2Quat(mj_model.body_iquat[body], axes.ravel())
    if inertias:
        mujoco.mj_setConst(mj_model, mujoco.MjData(mj_model))


InMemory = Union["mujoco.MjSpec", "mujoco.MjModel"]
"""A model that a program holds in memory."""
# Folders of the files that ``file_of`` wrote; they are removed when the process ends.
_FOLDERS = contextlib.ExitStack()
atexit.register(_FOLDERS.close)


def is_in_memory(model: Any) -> bool:
    """Return whether an object is an ``MjSpec`` or ``MjModel``."""
    return isinstance(model, mujoco.MjModel) or _is_spec(model)


def _is_spec(model: Any) -> bool:
    """Return whether an object is an ``MjSpec``."""
    # Releases before 3.2 have none.
    return isinstance(model, getattr(mujoco, "MjSpec", ()))


def mjcf_of(path: Path, mesh_dir: Path | None = None) -> Path:
    """Return a temporary MJCF file of a model file, removed when this process ends.

    MuJoCo writes it, with all digits. ModelError where the model does not compile.
    """
    mjcf = lasting_folder() / "model.xml"
    # A floating joint that MuJoCo does not take has been fixed by whoever loaded the model.
    mj_model = compile_model(path, mesh_dir, fix_base=True).mj_model
    # MuJoCo writes only the last model that was loaded.
    with captured_warnings(), all_digits():
        try:
            mujoco.mj_saveLastXML(str(mjcf), mj_model)
        except FAILURES as error:
            raise ModelError(f"MuJoCo cannot write it: {error_text(error)}") from None
    _write_exactly(mjcf, mjcf.read_text(encoding="utf-8"), mj_model)
    return mjcf


def lasting_folder() -> Path:
    """Return a new folder that is removed when this process ends."""
    return _FOLDERS.enter_context(temporary_folder())


@contextlib.contextmanager
def all_digits() -> Iterator[None]:
    """Let MuJoCo write the numbers of a block with all their digits, where it would write six.

    Six digits of where joints sit change torques by more than a written model may differ, and those
    of a flat body's inertia make it one that no body has. MuJoCo has the setting for its own tests,
    without a place in Python.
    """
    folder = Path(mujoco.__file__).parent
    paths = [path for path in folder.glob("*mujoco*") if path.suffix != ".py"]
    library = next(filter(None, map(_library_with_digits, sorted(paths))), None)
    if library is None:
        raise ModelError(
            f"MuJoCo {mujoco.__version__} writes models with six digits only; install another "
            "release"
        )
    usual = library._mjPRIVATE__get_xml_precision()
    library._mjPRIVATE__set_xml_precision(ALL_DIGITS)
    try:
        yield
    finally:
        library._mjPRIVATE__set_xml_precision(usual)


def _library_with_digits(path: Path) -> Any:
    """Return MuJoCo's library of that path, if it is one and has the setting of digits."""
    with contextlib.suppress(OSError):
        library = ctypes.CDLL(str(path))
        return library if hasattr(library, "_mjPRIVATE__set_xml_precision") else None
    return None


def _write_exactly(path: Path, text: str, model: Any) -> None:
    """Write an MJCF that MuJoCo made of an MjModel, each number as short as it is read the same.

    The inertials have the numbers of the model: releases before 4 take what is nearer than 1e-12 to
    a whole number for that, which makes a flat body one with moments that no body has.
    """
    short = _LONG_NUMBER.sub(lambda number: format_number(float(number[0])), text)
    path.write_text(short, encoding="utf-8")
    document = read_document(path)
    for node, body in zip(document.root.iter("body"), range(1, model.nbody)):
        inertial = node.find("inertial")
        # The order differs where MuJoCo wrote another model, or frames around bodies.
        if inertial is None or node.get("name", "") != model.body(body).name:
            continue
        mass = model.body_mass[body]
        if np.isclose(float(inertial.get("mass", 0.0)), mass):
            inertial.set("pos", format_numbers(model.body_ipos[body]))
            inertial.set("quat", format_numbers(model.body_iquat[body]))
            inertial.set("diaginertia", format_numbers(model.body_inertia[body]))
            inertial.set("mass", format_number(mass))
    path.write_bytes(document.text())


def file_of(model: Any) -> Path:
    """Return a temporary MJCF file of an MjSpec, removed when this process ends.

    MuJoCo writes it, with all digits; the MjSpec stays as it is. Raises ModelError where it does
    not compile, and for an MjModel, of which MuJoCo writes only the last one that was loaded.
    """
    if not _is_spec(model):
        raise ModelError(
            "a MjModel cannot be written to a file; give its file, or the MjSpec that it was "
            "compiled from"
        )
    folder = lasting_folder()
    assets = dict(model.assets or {})
    for name, content in assets.items():
        data = content if isinstance(content, bytes) else content.encode()
        (folder / Path(name).name).write_bytes(data)
    spec = model.copy()
    for name in ("meshdir", "texturedir"):
        asset_folder = Path(model.modelfiledir, getattr(model, name)).absolute()
        setattr(spec, name, str(folder if assets else asset_folder))
    mj_model = _compile_spec(spec)
    file_name = re.sub(r"[^\w-]+", "_", model.modelname) or "model"
    path = folder / f"{file_name}.xml"
    with all_digits():
        text = spec.to_xml()
    _write_exactly(path, text, mj_model)
    return path


def _compile_spec(spec: Any) -> Any:
    """Return the MjModel of an MjSpec, or raise ModelError."""
    with captured_warnings():
        try:
            return spec.compile()
        except FAILURES as error:
            raise ModelError(
                f"MuJoCo cannot compile the MjSpec: {error_text(error)}"
            ) from None
