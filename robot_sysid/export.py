"""Writing results: params.json, model, payload card and motor trajectory, all together.

Files that an earlier run of any command left in the folder never stay beside them.

params.json is strict JSON in full precision: numbers that are not finite become null. Inertia is
about the body ORIGIN in ``inertia_tensor`` and about the centre of mass in ``inertia_about_com``,
in the frame of the body; of a payload in the flange frame. The torque that friction takes is the
sum of all terms' values times ``friction_formulas``, with ``qd`` the joint's speed and ``load`` the
torque its gear transmits (that of the links alone).
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.documents import read_document
from robot_sysid.model.compilation import warnings_as_notes
from robot_sysid.records import InertialParameters, Motion, file_access
from robot_sysid.records.controllers import AUTO
from robot_sysid.records.messages import NextStep, Progress
from robot_sysid.results.body_errors import ERROR_NAMES, INERTIA, load_errors
from robot_sysid.results.cards import card_text, number_groups
from robot_sysid.results.next_steps import last_lines
from robot_sysid.results.record import (
    BodyEstimate,
    ModelFile,
    ModelTarget,
    Payload,
    Result,
    json_text,
)
from robot_sysid.results.result_lines import (
    block_lines,
    clamping_lines,
    folder_text,
    more_lines,
)
from robot_sysid.results.verdict import PRIOR_SHARE, limitations, refusal, verdict_line
from robot_sysid.results.written_model import versions, write_model

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory import DamiaoExportReport

_LATER_NAMES = ("report_data.npz", file_access.RUN_NAME)
"""Files that a command writes after the results."""
RESULT_NAMES = (
    file_access.PARAMS_NAME,
    file_access.SERVO_NAME,
    *file_access.MODEL_NAMES.values(),
    file_access.CARD_NAME,
    file_access.DAMIAO_NAME,
    "report.html",
)
"""Result files of all commands and releases; a planned motion is no result."""
MotorFile = Callable[[TextIO], "DamiaoExportReport"]
"""Writes the motor trajectory into an open file and returns a report on it."""


@dataclass(frozen=True)
class Written:
    """What a command has written, and what it says of it.

    Attributes:
        files: the written files.
        lines: printed lines, in order.
        verdict: whether to use the result, which file, and the next step; printed last.
        failure: why there is nothing to use, or None.
        result: a ``Result``, identified servos, or what --json prints of a plan.
    """

    files: tuple[Path, ...]
    lines: tuple[str, ...]
    verdict: tuple[str, ...]
    failure: str | None
    result: Any


@contextlib.contextmanager
def writable_folder(folder: Path, progress: Progress) -> Iterator[None]:
    """Note MuJoCo's warnings when the block, which writes to an output folder, ends.

    InputError where the folder cannot be written to.
    """
    file_access.require_writable(folder)
    with warnings_as_notes(progress):
        yield


def save(
    result: Result,
    folder: Path,
    checkpoints: Motion,
    progress: Progress,
    *,
    mesh_dir: Path | None = None,
    as_body: str | None = None,
    card_choice: str = AUTO,
    motor_file: MotorFile | None = None,
    inputs: Collection[Path] = (),
    links: bool = False,
    step: NextStep | None = None,
) -> Written:
    """Write params.json, and where the result may be used the model and a payload's card.

    A result that may not be used, or that does not fit into this model, gets a params.json only,
    which says why. An error before files take their places leaves the folder as it was.

    Args:
        folder: the output folder, in which files of earlier runs are removed.
        checkpoints: motion on which the written model must reproduce the predicted torque.
        progress: receives notes on the written files.
        mesh_dir: the user's mesh folder, if any.
        as_body: name of a new body for the payload; None merges it into the terminal link.
        card_choice: whose cards of a payload are written, of ``controllers.CHOICES``.
        motor_file: writes the motor trajectory; None for none.
        inputs: files that this run reads, beside the model; they stay whatever they are called.
        links: whether the printed table shows every link.
        step: what to do after a result that may be used; None for nothing more.

    Returns:
        The written files and the lines on them.

    Raises:
        InputError: the folder cannot be written to.
    """
    # Of a known mass the torques are calibrated: there is nothing to write of such a payload.
    payload = result.payload
    is_calibration = payload is not None and payload.known_mass is not None
    failure = refusal(result)
    report = None
    card: Mapping[str, Any] | None = None
    written: list[Path] = []
    notes: tuple[str, ...] = ()
    with file_access.atomic_files() as files:
        if failure is None and not is_calibration:
            # Drafted first, the model appears last: what the other files say then holds for it.
            target = ModelTarget(
                files, folder, checkpoints, result.estimate.rmse, mesh_dir
            )
            try:
                written, notes = _write_models(result, target, as_body)
            except ExportError as error:
                failure = (
                    f"{error} (the identified numbers are in {file_access.PARAMS_NAME})"
                )
            if payload is not None:
                written.append(folder / file_access.CARD_NAME)
                card = number_groups(payload.body)
                text = card_text(payload, card, result.robot, card_choice)
                files.write(written[-1], text)
        if motor_file is not None:
            written.append(folder / file_access.DAMIAO_NAME)
            with files.open(written[-1]) as file:
                report = motor_file(file)
        step = None if failure else step
        verdict = last_lines(result, written, step, failure)
        written.append(folder / file_access.PARAMS_NAME)
        text = params_json_text(result, card, notes, verdict, step)
        files.write(written[-1], text)
        model_files = read_document(result.robot.path).contents
        notes += remove_earlier(files, folder, written, (*inputs, *model_files))
    lines = (
        *block_lines(result, links),
        f"Results saved to {folder_text(folder)}",
        *more_lines(result, links),
        *clamping_lines(report, result.robot.joint_names),
    )
    progress.note(*notes)
    return Written(tuple(written), lines, verdict, failure, result)


def _write_models(
    result: Result, target: ModelTarget, as_body: str | None
) -> tuple[list[Path], tuple[str, ...]]:
    """Write the updated model into the folder ``target.path``; return (paths, notes).

    An arm from a URDF gets both where MuJoCo alone would not load the URDF, or where the best model
    needs an MJCF: that MJCF, and the best URDF.

    Raises:
        ExportError: one of them cannot be written; then neither is.
    """
    robot = result.robot
    results = {result.model_kind: result}
    if robot.kind not in results:
        file = result.file and (result.file.urdf_file or result.file)
        results[robot.kind] = replace(result, file=file)
    written: list[Path] = []
    notes: list[str] = []
    try:
        for file_kind, model_result in results.items():
            path = target.path / file_access.MODEL_NAMES[file_kind]
            model_target = replace(target, path=path)
            file_notes = write_model(model_result, model_target, as_body, file_kind)
            if len(results) > 1:
                # A detail stays one.
                file_notes = tuple(type(n)(f"{path.name}: {n}") for n in file_notes)
            notes += file_notes
            written.append(model_target.path)
    except ExportError:
        for path in written:
            target.files.withdraw(path)
        raise
    return written, tuple(notes)


def remove_earlier(
    files: file_access.AtomicFiles,
    folder: Path,
    written: Collection[Path],
    read: Collection[Path],
) -> tuple[str, ...]:
    """Have result files of an earlier run removed once those of this run are in place.

    Args:
        files: which removes them when it commits.
        folder: the output folder.
        written: files of this run; they stay.
        read: files that this run reads; they stay, too.

    Returns:
        A note per removed result.
    """
    used = {os.path.realpath(path) for path in (*written, *read)}
    notes = []
    for name in (*RESULT_NAMES, *_LATER_NAMES):
        path = folder / name
        if path.is_file() and os.path.realpath(path) not in used:
            files.remove(path)
            if name not in _LATER_NAMES:
                notes.append(f"{path} of an earlier run was removed")
    return tuple(notes)


SCHEMA_VERSION = 4
"""Version of the format of params.json; readers refuse other versions."""
FORMULAS = {
    "coulomb": "sign(qd)",
    "viscous": "qd",
    "offset": "1",
    "sqrt": "sign(qd) * sqrt(abs(qd))",
    "fading_fast": "sign(qd) * exp(-abs(qd) / 0.04)",
    "fading": "sign(qd) * exp(-abs(qd) / 0.13)",
    "fading_slow": "sign(qd) * exp(-abs(qd) / 0.4)",
    "stribeck": "sign(qd) * exp(-(qd / 0.1)**2)",
    "load": "sign(qd) * abs(load)",
    "sigmoid": "tanh(qd / 0.05)",
}
"""Friction term to its torque per unit of its coefficient."""


def params_json_text(
    result: Result,
    card: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
    verdict: Sequence[str] = (),
    step: NextStep | None = None,
) -> str:
    """Return the text of params.json.

    Args:
        result: of the identification.
        card: numbers of the payload's card; None where none is written.
        notes: added to those of the result, one sentence each.
        verdict: last lines of the console; by default the verdict on the result alone.
        step: what to do next, or None.
    """
    written = {} if result.file is None else result.file.joints
    joints = {}
    for name, joint in result.joints.items():
        joints[name] = {
            "friction_model": joint.friction_model,
            "terms": joint.terms,
            "model": joint.model_terms,
            "in_the_file": written.get(name, {}),
            "torque_noise": joint.noise,
        }
    couplings = {}
    for name, motor in result.couplings.items():
        couplings[name] = {"terms": motor.terms, "in_the_file": written.get(name, {})}
    content = {
        "schema_version": SCHEMA_VERSION,
        **_terminal_link_entries(result),
        "verdict": verdict or (verdict_line(result),),
        "next_step": step,
        "file": _file_entry(result.file),
        "payload": _payload_entry(result.payload, card),
        "links": [_link_entry(result, body) for body in result.links.values()],
        "joints": joints,
        "couplings": couplings,
        "friction_formulas": FORMULAS,
        "sensors": result.sensors,
        **_fit_entries(result),
        **_run_entries(result, notes),
    }
    return json_text(content)


def inertial_entries(inertial: InertialParameters | None) -> dict[str, Any] | None:
    """Return ten parameters, and numbers that follow from them, as JSON entries; None for None."""
    if inertial is None:
        return None
    about_com = spatial.six_from_symmetric(inertial.inertia_com)
    return {
        "mass": inertial.mass,
        "center_of_mass_moment": inertial.first_moment,
        "inertia_tensor": dict(zip(INERTIA, inertial.theta[4:])),
        "center_of_mass": inertial.com,
        "inertia_about_com": dict(zip(INERTIA, about_com)),
        "principal_moments": inertial.principal_moments,
    }


def _terminal_link_entries(result: Result) -> dict[str, Any]:
    """Return the entries on the terminal link, with the payload if there is one, and the status."""
    estimate = result.estimate
    identifiability = estimate.identifiability
    joint = result.robot.terminal_joint
    inertial = estimate.inertial
    is_identified = not identifiability.unidentifiable
    if result.payload is not None:
        inertial = result.payload.total
        is_identified = bool(np.all(result.payload.body.is_determined))
    entries = inertial_entries(inertial) or {}
    # The keys of the specification stand in its order, before all further ones.
    first_keys = ("mass", "center_of_mass_moment", "inertia_tensor")
    first_entries = {key: entries.pop(key) for key in first_keys}
    return {
        "joint_name": joint,
        **first_entries,
        "coulomb_friction": estimate.value(f"coulomb[{joint}]"),
        "viscous_friction": estimate.value(f"viscous[{joint}]"),
        "rmse": estimate.rmse,
        "condition_number": identifiability.condition_number,
        "n_base_params": identifiability.rank,
        "question": result.question,
        "body_name": result.robot.body_name,
        **entries,
        "status": result.verdict.name,
        "status_text": result.verdict.value,
        "reasons": result.reasons,
        "known_to": result.relative_mass_error,
        "valid": {
            "physically_consistent": result.body.is_consistent,
            "all_identified": is_identified,
            "trustworthy": result.verdict.is_trustworthy,
        },
    }


def _file_entry(file: ModelFile | None) -> dict[str, Any] | None:
    """Return the errors of the written model and the parts that it keeps."""
    if file is None:
        return None
    return {
        "before": file.validation_before,
        "after": file.validation_after,
        "others": [{"before": b, "after": a} for b, a in file.other_validations],
        "gravity": file.gravity,
        "kept": file.unchanged,
    }


def _payload_entry(
    payload: Payload | None, card: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """Return flange, bodies, recordings and card of a payload."""
    if payload is None:
        return None
    return {
        "flange": payload.flange,
        "body": _body_entry(payload.body),
        "link": _body_entry(payload.link),
        "total": _body_entry(payload.total),
        "recordings": payload.recordings,
        "scatter": payload.scatter,
        "known_mass": payload.known_mass,
        "torque_scale": payload.torque_scale,
        "card": card,
    }


def _body_entry(body: BodyEstimate) -> dict[str, Any]:
    """Return a body's parameters, as identified and in the model, with their errors by cause."""

    def by_name(values: Any) -> dict[str, Any]:
        """Return parameter name to value, of values (10,)."""
        return dict(zip(PARAMETER_NAMES, values))

    from_data = body.is_determined & (body.data_share >= PRIOR_SHARE)
    source = np.where(from_data, "identified", "from_model").tolist()
    load_entries = dict(zip(ERROR_NAMES, load_errors(body)))
    return {
        "name": body.name,
        **(inertial_entries(body) or {}),
        "model": inertial_entries(body.prior),
        "standard_errors": {**by_name(body.errors), **load_entries},
        "error_budget": {c: by_name(errors) for c, errors in body.budget.items()},
        "data_share": by_name(body.data_share),
        "source": by_name(source),
    }


