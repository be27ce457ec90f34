"""Priors of links: reference bodies that are compared, and mistakes of models that a log shows."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.core_fits import fit_recordings
from rigs.logs.payload_logs import (
    TrueArm,
    add_noise,
    four_joint_arm,
    four_joint_xml,
    wide_motion,
)
from robot_sysid import spatial
from robot_sysid.estimate.choose import evidence_of, links_information
from robot_sysid.estimate.links import EXPECTED, link_factor, reference_links
from robot_sysid.model.mistakes import Mistake, MistakeKind, without_mistakes
from robot_sysid.spatial import theta_from_com

ROBOT = four_joint_arm()
LINKS = (0, 1, 2)


def test_references_are_compared_by_the_likelihood_of_the_data(noisy_fit):
    """It is the integral over links around the reference, solved for the posterior's mean."""
    robot = noisy_fit.arm.robot
    links = noisy_fit.arm.others
    information = curvature, gradient = links_information(noisy_fit)
    body = 3.0 * robot.links[links[-1]].reference
    mistake = Mistake(MistakeKind.MIRRORED, (links[-1],), (body,))
    found = []
    expected = []
    for arm in (robot, without_mistakes(robot, [mistake])):
        evidence = evidence_of(noisy_fit, arm, information)
        found.append(evidence.log_likelihood(EXPECTED))
        mean = reference_links(arm, links)
        factor = link_factor(arm, links, 0.05)
        precision = np.linalg.inv(factor @ factor.T)
        right_side = gradient + precision @ mean
        posterior = curvature + precision
        exponent = right_side @ np.linalg.solve(posterior, right_side)
        exponent -= mean @ precision @ mean
        widened = np.linalg.slogdet(np.eye(len(mean)) + factor.T @ curvature @ factor)[
            1
        ]
        expected.append(0.5 * (exponent - widened))
    assert abs(np.diff(found)[0]) > 1.0
    assert_allclose(np.diff(found), np.diff(expected), rtol=1e-4)


def mirrored(numbers):
    """Return the arm with a model in which centres of mass of links have the wrong signs."""
    model = small_arms.compile_xml(four_joint_xml('range="-2.5 2.5"'))
    for number in numbers:
        link = ROBOT.links[number]
        mass, centre, inertia = spatial.com_from_theta(link.theta)
        wrong = theta_from_com(mass, -centre, inertia)
        small_arms.write_body(model, link.body_id, wrong)
    return small_arms.robot_of(model)


@pytest.mark.parametrize("numbers", [(), (2,), (1, 2)])
def test_mirrored_centres_of_mass_are_found_and_errors_hold_the_truth(numbers):
    arm = TrueArm(ROBOT, 0, 0.15)
    recording = add_noise(arm.recording(wide_motion(0), False), 0.1, 0)
    answer = fit_recordings(mirrored(numbers), [recording])
    mistakes = answer.question.mistakes
    assert [each.links for each in mistakes] == [(number,) for number in numbers]
    assert all(each.kind is MistakeKind.MIRRORED for each in mistakes)
    names = [name for number in LINKS for name in answer.arm.links[number][:4]]
    places = answer.at(names)
    off = answer.values[places] - arm.values(names)
    assert np.all(np.abs(off) < 3.0 * answer.errors[places])


def test_links_allow_for_a_mistake_that_a_log_hardly_shows():
    arm = TrueArm(ROBOT, 1, 0.15)
    recording = add_noise(arm.recording(wide_motion(1), False), 0.1, 1)
    answer = fit_recordings(mirrored((1,)), [recording])
    question = answer.question
    assert not question.mistakes
    assert (1,) in [each.links for each in question.doubtful]
    names = answer.arm.links[1][:4]
    places = answer.at(names)
    off = answer.values[places] - arm.values(names)
    assert np.all(np.abs(off) < 3.0 * answer.errors[places])
