"""Writing the results: all files, each checked, or none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_sysid.config import SysidConfig
from robot_sysid.errors import ExportError
from robot_sysid.export import params_json_text, updated_model_text
from robot_sysid.mjcf.compiler_settings import bound_inertia
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.write_back import NO_LEEWAY, Leeway, plan_write_back
from robot_sysid.model.inertia import subtree_bodies
from robot_sysid.output.verification import (
    reads_fullinertia_exactly,
    require_reproduction,
    verify_written_model,
)
from robot_sysid.records import Array, Estimate, Identification, Motion, RobotModel
from robot_sysid.records.atomic_files import WholeFiles, whole_files

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory.csv_file import DamiaoExportReport

PARAMS_NAME = "params.json"
DAMIAO_NAME = "damiao_trajectory.csv"

Command = tuple[Array, Array, Array, Array]
"""A chunk of time (N,), q, qd and feed-forward tau (N, n) [s, rad, rad/s, N m]."""


@dataclass(frozen=True)
class Written:
    """What was written.

    Attributes:
        files: their paths.
        identification: the result, with notes that arose while writing.
        damiao: report of the Damiao export, where one was asked for.
        failure: why there is no updated model although the result is trustworthy, or None.
    """

    files: tuple[Path, ...]
    identification: Identification
    damiao: DamiaoExportReport | None
    failure: str | None = None


def updated_model_name(robot: RobotModel) -> str:
    """Return the name of the written model: a URDF stays one."""
    return "updated_model.urdf" if robot.kind == "urdf" else "updated_model.xml"


def check_motor_types(config: SysidConfig, robot: RobotModel) -> None:
    """Raise InputError before any work where the Damiao export could not be done."""
    if config.export_damiao:
        from robot_sysid.damiao.protocol.joints import damiao_joints

        ids, replies = config.can_ids or None, config.master_ids or None
        damiao_joints(config.motor_types, robot.n_joints, ids, replies)


def write_results(
    config: SysidConfig,
    robot: RobotModel,
    identification: Identification,
    checkpoints: Motion,
    commands: Callable[[], Iterator[Command]],
) -> Written:
    """Write params.json, the updated model and, where asked for, the motor trajectory.

    An estimate that is not trustworthy, or that cannot be written into this model, gets a
    params.json only, which says why.

    Args:
        config: names and options.
        robot: the arm as loaded.
        identification: the result.
        checkpoints: motion on which the written model must reproduce the predicted torque.
        commands: gives the motion and feed-forward torque to export for motors.

    Raises:
        InputError: the folder cannot be written to.
    """
    folder = config.output_dir
    names, report, failure = [], None, None
    with whole_files() as files:
        if identification.estimate.status.is_trustworthy:
            path = folder / updated_model_name(robot)
            note, failure = _try_model(files, path, config, robot, identification, checkpoints)
            names += [] if failure else [path.name]
            identification = replace(identification, notes=identification.notes + note)
        if config.export_damiao:
            names.append(DAMIAO_NAME)
            report = _write_damiao(files, folder / DAMIAO_NAME, config, commands())
        names.append(PARAMS_NAME)
        files.write(folder / PARAMS_NAME, params_json_text(identification))
    return Written(tuple(folder / name for name in names), identification, report, failure)


def _try_model(
    files: WholeFiles,
    path: Path,
    config: SysidConfig,
    robot: RobotModel,
    identification: Identification,
    checkpoints: Motion,
) -> tuple[tuple[str, ...], str | None]:
    """Write the updated model; returns (notes, why it could not be written or None)."""
    try:
        return _write_model(files, path, config, robot, identification, checkpoints), None
    except ExportError as error:
        files.withdraw(path)
        return (), str(error)


def write_commands(
    config: SysidConfig, commands: Iterator[Command]
) -> tuple[Path, DamiaoExportReport]:
    """Write the motor trajectory alone; returns its path and report."""
    path = config.output_dir / DAMIAO_NAME
    with whole_files() as files:
        return path, _write_damiao(files, path, config, commands)


def _write_model(
    files: WholeFiles,
    path: Path,
    config: SysidConfig,
    robot: RobotModel,
    identification: Identification,
    checkpoints: Motion,
) -> tuple[str, ...]:
    """Write the updated model, compile it again and compare; returns notes."""
    estimate = identification.estimate
    theta = estimate.inertial.theta
    bodies = subtree_bodies(robot.mj_model, robot.reference_qpos, robot.body_id)
    plan = plan_write_back(theta, bodies, _leeway(config, estimate))
    text = updated_model_text(
        config.model,
        robot.body_name,
        plan,
        estimate.rmse,
        path.absolute().parent,
        config.mesh_dir,
        principal=not reads_fullinertia_exactly(plan.theta),
    )
    draft = files.write(path, text)
    compiled = verify_written_model(robot.mj_model, draft, robot.body_id, plan)
    require_reproduction(robot, plan.written(theta), compiled.mj_model, checkpoints, path)
    return (plan.note,) if plan.note else ()


def _leeway(config: SysidConfig, estimate: Estimate) -> Leeway:
    """Return how far moments may be raised: within their standard errors."""
    if estimate.standard_errors is None:
        return NO_LEEWAY
    errors = [estimate.standard_errors[estimate.names.index(n)] for n in ("Ixx", "Iyy", "Izz")]
    finite = [float(error) for error in errors if np.isfinite(error)]
    return Leeway(bound_inertia(read_document(config.model)), min(finite, default=0.0))


def _write_damiao(
    files: WholeFiles, path: Path, config: SysidConfig, commands: Iterator[Command]
) -> DamiaoExportReport:
    from robot_sysid.damiao.trajectory.csv_file import export_damiao_trajectory

    with open(files.draft(path), "w", encoding="utf-8", newline="\n") as file:
        return export_damiao_trajectory(
            commands,
            config.motor_types,
            file,
            config.can_ids or None,
            config.master_ids or None,
            config.supply,
        )
