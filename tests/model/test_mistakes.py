"""Mistakes of a model in its links: which reference bodies they lead to."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from numpy.testing import assert_allclose

from rigs.arms.small_arms import SEEDS
from rigs.logs.payload_logs import four_joint_arm
from robot_sysid import spatial
from robot_sysid.estimate.links import reference_links
from robot_sysid.model.mistakes import (
    LEAST_STEP,
    MistakeKind,
    mistake_shifts,
    usual_mistakes,
    without_mistakes,
)
from robot_sysid.results.notes import mistake_words
from robot_sysid.spatial import theta_from_com

ROBOT = four_joint_arm()
LINKS = (0, 1, 2)


def with_body(robot, number, theta):
    """Return an arm whose model has other numbers for a link."""
    links = list(robot.links)
    links[number] = replace(links[number], theta=theta, reference=theta)
    return replace(robot, links=tuple(links))


def quarter_turn(rng):
    """Return a rotation (3, 3) by 90 degrees about one axis, either way."""
    axis = np.eye(3)[rng.integers(3)] * rng.choice([-1.0, 1.0])
    return np.outer(axis, axis) + spatial.skew(axis)


@given(SEEDS)
def test_a_mirrored_or_turned_centre_of_mass_is_among_the_mistakes(seed):
    rng = np.random.default_rng(seed)
    link = ROBOT.links[1]
    mass, _, inertia = spatial.com_from_theta(link.theta)
    true = link.size * rng.uniform(-0.5, 0.5, 3)
    signs = np.diag(rng.choice([-1.0, 1.0], 3))
    wrong = (signs if rng.random() < 0.5 else quarter_turn(rng)) @ true
    model = with_body(ROBOT, 1, theta_from_com(mass, wrong, inertia))
    centres = [wrong]
    for mistake in usual_mistakes(model, LINKS):
        if mistake.links == (1,) and mistake.kind is not MistakeKind.ABOUT_ORIGIN:
            (body,) = mistake.bodies
            centres.append(body[1:4] / mass)
            assert_allclose(spatial.com_from_theta(body)[2], inertia, atol=1e-9)
    distances = np.linalg.norm(np.array(centres) - true, axis=1)
    assert np.min(distances) <= LEAST_STEP * link.size


def test_an_inertia_about_the_origin_is_one_about_the_centre_of_mass_without_the_mistake():
    mass, centre, inertia = spatial.com_from_theta(ROBOT.links[2].theta)
    about_origin = spatial.symmetric_from_six(ROBOT.links[2].theta[4:])
    model = with_body(ROBOT, 2, theta_from_com(mass, centre, about_origin))
    (mistake,) = [
        each
        for each in usual_mistakes(model, (2,))
        if each.kind is MistakeKind.ABOUT_ORIGIN
    ]
    assert_allclose(mistake.bodies[0], ROBOT.links[2].theta, atol=1e-12)
    assert "inertia of link2 is about the origin" in mistake_words(model, mistake)


def test_exchanged_numbers_are_those_of_the_other_link():
    first, second = ROBOT.links[1].theta, 1.3 * ROBOT.links[2].theta
    model = with_body(with_body(ROBOT, 1, second), 2, first)
    (mistake,) = [
        each
        for each in usual_mistakes(model, (1, 2))
        if each.kind is MistakeKind.EXCHANGED
    ]
    right = without_mistakes(model, [mistake])
    assert_allclose(right.links[1].reference, first)
    assert_allclose(right.links[2].reference, second)
    assert_allclose(right.links[1].theta, second)
    words = mistake_words(model, mistake)
    assert words == "the numbers of link1 and link2 are exchanged"


def test_what_a_model_does_not_state_has_no_mistake():
    links = [replace(link, placeholders=("centre of mass",)) for link in ROBOT.links]
    assert not list(usual_mistakes(replace(ROBOT, links=tuple(links)), LINKS))


def test_shifts_lead_from_the_model_to_the_links_without_mistakes():
    for mistake in usual_mistakes(ROBOT, LINKS):
        (shift,) = mistake_shifts(ROBOT, LINKS, [mistake]).T
        right = without_mistakes(ROBOT, [mistake])
        moved = reference_links(ROBOT, LINKS) + shift
        assert_allclose(moved, reference_links(right, LINKS), atol=1e-12)
