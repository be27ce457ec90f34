"""The screw kinematics agrees with MuJoCo on any serial chain, and its gradient is exact."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from robot_sysid.design.screws import ScrewChain, bracket, bracket_transposed, exponential
from robot_sysid.errors import AmbiguousJointError
from robot_sysid.kinematics import ChainKinematics
from robot_sysid.surroundings.excitation_problem import screw_chain
from tests import arms
from tests.arms import SEEDS, random_chain, random_motion, robot_of
from tests.excitation_arms import slope


def arm_or_none(xml):
    """RobotModel of a random chain; None where its end is a matter of taste."""
    try:
        return robot_of(xml)
    except AmbiguousJointError:
        return None


@given(random_chain(), SEEDS)
def test_equals_mujoco(xml, seed):
    robot = arm_or_none(xml)
    if robot is None:
        return
    q, qd, qdd = random_motion(np.random.default_rng(seed), robot.n_joints, 5)
    ours = screw_chain(robot).evaluate(q, qd, qdd)
    theirs = ChainKinematics(robot).evaluate(q, qd, qdd)
    for mine, yours in (
        (ours.jacobian.transpose(2, 0, 1), theirs.jacobian),
        (ours.velocity.T, theirs.velocity),
        (ours.acceleration.T, theirs.acceleration),
    ):
        assert np.max(np.abs(mine - yours)) < 1e-10 * max(1.0, np.max(np.abs(yours)))


@pytest.mark.parametrize("xml", [arms.SEVEN, arms.SLIDE_IN_CHAIN, arms.SHARED_BODIES])
def test_gradient_equals_differences(xml):
    robot = robot_of(xml)
    rng = np.random.default_rng(3)
    chain, n = screw_chain(robot), robot.n_joints
    motion, direction = rng.normal(size=(3, 4, n)), rng.normal(size=(3, 4, n))
    bars = rng.normal(size=(6, n, 4)), rng.normal(size=(6, 4)), rng.normal(size=(6, 4))

    def scalar(at):
        out = chain.evaluate(*at)
        return sum(
            np.sum(bar * value)
            for bar, value in zip(bars, (out.jacobian, out.velocity, out.acceleration))
        )

    gradient = chain.evaluate(*motion).pull_back(*bars)
    exact = sum(np.sum(g * d) for g, d in zip(gradient, direction))
    assert exact == pytest.approx(slope(scalar, motion, direction), rel=1e-7)


@given(SEEDS)
def test_bracket_is_antisymmetric_and_its_transpose_is_adjoint(seed):
    a, b, c = np.random.default_rng(seed).normal(size=(3, 6))
    assert np.allclose(bracket(a, b), -bracket(b, a), atol=1e-12)
    assert np.dot(bracket(a, b), c) == pytest.approx(np.dot(b, bracket_transposed(a, c)), abs=1e-10)


@given(SEEDS)
def test_exponential_is_a_rigid_motion_and_adds_up(seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    twist = np.concatenate((axis / np.linalg.norm(axis), rng.normal(size=3)))
    one, two, both = (exponential(twist, np.array([a])) for a in (0.4, 0.9, 1.3))
    rotation, position = (np.squeeze(v) for v in both)
    first, second = np.squeeze(one[0]), np.squeeze(two[0])
    assert np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.allclose(first @ second, rotation, atol=1e-12)
    assert np.allclose(first @ two[1][:, 0] + one[1][:, 0], position, atol=1e-12)


def test_at_home_the_jacobian_is_the_screws():
    screws = np.random.default_rng(0).normal(size=(6, 3))
    screws[:3] /= np.linalg.norm(screws[:3], axis=0)
    home = np.array([0.1, 0.2, 0.3])
    chain = ScrewChain(screws, home, np.array([0.0, 0.0, -9.81]))
    still = np.zeros((1, 3))
    motion = chain.evaluate(home[None], still, still)
    assert np.allclose(motion.jacobian[..., 0], screws, atol=1e-14)
    assert np.allclose(motion.acceleration[:, 0], [0, 0, 0, 0, 0, 9.81], atol=1e-14)
