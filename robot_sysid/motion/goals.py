"""A motion as the goal positions of servos: a table as a file, and its playback by the clock.

A program that commands servos asks a ``GoalPlayer`` for the goals of the instant, at its own rate.
"""

from __future__ import annotations

import csv
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TextIO

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.motion.trajectories import LineTrajectory
from robot_sysid.records import Array, MotionPlan, RobotModel, check_arrays
from robot_sysid.records.messages import position_unit
from robot_sysid.trajectory import motion_chunks

APPROACH_SPEED = 0.2
"""Mean speed of the fastest joint on the way to the motion and back [rad/s, m/s]: a person has time
to stop an arm that goes where it should not."""
LONGEST_STEP = 0.1
"""Most by which the motion goes on from one call to the next [s]: after a pause of the program it
goes on where it was."""
DIGITS = 6
"""Digits behind the point in a table of goals: of radians, a thousandth of a servo's step."""
# Title of a column of goals.
_TITLE = re.compile(r"(.+) goal position \[(rad|m)\]")
_FORM = (
    'goals.csv, which robot-sysid plan writes for servos, has a column "time" in seconds and '
    'columns such as "elbow goal position [rad]"'
)


@dataclass(frozen=True)
class Goals:
    """Goal positions of n joints at N instants.

    Attributes:
        time: (N,) instants, increasing [s].
        q: (N, n) goal positions [rad or m].
        joint_names: of the columns.
        is_slide: whether each joint is a slide.
    """

    time: Array
    q: Array
    joint_names: tuple[str, ...]
    is_slide: tuple[bool, ...]

    def __post_init__(self) -> None:
        check_arrays(self, time=(None,))
        check_arrays(self, q=(len(self.time), len(self.joint_names)))
        if len(self.time) < 2 or not np.all(np.diff(self.time) > 0.0):
            raise InputError("goals need two rows at least, at times that increase")


def goal_titles(joint_names: Sequence[str], is_slide: Sequence[bool]) -> list[str]:
    """Return the titles of the columns of a table of goals."""
    units = map(position_unit, is_slide)
    named = zip(joint_names, units)
    return ["time", *(f"{name} goal position [{unit}]" for name, unit in named)]


def save_goals(
    file: TextIO, plan: MotionPlan, robot: RobotModel, sample_rate: float
) -> None:
    """Write the goal positions of a motion as CSV, ``sample_rate`` rows per second, and its end."""
    slides = robot.is_slide.tolist()
    last_time = -np.inf
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(goal_titles(robot.joint_names, slides))
    end = plan.evaluate(np.array([plan.duration]))
    for motion in chain(motion_chunks(plan, sample_rate), [end]):
        rows = np.column_stack((motion.time, motion.q))
        # A row at the very end may have been the last sample; adding zero takes the sign of -0.
        is_new = rows[:, 0] > last_time
        writer.writerows((np.round(rows[is_new], DIGITS) + 0.0).tolist())
        last_time = motion.time[-1]


def load_goals(path: Path) -> Goals:
    """Return the goal positions in a file.

    Raises:
        InputError: the file cannot be read, or is no table of goals.
    """
    try:
        with open(path, encoding="utf-8", newline="") as file:
            titles, *rows = csv.reader(file)
            numbers = np.array(rows, dtype=float)
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: no goals of servos ({error}); {_FORM}") from None
    found = [_TITLE.fullmatch(title) for title in titles[1:]]
    columns = [match for match in found if match]
    if titles[:1] != ["time"] or not columns or len(columns) < len(found):
        raise InputError(f"{path}: not the titles of goals; {_FORM}")
    names = tuple(match[1] for match in columns)
    slides = tuple(match[2] == "m" for match in columns)
    try:
        return Goals(numbers[:, 0], numbers[:, 1:], names, slides)
    except (InputError, IndexError) as error:
        raise InputError(f"{path}: {error}; {_FORM}") from None


class GoalPlayer:
    """Plays goals by the clock, from a pose and back to it, however often it is asked.

    It begins with the first call. The way from the start pose to the first goals, and back to it
    from the last ones, is a straight line in joint space, slow and smooth; then the last pose is
    held. The motion follows the clock, but never goes on by more than ``LONGEST_STEP`` from one
    call to the next, so that it does not jump after a pause.

    Args:
        goals: to play.
        start: joint names to positions at which the arm stands [rad or m]; a joint without one
            stands at its first goal.
        speed: factor on the speed of the goals.
        clock: returns the time [s].

    Raises:
        InputError: the speed is not above 0 and at most 1, or a position is no number.
    """

    def __init__(
        self,
        goals: Goals,
        start: Mapping[str, float],
        speed: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not 0.0 < speed <= 1.0:
            raise InputError(
                f"the speed is a factor above 0 and at most 1, not {speed:g}"
            )
        self.goals = goals
        first = dict(zip(goals.joint_names, goals.q[0]))
        pose = np.array([start.get(name, first[name]) for name in goals.joint_names])
        if not np.all(np.isfinite(pose)):
            raise InputError("a position of the start pose is no number")
        self._speed = speed
        self._clock = clock
        self._way_there = LineTrajectory(pose, goals.q[0], APPROACH_SPEED)
        self._way_back = LineTrajectory(goals.q[-1], pose, APPROACH_SPEED)
        self._time = 0.0
        self._n_calls = 0
        self._first_call = self._last_call = 0.0

    @property
    def approach_time(self) -> float:
        """Time from the start pose to the first goals [s]."""
        return self._way_there.duration

    @property
    def motion_time(self) -> float:
        """Time that the goals take [s]."""
        return float(self.goals.time[-1] - self.goals.time[0]) / self._speed

    @property
    def duration(self) -> float:
        """Time of all, with the way there and back [s]."""
        return self.approach_time + self.motion_time + self._way_back.duration

    @property
    def has_ended(self) -> bool:
        """Whether the last pose is held."""
        return self._time >= self.duration

    @property
    def call_rate(self) -> float:
        """How often goals were asked for, on average [Hz]; 0 before the second call."""
        if self._n_calls < 2:
            return 0.0
        return (self._n_calls - 1) / (self._last_call - self._first_call)

    def pose(self) -> Array:
        """Return the goals (n,) of this instant [rad or m]."""
        now = self._clock()
        if self._n_calls:
            self._time += min(max(now - self._last_call, 0.0), LONGEST_STEP)
        else:
            self._first_call = now
        self._last_call = now
        self._n_calls += 1
        in_motion = self._time - self.approach_time
        if in_motion < 0.0:
            return self._way_there.evaluate(np.array([self._time])).q[0]
        if in_motion < self.motion_time:
            instant = self.goals.time[0] + self._speed * in_motion
            columns = self.goals.q.T
            return np.array(
                [np.interp(instant, self.goals.time, column) for column in columns]
            )
        after = np.array([in_motion - self.motion_time])
        return self._way_back.evaluate(after).q[0]
