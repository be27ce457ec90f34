"""Windows of an arm's logs, played with a model's servos: how far off are the positions?

Played are windows that are fitted, and held-out ones, by the servos before and after: the
judgement of what is written. A model that predicts positions no better than "position equals the
command of some time before" is of no use, however much better than the model before it is.

n is the number of joints, W that of windows, m that of samples in each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.estimate.held_out import is_clearly_lower
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.records.servo_setting import ServoSetting
from robot_sysid.servo.loop import commands, longest_period, low_pass_motion, stretches
from robot_sysid.servo.setting import loaded, with_setting
from robot_sysid.signals.resampling import sampling_period
from robot_sysid.simulation.playback import (
    MAX_WINDOWS,
    STEP,
    ServoParameters,
    ServoRollouts,
    ServoWindow,
    interpolate,
)

WINDOW = 5.0
"""Length of a window [s]; shorter where a piece of a log is."""
LEAST_WINDOW = 0.1
"""Length of a window below which a model is not judged [s]."""
BEGINNING = 0.2
"""Least time at the beginning of a piece that is not played [s]: commands before it act there, late
by the delay and by what a servo takes to follow."""
FOLLOWING = 0.05
"""Time beyond the delay in which a servo follows most of a command [s]."""
HIDDEN = 5e-4
"""Position error that no encoder shows [rad or m]: a third of a step of 4096 a turn."""


class ServoProblem:
    """Windows of logs and the position errors of rollouts in them.

    Stretches of logs are cut into consecutive windows, all as long as ``WINDOW`` or as the shortest
    stretch. The beginning of each piece is left out: commands before a window act in it. Of more
    than ``MAX_WINDOWS`` every second one is taken, or every third.

    Args:
        robot: the arm as in the model file.
        pieces: of logs, which have commands.
        first: setting of the recording whose gains servo parameters are.
        delay: of the commands, as far as it is known [s].

    Attributes:
        robot: as given.
        length: of the windows [s].
        windows: start and commands of each window.
        times: (W, m) of the samples since the start of their window [s].
        measured: (W, m, n) positions measured then [rad or m].

    Raises InputError where a stretch is too short for one window after its beginning.
    """

    def __init__(
        self,
        robot: RobotModel,
        pieces: Sequence[Recording],
        first: ServoSetting,
        delay: float = 0.0,
    ) -> None:
        self.robot = robot
        self._first = first
        unplayed = max(BEGINNING, delay + FOLLOWING)
        played = []
        for piece in pieces:
            beginning = round(unplayed / sampling_period(piece.time))
            _, qd, _ = low_pass_motion(piece)
            for rows in stretches(piece):
                first_row = min(max(rows.start, beginning), rows.stop - 1)
                played.append((piece, qd, slice(first_row, rows.stop)))
        lengths = [np.ptp(piece.time[rows]) for piece, _, rows in played]
        self.length = min(WINDOW, float(min(lengths)))
        if self.length < LEAST_WINDOW:
            raise InputError(
                "a log, or what is held out of it to judge the result, has only "
                f"{self.length:.2g} s after its beginning, and needs {LEAST_WINDOW:g} s; record "
                "longer"
            )
        # Samples may come faster than on average.
        fewest = min(rows.stop - rows.start for *_, rows in played) - 1
        count = min(int(self.length / longest_period(pieces)), fewest)
        cut = []
        for piece, qd, rows in played:
            for begin in range(rows.start, rows.stop - count, count):
                at = slice(begin, begin + count)
                start = piece.time[begin]
                window = ServoWindow(
                    start, piece.q[begin], qd[begin], piece.time, commands(piece)
                )
                cut.append((window, piece.time[at] - start, piece.q[at], piece.setting))
        cut = cut[:: math.ceil(len(cut) / MAX_WINDOWS)]
        self.windows, times, measured, settings = zip(*cut)
        self.times = np.array(times)
        self.measured = np.array(measured)
        self._of_setting = {
            setting: np.flatnonzero([setting == other for other in settings])
            for setting in dict.fromkeys(settings)
        }
        self._rollouts = {
            setting: ServoRollouts(loaded(robot, setting))
            for setting in self._of_setting
        }

    def errors(self, servos: ServoParameters, step: float = STEP) -> Array:
        """Return played minus measured positions (W, m, n), pi where a rollout has diverged.

        Args:
            servos: the servo parameters, with the first recording's setting.
            step: time step of the rollouts [s].
        """
        # Windows over lost samples are longer than others.
        edges = np.arange(0.0, np.max(self.times) + step, step)
        played = np.empty_like(self.measured)
        for setting, chosen in self._of_setting.items():
            own = with_setting(servos, setting, self._first)
            windows = [self.windows[k] for k in chosen]
            q = self._rollouts[setting].positions(own, windows, edges)
            for k, of_window in zip(chosen.tolist(), q):
                played[k] = interpolate(self.times[k], edges, of_window)
        return np.nan_to_num(played - self.measured, nan=np.pi)

    def test(
        self, before: ServoParameters, after: ServoParameters, step: float = STEP
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return what two sets of servo parameters miss.

        They are each joint's root mean square errors (n,) before and after, and whether those after
        are clearly larger, window by window (n,).

        Args:
            before, after: the two sets.
            step: time step of the rollouts [s].
        """
        both = (self.errors(servos, step) for servos in (before, after))
        old, new = (np.mean(errors**2, axis=1) for errors in both)
        hidden = HIDDEN**2
        pairs = zip(old.T + hidden, new.T + hidden)
        is_worse = np.array([is_clearly_lower(*pair) for pair in pairs])
        return np.sqrt(np.mean(old, axis=0)), np.sqrt(np.mean(new, axis=0)), is_worse
