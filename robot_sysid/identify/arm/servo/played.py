"""The model before and after, driven by the commands of pieces that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.identify.arm.servo.commands import Piece
from robot_sysid.identify.arm.servo.problem import problem_of
from robot_sysid.identify.judgement.rollout.compare import HELD_OUT_SHARE, HORIZONS
from robot_sysid.records import RobotModel
from robot_sysid.records.results import CLOSED, RolloutError, RolloutTest
from robot_sysid.simulation.rollout.playback import MOST_WINDOWS
from robot_sysid.simulation.rollout.servo import Actuators, Servos

SERVO_WORDS = "the log's commands through the model's servos, both late by the delay that was found"


def parted(pieces: Sequence[Piece]) -> tuple[list[Piece], list[Piece], str]:
    """Return (what is fitted, what is held out, that in words): the last fifth of every piece."""
    fitted, held = [], []
    for piece in pieces:
        late = piece.time > piece.time[-1] - HELD_OUT_SHARE * (piece.time[-1] - piece.time[0])
        fitted.append(piece.part(~late))
        held.append(piece.part(late))
    return fitted, held, "the last fifth of every log, which was not fitted for it"


def play_servos(
    robot: RobotModel,
    actuators: Actuators,
    pieces: Sequence[Piece],
    pair: tuple[Servos, Servos],
    held_out: str,
) -> RolloutTest:
    """Play two models (before, after) on held-out pieces, over every horizon that is there."""
    errors, notes = [], ["open loop was not played: no torque was measured"]
    for horizon in HORIZONS:
        try:
            problem = problem_of(robot, actuators, pieces, MOST_WINDOWS, horizon, 0.0)
        except InputError:
            notes.append(f"no held-out piece is as long as {horizon:g} s")
            continue
        old, new = (np.sqrt(np.mean(e**2, axis=0)) for e in problem.errors(pair))
        errors.append(RolloutError(CLOSED, horizon, len(problem.windows), old, new))
    return RolloutTest(robot.joint_names, held_out, SERVO_WORDS, tuple(errors), tuple(notes))
