"""Constraints, the objective and its gradient, and rounds of the optimiser."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.motion.design.optimise import (
    EXTRA_SLACK,
    GRID_PER_CYCLE,
    LIMIT_SHARE,
    Candidate,
    constraints_of,
    first_candidate,
    improve,
    penalised,
)
from robot_sysid.motion.design.search import draw_trajectories
from robot_sysid.motion.information import CRITERIA, PredictedInformation
from robot_sysid.motion.limit_check import check_limits, keeps_limits
from tests.support import arms
from tests.support.arms import SEEDS
from tests.support.excitation_arms import TUBES, TUBES_AND_POST, design, problem, random_x, slope


def best_draw(some, seed=0):
    return min(draw_trajectories(some, seed, range(6)), key=lambda d: d.score)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("xml", "ends"),
    [
        (arms.THREE, "faded"),
        (TUBES, "periodic"),
        (TUBES_AND_POST, "faded"),
        (arms.SLIDE_IN_CHAIN, "periodic"),
    ],
)
def test_rounds_keep_the_best_that_keeps_all_limits(xml, ends):
    some = design(xml, ends=ends, iterations=15)
    candidate = first_candidate(some, best_draw(some).x)
    scores = [candidate.feasible_score]
    for _ in range(3):
        candidate = improve(some, candidate)
        scores.append(candidate.feasible_score)
        assert check_limits(some.problem, some.trajectory(candidate.feasible_x)).holds
    assert all(later <= earlier for earlier, later in zip(scores, scores[1:]))
    assert scores[-1] < scores[0] - 0.1
    assert scores[-1] == some.criterion_of(candidate.feasible_x)


def test_a_motion_beyond_its_limits_is_shrunk_until_it_obeys():
    some = design(TUBES_AND_POST)
    candidate = first_candidate(some, 3.0 * best_draw(some).x)
    assert not keeps_limits(some.problem, some.trajectory(candidate.x))
    assert keeps_limits(some.problem, some.trajectory(candidate.feasible_x))
    assert np.linalg.norm(candidate.feasible_x) < np.linalg.norm(candidate.x)


def test_times_of_excess_join_the_grid():
    some = design(TUBES_AND_POST, iterations=3)
    candidate = improve(some, first_candidate(some, 1.5 * best_draw(some).x))
    assert len(candidate.extra_times) > 0
    assert candidate.multipliers.shape[0] == len(some.grid) + len(candidate.extra_times)
    assert len(np.unique(candidate.extra_times)) == len(candidate.extra_times)
    again = improve(some, candidate)
    assert len(again.extra_times) >= len(candidate.extra_times)


NAMES = st.sampled_from(sorted(CRITERIA))
ENDS = st.sampled_from(["faded", "periodic"])


def objective_of(some, extra, multipliers):
    candidate = Candidate(None, multipliers, extra, 10.0)
    return partial(penalised, some, candidate, some.functions(extra))


@given(NAMES, ENDS, SEEDS)
def test_gradient_equals_differences(criterion, ends, seed):
    some = design(arms.THREE, criterion=criterion, ends=ends)
    rng = np.random.default_rng(seed)
    extra = rng.uniform(0.0, 6.0, size=3)
    multipliers = rng.uniform(size=(len(some.grid) + 3, 14))
    x, direction = random_x(some, seed), random_x(some, seed + 1, 1.0)
    objective = objective_of(some, extra, multipliers)
    exact = np.sum(objective(x)[1] * direction)
    value = slope(lambda at: objective(at)[0], x, direction)
    assert value == pytest.approx(exact, rel=1e-4, abs=1e-4 * (1.0 + np.abs(exact)))


def test_without_multipliers_and_excess_the_objective_is_the_criterion():
    some = design(arms.THREE)
    draw = min(draw_trajectories(some, 0, range(5)), key=lambda d: d.score)
    none = np.zeros((len(some.grid), 14))
    value, _, _ = objective_of(some, np.zeros(0), none)(0.9 * draw.x)
    assert value == some.criterion_of(0.9 * draw.x)


def test_multipliers_grow_where_limits_are_exceeded_and_nowhere_else():
    some = design(arms.THREE)
    none = np.zeros((len(some.grid), 14))
    x = random_x(some, 0, 2.0)
    value = constraints_of(some.problem, some.motion(x), LIMIT_SHARE, EXTRA_SLACK).value
    assert np.array_equal(objective_of(some, np.zeros(0), none)(x)[2] > 0.0, value > 0.0)


def deviations(some, plan, rate, smooth):
    """Predicted standard deviations (r,) from samples at a rate."""
    time = (np.arange(int(plan.duration * rate)) + 0.5) / rate
    motion = plan.evaluate(time)
    smoothing = 0.03 * some.problem.limits.velocity if smooth else np.zeros(some.problem.n_joints)
    sigma = some.problem.sigma * np.sqrt(len(time))
    information = PredictedInformation(
        some.problem.chain, some.problem.rows, sigma, smoothing, some.coordinates
    )
    return np.sqrt(
        np.diag(np.linalg.inv(information.evaluate(motion.q, motion.qd, motion.qdd).information))
    )


@pytest.mark.parametrize("xml", [arms.SEVEN, arms.THREE, arms.SLIDE_IN_CHAIN])
@pytest.mark.parametrize("ends", ["faded", "periodic"])
def test_the_grid_is_fine_enough_for_the_band(xml, ends):
    """On the search's grid, with rounded friction, no deviation is off by more than 3 %."""
    some = design(xml, duration=15.0, ends=ends, harmonics=None)
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
    chosen = PredictedInformation(some.problem.chain, (6,), np.ones(1), np.zeros(7), scale)
    q, qd, qdd = np.random.default_rng(seed).normal(size=(3, 50, 7))
    matrix = chosen.evaluate(q, qd, qdd).information
    seen = np.linalg.solve(scale, some.coordinates)
    hidden = np.eye(10) - seen @ seen.T
    assert np.max(np.abs(matrix @ hidden)) < 1e-6 * np.max(np.abs(matrix))


