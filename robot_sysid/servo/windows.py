"""Windows of an arm's logs, played with a model's servos: how far off are the positions?

n is the number of joints, M the number of samples in all windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Array, Measurement
from robot_sysid.results.prediction import split_time
from robot_sysid.signals.resampling import sampling_period, slice_samples
from robot_sysid.simulation.playback import (
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
        _, times, measured = zip(*self.windows)
        # Index of each sample's window, and of the step before it.
        window = np.repeat(np.arange(len(times)), list(map(len, times)))
        # The rollout is interpolated linearly between its steps.
        step_count = np.concatenate(times) / (self.edges[1] - self.edges[0])
        step = np.minimum(step_count.astype(int), len(self.edges) - 2)
        fraction = (step_count - step)[:, None]
        target = np.concatenate(measured)
        errors = []
        for q in self.rollouts.positions(candidates, starts, self.edges):
            played = (1.0 - fraction) * q[window, step] + fraction * q[window, step + 1]
            errors.append(np.nan_to_num(played - target, nan=np.pi))
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
        max_windows: largest number of windows; if there are more, so many are taken, spread evenly.
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
    count = min(len(windows), max_windows)
    chosen = np.linspace(0, len(windows) - 1, count).round().astype(int).tolist()
    edges = np.linspace(0.0, length, max(1, round(length / STEP)) + 1)
    return ServoProblem(rollouts, tuple(windows[k] for k in chosen), edges)


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
        index = int(np.searchsorted(piece.time, split_time(piece), "right"))
        fitted.append(slice_samples(piece, 0, index))
        held_out.append(slice_samples(piece, index, len(piece)))
    return fitted, held_out
