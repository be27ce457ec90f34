"""Windows of an arm's logs, played with a model's servos: how far off are the positions?

Played are windows that are fitted, and held-out pieces, by the servos before and after: the
judgement of what is written. A model that predicts positions no better than "position equals the
command of some time before" is of no use, however much better than the model before it is.

n is the number of joints, M the number of samples in all windows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.estimate.held_out import is_clearly_lower
from robot_sysid.records import Array, Measurement
from robot_sysid.results.prediction import HELD_OUT_SHARE, HORIZONS
from robot_sysid.results.record import RolloutError, RolloutTest
from robot_sysid.signals.resampling import sampling_period, slice_samples
from robot_sysid.simulation.playback import (
    MAX_WINDOWS,
    STEP,
    ServoParameters,
    ServoRollouts,
    ServoWindow,
    interpolate,
)

SMOOTHING_TIME = 0.12
"""Length of the parabolas that give the start state from encoder steps [s]."""
MAX_DELAY_PERIODS = 10
"""Largest delay of the commands that is searched for, in sampling periods."""
ROLLOUT_INPUT = (
    "the log's commands through the model's servos, both late by the delay that was "
    "found"
)
"""What drives the rollouts that compare two models, as printed."""
FLOOR = 5e-4
"""Error that encoder steps hide: a third of a step of 4096 a turn [rad or m]."""


@dataclass(frozen=True)
class ServoProblem:
    """Windows of logs and the position errors of rollouts in them.

    Attributes:
        rollouts: plays the windows on the arm's model.
        windows: for each window its start and commands, the times after its start at which errors
            count (m,) [s], and the positions measured then (m, n). M is the sum of all m.
        edges: (S + 1,) ends of the S rollout steps of every window, from its start [s].
    """

    rollouts: ServoRollouts
    windows: tuple[tuple[ServoWindow, Array, Array], ...]
    edges: Array

    def errors(self, candidates: Sequence[ServoParameters]) -> Array:
        """Return played minus measured positions (C, M, n) of C candidates [rad].

        Where a rollout has diverged the error is pi.
        """
        starts = [window for window, _, _ in self.windows]
        errors = []
        for q in self.rollouts.positions(candidates, starts, self.edges):
            parts = []
            for played, (_, times, measured) in zip(q, self.windows):
                parts.append(interpolate(times, self.edges, played) - measured)
            errors.append(np.nan_to_num(np.concatenate(parts), nan=np.pi))
        return np.stack(errors)

    def goal_errors(self, delay: float) -> Array:
        """Return commands of ``delay`` [s] before minus measured positions (M, n) [rad]."""
        errors = []
        for window, time, measured in self.windows:
            times = window.start + time - delay
            errors.append(interpolate(times, window.time, window.command) - measured)
        return np.concatenate(errors)


def make_problem(
    rollouts: ServoRollouts,
    pieces: Sequence[Measurement],
    max_windows: int,
    length: float,
    settling_time: float = 0.0,
) -> ServoProblem:
    """Return a problem with the consecutive windows into which pieces of logs are cut.

    Pieces without commands are left out, and so is the beginning of each piece, whose commands and
    positions the first window needs.

    Args:
        rollouts: play the windows.
        pieces: pieces of logs.
        max_windows: largest number of windows; of more, every second one is taken, or every third.
        length: length of a window [s].
        settling_time: beginning of a window in which errors do not count [s].

    Raises:
        InputError: no piece with commands is long enough for one window after its beginning.
    """
    windows = []
    for piece in pieces:
        # Commands before the window act in it, and parabolas need samples before its start.
        lead = max(MAX_DELAY_PERIODS * sampling_period(piece.time), SMOOTHING_TIME)
        starts = np.arange(piece.time[0] + lead, piece.time[-1] - length, length)
        if not len(starts) or piece.command is None:
            continue
        q, qd = smooth_states(piece)
        for k in np.searchsorted(piece.time, starts).tolist():
            start = float(piece.time[k])
            is_late = piece.time > start + settling_time
            counts = is_late & (piece.time <= start + length)
            window = ServoWindow(start, q[k], qd[k], piece.time, piece.command)
            windows.append((window, piece.time[counts] - start, piece.q[counts]))
    if not windows:
        raise InputError(
            f"no piece of the log has commands for {length:g} s; record longer"
        )
    stride = math.ceil(len(windows) / max_windows)
    edges = np.linspace(0.0, length, max(1, round(length / STEP)) + 1)
    return ServoProblem(rollouts, tuple(windows[::stride]), edges)


def smooth_states(piece: Measurement) -> tuple[Array, Array]:
    """Return smoothed positions (N, n) [rad or m] of a piece of a log, and velocities (N, n).

    Both follow from parabolas through the measured positions (Savitzky-Golay filters over
    ``SMOOTHING_TIME``); velocities are in [rad/s or m/s].
    """
    from scipy.signal import savgol_filter

    period = sampling_period(piece.time)
    length = max(5, 2 * round(0.5 * SMOOTHING_TIME / period) + 1)
    qd = savgol_filter(piece.q, length, polyorder=2, deriv=1, delta=period, axis=0)
    return savgol_filter(piece.q, length, polyorder=2, axis=0), qd


def split_pieces(
    pieces: Sequence[Measurement],
) -> tuple[list[Measurement], list[Measurement]]:
    """Return the beginnings of all pieces, to be fitted, and their last fifths, to be held out."""
    fitted = []
    held_out = []
    for piece in pieces:
        index = round((1.0 - HELD_OUT_SHARE) * len(piece))
        fitted.append(slice_samples(piece, 0, index))
        held_out.append(slice_samples(piece, index, len(piece)))
    return fitted, held_out


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
    squares = problem.errors(pair) ** 2
    old, new = np.sqrt(np.mean(squares, axis=1))
    lengths = [len(times) for _, times, _ in problem.windows]
    sums = np.add.reduceat(squares, np.cumsum([0, *lengths[:-1]]), axis=1)
    before, after = sums + FLOOR**2 * np.reshape(lengths, (-1, 1))
    is_worse = [is_clearly_lower(*own) for own in zip(before.T, after.T)]
    horizon = float(problem.edges[-1])
    return RolloutError(horizon, len(lengths), old, new, np.array(is_worse))


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
    for k in np.flatnonzero(np.any([error.is_worse for error in test.errors], axis=0)):
        faults.append(f"{test.joint_names[k]} is predicted worse than before")
    if not faults:
        return None
    return (
        "on held-out pieces the new model does not predict positions better than what is there "
        f"without it ({'; '.join(faults)})"
    )
