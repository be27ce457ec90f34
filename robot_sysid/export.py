"""Writing the results: params.json, model, payload card, motor trajectory, all together.

What an earlier run left in the folder, whatever command wrote it, never stays beside them.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.inertial import WriteBack
from robot_sysid.mjcf.updated_model import BodyChange, ModelChange, changed_model_text
from robot_sysid.model.compilation import warnings_as_notes
from robot_sysid.records import InertialParameters, Motion, PriorConflict, file_access
from robot_sysid.records.file_access import write_atomically
from robot_sysid.records.messages import Progress, with_error
from robot_sysid.results import record
from robot_sysid.results.cards import (
    ERROR_NAMES,
    INERTIA,
    Card,
    card_text,
    load_errors,
    payload_cards,
)
from robot_sysid.results.record import (
    BodyEstimate,
    JointEstimate,
    ModelTarget,
    Payload,
    Quantity,
    Result,
    RolloutTest,
)
from robot_sysid.results.verdict import PRIOR_SHARE, limitations, refusal, verdict_lines
from robot_sysid.results.written_model import versions, write_model

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory import DamiaoExportReport

_BESIDE = ("report_data.npz", file_access.RUN_NAME)
"""What a command writes once the results are in their places."""
RESULT_NAMES = (
    file_access.PARAMS_NAME,
    file_access.SERVO_NAME,
    *file_access.MODEL_NAMES.values(),
    file_access.CARD_NAME,
    file_access.DAMIAO_NAME,
    "report.html",
)
"""What a run leaves, whichever command and release it was; a planned motion is no result."""
MotorFile = Callable[[TextIO], "DamiaoExportReport"]
"""Writes the motor trajectory into an open file."""


@dataclass(frozen=True)
class Saved:
    """What was written.

    Attributes:
        files: their paths.
        notes: what writing had to say, one sentence each.
        damiao: report of the Damiao export, where one was asked for.
        failure: why there is no model, or None where there is one or none was to be.
        result_hash: of params.json.
    """

    files: tuple[Path, ...]
    notes: tuple[str, ...]
    damiao: DamiaoExportReport | None
    failure: str | None
    result_hash: str


@contextlib.contextmanager
def locked_folder(folder: Path, progress: Progress) -> Iterator[None]:
    """Keep an output folder to one run, and tell at its end what MuJoCo warned of meanwhile;
    InputError where the folder cannot be written to, or another run has it.
    """
    file_access.require_writable(folder)
    with warnings_as_notes(progress), file_access.lock_folder(folder):
        yield


def export_updated_xml(
    source: Path,
    body: str,
    plan: WriteBack,
    rmse: float,
    destination: Path,
    mesh_dir: Path | None = None,
    principal: bool = False,
) -> None:
    """Write an MJCF or URDF file with one body's inertia replaced.

    Args:
        body: name of the terminal body, or "#7" for the nameless body with id 7.
        rmse: of the identification [N m], for the comment.
        mesh_dir: the user's mesh folder, if any.
        principal: see ``mjcf.inertial.mjcf_inertial``.
    """
    change = ModelChange((BodyChange(body, 0, plan),), rmse, principal=principal)
    folder = destination.absolute().parent
    file_access.write_atomically(
        destination, changed_model_text(source, change, folder, mesh_dir)
    )


def save(
    result: Result,
    folder: Path,
    checkpoints: Motion,
    *,
    mesh_dir: Path | None = None,
    as_body: str | None = None,
    motor_file: MotorFile | None = None,
    refused: str | None = None,
    inputs: Collection[Path] = (),
) -> Saved:
    """Write params.json, and where the result may be used the model and a payload's card.

    A result that may not be used, or that does not fit into this model, gets a params.json only,
    which says why. An error before files take their places leaves the folder as it was.

    Args:
        checkpoints: motion on which the written model must reproduce the predicted torque.
        mesh_dir: the user's mesh folder, if any.
        as_body: name of a new body for the payload; None merges it into the terminal link.
        motor_file: writes the motor trajectory; None for none.
        refused: why no model is to be written although the result may be used, or None.
        inputs: files that this run reads, beside the model; they stay whatever they are called.

    Raises:
        InputError: the folder cannot be written to.
    """
    # A known mass weighed the torques: there is nothing to write of such a payload.
    calibrates = result.payload is not None and result.payload.known_mass is not None
    failure = refusal(result) or refused
    report = None
    cards: tuple[Card, ...] = ()
    written: list[Path] = []
    notes: tuple[str, ...] = ()
    with file_access.atomic_files() as files:
        if failure is None and not calibrates:
            # Drafted first, it takes its place last: what the other files say then holds for it.
            target = ModelTarget(
                files, folder, checkpoints, result.estimate.rmse, mesh_dir
            )
            try:
                written, notes = _write_models(result, target, as_body)
            except ExportError as error:
                failure = (
                    f"{error} (the identified numbers are in {file_access.PARAMS_NAME})"
                )
            if result.payload is not None:
                cards, text = _card_file(result, result.payload)
                written.append(folder / file_access.CARD_NAME)
                files.write(written[-1], text)
        if motor_file is not None:
            written.append(folder / file_access.DAMIAO_NAME)
            with files.open(written[-1]) as file:
                report = motor_file(file)
        text = params_json_text(result, cards, notes, failure)
        written.append(folder / file_access.PARAMS_NAME)
        files.write(written[-1], text)
        read = (
            *inputs,
            *(file.path for file in read_document(result.robot.path).files),
        )
        notes += remove_earlier(files, folder, written, read)
    return Saved(
        tuple(written),
        notes,
        report,
        failure,
        hashlib.sha256(text.encode()).hexdigest(),
    )


def _write_models(
    result: Result, target: ModelTarget, as_body: str | None
) -> tuple[list[Path], tuple[str, ...]]:
    """Write a model into a folder, where that is an MJCF for a URDF's arm a URDF too; return their
    paths and notes. Either none is written, or all.
    """
    written = []
    notes: tuple[str, ...] = ()
    beside = None if result.file is None else result.file.urdf_file
    try:
        for model in (
            result,
            *([] if beside is None else [replace(result, file=beside)]),
        ):
            path = target.path / file_access.MODEL_NAMES[model.model_kind]
            notes += write_model(model, replace(target, path=path), as_body)
            written.append(path)
    except ExportError:
        for path in written:
            target.files.withdraw(path)
        raise
    return written, notes


def remove_earlier(
    files: file_access.AtomicFiles,
    folder: Path,
    written: Collection[Path],
    read: Collection[Path],
) -> tuple[str, ...]:
    """Have results of an earlier run removed once this run's are in place; returns notes.

    What this run writes, and what it reads, stays.
    """
    kept = {os.path.realpath(path) for path in (*written, *read)}
    there = [
        folder / name for name in (*RESULT_NAMES, *_BESIDE) if (folder / name).is_file()
    ]
    stale = [path for path in there if os.path.realpath(path) not in kept]
    for path in stale:
        files.remove(path)
    told = [path for path in stale if path.name not in _BESIDE]
    return tuple(f"{path} of an earlier run was removed" for path in told)


def _card_file(result: Result, payload: Payload) -> tuple[tuple[Card, ...], str]:
    cards = payload_cards(payload.body, payload.flange)
    recordings = payload.recordings
    mass = with_error(payload.body.inertial.mass, float(payload.body.errors[0]), "kg")
    heading = (
        f"Payload of {mass}, identified with {result.robot.path.name} from "
        f"{len(recordings['empty'])} empty and {len(recordings['loaded'])} loaded recordings."
    )
    return cards, card_text(cards, heading)


SCHEMA_VERSION = 4
FORMULAS = {
    "coulomb": "sign(qd)",
    "viscous": "qd",
    "offset": "1",
    "sqrt": "sign(qd) * sqrt(abs(qd))",
    "fading_fast": "sign(qd) * exp(-abs(qd) / 0.04)",
    "fading": "sign(qd) * exp(-abs(qd) / 0.13)",
    "fading_slow": "sign(qd) * exp(-abs(qd) / 0.4)",
    "stribeck": "sign(qd) * exp(-(qd / stribeck_speed)**2)",
    "load": "sign(qd) * abs(load)",
    "quadratic": "qd * abs(qd)",
    "cubic": "qd**3",
    "sigmoid": "tanh(qd / sigmoid_speed)",
}
_SURE = 1.96
"""Standard errors on each side of a value that hold 95 % of a bell curve."""
_WHEN = ("before", "after")
_OF_PAYLOAD = ("recordings", "scatter", "known_mass", "torque_scale")
_OF_RUN = ("delay", "tilt", "cutoff", "friction_model")
_IN_BAM = {
    "viscous": ("friction_viscous", 1.0),
    "stribeck": ("friction_stribeck", 1.0),
    "stribeck_speed": ("dtheta_stribeck", 1.0),
    "load": ("load_friction_base", 0.5),
    "armature": ("armature", 1.0),
}


def export_params_json(result: Result, path: Path, notes: Sequence[str] = ()) -> None:
    """Write params.json, or raise InputError; ``notes``, a sentence each, join the result's."""
    write_atomically(path, params_json_text(result, notes=notes))


