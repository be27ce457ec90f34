"""Searches for a motion: gradients, limits, repeatable by seed, interruptions keep the best."""

import time
from dataclasses import replace
from functools import partial
from itertools import count

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng

from rigs.arms import small_arms, witness
from rigs.arms.excitation_arms import (
    DURATION,
    TOUCHING_AT_REST,
    TUBES_AND_POST,
    TUBES_ON_FLOOR,
    known_arm,
    link_covariance,
    make_design,
    make_problem,
    options,
    random_x,
    robot,
    slope,
)
from rigs.arms.small_arms import SEEDS
from rigs.files.notes import NoteRecorder
from robot_sysid.errors import InputError
from robot_sysid.expected.criterion import Criterion
from robot_sysid.motion import search
from robot_sysid.motion.limit_check import keeps_limits
from robot_sysid.motion.search import (
    GRID_PER_CYCLE,
    INFORMATION_POINTS,
    Design,
    constraint_gradient,
    constraints_of,
    design_excitation,
    draw_trajectory,
)
from robot_sysid.records.limits import ROUNDING
from robot_sysid.records.messages import Progress
from robot_sysid.trajectory import TrajectoryOptions, motion_chunks

ARMS = (
    small_arms.SLIDE_IN_CHAIN,
    small_arms.UNLIMITED,
    TUBES_AND_POST,
    TOUCHING_AT_REST,
    TUBES_ON_FLOOR,
)


def run_search(design, seed, progress=None, clock=time.monotonic):
    """Return the trajectory of a search with the seed, a progress listener and a clock."""
    return design_excitation(design, default_rng(seed), progress or Progress(), clock)


def assert_obeys(xml, seed, **changes):
    """Check every limit at 500 Hz against the arm's own limits, and contacts by MuJoCo."""
    plan = run_search(make_design(xml, **changes), seed)
    problem = make_problem(xml)
    arm = robot(xml)
    slack = 1.0 + ROUNDING
    for motion in motion_chunks(plan, 500.0):
        assert np.all(motion.q >= arm.limits.lower)
        assert np.all(motion.q <= arm.limits.upper)
        assert np.all(np.abs(motion.qd) <= arm.limits.velocity * slack)
        assert np.all(np.abs(motion.qdd) <= problem.limits.acceleration * slack)
        assert np.all(np.abs(problem.torque(motion)) <= problem.limits.torque * slack)
    assert witness.new_contacts(arm, plan) == set()
    ends = plan.evaluate(np.array([0.0, plan.duration]))
    assert np.max(np.abs([ends.qd, ends.qdd])) < 1e-9
    assert keeps_limits(problem, plan)


@pytest.mark.slow
@given(st.sampled_from(ARMS), SEEDS)
def test_limits_hold_for_any_seed(xml, seed):
    assert_obeys(xml, seed, rounds=2, iterations=10)


@pytest.mark.parametrize("xml", [small_arms.SLIDE_IN_CHAIN, TUBES_ON_FLOOR])
def test_limits_hold_for_a_slide_joint_and_over_a_floor(xml):
    assert_obeys(xml, 1, iterations=2)


@pytest.mark.slow
def test_rounds_keep_the_best_feasible_trajectory():
    """A start that exceeds its limits is made feasible, and rounds only improve the score."""
    design = make_design(TUBES_AND_POST, iterations=5)
    draws = [draw_trajectory(design, 0, number) for number in range(4)]
    best = min(draws, key=lambda draw: draw.score)
    candidate = search.first_candidate(design, 1.5 * best.x)
    assert not keeps_limits(design.problem, design.trajectory(candidate.x))
    assert np.linalg.norm(candidate.feasible_x) < np.linalg.norm(candidate.x)
    scores = [candidate.feasible_score]
    for _ in range(2):
        candidate = search.improve(design, candidate, tick=lambda: None)
        scores.append(candidate.feasible_score)
        assert keeps_limits(design.problem, design.trajectory(candidate.feasible_x))
    assert scores[0] >= scores[1] >= scores[2]
    assert scores[2] == design.criterion_of(candidate.feasible_x) < scores[0] - 0.1