def test_the_free_coefficients_make_the_trajectory():
    some = design(TUBES_AND_POST, ends="periodic")
    x = random_x(some, 3)
    time = np.linspace(0.0, 6.0, 20)
    b, _, ddb = (values[len(some.grid) :] for values in some.functions(time))
    motion = some.trajectory(x).evaluate(time)
    assert np.allclose(motion.q, some.problem.rest + b @ x.T, atol=1e-12)
    assert np.allclose(motion.qdd, ddb @ x.T, atol=1e-11)


def information(rng, size=5):
    factor = rng.normal(size=(size + 3, size))
    return factor.T @ factor


@given(NAMES, SEEDS)
def test_gradient_of_a_criterion_equals_differences(name, seed):
    rng = np.random.default_rng(seed)
    matrix, direction = information(rng), rng.normal(size=(5, 5))
    direction += direction.T
    size = np.linalg.eigvalsh(matrix)[0]
    value = slope(lambda m: CRITERIA[name](m)[0], matrix, direction, 1e-5 * size)
    exact = np.sum(CRITERIA[name](matrix)[1] * direction)
    assert value == pytest.approx(exact, rel=1e-4, abs=1e-6 / size)


@given(st.sampled_from(["A", "D"]), SEEDS)
def test_more_information_is_never_worse(name, seed):
    rng = np.random.default_rng(seed)
    matrix, row = information(rng), rng.normal(size=5)
    more = matrix + np.outer(row, row)
    assert CRITERIA[name](more)[0] <= CRITERIA[name](matrix)[0] + 1e-12


@given(st.sampled_from(["A", "D"]), SEEDS, st.floats(0.1, 10.0))
def test_twice_the_noise_is_twice_the_value(name, seed, factor):
    matrix = information(np.random.default_rng(seed))
    change = CRITERIA[name](matrix / factor**2)[0] - CRITERIA[name](matrix)[0]
    assert change == pytest.approx(np.log(factor), abs=1e-9)


@given(SEEDS)
def test_condition_ignores_units_and_noise(seed):
    rng = np.random.default_rng(seed)
    matrix, units = information(rng), np.diag(rng.uniform(0.1, 10.0, size=5))
    value = CRITERIA["cond"](matrix)[0]
    assert CRITERIA["cond"](7.0 * units @ matrix @ units)[0] == pytest.approx(value, abs=1e-8)
    assert value >= 0.0


def test_a_is_the_root_of_the_summed_variances():
    matrix = np.diag([4.0, 25.0])
    assert np.exp(CRITERIA["A"](matrix)[0]) == pytest.approx(np.sqrt(0.25 + 0.04), abs=1e-14)


