"""Predicted deviations equal those of Monte Carlo, and the report states true figures."""

import re

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.excitation_arms import make_design, make_problem, robot
from robot_sysid.motion.expected_errors import centre_slopes
from robot_sysid.motion.limit_check import check_limits
from robot_sysid.motion.prediction import limit_lines, motion_lines
from robot_sysid.motion.search import draw_trajectory
from robot_sysid.trajectory import generate_excitation_trajectory


def best_plan(xml, seed=0, **changes):
    """Return the trajectory with the best score among six draws."""
    design = make_design(xml, **changes)
    draws = [draw_trajectory(design, seed, number) for number in range(6)]
    return design.trajectory(min(draws, key=lambda draw: draw.score).x)


def test_slopes_of_the_centre_of_mass_equal_differences():
    theta = make_problem(small_arms.SEVEN).robot.prior.theta
    step = 1e-6 * np.eye(10)[:, :4]
    ahead, behind = (theta[:, None] + signed for signed in (step, -step))
    change = ahead[1:4] / ahead[0] - behind[1:4] / behind[0]
    slopes = centre_slopes(theta)
    assert_allclose(slopes[:, :4], change / 2e-6, rtol=1e-6, atol=1e-9)
    assert not np.any(slopes[:, 4:])


def report(problem, plan):
    """Return the report lines of a plan."""
    return list(motion_lines(problem, plan, check_limits(problem, plan)))


def sines(xml, seed=0):
    """Return random sinusoids of 2 s."""
    return generate_excitation_trajectory(robot(xml), default_rng(seed), 2.0)


def test_a_distance_that_is_not_known_is_not_called_large():
    problem = make_problem(small_arms.THREE)
    plan = sines(small_arms.THREE).scale_amplitudes(0.1)
    lines = limit_lines(problem, plan, check_limits(problem, plan))
    first, second, third = lines
    assert first == "Keeps all limits for 2.0 s"
    assert second.startswith("Nothing keeps link0, link1, link2 from touching anything")
    assert third.startswith("No torque limit of joint0, joint1, joint2 is known: ")


def test_limits_that_neither_the_model_nor_an_option_states_are_named():
    slide = small_arms.SLIDE_IN_CHAIN
    lines = "\n".join(report(make_problem(slide), sines(slide)))
    (assumed,) = re.findall("Limits of this program .*", lines)
    speeds = "velocity 2 rad/s of turn, bend, roll; velocity 0.25 m/s of lift"
    pattern = "acceleration .* rad/s² of turn, bend, roll; acceleration .* m/s² of lift"
    assert speeds in assumed and re.search(pattern, assumed)
    asked = make_problem(slide, max_acceleration=3.0)
    assert "rad/s²" not in "\n".join(report(asked, sines(slide)))
