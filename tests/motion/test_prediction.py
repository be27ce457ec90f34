"""Predicted deviations equal those of Monte Carlo, and the report states true figures."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.random import default_rng

from robot_sysid.dynamics.equations import Equations
from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.motion.design_search import draw_trajectory
from robot_sysid.motion.information import (
    InformationModel,
    design_criterion,
    known_arm,
    mass_and_centre_errors,
)
from robot_sysid.motion.limit_check import check_limits
from robot_sysid.motion.prediction import limit_lines, motion_lines
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks
from tests.support import arms, witness
from tests.support.arms import X, Y, Z
from tests.support.excitation_arms import (
    TUBES,
    TUBES_ON_FLOOR,
    make_design,
    make_problem,
    robot,
    tube_arm,
)
from tests.support.releases import since

FULL_FRICTION = FrictionModel(("coulomb", "viscous", "offset", "armature"))


def best_plan(xml, seed=0, **changes):
    """Return the trajectory with the best score among six draws."""
    design = make_design(xml, **changes)
    draws = [draw_trajectory(design, seed, number) for number in range(6)]
    return design.trajectory(min(draws, key=lambda draw: draw.score).x)


def empirical_deviation_of(arm, plan, rate, sigma, draws, seed=0):
    """Return the standard deviation (10,) of least-squares estimates over noise draws.

    Args:
        arm: the robot model.
        plan: its motion.
        rate: samples per second.
        sigma: standard deviation of the torque noise [N m].
        draws: number of noise draws.
        seed: of the noise.
    """
    rng = default_rng(seed)
    equations = Equations(arm, "chain", (FULL_FRICTION,) * arm.n_joints)
    size = len(equations.names)
    normal = np.zeros((size, size))
    rhs = np.zeros((size, draws))
    for measurement in simulate_inverse(arm, motion_chunks(plan, rate)):
        for (rows, tau), columns in zip(equations.rows(measurement), equations.columns):
            noisy = tau[:, None] + sigma * rng.normal(size=(len(tau), draws))
            normal[np.ix_(columns, columns)] += rows.T @ rows
            rhs[columns] += rows.T @ noisy
    scale = np.sqrt(np.diag(normal))
    solution = np.linalg.solve(normal / np.outer(scale, scale), rhs / scale[:, None])
    return (solution / scale[:, None])[:10].std(axis=1, ddof=1)


@pytest.mark.parametrize("xml", [arms.SEVEN, arms.SLIDE_IN_CHAIN])
def test_predicted_deviations_equal_monte_carlo(xml):
    problem = make_problem(xml)
    plan = best_plan(xml)
    prior = known_arm(problem)
    time = np.arange(1201) / 200.0
    motion = plan.evaluate(time)
    model = InformationModel(problem, problem.sigma, known_arm(problem))
    information = model.evaluate(motion.q, motion.qd, motion.qdd).information
    covariance = design_criterion(problem, prior).covariance(information)
    deviation = np.sqrt(np.diag(covariance))
    # 1000 draws know a standard deviation to 2.2 %; ten of them stay within 10 %.
    spread = empirical_deviation_of(robot(xml), plan, 200.0, 0.3, 1000)
    assert np.all(np.abs(spread / deviation - 1.0) < 0.10)


def test_the_error_of_the_centre_of_mass_equals_monte_carlo():
    """To first order in the covariance."""
    theta = make_problem(arms.SEVEN).robot.prior.theta
    rng = default_rng(0)
    root = 1e-3 * rng.normal(size=(10, 10))
    drawn = rng.multivariate_normal(theta, root @ root.T, size=4000)
    centres = drawn[:, 1:4] / drawn[:, :1]
    spread = np.sqrt(np.sum(np.var(centres, axis=0)))
    _, centre_error = mass_and_centre_errors(theta, root @ root.T)
    assert centre_error == pytest.approx(spread, rel=0.05)


def report(problem, plan):
    """Return the report lines of a plan."""
    return list(motion_lines(problem, plan, check_limits(problem, plan)))


def sines(xml, seed=0):
    """Return random sinusoids of 2 s."""
    return generate_excitation_trajectory(robot(xml), default_rng(seed), 2.0)[0]


def find_numbers(lines, start):
    """Return the numbers in the only line that begins with ``start``."""
    (line,) = [line for line in lines if line.startswith(start)]
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", line)]


def test_the_stated_tool_speed_is_that_of_the_fastest_point():
    problem = make_problem(TUBES, max_tool_speed=9.0)
    plan = sines(TUBES)
    stated, share, _ = find_numbers(report(problem, plan), "Fastest point of the tool")
    fastest = witness.fastest_point(robot(TUBES), plan, "link3")
    # A ball stands for the tube's round end: a little too fast, never too slow.
    assert fastest - 0.005 <= stated <= 1.03 * fastest + 0.005
    assert share == pytest.approx(100.0 * fastest / 9.0, abs=1.5)


@since(3, 1, 6)
def test_the_stated_room_is_the_smallest_distance_beyond_the_clearance():
    post = '<body name="post" pos=".48 0 .7"><geom size=".4"/></body>'
    xml = tube_arm((Z, Y, X, Y), post)
    plan = sines(xml)
    real = witness.nearest(robot(xml), plan)
    stated, *_ = find_numbers(report(make_problem(xml), plan), "Least room: ")
    assert stated == pytest.approx(1e3 * real - 10.0, abs=1.6)


def test_a_distance_that_is_not_known_is_not_called_large():
    problem = make_problem(arms.THREE)
    plan = sines(arms.THREE).scale_amplitudes(0.1)
    lines = limit_lines(problem, plan, check_limits(problem, plan))
    first, second = lines
    assert (
        first == "Keeps all limits for 2.0 s; distances between its parts are not known"
    )
    assert second.startswith("Nothing keeps link0, link1, link2 from touching anything")


def test_limits_that_neither_the_model_nor_an_option_states_are_named():
    slide = arms.SLIDE_IN_CHAIN
    lines = "\n".join(report(make_problem(slide), sines(slide)))
    (assumed,) = re.findall("Limits of this program .*", lines)
    speeds = "velocity 2 rad/s of turn, bend, roll; velocity 0.25 m/s of lift"
    pattern = "acceleration .* rad/s² of turn, bend, roll; acceleration .* m/s² of lift"
    assert speeds in assumed and re.search(pattern, assumed)
    asked = make_problem(slide, max_acceleration=3.0)
    assert "rad/s²" not in "\n".join(report(asked, sines(slide)))


@pytest.mark.parametrize(("xml", "has_floor"), [(TUBES, False), (TUBES_ON_FLOOR, True)])
def test_a_motion_below_zero_is_noted_where_the_model_has_no_floor(xml, has_floor):
    lines = report(make_problem(xml, below_base=True), sines(xml))
    assert any("The model has no floor" in line for line in lines) != has_floor
