"""Writing the results: params.json, model, payload card, motor trajectory, all together.

What an earlier run left in the folder, whatever command wrote it, never stays beside them.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from robot_sysid.errors import ExportError
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.inertial import WriteBack
from robot_sysid.mjcf.updated_model import BodyChange, ModelChange, changed_model_text
from robot_sysid.model.compilation import warnings_as_notes
from robot_sysid.records import Motion, file_access
from robot_sysid.records.messages import Progress, with_error
from robot_sysid.results.cards import Card, card_text, payload_cards
from robot_sysid.results.json import export_params_json as export_params_json
from robot_sysid.results.json import params_json_text
from robot_sysid.results.model import ModelTarget, write_model
from robot_sysid.results.record import Payload, Result
from robot_sysid.results.verdict import refusal

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
    beside = None if result.file is None else result.file.beside
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
