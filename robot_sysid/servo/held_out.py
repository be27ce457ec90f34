"""Prediction of held-out pieces: by the servos before and after, and by the commands themselves.

A model that predicts positions no better than "position equals the command of some time before" is
of no use, however much better than the model before it is.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Measurement
from robot_sysid.results.prediction import HORIZONS, rollout_refusal
from robot_sysid.results.record import RolloutError, RolloutTest
from robot_sysid.servo.windows import MAX_DELAY_PERIODS, ServoProblem, make_problem
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.simulation.playback import MAX_WINDOWS, ServoParameters, ServoRollouts

ROLLOUT_INPUT = (
    "the log's commands through the model's servos, both late by the delay that was "
    "found"
)
"""What drives the rollouts that compare two models, as printed."""


@dataclass(frozen=True)
class GoalPrediction:
    """Prediction of positions without a model: each equals the command of some time before.

    Attributes:
        delay: this time, the best one in the fitted logs [s].
        errors: root mean square errors on held-out pieces, one per horizon of the rollouts [rad].
    """

    delay: float
    errors: tuple[float, ...]

    @property
    def name(self) -> str:
        """Its name in printed lines."""
        return f'"position = command of {1e3 * self.delay:.0f} ms before"'


def best_goal_delay(problem: ServoProblem) -> float:
    """Return the time [s] by which positions lag behind commands if they otherwise equal them."""
    window, _, _ = problem.windows[0]
    period = sampling_period(window.time)
    delays = period * np.arange(4 * MAX_DELAY_PERIODS + 1) / 4.0
    errors = [np.mean(problem.goal_errors(delay) ** 2) for delay in delays.tolist()]
    return float(delays[int(np.argmin(errors))])


def play_servos(
    rollouts: ServoRollouts,
    pieces: Sequence[Measurement],
    pair: Sequence[ServoParameters],
    held_out: str,
    goal_delay: float,
) -> tuple[RolloutTest, GoalPrediction]:
    """Return the position errors of two sets of servo parameters that play held-out pieces of logs,
    and those of positions that equal the commands of ``goal_delay`` before.

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
            problem = make_problem(
                rollouts,
                pieces,
                max_windows=MAX_WINDOWS,
                length=horizon,
                settling_time=0.0,
            )
        except InputError:  # the only reason: no window fits into a piece with commands
            notes.append(f"no held-out piece has commands for {horizon:g} s")
            continue
        # Root mean square error (n,) of each joint [rad].
        old, new = np.sqrt(np.mean(problem.errors(pair) ** 2, axis=1))
        errors.append(RolloutError(horizon, len(problem.windows), old, new))
        goal_errors.append(
            float(np.sqrt(np.mean(problem.goal_errors(goal_delay) ** 2)))
        )
    names = rollouts.robot.joint_names
    test = RolloutTest(names, held_out, ROLLOUT_INPUT, tuple(errors), tuple(notes))
    return test, GoalPrediction(goal_delay, tuple(goal_errors))


def servo_refusal(
    test: RolloutTest, goal: GoalPrediction, accepted: Collection[str]
) -> str | None:
    """Return why a model with identified servos must not be written, or None.

    It must predict held-out positions better than the model before and than the delayed commands
    themselves, over every horizon that was played.

    Args:
        test: the models before and after, played on held-out pieces.
        goal: the prediction by the commands.
        accepted: names of the findings that the user accepts, "rollout" among them or not.
    """
    if not test.errors or "rollout" in accepted:
        return rollout_refusal(test, accepted)
    faults = []
    for error, goal_error in zip(test.errors, goal.errors):
        old_error, new_error = error.overall
        rivals = {"the model before": old_error, goal.name: goal_error}
        for name, rival_error in rivals.items():
            if new_error >= rival_error:
                faults.append(
                    f"{new_error:.3g} rad over {error.horizon:g} s, {name} {rival_error:.3g}"
                )
    if not faults:
        return None
    return (
        "no model was written: on held-out pieces the new model does not predict positions better "
        f"than what is there without it ({'; '.join(faults)}); to write it all the same: "
        "--accept rollout"
    )