def _link_entry(result: Result, body: BodyEstimate) -> dict[str, Any]:
    """Return the entry of a link, with the parameters that the written model has."""
    written = None
    if result.file is not None and body.joint is not None:
        theta = result.file.thetas[result.robot.joint_names.index(body.joint)]
        written = InertialParameters(theta) if np.any(theta) else None
    entry = {"joint": body.joint, **_body_entry(body)}
    return {**entry, "in_the_file": inertial_entries(written)}


def _fit_entries(result: Result) -> dict[str, Any]:
    """Return the entries on the fit: identifiability, errors, priors, samples."""
    estimate = result.estimate
    identifiability = estimate.identifiability
    sources = np.where(identifiability.identified, "identified", "from_model").tolist()
    errors = None
    if estimate.standard_errors is not None:
        errors = dict(zip(estimate.names, estimate.standard_errors))
    return {
        "torques": result.torques,
        "parameter_source": dict(zip(estimate.names, sources)),
        "unidentifiable_combinations": identifiability.unidentifiable,
        "rmse_per_joint": estimate.rmse_per_joint,
        "condition_number_scaled": identifiability.scaled_condition_number,
        "standard_errors": errors,
        "link_scales": result.link_scales,
        "wrong_links": result.wrong_links,
        "noise_per_joint": estimate.noise_per_joint,
        "samples_per_joint": estimate.samples,
    }


def _run_entries(result: Result, notes: Sequence[str]) -> dict[str, Any]:
    """Return the entries on validation and notes, and on data, model, versions."""
    data = result.data
    robot = result.robot
    return {
        "validation": result.validation,
        "cutoff": result.cutoff,
        "friction_model": result.friction_model,
        "limitations": [*limitations(result)],
        "notes": [*result.notes, *notes],
        "source": data.description,
        "logs": data.files,
        "model": {"path": str(robot.path), "sha256": robot.sha256},
        "joint_names": robot.joint_names,
        "seed": data.seed,
        "duration": data.duration,
        "sample_rate": data.sample_rate,
        "versions": versions(),
    }
