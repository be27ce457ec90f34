"""Identifying every link, from the files to the files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robot_sysid.checks.run import look_at
from robot_sysid.errors import ExportError, InputError
from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.identify.arm.fit import ArmFit, fit_arm
from robot_sysid.identify.arm.result import (
    estimate_of,
    judge,
    model_error,
    model_friction,
    off_notes,
)
from robot_sysid.identify.simulated import versions
from robot_sysid.logs.checks import sign_check
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import LogJoints, MeasurementLog, read_log
from robot_sysid.mjcf.changes import JointChange
from robot_sysid.output.arm_json import ARM_NAME, arm_json_text
from robot_sysid.output.arm_summary import arm_lines
from robot_sysid.output.model_writing import ModelTarget, write_links
from robot_sysid.output.summary import folder_text
from robot_sysid.records import DataOrigin, Measurement, Motion, RobotModel, Source
from robot_sysid.records.atomic_files import only_run_in, require_writable, whole_files
from robot_sysid.records.options import per_joint
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import MODEL_NAMES
from robot_sysid.records.whole_arm import ArmIdentification
from robot_sysid.signals.process import ProcessedSignals, process
from robot_sysid.simulator import ArmTorque

_CHECKPOINTS = 400
# Standard errors that a rotor inertia has to be away from zero to be written.
_SEEN = 2.0


@dataclass(frozen=True)
class ArmOutcome:
    """What a run produced.

    Attributes:
        identification: the result.
        output_dir: where files went.
        files: what was written there.
        not_written: why the result could not be written into the model, or None.
        notes: what writing the model had to say.
    """

    identification: ArmIdentification
    output_dir: Path
    files: tuple[Path, ...]
    not_written: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def failure(self) -> str | None:
        """Why there is no updated model, or None."""
        found = self.identification
        if not found.status.is_trustworthy:
            return f"no model was written: {found.status.value} ({'; '.join(found.reasons)})"
        if self.not_written is None:
            return None
        return f"{self.not_written} (the identified numbers are in {ARM_NAME})"

    def report_lines(self, verbose: bool) -> list[str]:
        """Return what the command line prints at the end."""
        saved = f"Results saved to {folder_text(self.output_dir)}"
        return [*arm_lines(self.identification, verbose), saved]


def run_arm(
    robot: RobotModel,
    logs: LogOptions,
    options: ArmOptions,
    folder: Path,
    mesh_dir: Path | None,
    progress: Progress,
) -> ArmOutcome:
    """Identify every link of an arm and write the results.

    Args:
        robot: the arm.
        logs: which logs, and what their columns are.
        options: how.
        folder: where results go.
        mesh_dir: the user's mesh folder, if any.
        progress: where to tell how far it is.

    Raises:
        SysidError: with the exit code that fits, see ``errors``.
    """
    require_writable(folder)
    _require_own_files(robot, logs, options, folder)
    with only_run_in(folder):
        found, fit, signals = identify_arm(robot, logs, options, progress)
        for note in found.notes:
            progress.note(note)
        outcome = _write(robot, found, checkpoints(signals[0]), folder, mesh_dir)
    for note in outcome.notes:
        progress.note(note)
    return outcome


def identify_arm(
    robot: RobotModel, logs: LogOptions, options: ArmOptions, progress: Progress
) -> tuple[ArmIdentification, ArmFit, list[ProcessedSignals]]:
    """Identify every link from logs; returns (result, fit, processed logs)."""
    if options.velocity_deadband is not None:
        per_joint(options.velocity_deadband, robot.n_joints, "--velocity-deadband")
    read = [_read(robot, logs, path, progress) for path in logs.measurements]
    signals = processed(robot, [piece for log in read for piece in log.pieces], options)
    notes = [note for log in read for note in log.notes]
    notes += [note for log in signals for note in (*log.notes, *_compared(robot, log))]
    fit = fit_arm(robot, signals, options, progress)
    estimate, own = estimate_of(robot, fit), model_error(fit)
    held_out = fit.validation("the logs, a fifth at a time")
    status, reasons = judge(robot, estimate, held_out, own)
    tests = []
    if logs.validation_measurements is not None:
        log = _read(robot, logs, logs.validation_measurements, progress)
        notes += [f"validation log: {note}" for note in log.notes]
        again = replace(options, cutoff=signals[0].cutoff)
        others = processed(robot, log.pieces, again)
        tests.append(fit.validate_on(robot, others, str(log.path)))
    found = ArmIdentification(
        model_path=robot.path,
        model_sha256=robot.sha256,
        joint_names=robot.joint_names,
        link_names=tuple(link.body_name for link in robot.links),
        model_thetas=np.array([link.theta for link in robot.links]),
        estimate=estimate,
        status=status,
        reasons=reasons,
        data=_origin(read),
        held_out=held_out,
        model_error=own,
        validation=tuple(tests),
        choices=fit.choices,
        model_friction=model_friction(fit),
        cutoff=signals[0].cutoff,
        versions=versions(),
        notes=tuple(dict.fromkeys((*notes, *off_notes(estimate, robot.joint_names)))),
    )
    return found, fit, signals


def processed(
    robot: RobotModel, logs: Sequence[Measurement], options: ArmOptions
) -> list[ProcessedSignals]:
    """Return the signals, each log filtered on its own, with the lowest cut-off that one needs."""

    def at(log: Measurement, cutoff: float | None) -> ProcessedSignals:
        return process(log, robot.joint_names, cutoff, options.velocity_deadband)

    signals = [at(log, options.cutoff) for log in logs]
    lowest = min(each.cutoff for each in signals)
    return [each if each.cutoff == lowest else at(log, lowest) for each, log in zip(signals, logs)]


def checkpoints(signals: ProcessedSignals) -> Motion:
    """Return some of the measured motion."""
    places = np.unique(np.linspace(0, len(signals) - 1, _CHECKPOINTS).astype(int))
    return Motion(signals.time[places], signals.q[places], signals.qd[places], signals.qdd[places])


def _read(robot: RobotModel, logs: LogOptions, path: Path, progress: Progress) -> MeasurementLog:
    progress.stage(f"Reading measurements from {path}...")
    joints = LogJoints(robot.joint_names, robot.limits, tuple(robot.is_slide.tolist()))
    log = read_log(path, joints, logs, progress)
    look_at(robot, log, logs.accept, progress, links_known=False)
    return log


def _origin(logs: Sequence[MeasurementLog]) -> DataOrigin:
    duration = sum(log.duration for log in logs)
    rate = sum(len(log.samples) - 1 for log in logs) / duration
    return DataOrigin(Source.LOG, ", ".join(str(log.path) for log in logs), duration, rate)


def _compared(robot: RobotModel, signals: ProcessedSignals) -> tuple[str, ...]:
    motion = checkpoints(signals)
    places = np.searchsorted(signals.time, motion.time)
    return sign_check(signals.tau[places], ArmTorque(robot)(motion), robot.joint_names)


def _require_own_files(
    robot: RobotModel, logs: LogOptions, options: ArmOptions, folder: Path
) -> None:
    """Refuse to write over a file that is read."""
    read = (robot.path, *logs.measurements, logs.validation_measurements, logs.columns)
    taken = {os.path.realpath(path) for path in (*read, options.coupling) if path is not None}
    for name in (ARM_NAME, *MODEL_NAMES.values()):
        if os.path.realpath(folder / name) in taken:
            raise InputError(
                f"--output-dir would overwrite a file that is read: {folder / name}; choose "
                "another folder"
            )


def _write(
    robot: RobotModel,
    found: ArmIdentification,
    motion: Motion,
    folder: Path,
    mesh_dir: Path | None,
) -> ArmOutcome:
    """Write arm.json and, where the result may be trusted, the updated model; all or none."""
    names, failure = [ARM_NAME], None
    notes: tuple[str, ...] = ()
    with whole_files() as files:
        if found.status.is_trustworthy:
            path = files.reserve_last(folder / MODEL_NAMES[robot.kind])
            target = ModelTarget(files, path, motion, found.held_out.rmse, mesh_dir)
            estimate = found.estimate
            joints = _joint_changes(found)
            try:
                notes = write_links(robot, estimate.thetas, target, joints, estimate.theta_errors)
                names.append(path.name)
            except ExportError as error:
                files.withdraw(path)
                failure = str(error)
        final = replace(found, notes=found.notes + notes)
        files.write(folder / ARM_NAME, arm_json_text(final))
    stale = folder / MODEL_NAMES[robot.kind]
    if stale.name not in names and stale.exists():
        notes = (*notes, f"{stale} is from an earlier run; this run wrote no model")
    return ArmOutcome(final, folder, tuple(folder / name for name in names), failure, notes)


def _joint_changes(found: ArmIdentification) -> list[JointChange]:
    """Return what the joints of the model get; rotor inertia where the data shows it."""
    changes = []
    for joint, held in found.model_friction.items():
        value, error = held["armature"], found.estimate.error(f"armature[{joint}]")
        seen = error is not None and value > _SEEN * error
        armature = value if seen else None
        changes.append(JointChange(joint, armature, held["viscous"], held["coulomb"]))
    return changes
