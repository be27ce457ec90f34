"""Playing a log: a perfect model makes no error, in open and closed loop; a wrong one does."""

import numpy as np
import pytest

from robot_sysid.records import Measurement
from robot_sysid.simulation import playback
from tests.support.arms import SEVEN, X, Y, Z, robot_of, serial_arm

JOINT = 'range="-2.5 2.5" armature="{}" damping="3" frictionloss=".5"'
SECONDS = 1.2


def arm(armature=0.2):
    return robot_of(serial_arm((Z, Y, X), joint=JOINT.format(armature)))


def recording(robot):
    """What an arm does under smooth torques, every step of it."""
    steps = round(SECONDS / playback.STEP)
    time = playback.STEP * np.arange(steps + 1)
    torque = 6.0 * np.sin(np.outer(time[:-1] + 0.5 * playback.STEP, [3.0, 4.0, 5.0]))
    start = np.array([[0.1, -0.2, 0.3]])
    q = playback.Roller(robot, playback.rollout_copy(robot, playback.STEP))(
        playback.Inputs(start, 0.0 * start, torque[None])
    )[0]
    q = np.vstack((start, q))
    qd = np.vstack((0.0 * start, np.diff(q, axis=0) / playback.STEP))
    return Measurement(time, q, qd, np.vstack((torque, torque[-1:])))


@pytest.mark.parametrize("closed", [False, True])
def test_the_arm_itself_makes_no_error_and_another_one_does(closed):
    robot = arm()
    other = arm(0.5)
    piece = recording(robot)
    windows = playback.starts([piece], 0.3)
    assert len(windows) == 4
    servo = playback.stated_servo((robot, other), [piece]) if closed else None
    own, _ = playback.played(robot, windows, 0.3, servo)
    wrong, away = playback.played(other, windows, 0.3, servo)
    # Torques are interpolated, so the first steps of a window are not quite the arm's.
    assert np.max(own) < (2e-4 if closed else 1e-3)
    assert np.all(wrong > 5.0 * own)
    assert away == 0


def test_an_error_that_runs_away_counts_with_the_largest_one():
    robot = arm()
    piece = recording(robot)
    wild = Measurement(piece.time, piece.q, piece.qd, 1e6 * np.ones_like(piece.tau))
    error, away = playback.played(robot, playback.starts([wild], 1.0), 1.0, None)
    assert away == 1
    assert np.all(error <= np.pi + 1e-12)


STEPS = 30
COUNT = 4


def inputs(robot, seed=0):
    rng = np.random.default_rng(seed)
    shape = (COUNT, robot.n_joints)
    torque = rng.normal(0.0, 5.0, (COUNT, STEPS, robot.n_joints))
    return playback.Inputs(
        rng.uniform(-1.0, 1.0, shape), rng.normal(size=shape), torque
    )


def test_rollouts_on_threads_are_the_same_as_single_steps(monkeypatch):
    robot = robot_of(SEVEN)
    model = playback.rollout_copy(robot, 0.002)
    threads = playback.Roller(robot, model)
    monkeypatch.setattr(playback, "_has_threads", lambda: False)
    steps = playback.Roller(robot, model)
    for armature in (0.0, 0.3):
        # Its numbers may change between calls.
        model.dof_armature[:] = armature
        np.testing.assert_array_equal(threads(inputs(robot)), steps(inputs(robot)))


def test_a_rollout_that_diverges_ends_there_and_disturbs_no_other(monkeypatch):
    robot = robot_of(SEVEN)
    model = playback.rollout_copy(robot, 0.002)
    usual = inputs(robot)
    whole = playback.Roller(robot, model)(usual)
    torque = usual.torque.copy()
    torque[1, 10:] = 1e15
    for has_threads in (playback._has_threads(), False):
        monkeypatch.setattr(playback, "_has_threads", lambda has=has_threads: has)
        found = playback.Roller(robot, model)(
            playback.Inputs(usual.q, usual.qd, torque)
        )
        np.testing.assert_array_equal(found[[0, 2, 3]], whole[[0, 2, 3]])
        np.testing.assert_array_equal(found[1, :10], whole[1, :10])
        assert np.all(np.isnan(found[1, 13:]))
