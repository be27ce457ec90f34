"""Writing the results: params.json, the updated model and the motor trajectory, all or none."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from robot_sysid.errors import ExportError
from robot_sysid.mjcf.updated_model import updated_model_text
from robot_sysid.mjcf.write_back import WriteBack
from robot_sysid.model.compilation import warnings_as_notes
from robot_sysid.output.joint_friction import friction_changes
from robot_sysid.output.model_writing import ModelTarget, write_link
from robot_sysid.output.params_json import export_params_json, params_json_text
from robot_sysid.records import Identification, Motion, RobotModel
from robot_sysid.records.atomic_files import (
    WholeFiles,
    only_run_in,
    require_writable,
    whole_files,
    write_whole,
)
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import DAMIAO_NAME, MODEL_NAMES, PARAMS_NAME

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory.csv_file import DamiaoExportReport

__all__ = [
    "MotorFile",
    "Written",
    "alone_in",
    "export_params_json",
    "export_updated_xml",
    "left_over",
    "write_results",
]

MotorFile = Callable[[TextIO], "DamiaoExportReport"]
"""Writes the motor trajectory into an open file."""


@dataclass(frozen=True)
class Written:
    """What was written.

    Attributes:
        files: their paths.
        notes: what writing had to say, one sentence each.
        damiao: report of the Damiao export, where one was asked for.
        failure: why there is no updated model although the result is trustworthy, or None.
    """

    files: tuple[Path, ...]
    notes: tuple[str, ...]
    damiao: DamiaoExportReport | None
    failure: str | None = None


@contextlib.contextmanager
def alone_in(folder: Path, progress: Progress) -> Iterator[None]:
    """Keep an output folder to one run, and tell at its end what MuJoCo warned of meanwhile.

    Raises:
        InputError: the folder cannot be written to, or another run has it.
    """
    require_writable(folder)
    with warnings_as_notes(progress), only_run_in(folder):
        yield


def left_over(folder: Path, names: Collection[str], written: Collection[Path]) -> list[str]:
    """Return a note for each of these files that an earlier run left and this one did not write."""
    stale = [folder / name for name in names if (folder / name).exists()]
    return [
        f"{path} is from an earlier run; this run wrote none"
        for path in stale
        if path not in written
    ]


def export_updated_xml(
    source: Path,
    body: str,
    plan: WriteBack,
    rmse: float,
    destination: Path,
    mesh_dir: Path | None = None,
    principal: bool = False,
) -> None:
    """Write an MJCF or URDF file with one body's inertia replaced; see ``updated_model_text``."""
    folder = destination.absolute().parent
    text = updated_model_text(source, body, plan, rmse, folder, mesh_dir, principal)
    write_whole(destination, text)


def write_results(
    robot: RobotModel,
    identification: Identification,
    checkpoints: Motion,
    folder: Path,
    mesh_dir: Path | None = None,
    motor_file: MotorFile | None = None,
    keep_friction: bool = False,
    refused: str | None = None,
) -> Written:
    """Write params.json, the updated model and, where asked for, the motor trajectory.

    An estimate that is not trustworthy, or that cannot be written into this model, gets a
    params.json only, which says why.

    Args:
        robot: the arm as loaded.
        identification: the result.
        checkpoints: motion on which the written model must reproduce the predicted torque.
        folder: where to.
        mesh_dir: the user's mesh folder, if any.
        motor_file: writes the motor trajectory; None for none.
        keep_friction: leave the friction of the model's joints as it is.
        refused: why no model is to be written although the estimate is trustworthy, or None.

    Raises:
        InputError: the folder cannot be written to.
    """
    names: list[str] = []
    notes: tuple[str, ...] = ()
    report, failure = None, refused
    with whole_files() as files:
        if identification.estimate.status.is_trustworthy and refused is None:
            # Its place is taken last: what the other files say then holds for it.
            path = files.reserve_last(folder / MODEL_NAMES[robot.kind])
            try:
                target = ModelTarget(
                    files, path, checkpoints, identification.estimate.rmse, mesh_dir
                )
                notes = write_model(robot, keep_friction, identification, target)
                names.append(path.name)
            except ExportError as error:
                files.withdraw(path)
                failure = str(error)
        if motor_file is not None:
            names.append(DAMIAO_NAME)
            report = write_motor_file(files, folder / DAMIAO_NAME, motor_file)
        names.append(PARAMS_NAME)
        files.write(folder / PARAMS_NAME, params_json_text(identification, notes))
    return Written(tuple(folder / name for name in names), notes, report, failure)


def write_motor_file(files: WholeFiles, path: Path, motor_file: MotorFile) -> DamiaoExportReport:
    """Write the draft of a motor trajectory."""
    with files.open(path) as file:
        return motor_file(file)


def write_model(
    robot: RobotModel, keep_friction: bool, identification: Identification, target: ModelTarget
) -> tuple[str, ...]:
    """Write the updated model, compile it again and compare; returns notes."""
    estimate = identification.estimate
    found = identification if not keep_friction else replace(identification, friction_model=None)
    joints, notes = friction_changes(found, target.checkpoints)
    errors = None if estimate.standard_errors is None else estimate.standard_errors[:10]
    return (*notes, *write_link(robot, estimate.inertial, target, errors, joints))
