"""The predicted information equals what the identification itself collects."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.equations import Equations
from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.dynamics.kinematics import ChainKinematics
from robot_sysid.errors import AmbiguousJointError
from robot_sysid.motion.information import PredictedInformation
from robot_sysid.motion.problem import screw_chain
from robot_sysid.records import Measurement
from tests.support import arms
from tests.support.arms import SEEDS, random_chain, random_motion, robot_of
from tests.support.excitation_arms import slope

NUISANCES = {
    False: FrictionModel(("coulomb", "viscous", "offset")),
    True: FrictionModel(("coulomb", "viscous", "offset", "armature")),
}
SAMPLES = 60


def predicted(robot, smoothing=0.0, rows=None, coordinates=None, rotors=False):
    n = robot.n_joints
    rows = tuple(range(n)) if rows is None else rows
    eye = np.eye(10) if coordinates is None else coordinates
    sigma, smooth = np.linspace(0.5, 2.0, len(rows)), np.full(n, smoothing)
    return PredictedInformation(screw_chain(robot), rows, sigma, smooth, eye, rotors)


def eliminated_by_hand(robot, motion, torques, sigma, rotors=False):
    """Information of theta from the tool's own equations, nuisances removed by least squares."""
    equations = Equations(robot, torques, (NUISANCES[rotors],) * robot.n_joints)
    q, qd, qdd = motion
    data = Measurement(np.arange(float(len(q))), q, qd, np.zeros_like(q), qdd)
    total = np.zeros((10, 10))
    for (rows, _), s in zip(equations.rows(data), sigma):
        own, nuisance = rows[:, :10] / s, rows[:, 10:]
        left = own - nuisance @ np.linalg.lstsq(nuisance, own, rcond=None)[0]
        total += left.T @ left
    return total


@pytest.mark.parametrize("rotors", [False, True])
@pytest.mark.parametrize("torques", ["chain", "terminal"])
@pytest.mark.parametrize("xml", [arms.SEVEN, arms.SLIDE_IN_CHAIN, arms.SHARED_BODIES])
def test_equals_the_schur_complement_of_the_tools_equations(xml, torques, rotors):
    robot = robot_of(xml)
    motion = random_motion(np.random.default_rng(0), robot.n_joints, SAMPLES)
    rows = None if torques == "chain" else (robot.n_joints - 1,)
    chosen = predicted(robot, rows=rows, rotors=rotors)
    ours = chosen.evaluate(*motion).information
    theirs = eliminated_by_hand(robot, motion, torques, chosen.sigma, rotors)
    assert np.max(np.abs(ours - theirs)) < 1e-8 * np.max(np.abs(theirs))


@pytest.mark.slow
@given(SEEDS, st.floats(0.05, 1.0), st.booleans())
def test_gradient_equals_differences(seed, smoothing, rotors):
    robot, rng = robot_of(arms.THREE), np.random.default_rng(seed)
    coordinates = rng.normal(size=(10, 4))
    information = predicted(robot, smoothing, coordinates=coordinates, rotors=rotors)
    motion, direction = rng.normal(size=(2, 3, 12, 3))
    weight = rng.normal(size=(4, 4))
    weight += weight.T
    gradient = information.evaluate(*motion).vjp(weight)
    exact = sum(np.sum(g * d) for g, d in zip(gradient, direction))
    size = sum(np.sum(np.abs(g * d)) for g, d in zip(gradient, direction))
    value = slope(
        lambda at: np.sum(weight * information.evaluate(*at).information), motion, direction, 1e-5
    )
    assert value == pytest.approx(exact, abs=1e-5 * size)


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
