"""The number that a search minimises is a dense fit's covariance; its gradient is exact."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.excitation_arms import known_arm, link_covariance, make_problem, slope
from rigs.arms.small_arms import random_motion
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.expected.criterion import Criterion, FileKnowledge, PriorKnowledge

DEVIATIONS = dict.fromkeys(("coulomb", "viscous", "offset", "armature"), np.inf)
DEVIATIONS |= {"scale": 0.02, "load": 0.03, "sqrt": 0.1}
HELD = ("coulomb", "viscous", "offset", "armature")
TARGETS = ("link", "payload")


def knowledge_of(problem, target):
    """Return priors with errors of all links; of an arm's file also of the last one and of all
    friction, for a payload of no link.
    """
    others = 10 * (len(problem.links) - 1)
    factor = 0.1 * np.eye(others) + 0.01 * default_rng(0).normal(size=(others, others))
    if target == "payload":
        factor = np.zeros((others, 0))
    count = len(problem.rows)
    deviations = {term: np.full(count, size) for term, size in DEVIATIONS.items()}
    if target != "arm":
        return PriorKnowledge(factor, deviations)
    sizes = {"coulomb": 0.5, "viscous": 0.2, "offset": 0.1, "armature": 0.05}
    deviations |= {term: np.full(count, size) for term, size in sizes.items()}
    last = 0.2 * np.diag(problem.robot.prior.scale)
    elsewhere = random_motion(default_rng(2), problem.n_joints, 300)
    return PriorKnowledge(factor, deviations, FileKnowledge(last, HELD, elsewhere))


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
    return np.linalg.inv(precision)


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("xml", [small_arms.THREE, small_arms.SLIDE_IN_CHAIN])
def test_the_value_is_the_volume_of_a_dense_fits_covariance(xml, target):
    problem = make_problem(xml)
    knowledge = knowledge_of(problem, target)
    motion = random_motion(default_rng(1), problem.n_joints, 200)
    criterion = Criterion(problem, knowledge, smoothing=1e-9)
    covariance = dense_covariance(problem, knowledge, motion)
    assert criterion.visible.shape == (10, 10)
    deviation = np.sqrt(np.diag(covariance)[:10])
    ours = link_covariance(criterion, motion) / np.outer(deviation, deviation)
    theirs = covariance[:10, :10] / np.outer(deviation, deviation)
    assert_allclose(ours, theirs, atol=1e-5)
    inverse = np.linalg.inv(criterion.visible)
    volume = np.linalg.slogdet(inverse @ covariance[:10, :10] @ inverse.T)[1]
    assert criterion.evaluate(motion) == pytest.approx(volume / 20.0, abs=1e-5)


@pytest.mark.parametrize("target", [*TARGETS, "arm"])
def test_the_gradient_equals_differences(target):
    rng = default_rng(0)
    problem = make_problem(small_arms.THREE)
    criterion = Criterion(problem, knowledge_of(problem, target), smoothing=0.15)
    motion, direction = rng.normal(size=(2, 3, 40, 3))
    value, gradient = criterion.with_gradient(tuple(motion))
    assert value == criterion.evaluate(tuple(motion))
    exact = np.sum(np.stack(gradient) * direction)
    difference = slope(criterion.evaluate, motion, direction, 1e-5)
    assert difference == pytest.approx(exact, rel=1e-4, abs=1e-6)


def test_what_no_motion_shows_does_not_count_and_what_this_one_hides_is_infinite():
    problem = make_problem(small_arms.SEVEN, "terminal")
    criterion = Criterion(problem, known_arm(problem))
    assert criterion.visible.shape == (10, 7)
    motion = tuple(default_rng(0).normal(size=(3, 50, 7)))
    assert np.isfinite(criterion.evaluate(motion))
    still = (motion[0], 0.0 * motion[1], 0.0 * motion[2])
    assert criterion.evaluate(still) == np.inf
    lost = (motion[0], np.nan * motion[1], motion[2])
    assert criterion.evaluate(lost) == np.inf


def test_a_file_is_worth_less_where_the_arm_stands_still_and_nothing_by_noise_alone():
    problem = make_problem(small_arms.THREE)
    knowledge = knowledge_of(problem, "arm")
    criterion = Criterion(problem, knowledge)
    motion = random_motion(default_rng(1), problem.n_joints, 200)
    q, qd, qdd = motion
    still = (q, 0.0 * qd, 0.0 * qdd)
    assert criterion.evaluate(motion) < criterion.evaluate(still) < 0.0
    noisy = Criterion(problem, knowledge, samples=1e-14)
    assert noisy.evaluate(motion) == pytest.approx(0.0, abs=1e-9)
    lost = (q, np.nan * qd, qdd)
    assert criterion.evaluate(lost) == np.inf


def test_constant_torques_are_no_errors_of_a_file():
    """Sensors have offsets, which the judge of a file takes off, too."""
    problem = make_problem(small_arms.THREE)
    motion = random_motion(default_rng(1), problem.n_joints, 200)
    values = []
    for size in (0.1, 10.0):
        knowledge = knowledge_of(problem, "arm")
        offsets = np.full(len(problem.rows), size)
        deviations = {**knowledge.joint_deviations, "offset": offsets}
        knowledge = replace(knowledge, joint_deviations=deviations)
        values.append(Criterion(problem, knowledge).evaluate(motion))
    assert values[0] < values[1] < values[0] + 0.02
