"""Identifying every link, from the files to the files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from robot_sysid.checks.run import look_at
from robot_sysid.errors import ExportError
from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.export import alone_in, left_over
from robot_sysid.identify.arm.fit import ArmFit, fit_arm
from robot_sysid.identify.arm.model_friction import model_friction
from robot_sysid.identify.arm.played import Writer, play_held_out, play_other
from robot_sysid.identify.arm.result import estimate_of, judge, model_error, off_notes
from robot_sysid.identify.judgement.rollout.candidate import played_or_reason, refusal
from robot_sysid.identify.judgement.signs import compared_with_model
from robot_sysid.identify.simulated import CHECKPOINTS, versions
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import MeasurementLog, open_log, origin_of
from robot_sysid.mjcf.changes import JointChange
from robot_sysid.output.arm_json import FRICTION_NAME, arm_json_text, friction_json_text
from robot_sysid.output.model_writing import ModelTarget, write_links
from robot_sysid.output.printed.arm import arm_lines
from robot_sysid.output.printed.link import folder_text
from robot_sysid.records import Measurement, Motion, RobotModel, Validation
from robot_sysid.records.atomic_files import refuse_overwriting, whole_files
from robot_sysid.records.options import per_joint
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import ARM_NAME, MODEL_NAMES, RolloutTest
from robot_sysid.records.traces import Traces
from robot_sysid.records.whole_arm import ArmEstimate, ArmIdentification, HeldFriction
from robot_sysid.report.runs import fingerprint
from robot_sysid.signals.process import ProcessedSignals, process, with_one_cutoff

_IN_MJCF = {"armature": "armature", "viscous": "damping", "coulomb": "frictionloss"}


@dataclass(frozen=True)
class ArmOutcome:
    """What a run produced.

    Attributes:
        identification: the result.
        output_dir: where files went.
        files: what was written there.
        not_written: why the result could not be written into the model, or None.
        notes: what writing the model had to say.
        traces: makes what a report draws.
        result: hash of the JSON file, taken before another run may write to the folder.
    """

    identification: ArmIdentification
    output_dir: Path
    files: tuple[Path, ...]
    not_written: str | None = None
    notes: tuple[str, ...] = ()
    traces: Callable[[], Traces] | None = None
    result: str = ""

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
    keep_friction: bool = False,
) -> ArmOutcome:
    """Identify every link of an arm and write the results.

    Args:
        robot: the arm.
        logs: which logs, and what their columns are.
        options: how.
        folder: where results go.
        mesh_dir: the user's mesh folder, if any.
        progress: where to tell how far it is.
        keep_friction: leave the friction of the model's joints as it is.

    Raises:
        SysidError: with the exit code that fits, see ``errors``.
    """
    read = (robot.path, *logs.measurements, logs.validation_measurements, logs.columns)
    names = (ARM_NAME, FRICTION_NAME, *MODEL_NAMES.values())
    refuse_overwriting((*read, options.coupling), (("--output-dir", folder / n) for n in names))
    with alone_in(folder, progress):
        found, fit, signals = identify_arm(robot, logs, options, progress)
        for note in found.notes:
            progress.note(note)
        write, refused = partial(write_model, robot, keep_friction), None
        if logs.verify_rollout and found.status.is_trustworthy:
            found = _played(robot, found, signals, logs, options, write, mesh_dir, progress)
            refused = refusal(found.rollout, logs.accept)
        motion = signals[0].motion(signals[0].spread(CHECKPOINTS))
        outcome = write_arm(robot, found, motion, folder, mesh_dir, write, refused)
    for note in outcome.notes:
        progress.note(note)
    return replace(outcome, traces=lambda: fit.traces(robot, signals))


def identify_arm(
    robot: RobotModel, logs: LogOptions, options: ArmOptions, progress: Progress
) -> tuple[ArmIdentification, ArmFit, list[ProcessedSignals]]:
    """Identify every link from logs; returns (result, fit, processed logs)."""
    if options.velocity_deadband is not None:
        per_joint(options.velocity_deadband, robot.n_joints, "--velocity-deadband")
    read = [_read(robot, logs, path, progress) for path in logs.measurements]
    signals = processed(robot, [piece for log in read for piece in log.pieces], options)
    notes = [note for log in read for note in log.notes]
    notes += [note for log in signals for note in (*log.notes, *compared_with_model(robot, log))]
    fit = fit_arm(robot, signals, options, progress)
    estimate, own = estimate_of(robot, fit), model_error(fit)
    held_out = fit.validation("the logs, a fifth at a time")
    status, reasons = judge(robot, estimate, held_out, own)
    held = model_friction(robot, fit, estimate, options.write_offset)
    tests = []
    if logs.validation_measurements is not None:
        log = _read(robot, logs, logs.validation_measurements, progress)
        notes += [f"validation log: {note}" for note in log.notes]
        tests.append(_tested(robot, fit, log, replace(options, cutoff=signals[0].cutoff)))
    found = ArmIdentification(
        model_path=robot.path,
        model_sha256=robot.sha256,
        joint_names=robot.joint_names,
        link_names=tuple(link.body_name for link in robot.links),
        model_thetas=np.array([link.theta for link in robot.links]),
        estimate=estimate,
        status=status,
        reasons=reasons,
        data=origin_of(read),
        held_out=held_out,
        model_error=own,
        validation=tuple(tests),
        choices=fit.choices,
        model_friction=held,
        cutoff=signals[0].cutoff,
        versions=versions(),
        slides=robot.slides,
        notes=tuple(dict.fromkeys((*notes, *_said(robot, estimate, held)))),
    )
    return found, fit, signals


def _played(
    robot: RobotModel,
    found: ArmIdentification,
    signals: Sequence[ProcessedSignals],
    logs: LogOptions,
    options: ArmOptions,
    write: Writer,
    mesh_dir: Path | None,
    progress: Progress,
) -> ArmIdentification:
    """Return the result with what playing it on held-out pieces showed."""

    def test() -> RolloutTest:
        if logs.validation_measurements is None:
            return play_held_out(robot, found, signals, options, write, mesh_dir, progress)
        log = open_log(robot, logs.validation_measurements, logs, progress)
        others = processed(robot, log.pieces, replace(options, cutoff=found.cutoff))
        return play_other(robot, found, signals, others, write, mesh_dir, progress)

    return replace(found, rollout=played_or_reason(robot, test))


def _tested(robot: RobotModel, fit: ArmFit, log: MeasurementLog, options: ArmOptions) -> Validation:
    return fit.validate_on(robot, processed(robot, log.pieces, options), str(log.path))


def _said(
    robot: RobotModel, estimate: ArmEstimate, held: Mapping[str, HeldFriction]
) -> Iterator[str]:
    yield from off_notes(estimate, robot.joint_names)
    for each in held.values():
        yield from each.notes


def processed(
    robot: RobotModel, logs: Sequence[Measurement], options: ArmOptions
) -> list[ProcessedSignals]:
    """Return the signals, each log filtered on its own, with the lowest cut-off that one needs."""

    def at(log: Measurement, cutoff: float | None) -> ProcessedSignals:
        return process(log, robot.joint_names, cutoff, options.velocity_deadband)

    return with_one_cutoff(logs, at, options.cutoff)


def _read(robot: RobotModel, logs: LogOptions, path: Path, progress: Progress) -> MeasurementLog:
    progress.stage(f"Reading measurements from {path}...")
    log = open_log(robot, path, logs, progress)
    look_at(robot, log, logs.accept, progress, links_known=False)
    return log


def write_arm(
    robot: RobotModel,
    found: ArmIdentification,
    motion: Motion,
    folder: Path,
    mesh_dir: Path | None,
    write: Writer,
    refused: str | None,
) -> ArmOutcome:
    """Write arm.json and, where the result may be trusted, the updated model; all or none."""
    names, failure = [ARM_NAME, FRICTION_NAME], refused
    notes: tuple[str, ...] = ()
    with whole_files() as files:
        if found.status.is_trustworthy and refused is None:
            path = files.reserve_last(folder / MODEL_NAMES[robot.kind])
            target = ModelTarget(files, path, motion, found.held_out.rmse, mesh_dir)
            try:
                notes = write(found, target)
                names.append(path.name)
            except ExportError as error:
                files.withdraw(path)
                failure = str(error)
        final = replace(found, notes=found.notes + notes)
        files.write(folder / ARM_NAME, arm_json_text(final))
        files.write(folder / FRICTION_NAME, friction_json_text(final))
    paths, result = tuple(folder / name for name in names), fingerprint(folder / ARM_NAME)
    notes = (*notes, *left_over(folder, [MODEL_NAMES[robot.kind]], paths))
    return ArmOutcome(final, folder, paths, failure, notes, result=result)


def write_model(
    robot: RobotModel, keep_friction: bool, found: ArmIdentification, target: ModelTarget
) -> tuple[str, ...]:
    """Write the draft of the updated model and return its notes."""
    joints, estimate = _joint_changes(robot, found, keep_friction), found.estimate
    return write_links(robot, estimate.thetas, target, joints, estimate.theta_errors)


def _joint_changes(
    robot: RobotModel, found: ArmIdentification, keep_friction: bool
) -> list[JointChange]:
    """Return what the joints of the model get: what the data proves."""
    own = robot.friction.viscous.tolist()
    return [
        _joint_change(joint, held, keep_friction, viscous)
        for (joint, held), viscous in zip(found.model_friction.items(), own)
    ]


def _joint_change(
    joint: str, held: HeldFriction, keep_friction: bool, own_viscous: float
) -> JointChange:
    terms = ("armature",) if keep_friction else ("armature", "viscous", "coulomb")
    numbers = {_IN_MJCF[term]: held.written(term) for term in terms}
    polynomial = None
    if not keep_friction and "cubic" in held.values:
        polynomial = (held.values["quadratic"], held.values["cubic"])
        # One attribute holds all three numbers, so that the one that stays is written again.
        if numbers["damping"] is None:
            numbers["damping"] = own_viscous
    offset = None if keep_friction else held.values.get("offset")
    words = [
        f"{_IN_MJCF[term]} {held.words(term)}" for term in terms if held.written(term) is not None
    ]
    if polynomial is not None:
        words.append(f"nonlinear damping {held.words('quadratic')}, {held.words('cubic')}")
    if offset is not None:
        words.append(f"offset {held.words('offset')}, as a spring tensioned far away")
    text = ", ".join(words)
    return JointChange(joint, **numbers, polynomial=polynomial, offset=offset, words=text)
