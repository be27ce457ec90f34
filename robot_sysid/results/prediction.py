"""Prediction of logs that were not fitted, by the original model and by a written model.

Both models are simulated along the logs, and their positions compared with the measured ones
(rollout); or the torques that a model takes are compared with the measured ones.
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
from robot_sysid.results.record import (
    CLOSED,
    OPEN,
    ModelTarget,
    RolloutError,
    RolloutTest,
)
from robot_sysid.results.verification import CHECKPOINTS
from robot_sysid.signals.process import ProcessedSignals
from robot_sysid.simulation import playback

HORIZONS = (0.1, 0.3, 1.0, 3.0)
"""Durations over which the models are simulated [s]."""
HELD_OUT_SHARE = 0.2
"""Share of each log, its end, that is held out; cross-validation leaves out as much."""
LAST_FIFTH = "the last fifth of every log, which was not fitted for it"
"""Description of the pieces that ``HELD_OUT_SHARE`` holds out."""
SERVO_DESCRIPTION = (
    f"measured torques and a critically damped servo of {playback.TRACKING_RATE:g} Hz towards the "
    "measured motion"
)


def play(
    robot: RobotModel,
    signals: Sequence[ProcessedSignals],
    write: Callable[[ModelTarget], object],
    mesh_dir: Path | None,
    start_time: Callable[[ProcessedSignals], float] = lambda log: -np.inf,
    held_out: str = "the validation log",
) -> RolloutTest:
    """Simulate the original model and a written one along logs, and return their position errors.

    Args:
        robot: the arm with the original model.
        signals: the processed logs, at least one.
        write: writes the new model to the given target, a file in a temporary folder, from which
            the model is loaded.
        mesh_dir: the user's mesh folder; None where there is none.
        start_time: returns the time of a log [s] from which on it is held out.
        held_out: description of the held-out pieces.

    Returns:
        The errors; without any, and with a note, where the model cannot be written or simulated.
    """
    try:
        pieces: list[Measurement] = []
        for log in signals:
            pieces += playback.low_passed_pieces(log, start_time(log))
        checkpoints = signals[0].motion(signals[0].spread_indices(CHECKPOINTS))
        with temporary_folder() as folder:
            # Its content and not this name tells the format.
            path = folder / MODEL_NAMES["mjcf"]
            with atomic_files() as files:
                target = ModelTarget(
                    files, path, checkpoints, rmse=0.0, mesh_dir=mesh_dir
                )
                write(target)
            new_robot = load_robot_model(path, joint=robot.terminal_joint)
        return compare(robot, new_robot, pieces, held_out)
    except (ExportError, InputError) as error:
        return RolloutTest(robot.joint_names, "held-out pieces", "", (), (str(error),))


def rollout_refusal(test: RolloutTest | None, accepted: Collection[str]) -> str | None:
    """Return why a new model that was compared in a rollout must not be written, or None.

    It must not where the test could not be made, or found it no better than the original model at
    predicting positions.

    Args:
        test: position errors of both models (``play``); None, without a test, does not refuse the
            model.
        accepted: names of the findings that the user accepts; with "rollout" among them, no model
            is refused.
    """
    if test is None or test.is_better or "rollout" in accepted:
        return None
    reason = f"nothing could be played on held-out pieces ({'; '.join(test.notes)})"
    if test.score is not None:
        reason = (
            "played on held-out pieces, the new model is not better than the old one (errors "
            f"{test.score:.2f} times those before)"
        )
    return f"no model was written: {reason}; to write it all the same: --accept rollout"


def compare(
    old_robot: RobotModel,
    new_robot: RobotModel,
    pieces: Sequence[Measurement],
    held_out: str,
) -> RolloutTest:
    """Simulate two models of an arm along recorded pieces, and return their position errors.

    Windows of each of ``HORIZONS`` are simulated in open loop and with a servo. A note names each
    horizon for which no piece is long enough, and windows in which a simulation diverges.

    Args:
        old_robot: the arm with the original model.
        new_robot: the arm with the written model.
        pieces: low-passed stretches of logs; windows of each horizon are cut from them.
        held_out: description of the pieces.
    """
    errors = []
    notes = []
    divergence_notes = []
    robots = (old_robot, new_robot)
    servo = playback.tracking_servo(robots, pieces) if pieces else None
    for horizon in HORIZONS:
        windows = playback.window_starts(pieces, horizon)
        if not windows:
            notes.append(f"no held-out piece is as long as {horizon:g} s")
            continue
        for loop, loop_servo in ((OPEN, None), (CLOSED, servo)):
            old_errors, old_diverged = playback.rollout_error(
                old_robot, windows, horizon, loop_servo
            )
            new_errors, new_diverged = playback.rollout_error(
                new_robot, windows, horizon, loop_servo
            )
            diverged = (old_diverged, new_diverged)
            errors.append(
                RolloutError(
                    loop, horizon, len(windows), old_errors, new_errors, diverged
                )
            )
            if any(diverged):
                divergence_notes.append(
                    f"{loop}, {horizon:g} s: {old_diverged} of {len(windows)} windows run away "
                    f"with the model before, {new_diverged} with the new one"
                )
    return RolloutTest(
        old_robot.joint_names,
        held_out,
        SERVO_DESCRIPTION,
        tuple(errors),
        (*notes, *divergence_notes),
    )


def split_time(signals: ProcessedSignals | Measurement) -> float:
    """Return the time from which on the last fifth of a log is held out [s]."""
    start = float(signals.time[0])
    end = float(signals.time[-1])
    return end - HELD_OUT_SHARE * (end - start)


def fitted_rows(signals: ProcessedSignals) -> NDArray[np.bool_]:
    """Return which decimated rows (K,) use no sample of the held-out last fifth."""
    # Positions pass a low-pass of their own before the equations pass one: two half widths.
    reach = signals.low_pass.half_width / signals.rate
    return np.asarray(signals.decimated_time() < split_time(signals) - 2.0 * reach)


def torque_error(
    model: Path | Any, robot: RobotModel, signals: ProcessedSignals, source: str
) -> Validation:
    """Return the torque error of a model file on a log, up to one sensor offset per joint.

    ``ArmDynamics`` has no linear damping of joints; it is added as viscous friction. Dry friction
    is Coulomb's. The prediction passes the same low-pass as the measured torque, and the mean
    residual of each joint is subtracted.

    Args:
        model: path of the file, or a compiled model whose chain joints have the addresses of the
            robot's model.
        robot: the arm.
        signals: the processed log.
        source: description of the log.

    Raises:
        InputError: the file cannot be loaded.
    """
    compiled = compile_model(model).mj_model if isinstance(model, Path) else model
    dynamics = ArmDynamics(robot, compiled)
    friction = joint_friction(compiled, robot.dof_index)

    def smooth_torque(motion: Motion) -> tuple[Array]:
        """Return (torque (K, n) along a motion without dry friction [N m],)."""
        rigid = dynamics.torque(motion.q, motion.qd, motion.qdd)
        return (rigid + friction.viscous * motion.qd,)

    (predicted,) = signals.filter_columns(smooth_torque, smooth=True)
    predicted += signals.low_pass.decimate(friction.dry(signals.qd))
    tau = signals.low_pass.decimate(signals.tau)
    usable = signals.usable()
    counts = np.count_nonzero(usable, axis=0)
    residual = np.where(usable, tau - predicted, 0.0)
    offset = np.sum(residual, axis=0) / np.maximum(counts, 1)
    residual = np.where(usable, residual - offset, 0.0)
    squared_errors = np.sum(residual**2, axis=0)
    squared_torques = np.sum(np.where(usable, tau, 0.0) ** 2, axis=0)
    return validation_of(
        robot.joint_names, squared_errors, squared_torques, counts, source
    )
