"""The model before and the one to be written, played on logs that were not fitted, and the figures.

Files are played: the new model is written into a folder that is gone afterwards, and loaded. The
torques that a file predicts are told beside it, judged as a file too: compiled, by MuJoCo alone.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import ExportError, InputError
from robot_sysid.model.chain import joint_friction
from robot_sysid.model.compilation import compile_model
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Measurement, Motion, RobotModel, Validation
from robot_sysid.records.data import validation_of
from robot_sysid.records.file_access import MODEL_NAMES, atomic_files, temporary_folder
from robot_sysid.results.model import CHECKPOINTS, ModelTarget
from robot_sysid.results.record import CLOSED, OPEN, RolloutError, RolloutTest
from robot_sysid.signals.process import ProcessedSignals
from robot_sysid.simulation import playback

HORIZONS = (0.1, 0.3, 1.0, 3.0)
"""Lengths of time over which the models are played [s]."""
HELD_OUT_SHARE = 0.2
LAST_FIFTH = "the last fifth of every log, which was not fitted for it"
"""Part of each log, its end, that is not fitted: the fifth that cross-validation leaves out too."""
SERVO_WORDS = (
    f"measured torques and a critically damped servo of {playback.TRACKING_RATE:g} Hz towards the "
    "measured motion"
)


def play(
    robot: RobotModel,
    signals: Sequence[ProcessedSignals],
    write: Callable[[ModelTarget], object],
    mesh_dir: Path | None,
    since: Callable[[ProcessedSignals], float] = lambda log: -np.inf,
    held_out: str = "the validation log",
) -> RolloutTest:
    """Play logs with the model before and with the one that ``write`` writes, read from its file;
    return the figures, or why there are none.

    A log is played ``since`` some time on [s], ``split_time`` where the rest was fitted; what is
    ``held_out`` so is told in words.
    """
    try:
        pieces = [
            p for log in signals for p in playback.low_passed_pieces(log, since(log))
        ]
        checkpoints = signals[0].motion(signals[0].spread_indices(CHECKPOINTS))
        with temporary_folder() as folder:
            path = folder / MODEL_NAMES["mjcf"]  # what is in it tells its kind
            with atomic_files() as files:
                write(ModelTarget(files, path, checkpoints, 0.0, mesh_dir))
            after = load_robot_model(path, joint=robot.terminal_joint)
        return compare(robot, after, pieces, held_out)
    except (ExportError, InputError) as error:
        return RolloutTest(robot.joint_names, "held-out pieces", "", (), (str(error),))


def refusal(test: RolloutTest | None, accepted: Collection[str]) -> str | None:
    """Return why a model that was played must not be written, or None."""
    if test is None or test.is_better or "rollout" in accepted:
        return None
    worse = f"nothing could be played on held-out pieces ({'; '.join(test.notes)})"
    if test.score is not None:
        worse = "played on held-out pieces, the new model is not better than the old one (errors "
        worse += f"{test.score:.2f} times those before)"
    return f"no model was written: {worse}; to write it all the same: --accept rollout"


def compare(
    before: RobotModel, after: RobotModel, pieces: Sequence[Measurement], held_out: str
) -> RolloutTest:
    """Play two models of an arm on the same pieces."""
    errors = []
    notes = []
    servo = playback.tracking_servo((before, after), pieces) if pieces else None
    for horizon in HORIZONS:
        windows = playback.window_starts(pieces, horizon)
        if not windows:
            notes.append(f"no held-out piece is as long as {horizon:g} s")
            continue
        for loop, own in ((OPEN, None), (CLOSED, servo)):
            old, new = (
                playback.rollout_error(robot, windows, horizon, own)
                for robot in (before, after)
            )
            away = (old[1], new[1])
            errors.append(
                RolloutError(loop, horizon, len(windows), old[0], new[0], away)
            )
    notes += [
        f"{e.loop}, {e.horizon:g} s: {e.diverged[0]} of {e.windows} windows run away with the "
        f"model before, {e.diverged[1]} with the new one"
        for e in errors
        if any(e.diverged)
    ]
    return RolloutTest(
        before.joint_names, held_out, SERVO_WORDS, tuple(errors), tuple(notes)
    )


def split_time(signals: ProcessedSignals | Measurement) -> float:
    """Return from when on a log is held out [s]."""
    start = float(signals.time[0])
    end = float(signals.time[-1])
    return end - HELD_OUT_SHARE * (end - start)


def fitted_rows(signals: ProcessedSignals) -> NDArray[np.bool_]:
    """Return which decimated rows (K,) share no sample with what is held out."""
    reach = signals.low_pass.half_width / signals.rate
    return np.asarray(signals.decimated_time() < split_time(signals) - 2.0 * reach)


def torque_error(
    model: Path | Any, robot: RobotModel, signals: ProcessedSignals, source: str
) -> Validation:
    """Return the torque error of a model file, with each joint's sensor offset beside it alone.

    The model's inverse dynamics holds its links, gravity, rotor inertia, springs and all damping;
    its dry friction is Coulomb's. It passes the same low-pass as the measured torque. Of what is
    left, each joint's mean is taken out. The chain's joints have the robot's places in the model;
    InputError where its file cannot be loaded.
    """
    compiled = compile_model(model).mj_model if isinstance(model, Path) else model
    dynamics = ArmDynamics(robot, compiled)
    friction = joint_friction(compiled, robot.dof_index)

    def smooth(motion: Motion) -> tuple[Array]:
        return (
            dynamics.torque(motion.q, motion.qd, motion.qdd)
            + friction.viscous * motion.qd,
        )

    (predicted,) = signals.filter_columns(smooth, smooth=True)
    predicted += signals.low_pass.decimate(friction.dry(signals.qd))
    tau = signals.low_pass.decimate(signals.tau)
    usable = signals.usable()
    residual = np.where(usable, tau - predicted, 0.0)
    counts = np.count_nonzero(usable, axis=0)
    residual = np.where(
        usable, residual - np.sum(residual, axis=0) / np.maximum(counts, 1), 0.0
    )
    sizes = np.sum(np.where(usable, tau, 0.0) ** 2, axis=0)
    return validation_of(
        robot.joint_names, np.sum(residual**2, axis=0), sizes, counts, source
    )
