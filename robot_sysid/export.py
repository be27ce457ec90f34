"""Writing results: params.json, model, payload card and motor trajectory, all together.

Files that an earlier run of any command left in the folder never stay beside them.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from robot_sysid.config import Config, IdentifyConfig, PayloadConfig, PayloadOptions
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.urdf import base_link
from robot_sysid.model.compilation import warnings_as_notes
from robot_sysid.parser import load_robot_model
from robot_sysid.records import RobotModel, file_access
from robot_sysid.records.controllers import ALL, SIMULATORS
from robot_sysid.records.messages import Detail, Level, NextStep, Progress, says
from robot_sysid.records.option_fields import SCALE, joint_factors, write_torque_scale
from robot_sysid.records.quantities import CURVED
from robot_sysid.results.cards import LogResult, arm_card, card_text, number_groups
from robot_sysid.results.content import content_of
from robot_sysid.results.lines import block_lines, folder_line, last_lines, more_lines
from robot_sysid.results.record import Identification, ModelTarget
from robot_sysid.results.verdicts import Verdict
from robot_sysid.results.written_model import can_bend, versions, write_model

# Files that a command writes after the results.
_LATER_NAMES = (file_access.DATA_NAME, file_access.RUN_NAME)
_MOTOR_NAMES = (file_access.DAMIAO_NAME, file_access.DAMIAO_WEIGHT_NAME)
RESULT_NAMES = (*file_access.RESULT_NAMES, *_MOTOR_NAMES, file_access.REPORT_NAME)
"""Result files of all commands and releases; a planned motion is no result."""
MotorFile = Callable[[file_access.AtomicFiles, Path], tuple[Sequence[Path], list[str]]]
"""Drafts the motor trajectory in a folder; returns the paths of its files and lines on them."""


@dataclass(frozen=True)
class Written:
    """What a command has written, and what it says of it.

    Attributes:
        files: the written files.
        lines: printed lines, in order.
        verdict: whether to use the result, which file, and the next step; printed last.
        failure: why there is nothing to use, or None.
        result: an ``Identification``, identified servos, or what --json prints of a plan.
    """

    files: tuple[Path, ...]
    lines: Sequence[str]
    verdict: Sequence[str]
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
    result: Identification,
    config: Config,
    progress: Progress,
    motor_file: MotorFile | None = None,
    step: NextStep | None = None,
) -> Written:
    """Write params.json, and where the result may be used the model and a payload's card or scales.

    A result that may not be used, or that does not fit into this model, gets a params.json only,
    which says why. An error before files take their places leaves the folder as it was.

    Args:
        result: with ``checkpoints``, where the written model must reproduce the predicted torque.
        config: options of the run. Files of earlier runs in its output folder are removed, but for
            those that this run reads, whatever they are called.
        progress: receives notes on the written files.
        motor_file: drafts the motor trajectory; None for none.
        step: what to do after a result that may be used; None for nothing more.

    Returns:
        The written files and the lines on them.

    Raises:
        InputError: the folder cannot be written to.
    """
    folder = config.output.output_dir
    options = config.payload if isinstance(config, PayloadConfig) else PayloadOptions()
    # Of a known mass the torques are calibrated: there is nothing to write of such a payload.
    payload = result.payload
    is_calibration = payload is not None and payload.known_mass is not None
    failure = result.failure
    clamping: list[str] = []
    card = None
    written: list[Path] = []
    notes: list[str] = []
    with file_access.atomic_files() as files:
        if failure is None and not is_calibration:
            # Drafted first, the model appears last: what the other files say then holds for it.
            assert result.checkpoints is not None
            mesh_dir = config.model.mesh_dir
            target = ModelTarget(files, folder, result.checkpoints, mesh_dir)
            try:
                written, notes = _write_models(result, target, options.as_body)
            except ExportError as error:
                failure = (
                    f"no model was written: {error} (the identified numbers are in "
                    f"{file_access.PARAMS_NAME})"
                )
            if payload is not None:
                written.append(folder / file_access.CARD_NAME)
                card = number_groups(payload)
                text = card_text(payload, card, result.robot, options.cards)
                files.write(written[-1], text)
            written += write_arm_cards(config, result.robot, files, written, result)
        if motor_file is not None:
            motor_paths, clamping = motor_file(files, folder)
            written += motor_paths
        names = {path.name for path in written}
        content = content_of(result, card, notes, failure, names)
        step = None if content["failure"] else step
        verdict = last_lines(content, written, step)
        written.append(folder / file_access.PARAMS_NAME)
        shown = {**content, "verdict": verdict, "next_step": step}
        files.write(written[-1], file_access.json_text(shown))
        removed = remove_earlier(files, config, result.robot, written)
    lines = (
        *block_lines(content, config.output.links),
        folder_line(folder, result.is_measured),
        *more_lines(content),
        *clamping,
    )
    # What lets a result be used is in the verdict.
    remarks = [
        remark
        for remark in result.remarks
        if not isinstance(remark.about, Verdict) or remark.level is not Level.SAYS
    ]
    progress.remark(*remarks, *says((*notes, *removed)))
    if options.save_torque_scale is not None and content["failure"] is None:
        rows = [row for row in result.quantities if row.name == "torque_scale"]
        scales = {row.of: (row.value, row.error or 0.0) for row in rows}
        write_torque_scale(options.save_torque_scale, scales)
    return Written(tuple(written), lines, verdict, content["failure"], result)


def _write_models(
    result: Identification, target: ModelTarget, as_body: str | None
) -> tuple[list[Path], list[str]]:
    """Write the updated models into the folder ``target.path``; return (paths, notes).

    An arm from a URDF gets both where MuJoCo alone would not load the URDF, or where the best model
    needs an MJCF: that MJCF, and the best URDF. Where friction bends with speed, an MJCF that has
    it is beside them, if MuJoCo knows such friction. A note says why one of them is not written.

    Raises:
        ExportError: none of them can be written.
    """
    written = []
    notes: list[str] = []
    failures = []
    for file_kind in dict.fromkeys((result.model_kind, result.robot.kind)):
        path = target.path / file_access.MODEL_NAMES[file_kind]
        try:
            file_notes = write_model(
                result, replace(target, path=path), as_body, file_kind
            )
        except ExportError as error:
            failures.append(error)
            notes.append(f"{path.name} is not written: {error}")
            continue
        if file_kind != result.model_kind:
            # Of the file beside the one to use.
            file_notes = tuple(Detail(f"{path.name}: {n}") for n in file_notes)
        notes += file_notes
        written.append(path)
    if not written:
        raise failures[0]
    curved, curved_notes = _write_curved(result, target, as_body)
    return [*written, *curved], [*notes, *curved_notes]


def _write_curved(
    result: Identification, target: ModelTarget, as_body: str | None
) -> tuple[list[Path], list[str]]:
    """Write the model whose friction bends with speed, if it does; return (paths, notes).

    The others stand without it, so that a note says why it cannot be written.
    """
    if result.file is None or result.file.curved is None:
        return [], []
    name = file_access.CURVED_NAME
    if not can_bend():
        release = versions()["mujoco"]
        return [], [
            f"{name} is not written: friction that bends with speed begins with MuJoCo 3.7, and "
            f"this is {release}"
        ]
    path = target.path / name
    try:
        write_model(result, replace(target, path=path), as_body, "mjcf", CURVED)
    except ExportError as error:
        return [], [f"{name} is not written: {error}"]
    return [path], []


def write_arm_cards(
    config: Config,
    robot: RobotModel,
    files: file_access.AtomicFiles,
    written: Collection[Path],
    result: LogResult | None = None,
) -> list[Path]:
    """Write the cards that the options ask for, of the first written model; return their paths.

    Args:
        config: names the simulators or the arm's software, if any, and torque scales of the logs.
        robot: the arm as in the original model.
        files: holds the draft of the model.
        written: paths of the written files; without a model there is no card.
        result: of the logs; None where there is none.
    """
    models = file_access.models_in(written)
    if not isinstance(config, IdentifyConfig) or not config.cards.cards or not models:
        return []
    model = models[0]
    draft = files.draft_of(model)
    names = robot.joint_names
    arm = load_robot_model(draft, joint=names[-1], first_joint=names[0])
    curved = file_access.curved_file_in(written)
    curved_name = curved.name if curved else ""
    base = base_link(read_document(files.draft_of(model)))
    paths = []
    scale, _ = joint_factors(config.log.torque_scale, names, SCALE)
    asked = config.cards.cards
    for software in [*SIMULATORS] if asked == ALL else [asked]:
        paths.append(model.with_name(file_access.ARM_CARD_NAMES[software]))
        text = arm_card(
            software, robot, arm, model.name, curved_name, result, base, scale
        )
        files.write(paths[-1], text)
    return paths


def remove_earlier(
    files: file_access.AtomicFiles,
    config: Config,
    robot: RobotModel,
    written: Collection[Path],
) -> list[str]:
    """Have result files of an earlier run removed once those of this run are in place.

    Files that this run reads stay, whatever they are called, those that no run wrote, and the file
    for motors of a motion that was planned in this folder: a self-test's is a result, a plan's is
    played again.

    Args:
        files: which removes them when it commits.
        config: names the output folder, and files that this run reads.
        robot: the arm, whose model file may include others.
        written: files of this run; they stay.

    Returns:
        A note per removed result.
    """
    read = [*filter(None, config.input_files()), *read_document(robot.path).contents]
    used = {os.path.realpath(path) for path in (*written, *read)}
    notes = []
    folder = config.output.output_dir
    of_plan = (
        _MOTOR_NAMES if file_access.plan_settings(folder).get("motor_type") else ()
    )
    for name in (*RESULT_NAMES, *_LATER_NAMES):
        path = folder / name
        is_kept = name in of_plan or os.path.realpath(path) in used
        if is_kept:
            continue
        # What is known by its marks alone is kept by another name, which is said.
        is_of_run = file_access.is_of_run(path)
        if is_of_run or file_access.is_marked(path):
            files.remove(path)
        if is_of_run and name not in _LATER_NAMES:
            notes.append(f"{path} of an earlier run was removed")
    return notes