@pytest.mark.parametrize("name", sorted(CRITERIA))
@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.ones((3, 3)), np.diag([1.0, 1.0, np.nan])])
def test_singular_information_is_infinitely_bad(name, matrix):
    value, gradient = CRITERIA[name](matrix)
    assert value == np.inf
    assert np.array_equal(gradient, np.zeros((3, 3)))


def test_a_frequency_that_samples_cannot_show_is_refused_for_what_it_is():
    with pytest.raises(InputError, match="--base-frequency 1e.09: harmonic 3 of it is at 3e.09 Hz"):
        design(arms.THREE, duration=15.0, base_frequency=1e9, harmonics=3)


def test_a_search_that_would_take_too_much_memory_is_refused_beforehand():
    with pytest.raises(InputError, match=r"would take about 3\d GB of memory.*--harmonics to \d+"):
        design(arms.THREE, duration=15.0, harmonics=3000)
    assert 1e5 < design(arms.THREE, duration=15.0, harmonics=9).memory < 3e6


STRONG_MOTORS = arms.DRY_FRICTION.replace(
    "</worldbody>",
    "</worldbody><actuator>"
    + "".join(
        f'<motor joint="joint{j}" ctrlrange="-{t} {t}" ctrllimited="true"/>'
        for j, t in enumerate((40, 90, 90))
    )
    + "</actuator>",
)


def columns(joints):
    """Names of the constraint families by column."""
    names = ("position", "velocity", "acceleration", "torque")
    return [name for name in names for _ in range(joints)] + ["tool speed", "clearance"]


LIMITED = ({}, {"max_tool_speed": 0.7}, {"payload_reserve": 2.0})


@given(st.sampled_from(LIMITED), SEEDS)
def test_the_gradient_of_constraints_equals_differences(limits, seed):
    constraints = partial(constraints_of, problem(STRONG_MOTORS, **limits), share=0.99)
    rng = np.random.default_rng(seed)
    motion, direction = rng.normal(size=(2, 3, 3, 3))
    cache = constraints(motion)
    weight = rng.uniform(size=cache.value.shape)
    gradient = cache.vjp(weight)
    exact = sum(np.sum(g * d) for g, d in zip(gradient, direction))
    size = sum(np.sum(np.abs(g * d)) for g, d in zip(gradient, direction))
    ahead, behind = (
        np.sum(weight * constraints(motion + step * direction).value) for step in (1e-6, -1e-6)
    )
    here = np.sum(weight * cache.value)
    # A coordinate that passes zero within the step has a kink there: two slopes.
    slopes = np.array([ahead - here, here - behind]) / 1e-6
    assert min(abs(slopes - exact)) < 1e-4 * size


def test_values_are_shares_of_the_limits_minus_one():
    some = problem(arms.THREE, max_acceleration=5.0)
    limits = some.limits
    q = np.vstack((limits.upper, limits.lower, 0.5 * (limits.lower + limits.upper)))
    qd, qdd = np.tile(limits.velocity, (3, 1)), np.tile(-0.5 * limits.acceleration, (3, 1))
    value = constraints_of(some, (q, qd, qdd)).value
    names = np.array(columns(3))
    assert np.allclose(value[:, names == "position"], [[0.0] * 3, [0.0] * 3, [-1.0] * 3])
    assert np.allclose(value[:, names == "velocity"], 0.0)
    assert np.allclose(value[:, names == "acceleration"], -0.5)
    assert np.all(value[:, names == "torque"] == -1.0)
    assert np.all(value[:, names == "tool speed"] == -1.0)


def test_gradient_of_the_clearance_equals_differences():
    some = problem(TUBES_AND_POST)
    rng = np.random.default_rng(2)
    checked = 0
    while checked < 20:
        q, direction = rng.uniform(-1.5, 1.5, size=(2, 1, 4))
        still = np.zeros((1, 4))

        def value(at, still=still):
            return constraints_of(some, (at, still, still)).value[0, -1]

        cache = constraints_of(some, (q, still, still))
        if cache.value[0, -1] <= -0.9:
            continue
        weight = np.zeros_like(cache.value)
        weight[0, -1] = 1.0
        exact = np.sum(cache.vjp(weight)[0] * direction)
        if value(q + 1e-4 * direction) + value(q - 1e-4 * direction) - 2 * value(q) < 1e-6:
            checked += 1
            assert exact == pytest.approx(slope(value, q, direction), rel=1e-3, abs=1e-3)