@given(SEEDS)
def test_gradient_equals_differences(seed):
    design = make_design(small_arms.THREE)
    rng = default_rng(seed)
    problem = design.problem
    n_constraints = len(problem.limits.columns) + problem.obstacles.n_pairs
    multipliers = rng.uniform(size=(len(design.grid), n_constraints))
    x = random_x(design, seed)
    direction = random_x(design, seed + 1, 1.0)
    candidate = search.Candidate(x, x, multipliers)
    objective = partial(search.penalised_objective, design, candidate)
    exact = np.sum(objective(x)[1] * direction)
    value = slope(lambda at: objective(at)[0], x, direction)
    assert value == pytest.approx(exact, rel=1e-4, abs=1e-4 * (1.0 + np.abs(exact)))


def test_all_points_are_looked_at_where_a_motion_breaks_limits():
    """It may break them between every second one, where nothing would ever pull it away."""
    design = make_design(small_arms.THREE)
    candidate = search.first_candidate(design, random_x(design, 0, 0.01))
    assert candidate.obstacle_step == search.OBSTACLE_STEP > 1
    improved = search.improve(design, candidate, tick=lambda: None)
    assert improved.lead >= search.LEAST_LEAD
    assert improved.obstacle_step == 1


def test_distances_between_the_points_that_are_looked_at_count_as_far():
    problem = make_problem(TUBES_AND_POST)
    motion = default_rng(0).normal(size=(3, 60, problem.n_joints))
    every, _ = constraints_of(problem, motion)
    second, pairs = constraints_of(problem, motion, obstacle_step=2)
    n_signals = len(problem.limits.columns)
    np.testing.assert_array_equal(second[::2], every[::2])
    np.testing.assert_array_equal(second[1::2, :n_signals], every[1::2, :n_signals])
    assert np.all(every[1::2, n_signals:] > -1.0)
    assert np.all(second[1::2, n_signals:] == -1.0)
    assert len(pairs.posture) and not np.any(pairs.posture % 2)