def params_json_text(
    result: Result,
    cards: Sequence[Card] = (),
    notes: Sequence[str] = (),
    failure: str | None = None,
) -> str:
    """Return the text of params.json, with the payload's cards, notes of one sentence each, and why
    nothing may be used of a result that may be used for itself, or None.
    """
    found = replace(result, notes=(*result.notes, *notes))
    content = {
        "schema_version": SCHEMA_VERSION,
        **_asked(found),
        "verdict": verdict_lines(result, failure),
        "file": _file(found.file),
        "payload": _payload(found.payload, cards),
        "links": [_link(found, body) for body in found.links],
        "joints": {
            name: _joint(found, name, each) for name, each in found.joints.items()
        },
        "couplings": {
            name: {"terms": each.terms, "in_the_file": _written_terms(found, name)}
            for name, each in found.couplings.items()
        },
        "friction_formulas": FORMULAS,
        "sensors": found.sensors,
        **_fit(found),
        **_beside(found),
    }
    return json_text(content)


def json_text(content: Mapping[str, Any]) -> str:
    """Return strict JSON: arrays as lists, numbers that are not finite as null."""
    return json.dumps(_strict(content), indent=2, allow_nan=False) + "\n"


def inertial_entries(inertial: InertialParameters) -> dict[str, Any]:
    """Return the ten parameters and what follows from them as JSON entries."""
    return {
        "mass": inertial.mass,
        "center_of_mass_moment": inertial.first_moment,
        "inertia_tensor": dict(zip(INERTIA, inertial.theta[4:])),
        "center_of_mass": inertial.com,
        "inertia_about_com": dict(
            zip(INERTIA, spatial.six_from_symmetric(inertial.inertia_com))
        ),
        "principal_moments": inertial.principal_moments,
    }


