"""Rollouts: many at a time are what single steps are, and one that diverges says so."""

import numpy as np

from robot_sysid.simulation.rollout import batch
from robot_sysid.simulation.rollout.batch import Inputs, roll, rollout_copy
from tests.support.arms import SEVEN, robot_of

STEPS, COUNT = 30, 4


def inputs(robot, seed=0):
    rng = np.random.default_rng(seed)
    shape = (COUNT, robot.n_joints)
    torque = rng.normal(0.0, 5.0, (COUNT, STEPS, robot.n_joints))
    return Inputs(rng.uniform(-1.0, 1.0, shape), rng.normal(size=shape), torque)


def test_rollouts_on_threads_are_the_same_as_single_steps(monkeypatch):
    robot = robot_of(SEVEN)
    models = [rollout_copy(robot, 0.002) for _ in range(COUNT)]
    for number, model in enumerate(models):
        model.dof_armature[:] = 0.1 * number
    threads = roll(robot, models, inputs(robot))
    monkeypatch.setattr(batch, "_has_threads", lambda: False)
    np.testing.assert_array_equal(threads, roll(robot, models, inputs(robot)))


def test_few_at_a_time_are_the_same_as_all_at_once(monkeypatch):
    robot = robot_of(SEVEN)
    models = [rollout_copy(robot, 0.002)] * COUNT
    whole = roll(robot, models, inputs(robot))
    monkeypatch.setattr(batch, "MOST_NUMBERS", 1)
    np.testing.assert_array_equal(roll(robot, models, inputs(robot)), whole)


def test_a_rollout_that_diverges_ends_there_and_disturbs_no_other(monkeypatch):
    robot = robot_of(SEVEN)
    models = [rollout_copy(robot, 0.002)] * COUNT
    usual = inputs(robot)
    whole = roll(robot, models, usual)
    torque = usual.torque.copy()
    torque[1, 10:] = 1e15
    for has_threads in (batch._has_threads(), False):
        monkeypatch.setattr(batch, "_has_threads", lambda has=has_threads: has)
        found = roll(robot, models, Inputs(usual.q, usual.qd, torque))
        np.testing.assert_array_equal(found[[0, 2, 3]], whole[[0, 2, 3]])
        np.testing.assert_array_equal(found[1, :10], whole[1, :10])
        assert np.all(np.isnan(found[1, 13:]))
