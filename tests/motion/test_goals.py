"""Goal positions of servos: their file, and their playback by the clock."""

import io
from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms import small_arms
from rigs.logs.log_files import open_log
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.motion.goals import (
    APPROACH_SPEED,
    DIGITS,
    LONGEST_STEP,
    GoalPlayer,
    Goals,
    load_goals,
    save_goals,
)
from robot_sysid.motion.trajectories import LineTrajectory
from robot_sysid.parser import load_robot_model

NAMES = ("lift", "roll")
TIME = np.arange(61) / 30.0
GOALS = Goals(
    TIME, 0.3 + np.outer(np.sin(3.0 * TIME), [0.5, -0.2]), NAMES, (False, False)
)
START = {"lift": -0.4}
PEAK_SPEED = 35.0 / 16.0
"""Highest speed of a line over its mean."""


class Clock:
    """A clock that passes given times, one a call."""

    def __init__(self, times):
        self._times = iter(times)

    def __call__(self):
        return next(self._times)


def played(times, **options):
    """Return the poses (N, 2) at calls at some times (N,), and the player."""
    player = GoalPlayer(GOALS, START, clock=Clock(times), **options)
    return np.array([player.pose() for _ in times]), player


def test_goals_survive_their_file_and_end_where_the_motion_ends(arm_file, tmp_path):
    robot = load_robot_model(arm_file(small_arms.serial_arm()))
    plan = LineTrajectory(np.zeros(robot.n_joints), np.full(robot.n_joints, 1.0312))
    for rate, rows in ((30.0, 32), (50.0, 53), (100.0, 105)):
        path = tmp_path / "goals.csv"
        with open(path, "w", encoding="utf-8") as file:
            save_goals(file, plan, robot, rate)
        goals = load_goals(path)
        assert goals.joint_names == robot.joint_names and len(goals.time) == rows
        expected = plan.evaluate(goals.time).q
        assert_allclose(goals.q, expected, atol=2.5 * 10.0**-DIGITS)
        assert_allclose(goals.time[-1], plan.duration, atol=10.0**-DIGITS)
        assert_allclose(np.diff(goals.time)[:-1], 1.0 / rate, atol=2e-6)


def test_a_recording_under_the_titles_of_goals_is_read(arm_file, tmp_path):
    """Goals beside measured positions are commands, without any option."""
    robot = load_robot_model(arm_file(small_arms.serial_arm()))
    file = io.StringIO()
    plan = LineTrajectory(
        np.zeros(robot.n_joints), np.linspace(3.0, 1.0, robot.n_joints)
    )
    save_goals(file, plan, robot, 50.0)
    titles, *rows = file.getvalue().splitlines()
    names = [f"{name} position [rad]" for name in robot.joint_names]
    lines = [",".join([titles, *names])]
    lines += [",".join([row, *row.split(",")[1:]]) for row in rows]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    recording = open_log(robot, path, LogOptions(commanded=True))
    assert_allclose(recording.command, recording.q, atol=1e-12)
    assert np.ptp(recording.q[:, 0]) > 2.0


@given(st.lists(st.floats(0.0, 0.3), min_size=1, max_size=300), st.floats(0.2, 1.0))
def test_no_call_however_late_makes_a_jump(steps, speed):
    """Goals move on with the clock, from the start pose on, and by 0.1 s at most."""
    times = [5.0, *accumulate(steps, initial=5.0)]
    poses, player = played(times, speed=speed)
    assert_allclose(poses[0], [START["lift"], GOALS.q[0, 1]], atol=1e-12)
    fastest = max(PEAK_SPEED * APPROACH_SPEED, speed * 1.5)
    moved = np.max(np.abs(np.diff(poses, axis=0)), axis=1)
    passed = np.minimum(np.diff(times), LONGEST_STEP)
    assert np.all(moved <= fastest * passed + 1e-9)


def test_the_motion_is_played_between_two_slow_ways_and_the_last_pose_is_held():
    times = 7.0 + np.arange(1200) / 60.0
    poses, player = played(times)
    begin = player.approach_time
    assert begin == pytest.approx(0.7 / APPROACH_SPEED)
    instants = times - times[0] - begin
    inside = (instants >= 0.0) & (instants < TIME[-1])
    columns = [np.interp(instants[inside], TIME, column) for column in GOALS.q.T]
    assert_allclose(poses[inside], np.transpose(columns), atol=1e-9)
    assert player.has_ended
    assert_array_equal(poses[-1], poses[-60])
    assert_allclose(poses[-1], poses[0], atol=1e-12)
    assert player.call_rate == pytest.approx(60.0)


def test_after_a_pause_it_goes_on_where_it_was():
    before = np.arange(150) / 30.0
    pause = 20.0
    poses, _ = played([*before, *(before + before[-1] + pause)])
    through, _ = played(np.arange(300) / 30.0)
    assert_array_equal(poses[:150], through[:150])
    skipped = np.max(np.abs(poses[150] - poses[149]))
    assert skipped <= 1.5 * LONGEST_STEP


@pytest.mark.parametrize("speed", [0.0, -1.0, 1.1, float("nan")])
def test_a_speed_above_that_of_the_plan_is_refused(speed):
    with pytest.raises(InputError, match="factor above 0 and at most 1"):
        GoalPlayer(GOALS, START, speed)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no goals of servos"),
        ("time,q1\n0,1\n1,2\n", "not the titles of goals"),
        ("time,a goal position [deg]\n0,1\n1,2\n", "not the titles of goals"),
        ("time,a goal position [rad]\n0,x\n1,2\n", "no goals of servos"),
        ("time,a goal position [rad]\n0,1\n", "two rows at least"),
        ("time,a goal position [rad]\n1,1\n1,2\n", "times that increase"),
        ("time,a goal position [rad]\n0,nan\n1,2\n", "not finite"),
        ("time,a goal position [rad]\n0,1,2\n1,2\n", "no goals of servos"),
        ("time,a goal position [rad]\n", "goals.csv, which robot-sysid plan"),
    ],
)
def test_files_that_are_no_goals_are_refused(tmp_path, text, message):
    path = tmp_path / "goals.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        load_goals(path)
    with pytest.raises(InputError, match="no goals of servos"):
        load_goals(tmp_path / "missing.csv")
