"""Constraints, the objective, their gradients, and rounds of the optimiser."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng

from robot_sysid.errors import InputError
from robot_sysid.motion import ExcitationOptions
from robot_sysid.motion import design as design_module
from robot_sysid.motion.design import GRID_PER_CYCLE, INFORMATION_POINTS
from robot_sysid.motion.design_search import draw_trajectory
from robot_sysid.motion.information import InformationModel
from robot_sysid.motion.limit_check import keeps_limits
from robot_sysid.trajectory import TrajectoryOptions
from tests.support import arms
from tests.support.arms import SEEDS
from tests.support.excitation_arms import (
    TUBES_AND_POST,
    Design,
    known_arm,
    make_design,
    make_problem,
    random_x,
    slope,
)


def best_draw(design, seed=0):
    """Return the draw with the best score among four."""
    draws = [draw_trajectory(design, seed, number) for number in range(4)]
    return min(draws, key=lambda draw: draw.score)


def test_rounds_keep_the_best_feasible_trajectory():
    """A start that exceeds its limits is made feasible, and rounds only improve the score."""
    design = make_design(TUBES_AND_POST, iterations=8)
    candidate = design_module.first_candidate(design, 1.5 * best_draw(design).x)
    assert not keeps_limits(design.problem, design.trajectory(candidate.x))
    assert np.linalg.norm(candidate.feasible_x) < np.linalg.norm(candidate.x)
    scores = [candidate.feasible_score]
    for _ in range(2):
        candidate = design_module.improve(design, candidate)
        scores.append(candidate.feasible_score)
        assert keeps_limits(design.problem, design.trajectory(candidate.feasible_x))
    assert scores[0] >= scores[1] >= scores[2]
    assert scores[2] == design.criterion_of(candidate.feasible_x) < scores[0] - 0.1


@given(SEEDS)
def test_gradient_equals_differences(seed):
    design = make_design(arms.THREE)
    rng = default_rng(seed)
    multipliers = rng.uniform(size=(len(design.grid), 14))
    x = random_x(design, seed)
    direction = random_x(design, seed + 1, 1.0)
    candidate = design_module.Candidate(None, multipliers, 10.0)
    objective = partial(design_module.penalised_objective, design, candidate)
    exact = np.sum(objective(x)[1] * direction)
    value = slope(lambda at: objective(at)[0], x, direction)
    assert value == pytest.approx(exact, rel=1e-4, abs=1e-4 * (1.0 + np.abs(exact)))


def deviations(design, plan, rate, smooth):
    """Return predicted standard deviations (10,) of the last link's parameters.

    The motion is sampled at ``rate`` Hz; ``smooth`` rounds the sign of dry friction.
    """
    time = (np.arange(int(plan.duration * rate)) + 0.5) / rate
    motion = plan.evaluate(time)
    prior = known_arm(design.problem)
    sigma = design.problem.sigma * np.sqrt(len(time))
    model = InformationModel(design.problem, sigma, prior, 0.03 if smooth else 0.0)
    information = model.evaluate(motion.q, motion.qd, motion.qdd).information
    return np.sqrt(np.diag(design.criterion.covariance(information)))


@pytest.mark.parametrize("xml", [arms.SEVEN, arms.SLIDE_IN_CHAIN])
def test_the_grid_is_fine_enough_for_the_band(xml):
    """On the search's grid, with rounded friction, no deviation is off by more than 3 %."""
    design = make_design(xml, duration=15.0)
    points_per_cycle = GRID_PER_CYCLE / INFORMATION_POINTS.step
    rate = points_per_cycle * design.basis.top_frequency_hz
    for number in range(4):
        plan = design.trajectory(draw_trajectory(design, 2, number).x)
        fine = deviations(design, plan, 500.0, smooth=False)
        coarse = deviations(design, plan, rate, smooth=True)
        assert np.max(np.abs(coarse / fine - 1.0)) < 0.03


@given(SEEDS)
def test_unidentifiable_directions_have_no_information_on_any_motion(seed):
    design = make_design(arms.SEVEN, "terminal")
    assert make_design(arms.SEVEN).criterion.visible.shape == (10, 10)
    assert design.criterion.visible.shape == (10, 7)
    scale = np.diag(design.problem.scale)
    model = InformationModel(design.problem, np.ones(1), known_arm(design.problem))
    q, qd, qdd = default_rng(seed).normal(size=(3, 50, 7))
    matrix = scale @ model.evaluate(q, qd, qdd).information[:10, :10] @ scale
    visible = np.linalg.solve(scale, design.criterion.visible)
    hidden = np.eye(10) - visible @ visible.T
    assert np.max(np.abs(matrix @ hidden)) < 1e-6 * np.max(np.abs(matrix))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sample_rate": 1.0}, "rate 1 cannot show the motion's highest fr.*, 0.6 Hz"),
        ({"duration": 4e4}, r"take about \d.* GB of memory.*make the motion shorter"),
    ],
)
def test_impossible_searches_are_refused(changes, message):
    motion = TrajectoryOptions(**{"duration": 15.0, **changes})
    with pytest.raises(InputError, match=message):
        problem = make_problem(arms.THREE)
        Design(problem, ExcitationOptions(), motion, known_arm(problem))


STRONG_MOTORS = arms.DRY_FRICTION.replace(
    "</worldbody>",
    """</worldbody><actuator>
<motor joint="joint0" ctrlrange="-40 40" ctrllimited="true"/>
<motor joint="joint1" ctrlrange="-90 90" ctrllimited="true"/>
<motor joint="joint2" ctrlrange="-90 90" ctrllimited="true"/>
</actuator>""",
)
LIMITED = ({}, {"max_tool_speed": 0.7}, {"payload_reserve": 2.0})


@given(st.sampled_from(LIMITED), SEEDS)
def test_the_gradient_of_constraints_equals_differences(limits, seed):
    constraints = partial(
        design_module.constraints_of, make_problem(STRONG_MOTORS, **limits), share=0.99
    )
    rng = default_rng(seed)
    motion, direction = rng.normal(size=(2, 3, 3, 3))
    cache = constraints(motion)
    weight = rng.uniform(size=cache.value.shape)
    products = np.stack(cache.vjp(weight)) * direction
    steps = 1e-6 * np.array([-1.0, 0.0, 1.0])
    values = [np.sum(weight * constraints(motion + s * direction).value) for s in steps]
    # A coordinate that passes zero within the step has a kink there: two slopes.
    slopes = np.diff(values) / 1e-6
    size = np.sum(np.abs(products))
    assert np.min(np.abs(slopes - np.sum(products))) < 1e-4 * size


def test_gradient_of_the_clearance_equals_differences():
    """At ten poses near an obstacle where the distance has no kink."""
    problem = make_problem(TUBES_AND_POST)
    at_rest = np.zeros((1, 4))

    def constraints(q):
        return design_module.constraints_of(problem, (q, at_rest, at_rest))

    def clearance(q):
        return constraints(q).value[0, -1]

    rng = default_rng(2)
    checked = 0
    while checked < 10:
        q, direction = rng.uniform(-1.5, 1.5, size=(2, 1, 4))
        step = 1e-4 * direction
        curvature = clearance(q + step) + clearance(q - step) - 2 * clearance(q)
        if clearance(q) > -0.9 and curvature < 1e-6:
            checked += 1
            last_constraint = np.eye(18)[-1:]
            by_q, _, _ = constraints(q).vjp(last_constraint)
            exact = np.sum(by_q * direction)
            difference = slope(clearance, q, direction)
            assert exact == pytest.approx(difference, rel=1e-3, abs=1e-3)