def _asked(result: Result) -> dict[str, Any]:
    estimate = result.estimate
    joint = result.robot.terminal_joint
    payload = result.payload
    entries = inertial_entries(
        (estimate if payload is None else payload.total).inertial
    )
    seen = not estimate.identifiability.unidentifiable
    return {
        "joint_name": joint,
        **{key: entries.pop(key) for key in list(entries)[:3]},
        "coulomb_friction": estimate.value(f"coulomb[{joint}]"),
        "viscous_friction": estimate.value(f"viscous[{joint}]"),
        "rmse": estimate.rmse,
        "condition_number": estimate.identifiability.condition_number,
        "n_base_params": estimate.identifiability.rank,
        "question": result.question,
        "body_name": result.robot.body_name,
        **entries,
        "status": result.verdict.name,
        "status_text": result.verdict.value,
        "reasons": result.reasons,
        "known_to": result.relative_mass_error,
        "valid": {
            "physically_consistent": result.body.inertial.is_consistent,
            "all_identified": seen
            if payload is None
            else bool(np.all(payload.body.is_determined)),
            "trustworthy": result.verdict.is_trustworthy,
        },
    }


def _file(file: record.ModelFile | None) -> dict[str, Any] | None:
    if file is None:
        return None
    pairs = [
        dict(zip(_WHEN, tests))
        for tests in (
            (file.validation_before, file.validation_after),
            *file.other_validations,
        )
    ]
    return {
        "torque_error": {
            when: test and test.relative_error for when, test in pairs[0].items()
        },
        **pairs[0],
        "others": pairs[1:],
        "gravity": file.gravity,
        "kept": file.unchanged,
    }


