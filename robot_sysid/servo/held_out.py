"""Held-out pieces, played by the servos before and after: the judgement of what is written.

A model that predicts positions no better than "position equals the command of some time before" is
of no use, however much better than the model before it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement
from robot_sysid.results.prediction import HORIZONS
from robot_sysid.results.record import RolloutError, RolloutTest
from robot_sysid.servo.windows import ServoProblem, make_problem
from robot_sysid.simulation.playback import MAX_WINDOWS, ServoParameters, ServoRollouts

ROLLOUT_INPUT = (
    "the log's commands through the model's servos, both late by the delay that was "
    "found"
)
"""What drives the rollouts that compare two models, as printed."""
WORSE = 1.05
"""Error of a joint over that before, from which on it became worse: encoder steps alone, which both
errors hold, make them differ by less."""

FLOOR = 3e-4
"""Error that encoder steps hide [rad or m]."""


def play_servos(
    rollouts: ServoRollouts,
    pieces: Sequence[Measurement],
    pair: Sequence[ServoParameters],
    held_out: str,
    goal_delay: float,
) -> tuple[RolloutTest, tuple[float, ...]]:
    """Return the position errors of two sets of servo parameters that play held-out pieces of logs,
    and those of positions that equal the commands of ``goal_delay`` before, one per horizon [rad].

    The pieces are cut into windows of each length of ``HORIZONS``. A length for which no piece with
    commands is long enough (the InputError of ``make_problem``) is left out, with a note.

    Args:
        rollouts: play the windows on the arm's model; they are left with the last parameters.
        pieces: pieces of logs that were not fitted.
        pair: the parameters before and after identification.
        held_out: name of these pieces in printed lines.
        goal_delay: time by which positions lag behind commands [s].
    """
    errors = []
    goal_errors = []
    notes = []
    for horizon in HORIZONS:
        try:
            problem = make_problem(rollouts, pieces, MAX_WINDOWS, horizon)
        except InputError:  # the only reason: no window fits into a piece with commands
            notes.append(f"no held-out piece has commands for {horizon:g} s")
            continue
        errors.append(rollout_error(problem, pair))
        goal_errors.append(
            float(np.sqrt(np.mean(problem.goal_errors(goal_delay) ** 2)))
        )
    names = rollouts.robot.joint_names
    test = RolloutTest(names, held_out, ROLLOUT_INPUT, tuple(errors), tuple(notes))
    return test, tuple(goal_errors)


def rollout_error(
    problem: ServoProblem, pair: Sequence[ServoParameters]
) -> RolloutError:
    """Return the root mean square errors of two sets of servo parameters in windows."""
    old, new = np.sqrt(np.mean(problem.errors(pair) ** 2, axis=1))
    horizon = float(problem.edges[-1])
    return RolloutError(horizon, len(problem.windows), old, new)


def worse_joints(errors: Sequence[RolloutError]) -> NDArray[np.bool_]:
    """Return whether the positions of each joint (n,) are predicted worse than before.

    By the geometric mean over all errors; none is worse without any.
    """
    excess: Array | float = 0.0
    for error in errors:
        ratio = (error.errors_after + FLOOR) / (error.errors_before + FLOOR)
        excess = excess + np.log(ratio / WORSE)
    return np.asarray(excess) > 0.0


def servo_fault(test: RolloutTest, goal_errors: Sequence[float]) -> str | None:
    """Return why identified servos are not usable, or None.

    They must predict held-out positions better than the model before and than the delayed commands
    themselves, over every horizon that was played, and no joint's worse.

    Args:
        test: the models before and after, played on held-out pieces.
        goal_errors: errors of the prediction by the commands, one per horizon [rad].
    """
    if not test.errors:
        return f"nothing could be played on held-out pieces ({'; '.join(test.notes)})"
    faults = []
    for error, goal_error in zip(test.errors, goal_errors):
        old_error, new_error = error.overall
        rivals = {"the model before": old_error, "the delayed commands": goal_error}
        for name, rival_error in rivals.items():
            if new_error >= rival_error:
                faults.append(
                    f"{new_error:.3g} rad over {error.horizon:g} s, {name} {rival_error:.3g}"
                )
    for k in np.flatnonzero(worse_joints(test.errors)):
        faults.append(f"{test.joint_names[k]} is predicted worse than before")
    if not faults:
        return None
    return (
        "on held-out pieces the new model does not predict positions better than what is there "
        f"without it ({'; '.join(faults)})"
    )
