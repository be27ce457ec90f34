"""The stages in order: load, excite, simulate, collect, solve, export."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_sysid.analysis import Analysis, analyse_itself, analyse_log, analyse_plant
from robot_sysid.collisions import CHECK_RATE_HZ, find_new_contacts
from robot_sysid.compilation import captured_warnings
from robot_sysid.config import SysidConfig
from robot_sysid.damiao.trajectory_csv import DamiaoExportReport
from robot_sysid.files import require_writable
from robot_sysid.parser import load_robot_model
from robot_sysid.progress import Progress, Silent
from robot_sysid.records import Identification, MotionPlan, RobotModel, Status
from robot_sysid.results import Command, check_motor_types, write_results
from robot_sysid.simulator import inverse_torque
from robot_sysid.summary import clamping_lines, detail_lines, folder_text, result_lines
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks


@dataclass(frozen=True)
class Outcome:
    """What a run produced.

    Attributes:
        identification: the result.
        output_dir: where files went.
        files: what was written there.
        damiao: report of the Damiao export, where one was asked for.
    """

    identification: Identification
    output_dir: Path
    files: tuple[Path, ...]
    damiao: DamiaoExportReport | None = None

    @property
    def failure(self) -> str | None:
        """Why the result must not be used, or None."""
        status = self.identification.estimate.status
        return f"no model was written: {status.value}" if status is Status.INCONSISTENT else None

    def report_lines(self, verbose: bool) -> list[str]:
        """Return what the command line prints at the end."""
        details = detail_lines(self.identification) if verbose else []
        clamping = clamping_lines(self.damiao, self.identification.joint_names)
        saved = f"Results saved to {folder_text(self.output_dir)}"
        return [*result_lines(self.identification), *details, *clamping, saved]


def run(config: SysidConfig, progress: Progress | None = None) -> Outcome:
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


def _run(config: SysidConfig, progress: Progress) -> Outcome:
    require_writable(config.output_dir)
    robot = load(config, progress)
    if config.measurements is not None:
        analysis = analyse_log(config, robot, progress)
        return _write(config, robot, analysis, no_commands, progress)
    seed = config.seed if config.seed is not None else secrets.randbelow(2**31)
    plan = excite(config, robot, seed, progress)
    analyse = analyse_itself if config.plant_model is None else analyse_plant
    analysis = analyse(config, robot, plan, seed, progress)
    return _write(config, robot, analysis, lambda: commands(robot, plan, config), progress)


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
    return Outcome(written.identification, config.output_dir, written.files, written.damiao)


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


def excite(config: SysidConfig, robot: RobotModel, seed: int, progress: Progress) -> MotionPlan:
    """Draw the excitation trajectory and warn of what it touches."""
    rate = f"{config.sample_rate:g} Hz"
    progress.stage(f"Generating excitation trajectory ({config.duration:.1f}s, {rate})...")
    if config.seed is None:
        progress.stage(f"Random seed: {seed} (--seed {seed} repeats this run)")
    plan, notes = generate_excitation_trajectory(
        robot, np.random.default_rng(seed), config.duration, inverse_torque(robot)
    )
    for note in notes:
        progress.note(note)
    for contact in find_new_contacts(robot, motion_chunks(plan, CHECK_RATE_HZ)):
        progress.note(f"{contact} along this trajectory; do not play it on the arm")
    return plan


def commands(robot: RobotModel, plan: MotionPlan, config: SysidConfig) -> Iterator[Command]:
    """Yield the motion with the torque it takes, for playing it on motors."""
    torque = inverse_torque(robot)
    for motion in motion_chunks(plan, config.damiao_rate or config.sample_rate):
        yield motion.time, motion.q, motion.qd, torque(motion)


def no_commands() -> Iterator[Command]:
    """Yield nothing: a log is not played."""
    return iter(())
