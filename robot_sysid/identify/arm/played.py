"""Does the identified arm move more like the real one than the model before did?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.identify.arm.fit import fit_arm
from robot_sysid.identify.arm.model_friction import model_friction
from robot_sysid.identify.arm.result import estimate_of
from robot_sysid.identify.judgement.rollout.candidate import as_written
from robot_sysid.identify.judgement.rollout.compare import compare, fitted_rows, split_time
from robot_sysid.identify.simulated import CHECKPOINTS
from robot_sysid.output.model_writing import ModelTarget
from robot_sysid.records import RobotModel
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import RolloutTest
from robot_sysid.records.whole_arm import ArmIdentification
from robot_sysid.signals.process import ProcessedSignals
from robot_sysid.simulation.rollout.playback import pieces_of_signals

Writer = Callable[[ArmIdentification, ModelTarget], tuple[str, ...]]
"""Writes a result into a model file; returns notes."""


def play_held_out(
    robot: RobotModel,
    found: ArmIdentification,
    signals: Sequence[ProcessedSignals],
    options: ArmOptions,
    write: Writer,
    mesh_dir: Path | None,
    progress: Progress,
) -> RolloutTest:
    """Fit the beginning of every log, and play its end with the model before and with that one.

    Everything is chosen anew from the beginning alone. What is written in the end comes from all
    that was recorded.

    Raises:
        InputError: a log is too short to be split.
        ExportError: the model cannot hold what was found.
    """
    progress.stage("Playing the model on held-out pieces...")
    fit = fit_arm(robot, signals, options, Progress(), [fitted_rows(log) for log in signals])
    estimate = estimate_of(robot, fit)
    held = model_friction(robot, fit, estimate, options.write_offset)
    part = replace(found, estimate=estimate, model_friction=held)
    pieces = [piece for log in signals for piece in pieces_of_signals(log, split_time(log))]
    words = "the last fifth of every log, which was not fitted for it"
    return compare(robot, _written(robot, part, signals, write, mesh_dir), pieces, words)


def play_other(
    robot: RobotModel,
    found: ArmIdentification,
    signals: Sequence[ProcessedSignals],
    others: Sequence[ProcessedSignals],
    write: Writer,
    mesh_dir: Path | None,
    progress: Progress,
) -> RolloutTest:
    """Play another log with the model before and with the identified one."""
    progress.stage("Playing the model on the validation log...")
    pieces = [piece for log in others for piece in pieces_of_signals(log)]
    after = _written(robot, found, signals, write, mesh_dir)
    return compare(robot, after, pieces, "the validation log")


def _written(
    robot: RobotModel,
    found: ArmIdentification,
    signals: Sequence[ProcessedSignals],
    write: Writer,
    mesh_dir: Path | None,
) -> RobotModel:
    motion = signals[0].motion(signals[0].spread(CHECKPOINTS))
    return as_written(robot, lambda target: write(found, target), motion, mesh_dir)
