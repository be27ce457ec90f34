"""The stages in order: load, excite, simulate, collect, solve, export."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from robot_sysid.config import SysidConfig
from robot_sysid.identify.simulated import Analysis, analyse_itself
from robot_sysid.model.compilation import captured_warnings
from robot_sysid.output.summary import clamping_lines, detail_lines, folder_text, result_lines
from robot_sysid.parser import load_robot_model
from robot_sysid.planning import PlanReport, make_plan, plan_files, report_plan
from robot_sysid.records import Identification, MotionPlan, RobotModel
from robot_sysid.records.atomic_files import require_writable
from robot_sysid.records.progress import Progress, Silent
from robot_sysid.results_writer import (
    Command,
    check_motor_types,
    updated_model_name,
    write_commands,
    write_results,
)
from robot_sysid.simulator import inverse_torque
from robot_sysid.trajectory import motion_chunks

if TYPE_CHECKING:
    from robot_sysid.damiao.trajectory.csv_file import DamiaoExportReport


@dataclass(frozen=True)
class PlanOutcome:
    """What a run with --plan-only produced.

    Attributes:
        plan: the trajectory.
        report: what it promises and whether it keeps all limits.
        files: what was written.
        damiao: report lines of the Damiao export, where one was asked for.
    """

    plan: MotionPlan
    report: PlanReport
    files: tuple[Path, ...]
    damiao: tuple[str, ...] = ()

    @property
    def failure(self) -> str | None:
        """Why the trajectory must not be run, or None."""
        broken = self.report.certificate.excesses
        if not broken:
            return None
        return f"this trajectory must not be run: it breaks {len(broken)} limits, first {broken[0]}"

    def report_lines(self, verbose: bool) -> list[str]:
        """Return what the command line prints at the end."""
        written = [f"Trajectory saved to {path}" for path in self.files]
        return [*self.report.lines, *self.damiao, *written]


@dataclass(frozen=True)
class Outcome:
    """What a run produced.

    Attributes:
        identification: the result.
        output_dir: where files went.
        files: what was written there.
        damiao: report of the Damiao export, where one was asked for.
        not_written: why the result could not be written into the model, or None.
    """

    identification: Identification
    output_dir: Path
    files: tuple[Path, ...]
    damiao: DamiaoExportReport | None = None
    not_written: str | None = None

    @property
    def failure(self) -> str | None:
        """Why there is no updated model, or None."""
        status = self.identification.estimate.status
        if not status.is_trustworthy:
            return f"no model was written: {status.value}"
        if self.not_written is None:
            return None
        return f"{self.not_written} (the identified numbers are in params.json)"

    def report_lines(self, verbose: bool) -> list[str]:
        """Return what the command line prints at the end."""
        details = detail_lines(self.identification) if verbose else []
        clamping = clamping_lines(self.damiao, self.identification.joint_names)
        saved = f"Results saved to {folder_text(self.output_dir)}"
        return [*result_lines(self.identification), *details, *clamping, saved]


def run(config: SysidConfig, progress: Progress | None = None) -> Outcome | PlanOutcome:
    """Identify the terminal link of one arm and write the results.

    Args:
        config: what to do.
        progress: where to tell how far it is; None stays silent.

    Raises:
        SysidError: with the exit code that fits, see ``errors``.
    """
    progress = progress or Silent()
    with captured_warnings() as warnings:
        outcome = _run(config, progress)
    for warning in dict.fromkeys(warnings):
        progress.note(f"MuJoCo warns: {warning}")
    return outcome


def _run(config: SysidConfig, progress: Progress) -> Outcome | PlanOutcome:
    require_writable(config.output_dir)
    robot = load(config, progress)
    if config.measurements is not None:
        from robot_sysid.identify.log import analyse_log

        analysis = analyse_log(config, robot, progress)
        return _write(config, robot, analysis, no_commands, progress)
    seed = config.seed if config.seed is not None else secrets.randbelow(2**31)
    plan = make_plan(config, robot, seed, progress)
    if config.plan_only:
        return _plan_outcome(config, robot, plan)
    analysis = _analyse(config, robot, plan, seed, progress)
    return _write(config, robot, analysis, lambda: commands(robot, plan, config), progress)


def _analyse(
    config: SysidConfig, robot: RobotModel, plan: MotionPlan, seed: int, progress: Progress
) -> Analysis:
    if config.plant_model is None:
        return analyse_itself(config, robot, plan, seed, progress)
    from robot_sysid.identify.log import analyse_plant

    return analyse_plant(config, robot, plan, seed, progress)


def _plan_outcome(config: SysidConfig, robot: RobotModel, plan: MotionPlan) -> PlanOutcome:
    report = report_plan(config, robot, plan)
    files = plan_files(config)
    if not config.export_damiao:
        return PlanOutcome(plan, report, files)
    path, damiao = write_commands(config, commands(robot, plan, config))
    lines = tuple(clamping_lines(damiao, robot.joint_names))
    return PlanOutcome(plan, report, (*files, path), lines)


def _write(
    config: SysidConfig,
    robot: RobotModel,
    analysis: Analysis,
    motor_commands: Callable[[], Iterator[Command]],
    progress: Progress,
) -> Outcome:
    """Write all results and pass on what writing them had to say."""
    before = analysis.identification
    written = write_results(config, robot, before, analysis.checkpoints, motor_commands)
    for note in written.identification.notes[len(before.notes) :]:
        progress.note(note)
    stale = config.output_dir / updated_model_name(robot)
    if stale not in written.files and stale.exists():
        progress.note(f"{stale} is from an earlier run; this run wrote no model")
    return Outcome(
        written.identification,
        config.output_dir,
        written.files,
        written.damiao,
        written.failure,
    )


def load(config: SysidConfig, progress: Progress) -> RobotModel:
    """Load the model and find its terminal joint."""
    progress.stage(f"Loading robot model from {config.model}...")
    robot = load_robot_model(config.model, config.mesh_dir, config.joint, config.max_velocity)
    check_motor_types(config, robot)
    progress.stage(f"Identified terminal joint: {robot.terminal_joint}")
    for note in robot.notes:
        progress.note(note)
    progress.detail(f"Joints that carry it: {', '.join(robot.joint_names)}")
    return robot


def commands(robot: RobotModel, plan: MotionPlan, config: SysidConfig) -> Iterator[Command]:
    """Yield the motion with the torque it takes, for playing it on motors."""
    torque = inverse_torque(robot)
    for motion in motion_chunks(plan, config.damiao_rate or config.sample_rate):
        yield motion.time, motion.q, motion.qd, torque(motion)


def no_commands() -> Iterator[Command]:
    """Yield nothing: a log is not played."""
    return iter(())
