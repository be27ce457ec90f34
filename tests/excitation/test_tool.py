"""The fastest point of the tool, and what a load at its tip takes of the joints."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.excitation.tool import LoadedTorque, Tool
from robot_sysid.records import Motion
from robot_sysid.simulator import ArmTorque
from tests.support import arms
from tests.support.arms import SEEDS, robot_of
from tests.support.excitation_arms import TUBES, problem, robot, slope

SOME = Tool(np.random.default_rng(0).normal(size=(7, 3)), np.array([0.0, 0.0, 0.3, 0, 0.1, 0, 0]))


def twists(seed, count=5):
    return np.random.default_rng(seed).normal(size=(6, count))


@given(SEEDS)
def test_no_point_of_the_tool_is_faster(seed):
    """Points inside the hull of the balls, by v + w x p."""
    rng, twist = np.random.default_rng(seed), twists(seed)
    share = rng.dirichlet(np.ones(7), size=50)
    away = rng.normal(size=(50, 7, 3))
    away *= SOME.radius[:, None] / np.linalg.norm(away, axis=2, keepdims=True)
    inside = np.einsum("sp,spi->si", share, SOME.points + away)
    for w, v, fastest in zip(twist[:3].T, twist[3:].T, SOME.speed(twist)):
        assert np.max(np.linalg.norm(v + np.cross(w, inside), axis=1)) <= fastest + 1e-12


@given(SEEDS)
def test_the_gradient_of_the_speed_equals_differences(seed):
    twist, direction, weight = twists(seed), twists(seed + 1), np.arange(5.0)
    exact = np.sum(SOME.speed_vjp(twist, weight) * direction)
    found = slope(lambda at: np.sum(weight * SOME.speed(at)), twist, direction)
    assert found == pytest.approx(exact, rel=1e-5, abs=1e-5)


def test_the_tip_is_the_farthest_point():
    far = Tool(np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.2]]), np.array([0.3, 0.05]))
    np.testing.assert_allclose(far.tip, [0.4, 0.0, 0.0])
    # The last tube of this arm ends 0.2 m from its joint, in a ball of 3 cm.
    np.testing.assert_allclose(problem(TUBES).tool.tip, [0.0, 0.0, 0.23], atol=1e-12)


def moving(joints, seed, count=6):
    q, qd, qdd = np.random.default_rng(seed).normal(size=(3, count, joints))
    return Motion(np.arange(float(count)), q, qd, qdd)


def with_load(arm, mass, tip):
    """The arm with a point mass at a place of its last body."""
    model = copy.copy(arm.mj_model)
    from robot_sysid.dynamics import spatial

    load = spatial.theta_from_com(mass, tip, np.zeros((3, 3)))
    arms.write_body(model, arm.body_id, arm.prior.theta + load)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return robot_of(model)


@given(SEEDS, st.floats(0.1, 5.0))
def test_a_load_takes_the_torque_that_its_weight_and_inertia_need(seed, mass):
    arm, some = robot(arms.SEVEN), problem(arms.SEVEN)
    motion = moving(7, seed)
    more = mass * some.torque.per_kilogram(motion)
    loaded = ArmTorque(with_load(arm, mass, some.tool.tip))(motion)
    np.testing.assert_allclose(some.torque(motion) + more, loaded, rtol=1e-7, atol=1e-7)


@given(SEEDS, st.floats(0.0, 3.0))
def test_the_torque_with_a_reserve_covers_every_load_up_to_it(seed, share):
    some = problem(arms.SEVEN)
    motion, plain = moving(7, seed), some.torque
    reserved = LoadedTorque(plain.arm, plain.chain, plain.tip, 3.0)
    loaded = plain(motion) + share * plain.per_kilogram(motion)
    assert np.all(np.abs(loaded) <= np.abs(reserved(motion)) + 1e-12)


@given(SEEDS)
def test_the_load_that_is_left_just_fills_one_joint(seed):
    some = problem(arms.SEVEN)
    motion, torque = moving(7, seed), some.torque
    limit = 1.5 * np.max(np.abs(torque(motion)), axis=0)
    left, joint = torque.load_left(motion, limit)
    share = np.max(np.abs(torque(motion) + left * torque.per_kilogram(motion)), axis=0) / limit
    assert left > 0.0
    assert share[joint] == pytest.approx(1.0, rel=1e-9) and np.max(share) <= 1.0 + 1e-9


def test_without_limits_any_load_is_carried_and_beyond_them_none():
    some = problem(arms.SEVEN)
    motion = moving(7, 0)
    assert some.torque.load_left(motion, np.full(7, np.inf))[0] == np.inf
    assert some.torque.load_left(motion, np.full(7, 1e-3))[0] < 0.0
