"""The old and the new model played side by side on pieces of logs that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.records import RobotModel
from robot_sysid.records.results import CLOSED, OPEN, RolloutError, RolloutTest
from robot_sysid.signals.process import ProcessedSignals
from robot_sysid.simulation.rollout.playback import SERVO_RATE, Piece, played, starts, stated_servo

HORIZONS = (0.1, 0.3, 1.0, 3.0)
"""Lengths of time over which the models are played [s]."""
HELD_OUT_SHARE = 0.2
"""Part of each log, its end, that is not fitted."""
SERVO_WORDS = (
    f"measured torques and a critically damped servo of {SERVO_RATE:g} Hz towards the measured "
    "motion"
)


def compare(
    before: RobotModel, after: RobotModel, pieces: Sequence[Piece], held_out: str
) -> RolloutTest:
    """Play two models of an arm on the same pieces.

    Args:
        before, after: the models.
        pieces: what was measured and not fitted.
        held_out: which pieces these are, in words.
    """
    errors, notes = [], []
    servo = stated_servo((before, after), pieces) if pieces else None
    for horizon in HORIZONS:
        windows = starts(pieces, horizon)
        if not windows:
            notes.append(f"no held-out piece is as long as {horizon:g} s")
            continue
        for loop, own in ((OPEN, None), (CLOSED, servo)):
            old, new = (played(robot, windows, horizon, own) for robot in (before, after))
            away = (old[1], new[1])
            errors.append(RolloutError(loop, horizon, len(windows), old[0], new[0], away))
    notes += [_away_note(error) for error in errors if any(error.diverged)]
    return RolloutTest(before.joint_names, held_out, SERVO_WORDS, tuple(errors), tuple(notes))


def _away_note(error: RolloutError) -> str:
    old, new = error.diverged
    return (
        f"{error.loop}, {error.horizon:g} s: {old} of {error.windows} windows run away with the "
        f"model before, {new} with the new one"
    )


def split_time(signals: ProcessedSignals) -> float:
    """Return from when on a log is held out [s]."""
    start, end = float(signals.time[0]), float(signals.time[-1])
    return end - HELD_OUT_SHARE * (end - start)


def fitted_rows(signals: ProcessedSignals) -> np.ndarray:
    """Return which decimated rows (K,) share no sample with what is held out."""
    reach = signals.low_pass.half_width / signals.rate
    return np.asarray(signals.decimated_time() < split_time(signals) - 2.0 * reach)
