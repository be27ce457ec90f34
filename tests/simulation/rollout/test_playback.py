"""Playing a log: a perfect model makes no error, in open and closed loop; a wrong one does."""

import numpy as np
import pytest

from robot_sysid.simulation.rollout.batch import Inputs, roll, rollout_copy
from robot_sysid.simulation.rollout.playback import STEP, Piece, played, starts, stated_servo
from tests.support.arms import X, Y, Z, robot_of, serial_arm

JOINT = 'range="-2.5 2.5" armature="{}" damping="3" frictionloss=".5"'
SECONDS = 1.2


def arm(armature=0.2):
    return robot_of(serial_arm((Z, Y, X), joint=JOINT.format(armature)))


def recording(robot):
    """What an arm does under smooth torques, every step of it."""
    steps = round(SECONDS / STEP)
    time = STEP * np.arange(steps + 1)
    torque = 6.0 * np.sin(np.outer(time[:-1] + 0.5 * STEP, [3.0, 4.0, 5.0]))
    start = np.array([[0.1, -0.2, 0.3]])
    q = roll(robot, [rollout_copy(robot, STEP)], Inputs(start, 0.0 * start, torque[None]))[0]
    q = np.vstack((start, q))
    qd = np.vstack((0.0 * start, np.diff(q, axis=0) / STEP))
    return Piece(time, q, qd, np.vstack((torque, torque[-1:])))


@pytest.mark.parametrize("closed", [False, True])
def test_the_arm_itself_makes_no_error_and_another_one_does(closed):
    robot, other = arm(), arm(0.5)
    piece = recording(robot)
    windows = starts([piece], 0.3)
    assert len(windows) == 4
    servo = stated_servo((robot, other), [piece]) if closed else None
    own, _ = played(robot, windows, 0.3, servo)
    wrong, away = played(other, windows, 0.3, servo)
    # Torques are interpolated, so the first steps of a window are not quite the arm's.
    assert np.max(own) < 1e-3
    assert np.all(wrong > 5.0 * own)
    assert away == 0


def test_an_error_that_runs_away_counts_with_the_largest_one():
    robot = arm()
    piece = recording(robot)
    wild = Piece(piece.time, piece.q, piece.qd, 1e6 * np.ones_like(piece.tau))
    error, away = played(robot, starts([wild], 1.0), 1.0, None)
    assert away == 1
    assert np.all(error <= np.pi + 1e-12)


def test_a_piece_has_no_window_that_is_longer():
    piece = recording(arm())
    assert starts([piece], 1.3) == []
    assert len(starts([piece, piece], 0.1)) == 24
