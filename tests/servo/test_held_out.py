"""Blocks that are held out: every sample is on one side, and every joint on both."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rigs.arms.small_arms import robot_of
from rigs.logs import servo_logs
from robot_sysid.records import Recording
from robot_sysid.records.servo_setting import UNKNOWN
from robot_sysid.servo.held_out import LEAST_BLOCK, SHARE, hold_out
from robot_sysid.servo.loop import stretches
from robot_sysid.servo.play import make_tracks
from robot_sysid.servo.windows import ServoProblem

RATE = 50.0


def log_of(seconds, joints=2):
    """A log in which one joint moves after the other."""
    time = np.arange(round(seconds * RATE)) / RATE
    own = np.floor(time * joints / seconds).astype(int)
    command = np.sin(3.0 * time)[:, None] * (own[:, None] == np.arange(joints))
    q = 0.9 * command
    return Recording(time, q, None, command - q, command=command)


@pytest.mark.parametrize("seconds", [3.0, 6.0, 40.0, 300.0])
def test_each_sample_is_fitted_or_judges(seconds):
    piece = log_of(seconds)
    fitted, held_out = hold_out(piece)
    assert_array_equal(fitted.is_left_out, ~held_out.is_left_out)
    assert np.mean(fitted.is_left_out) == pytest.approx(SHARE, abs=0.02)
    # Commands are those of the whole log.
    assert_array_equal(fitted.command, piece.command)
    assert_array_equal(held_out.command, piece.command)
    for rows in stretches(held_out):
        block = np.ptp(piece.time[rows])
        assert block > min(0.95 * LEAST_BLOCK, 0.9 * SHARE * seconds)
    assert not fitted.is_left_out[0] and not fitted.is_left_out[-1]


@pytest.mark.parametrize("joints", [2, 5, 7])
def test_of_one_joint_after_the_other_each_moves_in_what_is_fitted(joints):
    piece = log_of(40.0, joints)
    fitted, _ = hold_out(piece)
    used = ~fitted.is_left_out
    for joint in range(joints):
        is_moving = np.abs(piece.q[:, joint]) > 0.0
        assert np.mean(used[is_moving]) > 0.4
        assert np.ptp(piece.q[used, joint]) > 1.0


def test_samples_that_were_left_out_judge_nothing_and_are_not_fitted():
    piece = log_of(40.0)
    hole = np.zeros(len(piece))
    hole[100:130] = np.inf
    marked = Recording(
        piece.time, piece.q, None, piece.tau, command=piece.command, hole=hole
    )
    for part in hold_out(marked):
        assert np.all(part.is_left_out[100:130])


def test_no_window_has_a_sample_of_the_other_side():
    robot = robot_of(servo_logs.XML)
    piece = log_of(40.0)
    fitted, held_out = hold_out(piece)
    tracks = make_tracks(robot, [fitted], 3.0, 60)
    expected = sum(len(range(*rows.indices(len(piece)))) for rows in stretches(fitted))
    # A sample at the end of a window begins the next one.
    shared = len(tracks) // 2 - len(stretches(fitted))
    assert np.sum(tracks.is_sample[tracks.joint == 0]) == expected + shared
    problem = ServoProblem(robot, [held_out], UNKNOWN)
    judged = np.concatenate(
        [window.start + times for window, times in zip(problem.windows, problem.times)]
    )
    assert np.all(np.isin(np.round(judged * RATE), np.flatnonzero(fitted.is_left_out)))
    # Commands before a block act in it.
    assert_allclose(problem.windows[0].command, piece.command)
