"""Predicted deviations equal those of Monte Carlo, and the report states true figures."""

import re

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.excitation_arms import make_design, make_problem, robot
from rigs.arms.small_arms import Z, hinge, link, world
from robot_sysid.expected.recording import centre_slopes
from robot_sysid.motion.clearance import Closest
from robot_sysid.motion.limit_check import LimitCheck, check_limits
from robot_sysid.motion.mounting import mounting_plane
from robot_sysid.motion.plan_lines import limit_lines, motion_lines
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
    lines = "\n".join(report(asked, sines(slide)))
    (assumed,) = re.findall("Limits of this program .*", lines)
    assert "rad/s²" not in assumed


@pytest.mark.parametrize(
    ("distance", "room"),
    [
        (0.0031, "about 3 mm apart"),
        (2e-4, "which touch (0 mm)"),
        (-1e-9, "which touch (0 mm)"),
        (-0.0021, "which are 2 mm inside each other, as at rest"),
    ],
)
def test_the_least_room_is_said_in_whole_millimetres(distance, room):
    problem = make_problem(small_arms.THREE)
    plan = sines(small_arms.THREE)
    check = LimitCheck((), Closest(0.0, distance, "hand and table"), ())
    first, *_ = limit_lines(problem, plan, check)
    assert (
        first
        == f"Keeps all limits for 2.0 s; least room between hand and table, {room}"
    )


@pytest.mark.parametrize(
    ("height", "place"), [("-9e-10", "0 mm"), ("-0.0024", "-2 mm"), ("0.9", "900 mm")]
)
def test_the_mounting_plane_is_at_a_height_in_whole_millimetres(height, place):
    ball = link(hinge("yaw", Z), '<geom size=".05" pos="0 0 .2"/>', pos="0 0 .3")
    arm = robot(world(f'<body pos="0 0 {height}">{ball}</body>'))
    plane = mounting_plane(arm, arm.reference)
    assert f"at a height of {place} (" in plane.label


def test_largest_values_have_a_unit_and_no_infinite_limit():
    slide = small_arms.SLIDE_IN_CHAIN
    lines = report(make_problem(slide), sines(slide))
    values = [line for line in lines if " at " in line and " limit of " in line]
    assert len(values) == 4 * 4 + 1
    assert "inf" not in "\n".join(values)
    pattern = r"  \d+\.\d\d( of \d+\.\d\d)? (rad|m|rad/s|m/s|rad/s²|m/s²|N·m|N) at "
    assert all(re.match(pattern, line) for line in values)