STRONG_MOTORS = small_arms.DRY_FRICTION.replace(
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
    problem = make_problem(STRONG_MOTORS, **limits)
    rng = default_rng(seed)
    motion, direction = rng.normal(size=(2, 3, 3, 3))
    value, pairs = constraints_of(problem, motion)
    weight = rng.uniform(size=value.shape)
    gradient = constraint_gradient(problem, motion, pairs, weight)
    products = np.stack(gradient) * direction
    steps = 1e-6 * np.array([-1.0, 0.0, 1.0])
    moved = [constraints_of(problem, motion + s * direction)[0] for s in steps]
    values = [np.sum(weight * constraints) for constraints in moved]
    # A coordinate that passes zero within the step has a kink there: two slopes.
    slopes = np.diff(values) / 1e-6
    size = np.sum(np.abs(products))
    assert np.min(np.abs(slopes - np.sum(products))) < 1e-4 * size


@pytest.mark.slow
@pytest.mark.parametrize("xml", [small_arms.SEVEN, small_arms.SLIDE_IN_CHAIN])
def test_the_grid_is_fine_enough_for_the_band(xml):
    """On the search's grid, with rounded friction, no deviation is off by more than 3 %."""
    design = make_design(xml, duration=15.0)
    coarse = GRID_PER_CYCLE / INFORMATION_POINTS.step * design.top_frequency_hz

    def deviations(plan, rate, smoothing):
        """Return predicted standard deviations (10,) of the last link's parameters."""
        time = (np.arange(int(plan.duration * rate)) + 0.5) / rate
        prior = known_arm(design.problem)
        criterion = Criterion(design.problem, prior, 1.0 / len(time), smoothing)
        motion = plan.evaluate(time)
        covariance = link_covariance(criterion, (motion.q, motion.qd, motion.qdd))
        return np.sqrt(np.diag(covariance))

    for number in range(4):
        plan = design.trajectory(draw_trajectory(design, 2, number).x)
        ratio = deviations(plan, coarse, 0.03) / deviations(plan, 500.0, 1e-9)
        assert np.max(np.abs(ratio - 1.0)) < 0.03


def test_a_long_motion_repeats_itself_within_the_band():
    design = make_design(small_arms.THREE, duration=200.0)
    time = np.linspace(0.0, 50.0, 101)
    plan = design.trajectory(draw_trajectory(design, 0, 0).x)
    motion = plan.evaluate(np.append(50.0 + time, 100.0 + time))
    assert np.allclose(*np.split(motion.q, 2), atol=1e-9)
    assert design.top_frequency_hz == pytest.approx(0.6)
    assert make_design(small_arms.THREE, duration=2.0).top_frequency_hz == 1.5


def test_rounds_improve_the_objective_and_report_progress():
    scores = []
    for rounds, iterations in ((1, 0), (2, 6)):
        progress = NoteRecorder()
        design = make_design(small_arms.THREE, rounds=rounds, iterations=iterations)
        plan = run_search(design, 3, progress)
        motion = plan.evaluate(design.grid[INFORMATION_POINTS])
        scores.append(design.criterion.evaluate((motion.q, motion.qd, motion.qdd)))
        shares = progress.shares
        assert np.all(np.diff(shares) >= 0.0) and shares[-1] == 1.0
    assert scores[1] < scores[0] - 0.1
    assert shares[0] < 0.1 and 0.6 < shares[-2] < 1.0


def test_the_progress_is_full_only_when_the_search_has_ended():
    """However many rounds follow: the last share before the end is far from full."""
    progress = NoteRecorder()
    design = make_design(small_arms.THREE, rounds=40, iterations=3)
    run_search(design, 3, progress)
    *before, last = progress.shares
    assert last == 1.0 and len(before) > 10
    assert max(before) < 0.97 and np.all(np.diff(progress.shares) >= 0.0)


def test_an_interruption_keeps_the_best_trajectory():
    def interrupt(share):
        if 0.5 < share < 1.0:
            raise KeyboardInterrupt

    progress = NoteRecorder(interrupt)
    design = make_design(small_arms.THREE, rounds=50)
    plan = run_search(design, 3, progress)
    assert any("ended early" in note for note in progress.notes)
    assert keeps_limits(design.problem, plan)


def test_an_interruption_before_the_first_result_is_raised():
    def interrupt(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_search(make_design(small_arms.THREE), 3, NoteRecorder(interrupt))


@pytest.mark.parametrize("step", [1.0, 0.01])
def test_the_time_budget_ends_a_search_in_the_middle_of_a_job(step):
    """Time is up after the first draw, or in the first round of improvement."""
    # Each reading is a step later than the one before.
    clock = count(step, step).__next__
    design = make_design(
        small_arms.THREE, time_budget=0.5, draws=20, rounds=50, iterations=1000
    )
    progress = NoteRecorder()
    plan = run_search(design, 3, progress, clock)
    assert any("ended early" in note for note in progress.notes)
    assert keeps_limits(design.problem, plan)
    assert clock() < 0.5 + 11.0 * step


def test_the_limit_that_no_draw_keeps_is_named():
    # However slow, moving takes at least the friction.
    problem = make_problem(small_arms.DRY_FRICTION)
    weak = replace(problem.limits, torque=np.full(3, 1e-3))
    problem = replace(problem, limits=weak)
    motion = TrajectoryOptions(duration=DURATION)
    design = Design(problem, options(), motion, known_arm(problem))
    with pytest.raises(InputError, match=r"18 of 18 .* torque limit of joint joint"):
        design_excitation(design, default_rng(0), Progress())


def test_an_arm_that_rests_at_its_limits_has_a_motion():
    """As a Trossen WXAI does, folded: its shoulder and elbow turn one way only."""
    folded = small_arms.serial_arm(
        (small_arms.Z, small_arms.Y, small_arms.X), joint='range="0 2"'
    )
    design = make_design(folded)
    assert np.isfinite(draw_trajectory(design, 0, 0).score)


DESIGNS = list(
    map(make_design, (small_arms.THREE, TUBES_AND_POST, small_arms.SLIDE_IN_CHAIN))
)


@given(st.sampled_from(DESIGNS), SEEDS)
def test_every_feasible_draw_keeps_all_limits_on_the_grid(design, seed):
    """Each draw depends on the seed and its own number alone."""
    first, second, again = (draw_trajectory(design, seed, k) for k in (0, 1, 1))
    assert np.array_equal(again.x, second.x)
    assert not np.any(first.x) or not np.array_equal(first.x, second.x)
    if np.isfinite(first.score):
        value, _ = constraints_of(design.problem, design.motion(first.x))
        assert np.max(value) <= ROUNDING
        assert (first.score, first.obstacle) == (design.criterion_of(first.x), "")
    else:
        assert not np.any(first.x) and first.obstacle
