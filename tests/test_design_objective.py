"""The optimiser's function: gradient, grid fine enough for the band, what can be seen at all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.design.design_objective import GRID_PER_CYCLE, Design, PenalisedDesign
from robot_sysid.design.predicted_information import PredictedInformation, RowSettings
from robot_sysid.design.random_search import draw_trajectories
from tests import arms
from tests.arms import SEEDS
from tests.excitation_arms import (
    TUBES_AND_POST,
    design,
    options,
    problem,
    random_x,
    slope,
)

CRITERIA = st.sampled_from(["A", "D", "cond"])
ENDS = st.sampled_from(["faded", "periodic"])


@given(CRITERIA, ENDS, SEEDS)
@settings(max_examples=100)
def test_gradient_equals_differences(criterion, ends, seed):
    some = design(arms.THREE, criterion=criterion, ends=ends)
    rng = np.random.default_rng(seed)
    extra = rng.uniform(0.0, 6.0, size=3)
    multipliers = rng.uniform(size=(len(some.grid) + 3, 13))
    objective = PenalisedDesign(some, extra, multipliers, 10.0)
    x, direction = random_x(some, seed), random_x(some, seed + 1, 1.0)
    exact = np.sum(objective.evaluate(x).gradient * direction)
    value = slope(lambda at: objective.evaluate(at).value, x, direction)
    assert value == pytest.approx(exact, rel=1e-4, abs=1e-4 * (1.0 + np.abs(exact)))


def test_without_multipliers_and_excess_the_objective_is_the_criterion():
    some = design(arms.THREE)
    draw = min(draw_trajectories(some, 0, range(5)), key=lambda d: d.score)
    none = np.zeros((len(some.grid), 13))
    evaluation = PenalisedDesign(some, np.zeros(0), none, 10.0).evaluate(0.9 * draw.x)
    assert evaluation.value == evaluation.criterion == some.criterion_of(0.9 * draw.x)


def test_multipliers_grow_where_limits_are_exceeded_and_nowhere_else():
    some = design(arms.THREE)
    none = np.zeros((len(some.grid), 13))
    objective = PenalisedDesign(some, np.zeros(0), none, 10.0)
    value = objective.evaluate(random_x(some, 0, 2.0)).constraints.value
    multipliers = objective.updated_multipliers(value)
    assert np.array_equal(multipliers > 0.0, value > 0.0)


def deviations(some, plan, rate, smooth):
    """Predicted standard deviations (r,) from samples at a rate."""
    time = (np.arange(int(plan.duration * rate)) + 0.5) / rate
    motion = plan.evaluate(time)
    smoothing = 0.03 * some.problem.limits.velocity if smooth else np.zeros(some.problem.n_joints)
    chosen = RowSettings(
        some.problem.rows,
        some.problem.sigma * np.sqrt(len(time)),
        smoothing,
        some.coordinates,
    )
    information = PredictedInformation(some.problem.chain, chosen)
    return np.sqrt(
        np.diag(np.linalg.inv(information.evaluate(motion.q, motion.qd, motion.qdd).information))
    )


@pytest.mark.parametrize("xml", [arms.SEVEN, arms.THREE, arms.SLIDE_IN_CHAIN])
@pytest.mark.parametrize("ends", ["faded", "periodic"])
def test_the_grid_is_fine_enough_for_the_band(xml, ends):
    """On the search's grid, with rounded friction, no deviation is off by more than 3 %."""
    some = Design(problem(xml, ends=ends), options(ends=ends, harmonics=None, duration=15.0))
    top = some.basis.top_frequency_hz
    worst = 0.0
    for draw in draw_trajectories(some, 2, range(8)):
        plan = some.trajectory(draw.x)
        fine = deviations(some, plan, 1000.0, smooth=False)
        coarse = deviations(some, plan, GRID_PER_CYCLE * top, smooth=True)
        worst = max(worst, np.max(np.abs(coarse / fine - 1.0)))
    assert worst < 0.03


def test_all_ten_parameters_of_a_seven_joint_arm_can_be_seen():
    assert design(arms.SEVEN).coordinates.shape == (10, 10)
    assert design(arms.SEVEN, torques="terminal").coordinates.shape == (10, 7)


@given(SEEDS)
@settings(max_examples=20)
def test_what_cannot_be_seen_stays_so_on_every_motion(seed):
    some = design(arms.SEVEN, torques="terminal")
    scale = np.diag(some.problem.scale)
    chosen = RowSettings((6,), np.ones(1), np.zeros(7), scale)
    q, qd, qdd = np.random.default_rng(seed).normal(size=(3, 50, 7))
    matrix = PredictedInformation(some.problem.chain, chosen).evaluate(q, qd, qdd).information
    seen = np.linalg.solve(scale, some.coordinates)
    hidden = np.eye(10) - seen @ seen.T
    assert np.max(np.abs(matrix @ hidden)) < 1e-6 * np.max(np.abs(matrix))


def test_the_free_coefficients_make_the_trajectory():
    some = design(TUBES_AND_POST, ends="periodic")
    x = random_x(some, 3)
    time = np.linspace(0.0, 6.0, 20)
    b, _, ddb = some.functions(time)
    motion = some.trajectory(x).evaluate(time)
    assert np.allclose(motion.q, some.problem.rest + b @ x.T, atol=1e-12)
    assert np.allclose(motion.qdd, ddb @ x.T, atol=1e-11)
