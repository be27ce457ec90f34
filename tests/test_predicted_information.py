"""The predicted information equals what the identification itself collects."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.collection import Equations
from robot_sysid.design.predicted_information import PredictedInformation, RowSettings
from robot_sysid.friction import FrictionModel
from robot_sysid.records import Measurement
from robot_sysid.surroundings.excitation_problem import screw_chain
from tests import arms
from tests.arms import SEEDS, random_motion, robot_of
from tests.excitation_arms import slope

NUISANCES = FrictionModel(("coulomb", "viscous", "offset"))
SAMPLES = 60


def settings_for(n, smoothing=0.0, rows=None, coordinates=None):
    rows = tuple(range(n)) if rows is None else rows
    eye = np.eye(10) if coordinates is None else coordinates
    return RowSettings(rows, np.linspace(0.5, 2.0, len(rows)), np.full(n, smoothing), eye)


def eliminated_by_hand(robot, motion, torques, sigma):
    """Information of theta from the tool's own equations, nuisances removed by least squares."""
    equations = Equations(robot, torques, (NUISANCES,) * robot.n_joints)
    q, qd, qdd = motion
    data = Measurement(np.arange(float(len(q))), q, qd, np.zeros_like(q), qdd)
    total = np.zeros((10, 10))
    for (rows, _), s in zip(equations.rows(data), sigma):
        own, nuisance = rows[:, :10] / s, rows[:, 10:]
        left = own - nuisance @ np.linalg.lstsq(nuisance, own, rcond=None)[0]
        total += left.T @ left
    return total


@pytest.mark.parametrize("torques", ["chain", "terminal"])
@pytest.mark.parametrize("xml", [arms.SEVEN, arms.SLIDE_IN_CHAIN, arms.SHARED_BODIES])
def test_equals_the_schur_complement_of_the_tools_equations(xml, torques):
    robot = robot_of(xml)
    motion = random_motion(np.random.default_rng(0), robot.n_joints, SAMPLES)
    rows = None if torques == "chain" else (robot.n_joints - 1,)
    chosen = settings_for(robot.n_joints, rows=rows)
    ours = PredictedInformation(screw_chain(robot), chosen).evaluate(*motion).information
    theirs = eliminated_by_hand(robot, motion, torques, chosen.sigma)
    assert np.max(np.abs(ours - theirs)) < 1e-8 * np.max(np.abs(theirs))


@given(SEEDS, st.floats(0.05, 1.0))
@settings(max_examples=100)
def test_gradient_equals_differences(seed, smoothing):
    robot, rng = robot_of(arms.THREE), np.random.default_rng(seed)
    coordinates = rng.normal(size=(10, 4))
    chosen = settings_for(3, smoothing, coordinates=coordinates)
    information = PredictedInformation(screw_chain(robot), chosen)
    motion, direction = rng.normal(size=(2, 3, 12, 3))
    weight = rng.normal(size=(4, 4))
    weight += weight.T
    gradient = information.evaluate(*motion).pull_back(weight)
    exact = sum(np.sum(g * d) for g, d in zip(gradient, direction))
    size = sum(np.sum(np.abs(g * d)) for g, d in zip(gradient, direction))
    value = slope(
        lambda at: np.sum(weight * information.evaluate(*at).information), motion, direction, 1e-5
    )
    assert value == pytest.approx(exact, abs=1e-5 * size)


@given(SEEDS)
def test_further_samples_only_add_information(seed):
    robot = robot_of(arms.THREE)
    q, qd, qdd = random_motion(np.random.default_rng(seed), 3, 30)
    information = PredictedInformation(screw_chain(robot), settings_for(3))
    some = information.evaluate(q[:20], qd[:20], qdd[:20]).information
    all_of_it = information.evaluate(q, qd, qdd).information
    smallest = np.linalg.eigvalsh(all_of_it - some)[0]
    assert smallest > -1e-8 * np.max(np.abs(all_of_it))


def test_a_joint_at_rest_tells_no_less_than_its_offset_allows():
    robot = robot_of(arms.THREE)
    q, qd, qdd = random_motion(np.random.default_rng(1), 3, 40)
    qd[:, 0] = 0.0
    information = PredictedInformation(screw_chain(robot), settings_for(3)).evaluate(q, qd, qdd)
    by_hand = eliminated_by_hand(robot, (q, qd, qdd), "chain", settings_for(3).sigma)
    assert np.allclose(information.information, by_hand, rtol=1e-6, atol=1e-6)