def _payload(found: Payload | None, cards: Sequence[Card]) -> dict[str, Any] | None:
    if found is None:
        return None
    flange = found.flange
    return {
        "flange": {
            "name": flange.name,
            "in_body": flange.terminal,
            "translation": flange.translation,
            "rotation": flange.rotation,
        },
        **{name: _body(getattr(found, name)) for name in ("body", "link", "total")},
        **{name: getattr(found, name) for name in _OF_PAYLOAD},
        "cards": {
            card.name: {k: v for k, v in vars(card).items() if k != "name"}
            for card in cards
        },
    }


def _body(body: BodyEstimate) -> dict[str, Any]:
    def named(values: Any) -> dict[str, Any]:
        return dict(zip(PARAMETER_NAMES, values))

    from_data = body.is_determined & (body.data_share >= PRIOR_SHARE)
    return {
        "name": body.name,
        **inertial_entries(body.inertial),
        "model": None if body.prior is None else inertial_entries(body.prior),
        "standard_errors": {
            **named(body.errors),
            **dict(zip(ERROR_NAMES, load_errors(body))),
        },
        "standard_errors_noise": named(body.noise_errors),
        "error_budget": {
            "noise": named(body.noise_errors),
            **{cause: named(part) for cause, part in body.budget.items()},
        },
        "data_share": named(body.data_share),
        "source": named(np.where(from_data, "identified", "from_model").tolist()),
    }


def _link(result: Result, body: BodyEstimate) -> dict[str, Any]:
    written = None
    if result.file is not None and body.joint is not None:
        theta = result.file.thetas[result.robot.joint_names.index(body.joint)]
        written = inertial_entries(InertialParameters(theta)) if np.any(theta) else None
    return {
        "name": body.name,
        "joint": body.joint,
        **_body(body),
        "in_the_file": written,
    }


def _joint(result: Result, name: str, joint: JointEstimate) -> dict[str, Any]:
    written = _written_terms(result, name)
    ways = joint.directional_coulomb
    return {
        "friction_model": joint.friction_model,
        "terms": joint.terms,
        "model": joint.model_terms,
        "in_the_file": written,
        "held_out_rmse_by_friction_model": joint.candidates,
        "two_ways": ways and dict(zip(("forward", "backward"), ways)),
        "logs": joint.logs,
        "another_day": joint.other_day_terms,
        "torque_noise": joint.noise,
        "bam": _bam(joint, written),
    }


def _written_terms(result: Result, name: str) -> Mapping[str, Quantity]:
    """Return what the written model has of a joint's friction, or of a shared motor's."""
    return {} if result.file is None else result.file.joints.get(name, {})


def _bam(
    joint: JointEstimate, written: Mapping[str, Quantity]
) -> dict[str, Any] | None:
    """Return what BAM's load_model_from_dict reads, but for the actuator's name."""
    terms = set(joint.friction_model.split("-")) - {"none"}
    figures = joint.terms
    if terms - {"coulomb", "viscous", "offset", "armature", "stribeck", "load"}:
        # BAM has no such curve: the nearest Coulomb and viscous friction, as in the file.
        terms = {"coulomb", "viscous", "armature"}
        figures = written
    if "coulomb" not in figures:
        return None
    number = 1 + ("stribeck" in terms) + 2 * ("load" in terms)
    known = {
        n: share * figures[t].value for t, (n, share) in _IN_BAM.items() if t in figures
    }
    return {
        "model": f"m{number}",
        "friction_base": figures["coulomb"].value,
        "friction_viscous": 0.0,
        **known,
        **({"alpha": 2.0} if "stribeck" in terms else {}),
        **({"load_friction_stribeck": 0.0} if number == 4 else {}),
    }


