"""The predicted information equals the information that an identification collects."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from robot_sysid.dynamics.equations import other_links
from robot_sysid.dynamics.friction import TERMS, FrictionModel
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.motion.information import (
    JOINT_TERMS,
    Criterion,
    InformationModel,
    PriorKnowledge,
)
from tests.support import arms
from tests.support.arms import random_motion, robot_of
from tests.support.excitation_arms import make_problem, slope

FREE = FrictionModel(JOINT_TERMS[:4])
SAMPLES = 60


def make_model(xml, prior_deviations, smoothing=0.0, torques="chain"):
    """Return the InformationModel of all links of an arm, and the noise of each torque (rows,).

    Args:
        xml: the arm.
        prior_deviations: (7,) prior standard deviation of each joint term, infinite for free ones.
        smoothing: share of the speed limits below which dry friction is rounded off.
        torques: "chain" or "terminal".
    """
    problem = make_problem(xml, torques)
    sigma = np.linspace(0.5, 2.0, len(problem.rows))
    deviations = np.tile(np.array(prior_deviations)[:, None], len(sigma))
    knowledge = PriorKnowledge(np.zeros((0, 0)), deviations)
    return InformationModel(problem, sigma, knowledge, smoothing), sigma


def schur_complement(robot, motion, torques, sigma, prior_deviations):
    """Return the information of all links from the tool's equations, nuisances eliminated.

    The order is the last link first, then the other links from the tip to the base.
    """
    links = other_links(robot)
    (q, qd, qdd) = motion
    moves = LinkDynamics(robot).motion(q, qd, qdd)
    of_links = moves.columns([robot.n_joints - 1, *links])
    total = np.zeros((10 * (1 + len(links)),) * 2)
    theta = np.concatenate([robot.links[k].theta for k in (-1, *links)])
    first_joint = 0 if torques == "chain" else robot.n_joints - 1
    for joint, s in zip(range(first_joint, robot.n_joints), sigma):
        bodies = of_links[:, joint]
        torque = bodies @ theta
        friction = FREE.columns(qd[:, joint], qdd[:, joint], torque)
        load = TERMS["load"](qd[:, joint], qdd[:, joint], torque)
        root = TERMS["sqrt"](qd[:, joint], qdd[:, joint], torque)
        nuisance = np.column_stack((friction, torque, load, root))
        has_prior = np.isfinite(prior_deviations)
        scaled = nuisance / s * np.where(has_prior, prior_deviations, 1.0)
        nuisance = np.vstack((scaled, np.diag(has_prior.astype(float))))
        body_rows = np.vstack((bodies / s, np.zeros((len(JOINT_TERMS), len(total)))))
        gain = np.linalg.lstsq(nuisance, body_rows, rcond=None)[0]
        residual = body_rows - nuisance @ gain
        total += residual.T @ residual
    # The terminal link first, then the other links from the tool to the base.
    others = np.arange(10, len(total)).reshape(-1, 10)
    link_order = [*range(10), *others[::-1].ravel()]
    return total[np.ix_(link_order, link_order)]


PRIORS = {
    "known": (np.inf, np.inf, np.inf, np.inf, 0.0, 0.0, 0.0),
    "usual": (np.inf, np.inf, np.inf, np.inf, 0.02, 0.02, 0.1),
}


@pytest.mark.parametrize("prior_deviations", PRIORS.values(), ids=PRIORS)
@pytest.mark.parametrize("torques", ["chain", "terminal"])
@pytest.mark.parametrize("xml", [arms.SEVEN, arms.SLIDE_IN_CHAIN, arms.SHARED_BODIES])
def test_information_equals_the_schur_complement_of_the_equations(
    xml, torques, prior_deviations
):
    robot = robot_of(xml)
    motion = random_motion(default_rng(0), robot.n_joints, SAMPLES)
    model, sigma = make_model(xml, prior_deviations, torques=torques)
    ours = model.evaluate(*motion).information
    deviations = np.array(prior_deviations)
    theirs = schur_complement(robot, motion, torques, sigma, deviations)
    assert np.max(np.abs(ours - theirs)) < 1e-7 * np.max(np.abs(theirs))


@pytest.mark.parametrize("target", ["link", "arm", "payload"])
@pytest.mark.parametrize("prior_deviations", PRIORS.values(), ids=PRIORS)
def test_the_gradient_of_the_criterion_equals_differences(target, prior_deviations):
    rng = default_rng(0)
    model, _ = make_model(arms.THREE, prior_deviations, 0.15)
    factor = 0.1 * rng.normal(size=(20, 20))
    if target == "payload":
        factor = np.zeros((0, 0))
    criterion = Criterion(np.diag(rng.uniform(0.1, 1.0, 10)), factor, target)
    motion, direction = rng.normal(size=(2, 3, 40, 3))

    def value(at):
        return criterion.evaluate(model.evaluate(*at).information)[0]

    evaluation = model.evaluate(*motion)
    gradient = evaluation.vjp(criterion.evaluate(evaluation.information)[1])
    exact = np.sum(np.stack(gradient) * direction)
    assert slope(value, motion, direction, 1e-5) == pytest.approx(
        exact, rel=1e-4, abs=1e-6
    )


def test_the_criterion_is_the_volume_of_the_posterior_covariance():
    """More rows or a narrower prior improve the value."""
    rng = default_rng(0)
    rows = rng.normal(size=(60, 30))
    factor = 0.3 * rng.normal(size=(20, 20))
    visible = np.diag(rng.uniform(0.1, 1.0, 10))
    prior = np.zeros((30, 30))
    prior[10:, 10:] = np.linalg.inv(factor @ factor.T)
    covariance = np.linalg.inv(rows.T @ rows + prior)
    scale = np.linalg.inv(visible)
    criterion = Criterion(visible, factor, "link")
    expected = 0.05 * np.linalg.slogdet(scale @ covariance[:10, :10] @ scale)[1]
    value = criterion.evaluate(rows.T @ rows)[0]
    assert value == pytest.approx(expected, abs=1e-9)
    assert_allclose(
        criterion.covariance(rows.T @ rows), covariance[:10, :10], rtol=1e-8
    )
    more = np.vstack((rows, rng.normal(size=(1, 30))))
    assert criterion.evaluate(more.T @ more)[0] < value
    assert Criterion(visible, 0.5 * factor, "link").evaluate(rows.T @ rows)[0] < value
    arm_value = Criterion(visible, factor, "arm").evaluate(rows.T @ rows)[0]
    units = np.linalg.inv(
        np.block([[visible, np.zeros((10, 20))], [np.zeros((20, 10)), factor]])
    )
    assert arm_value == pytest.approx(
        np.linalg.slogdet(units @ covariance @ units.T)[1] / 60.0, abs=1e-9
    )


@pytest.mark.parametrize("size", [0.0, 1.0, np.nan])
def test_singular_information_has_an_infinite_criterion(size):
    matrix = np.full((10, 10), size)
    value, gradient = Criterion(np.eye(10), np.zeros((0, 0)), "link").evaluate(matrix)
    assert value == np.inf and gradient.shape == (10, 0)
