"""The number that a search minimises is a dense fit's covariance; its gradient is exact."""

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs import arms
from rigs.arms import random_motion
from rigs.excitation_arms import known_arm, link_covariance, make_problem, slope
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.motion.information import Criterion, PriorKnowledge

DEVIATIONS = dict.fromkeys(("coulomb", "viscous", "offset", "armature"), np.inf)
DEVIATIONS |= {"scale": 0.02, "load": 0.03, "sqrt": 0.1}
TARGETS = ("link", "arm", "payload")


def knowledge_of(problem, target):
    """Return priors with errors of all links, none of them for a payload."""
    others = 10 * (len(problem.links) - 1)
    factor = 0.1 * np.eye(others) + 0.01 * default_rng(0).normal(size=(others, others))
    if target == "payload":
        factor = np.zeros((others, 0))
    count = len(problem.rows)
    deviations = {term: np.full(count, size) for term, size in DEVIATIONS.items()}
    return PriorKnowledge(factor, deviations, target)


def dense_covariance(problem, knowledge, motion):
    """Return the covariance of all unknowns of a dense fit: links, then each joint's terms."""
    links = LinkDynamics(problem.robot).motion(*motion).columns(problem.links)
    theta = np.ravel([problem.robot.links[k].theta for k in problem.links])
    factor = knowledge.link_factor
    size = 10 + factor.shape[1]
    equations = []
    for joint, deviation in enumerate(problem.sigma):
        qd, qdd = (signal[:, joint] for signal in motion[1:])
        load = links[:, joint] @ theta
        own = [
            load if name == "scale" else TERMS[name].torque(np.sign(qd), qd, qdd, load)
            for name in DEVIATIONS
        ]
        row = np.zeros((len(qd), size + 7 * len(problem.sigma)))
        row[:, :size] = links[:, joint, :size]
        row[:, size + 7 * joint : size + 7 * joint + 7] = np.transpose(own)
        equations.append(row / deviation)
    rows = np.vstack(equations)
    precision = rows.T @ rows
    if factor.size:
        precision[10:size, 10:size] += np.linalg.inv(factor @ factor.T)
    own = range(size, len(precision))
    deviations = np.column_stack([*knowledge.joint_deviations.values()])
    precision[own, own] += deviations.ravel() ** -2.0
    return np.linalg.inv(precision), size


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("xml", [arms.THREE, arms.SLIDE_IN_CHAIN])
def test_the_value_is_the_volume_of_a_dense_fits_covariance(xml, target):
    problem = make_problem(xml)
    knowledge = knowledge_of(problem, target)
    motion = random_motion(default_rng(1), problem.n_joints, 200)
    criterion = Criterion(problem, knowledge, smoothing=1e-9)
    covariance, size = dense_covariance(problem, knowledge, motion)
    assert criterion.visible.shape == (10, 10)
    deviation = np.sqrt(np.diag(covariance)[:10])
    ours = link_covariance(criterion, motion) / np.outer(deviation, deviation)
    theirs = covariance[:10, :10] / np.outer(deviation, deviation)
    assert_allclose(ours, theirs, atol=1e-5)
    count = size if target == "arm" else 10
    units = np.eye(count)
    units[:10, :10] = criterion.visible
    units[10:, 10:] = knowledge.link_factor[: count - 10, : count - 10]
    inverse = np.linalg.inv(units)
    volume = np.linalg.slogdet(inverse @ covariance[:count, :count] @ inverse.T)[1]
    assert criterion.evaluate(motion) == pytest.approx(volume / (2 * count), abs=1e-5)


@pytest.mark.parametrize("target", TARGETS)
def test_the_gradient_equals_differences(target):
    rng = default_rng(0)
    problem = make_problem(arms.THREE)
    criterion = Criterion(problem, knowledge_of(problem, target), smoothing=0.15)
    motion, direction = rng.normal(size=(2, 3, 40, 3))
    value, gradient = criterion.with_gradient(tuple(motion))
    assert value == criterion.evaluate(tuple(motion))
    exact = np.sum(np.stack(gradient) * direction)
    difference = slope(criterion.evaluate, motion, direction, 1e-5)
    assert difference == pytest.approx(exact, rel=1e-4, abs=1e-6)


def test_what_no_motion_shows_does_not_count_and_what_this_one_hides_is_infinite():
    problem = make_problem(arms.SEVEN, "terminal")
    criterion = Criterion(problem, known_arm(problem))
    assert criterion.visible.shape == (10, 7)
    motion = tuple(default_rng(0).normal(size=(3, 50, 7)))
    assert np.isfinite(criterion.evaluate(motion))
    still = (motion[0], 0.0 * motion[1], 0.0 * motion[2])
    assert criterion.evaluate(still) == np.inf
    lost = (motion[0], np.nan * motion[1], motion[2])
    assert criterion.evaluate(lost) == np.inf
