"""The stages in order: load, excite, simulate, collect, solve, export."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np

from robot_sysid.config import SysidConfig
from robot_sysid.errors import InputError
from robot_sysid.excitation.plan import CheckedPlan, MotionRequest, make_plan
from robot_sysid.export import (
    MotorFile,
    alone_in,
    left_over,
    write_model,
    write_motor_file,
    write_results,
)
from robot_sysid.identify.judgement.rollout.candidate import refusal
from robot_sysid.identify.simulated import Analysis, SimulatedRun, identify_itself
from robot_sysid.interrupts import only_the_first
from robot_sysid.output.printed.link import (
    clamping_lines,
    detail_lines,
    folder_text,
    more_lines,
    result_lines,
)
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Identification, MotionPlan, RobotModel
from robot_sysid.records.atomic_files import WholeFiles, whole_files
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import DAMIAO_NAME, MODEL_NAMES, PARAMS_NAME
from robot_sysid.records.traces import Traces
from robot_sysid.report.runs import fingerprint
from robot_sysid.simulator import ArmTorque
from robot_sysid.trajectory import motion_chunks, require_countable

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory.csv_file import DamiaoExportReport, MotionChunk

# Speed at which dry friction has turned round by three quarters [rad/s]. Wider is gentler, but an
# arm that sticks longer at its reversals tells less: three times this costs a millimetre more.
_SMOOTH_REVERSAL = 0.01


@dataclass(frozen=True)
class PlanOutcome:
    """What a run with --plan-only produced.

    Attributes:
        lines: what the trajectory promises.
        failure: why it must not be run, or None; nothing is written then.
        files: what was written.
        damiao: report lines of the Damiao export, where one was asked for.
        checked: the trajectory itself.
    """

    lines: tuple[str, ...]
    failure: str | None
    files: tuple[Path, ...] = ()
    damiao: tuple[str, ...] = ()
    checked: CheckedPlan | None = None

    def report_lines(self, verbose: bool) -> list[str]:
        """Return what the command line prints at the end."""
        written = [f"Trajectory saved to {path}" for path in self.files]
        return [*self.lines, *self.damiao, *written]


@dataclass(frozen=True)
class Outcome:
    """What a run produced.

    Attributes:
        identification: the result.
        output_dir: where files went.
        files: what was written there.
        damiao: report of the Damiao export, where one was asked for.
        not_written: why the result could not be written into the model, or None.
        traces: makes what a report draws.
        result: hash of the JSON file, taken before another run may write to the folder.
    """

    identification: Identification
    output_dir: Path
    files: tuple[Path, ...]
    damiao: DamiaoExportReport | None = None
    not_written: str | None = None
    traces: Callable[[], Traces] | None = None
    result: str = ""

    @property
    def leaves_data(self) -> bool:
        """Whether there is something to draw that a later run could not make again."""
        return self.identification.data.source.is_measured

    @property
    def failure(self) -> str | None:
        """Why there is no updated model, or None."""
        status = self.identification.estimate.status
        if not status.is_trustworthy:
            reasons = "; ".join(self.identification.reasons)
            return f"no model was written: {reasons + ': ' if reasons else ''}{status.value}"
        if self.not_written is None:
            return None
        return f"{self.not_written} (the identified numbers are in params.json)"

    def report_lines(self, verbose: bool) -> list[str]:
        """Return what the command line prints at the end."""
        details = detail_lines(self.identification) if verbose else []
        clamping = clamping_lines(self.damiao, self.identification.joint_names)
        saved = f"Results saved to {folder_text(self.output_dir)}"
        more = more_lines(self.identification)
        return [*result_lines(self.identification), saved, *more, *details, *clamping]


def run(config: SysidConfig, progress: Progress | None = None) -> Outcome | PlanOutcome:
    """Identify the terminal link of one arm and write the results.

    Args:
        config: what to do.
        progress: where to tell how far it is; None stays silent.

    Raises:
        SysidError: with the exit code that fits, see ``errors``.
    """
    progress = progress or Progress()
    with alone_in(config.output.output_dir, progress):
        return _run(config, progress)


def _run(config: SysidConfig, progress: Progress) -> Outcome | PlanOutcome:
    robot = load(config, progress)
    if config.trajectory.plan_only:
        with only_the_first():
            checked, _ = designed(config, robot, progress)
            return replace(_plan_outcome(config, robot, checked), checked=checked)
    analysis, plan = analysed(config, robot, progress)
    motor_file = None if plan is None else _motor_file(config, robot, plan)
    return written(config, robot, analysis, motor_file, progress)


def designed(config: SysidConfig, robot: RobotModel, progress: Progress) -> tuple[CheckedPlan, int]:
    """Return the motion that was asked for, checked, and the seed it was drawn with."""
    chosen = config.trajectory.seed
    seed = secrets.randbelow(2**31) if chosen is None else chosen
    return make_plan(_request(config), robot, seed, progress), seed


def analysed(
    config: SysidConfig, robot: RobotModel, progress: Progress
) -> tuple[Analysis, MotionPlan | None]:
    """Identify, and write no result; returns also the motion that a simulation followed."""
    if config.log.measurements:
        from robot_sysid.identify.measured import identify_logs

        save, estimation = config.arm.save_measurements, config.estimation
        return identify_logs(robot, config.log, save, estimation, progress), None
    with only_the_first():
        checked, seed = designed(config, robot, progress)
        if checked.failure:
            raise InputError(f"{checked.failure}; {_remedy(config)}")
        with whole_files() as files:
            save_plan(files, config, robot, checked.plan)
    return _analyse(config, robot, checked.plan, seed, progress), checked.plan


def load(config: SysidConfig, progress: Progress) -> RobotModel:
    """Load the model and find its terminal joint."""
    model = config.model
    progress.stage(f"Loading robot model from {model.path}...")
    speed = config.limits.max_velocity
    robot = load_robot_model(model.path, model.mesh_dir, model.joint, speed, model.keyframe)
    if config.motors.export_damiao:
        from robot_sysid.damiao.protocol.joints import damiao_joints

        # Refused before any work where the export could not be done.
        motors = config.motors
        damiao_joints(motors.motor_type, robot.n_joints, motors.can_id, motors.master_id)
    progress.stage(f"Identified terminal joint: {robot.terminal_joint}")
    for note in robot.notes:
        progress.note(note)
    progress.detail(f"Joints that carry it: {', '.join(robot.joint_names)}")
    return robot


def _request(config: SysidConfig) -> MotionRequest:
    played = config.motors.export_damiao or config.arm.simulation == "forward"
    torques, noise = config.estimation.torques, config.arm.noise_torque
    options = config.trajectory, config.excitation, config.limits
    return MotionRequest(*options, torques, noise, played, config.poses)


def _remedy(config: SysidConfig) -> str:
    if config.trajectory.file is not None:
        return "relax that limit, slow the motion down with --speed, or design one for this arm"
    return "relax that limit, try another --seed, or use --excitation optimal"


def save_plan(
    files: WholeFiles, config: SysidConfig, robot: RobotModel, plan: MotionPlan
) -> tuple[Path, ...]:
    """Write the drafts of the trajectory where it was asked for; returns where it will be."""
    path = config.plan_file
    if path is None:
        return ()
    from robot_sysid.excitation.trajectory_files import save_samples, save_trajectory

    samples = path.with_suffix(".csv")
    with files.open(path) as file:
        save_trajectory(file, plan, robot.joint_names, robot.sha256)
    with files.open(samples) as file:
        save_samples(file, plan, robot.joint_names, config.trajectory.sample_rate)
    return path, samples


def _plan_outcome(config: SysidConfig, robot: RobotModel, checked: CheckedPlan) -> PlanOutcome:
    lines = tuple(promise(config, robot, checked))
    if checked.failure:
        return PlanOutcome(lines, f"{checked.failure}; nothing was written")
    motor_file = _motor_file(config, robot, checked.plan)
    with whole_files() as files:
        paths = save_plan(files, config, robot, checked.plan)
        if motor_file is None:
            return PlanOutcome(lines, None, paths)
        path = config.output.output_dir / DAMIAO_NAME
        report = write_motor_file(files, path, motor_file)
    damiao = tuple(clamping_lines(report, robot.joint_names))
    return PlanOutcome(lines, None, (*paths, path), damiao)


def promise(config: SysidConfig, robot: RobotModel, checked: CheckedPlan) -> Iterator[str]:
    """Yield what a motion promises, and what it does beside its limits."""
    from robot_sysid.excitation.plan_report import motion_lines, plan_lines
    from robot_sysid.excitation.static.pose_design import pose_lines
    from robot_sysid.excitation.static.sweeps import sweep_lines
    from robot_sysid.expected import expect

    assert checked.problem is not None and checked.check is not None
    made = checked.problem, checked.plan, checked.check
    if config.poses.sets_its_time:
        poses = config.poses.static
        tell = pose_lines if poses else sweep_lines
        yield from tell(robot, checked.problem, checked.plan)
        yield from motion_lines(*made)
    else:
        rate = config.trajectory.sample_rate
        expected = expect(checked.problem, checked.plan, rate, config.estimation)
        promise = expected.counted, expected.stated, expected.shown
        yield from plan_lines(*made, expected.prediction, *promise)


def _analyse(
    config: SysidConfig, robot: RobotModel, plan: MotionPlan, seed: int, progress: Progress
) -> Analysis:
    arm, rate = config.arm, config.trajectory.sample_rate
    simulated = SimulatedRun(plan, rate, seed, arm.save_measurements)
    if arm.plant_model is None:
        return identify_itself(robot, simulated, config.estimation, progress)
    from robot_sysid.identify.measured import identify_simulated_arm

    mesh_dir = config.model.mesh_dir
    return identify_simulated_arm(robot, arm, mesh_dir, simulated, config.estimation, progress)


def written(
    config: SysidConfig,
    robot: RobotModel,
    analysis: Analysis,
    motor_file: MotorFile | None,
    progress: Progress,
) -> Outcome:
    """Write all results and pass on what writing them had to say."""
    folder, mesh_dir = config.output.output_dir, config.model.mesh_dir
    found, checkpoints = analysis.identification, analysis.checkpoints
    keep, refused = config.output.keep_friction, None
    if config.log.verify_rollout and analysis.rollouts and found.estimate.status.is_trustworthy:
        progress.stage("Playing the model on held-out pieces...")
        write = partial(write_model, robot, keep)
        found = replace(found, rollout=analysis.rollouts.test(found, checkpoints, write, mesh_dir))
        refused = refusal(found.rollout, config.log.accept)
    options = mesh_dir, motor_file, keep, refused
    written = write_results(robot, found, checkpoints, folder, *options)
    for note in (*written.notes, *left_over(folder, [MODEL_NAMES[robot.kind]], written.files)):
        progress.note(note)
    made = written.files, written.damiao, written.failure, analysis.traces
    return Outcome(found, folder, *made, fingerprint(folder / PARAMS_NAME))


def _motor_file(config: SysidConfig, robot: RobotModel, plan: MotionPlan) -> MotorFile | None:
    """Return what writes the trajectory for Damiao motors, or None where none was asked for."""
    motors = config.motors
    if not motors.export_damiao:
        return None
    from robot_sysid.damiao.trajectory.csv_file import export_damiao_trajectory

    rate = motors.damiao_rate or config.trajectory.sample_rate
    require_countable(plan.duration, rate, "--damiao-rate")

    def write(file: TextIO) -> DamiaoExportReport:
        motion, ids = commands(robot, plan, rate), (motors.can_id, motors.master_id)
        return export_damiao_trajectory(
            motion, motors.motor_type, file, *ids, motors.supply, robot.joint_names
        )

    return write


def commands(robot: RobotModel, plan: MotionPlan, rate: float) -> Iterator[MotionChunk]:
    """Yield the motion with the torque it takes at a rate [Hz], for playing it on motors.

    Dry friction turns round smoothly: its step at each reversal would be a blow to the arm.
    """
    torque = ArmTorque(robot)
    for motion in motion_chunks(plan, rate):
        turned = np.tanh(motion.qd / _SMOOTH_REVERSAL) - np.sign(motion.qd)
        yield motion.time, motion.q, motion.qd, torque(motion) + robot.friction.coulomb * turned