def _fit(result: Result) -> dict[str, Any]:
    estimate = result.estimate
    errors = result.estimate.standard_errors
    seen = estimate.identifiability
    words = {True: "identified", False: "from_model"}
    return {
        "method": estimate.method,
        "torques": result.torques,
        "parameter_source": {
            n: words[bool(k)] for n, k in zip(estimate.names, seen.identified)
        },
        "unidentifiable_combinations": seen.unidentifiable,
        "rmse_per_joint": estimate.rmse_per_joint,
        "condition_number_scaled": seen.scaled_condition_number,
        "constrained": estimate.constrained,
        "standard_errors": None
        if errors is None
        else dict(zip(estimate.names, errors)),
        "prior_conflicts": [_prior_conflict(conflict) for conflict in result.conflicts],
        "link_scales": result.link_scales,
        "wrong_links": result.wrong_links,
        "noise_per_joint": estimate.noise_per_joint,
        "samples_per_joint": estimate.samples,
        "effective_samples_per_joint": estimate.effective_samples,
    }


def _prior_conflict(conflict: PriorConflict) -> dict[str, Any]:
    return {
        "cause": conflict.cause,
        "members": conflict.members,
        "asked": conflict.deviation,
        "scale": conflict.scale,
    }


def _beside(result: Result) -> dict[str, Any]:
    base = result.base
    data = result.data
    robot = result.robot
    rows = None
    if base is not None:
        names = ("combination", "value", "standard_error", "essential")
        columns = (base.combinations, base.values, base.standard_errors, base.essential)
        rows = [dict(zip(names, row)) for row in zip(*columns)]
    return {
        "base_parameters": rows,
        "structural_rank": None if base is None else base.structural_rank,
        "validation": result.validation,
        "rollout": rollout_entry(result.rollout),
        **{name: getattr(result, name) for name in _OF_RUN},
        "limitations": limitations(result),
        "notes": result.notes,
        "source": data.description,
        "logs": data.files,
        "model": {"path": str(robot.path), "sha256": robot.sha256},
        "joint_names": robot.joint_names,
        **{name: getattr(data, name) for name in ("seed", "duration", "sample_rate")},
        "versions": versions(),
    }


def _strict(value: Any) -> Any:
    """Return what strict JSON can hold: a figure gets its 95 % interval, a record its names."""
    if isinstance(value, Quantity):
        found = value.value
        reach = _SURE * value.error
        interval = [found - reach, found + reach]
        return _strict(
            {"value": found, "standard_error": value.error, "interval": interval}
        )
    if is_dataclass(value) and not isinstance(value, type):
        return _strict(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return _strict(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_strict(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def rollout_entry(test: RolloutTest | None) -> dict[str, Any] | None:
    """Return the entry of params.json; None where nothing was played."""
    if test is None:
        return None

    def figures(before: float, after: float) -> dict[str, float | None]:
        ratio = after / before if before > 0.0 else None
        return {"before": before, "after": after, "ratio": ratio}

    return {
        "held_out": test.held_out,
        "closed_loop_is": test.servo,
        **{name: getattr(test, name) for name in ("is_better", "score")},
        "errors": [
            {
                **{
                    name: getattr(error, name)
                    for name in ("loop", "horizon", "windows")
                },
                "diverged": dict(zip(("before", "after"), error.diverged)),
                "overall": figures(*error.overall),
                "joints": dict(
                    zip(
                        test.joint_names,
                        map(figures, error.errors_before, error.errors_after),
                    )
                ),
            }
            for error in test.errors
        ],
        "notes": list(test.notes),
    }
