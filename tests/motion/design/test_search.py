"""Searches: what is found keeps all limits, is the same for a seed, and survives an end."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.model.contacts import find_new_contacts
from robot_sysid.motion.design import workers
from robot_sysid.motion.design.optimise import Design, constraints_of
from robot_sysid.motion.design.search import design_excitation, draw_trajectories
from robot_sysid.motion.limit_check import keeps_limits
from robot_sysid.motion.options import ExcitationOptions, LimitOptions
from robot_sysid.motion.prediction import arm_criterion
from robot_sysid.motion.problem import ROUNDING, build_problem
from robot_sysid.records.progress import Progress
from robot_sysid.trajectory import TrajectoryOptions, motion_chunks
from tests.support import arms
from tests.support.arms import SEEDS
from tests.support.excitation_arms import (
    DURATION,
    TOUCHING_AT_REST,
    TUBES,
    TUBES_AND_POST,
    TUBES_ON_FLOOR,
    design,
    options,
    problem,
    robot,
)

ARMS = (arms.THREE, arms.SLIDE_IN_CHAIN, arms.UNLIMITED, TUBES, TUBES_AND_POST, TOUCHING_AT_REST)


def search(xml, seed, progress=None, clock=workers.clock, torques="chain", **changes):
    some = design(xml, torques, **changes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "clock", clock)
        return design_excitation(some, np.random.default_rng(seed), progress)


def search_of(some_problem, seed=0, **changes):
    """Search with limits that no option says."""
    motion = TrajectoryOptions(duration=DURATION)
    some = Design(some_problem, options(**changes), motion)
    return design_excitation(some, np.random.default_rng(seed))


def assert_obeys(xml, result, some):
    """Every limit at 1 kHz by the records of the arm itself, and no contact by MuJoCo."""
    arm, slack = robot(xml), 1.0 + ROUNDING
    for motion in motion_chunks(result.trajectory, 1000.0):
        assert np.all(motion.q >= arm.limits.lower) and np.all(motion.q <= arm.limits.upper)
        assert np.all(np.abs(motion.qd) <= arm.limits.velocity * slack)
        assert np.all(np.abs(motion.qdd) <= some.limits.acceleration * slack)
        assert np.all(np.abs(some.torque(motion)) <= some.limits.torque * slack)
    assert find_new_contacts(arm, motion_chunks(result.trajectory, 1000.0)) == ()


def assert_at_rest(result):
    ends = result.trajectory.evaluate(np.array([0.0, result.trajectory.duration]))
    assert np.max(np.abs(ends.qd)) < 1e-9
    assert np.max(np.abs(ends.qdd)) < 1e-9
    assert np.max(np.abs(ends.q - ends.q[0])) < 1e-9


@pytest.mark.slow
@given(st.sampled_from(ARMS), SEEDS, st.sampled_from(["faded", "periodic"]))
@settings(max_examples=8)
def test_limits_hold_for_any_seed(xml, seed, ends):
    result = search(xml, seed, ends=ends)
    assert result.limit_check.holds
    assert_obeys(xml, result, problem(xml))
    assert_at_rest(result)


@pytest.mark.slow
@given(
    st.sampled_from(ARMS),
    SEEDS,
    st.sampled_from(["faded", "periodic"]),
    st.sampled_from(["A", "D", "cond"]),
)
def test_limits_hold_for_any_seed_and_criterion(xml, seed, ends, criterion):
    result = search(xml, seed, ends=ends, criterion=criterion, rounds=2, iterations=10)
    assert result.limit_check.holds
    assert_obeys(xml, result, problem(xml))
    assert_at_rest(result)


@pytest.mark.slow
def test_same_seed_same_trajectory_other_seed_another():
    one, two, other = (search(TUBES, seed) for seed in (7, 7, 8))
    assert np.array_equal(one.trajectory.coefficients, two.trajectory.coefficients)
    assert not np.array_equal(one.trajectory.coefficients, other.trajectory.coefficients)


@pytest.mark.slow
def test_the_number_of_workers_does_not_matter():
    alone, together = (search(arms.THREE, 1, workers=w, starts=2) for w in (1, 2))
    assert np.array_equal(alone.trajectory.coefficients, together.trajectory.coefficients)
    assert alone.objective == together.objective


@pytest.mark.slow
def test_more_rounds_are_never_worse():
    values = [search(TUBES_AND_POST, 2, rounds=r).objective for r in (0, 1, 3)]
    assert values[0] >= values[1] >= values[2]
    assert values[2] < 0.9 * values[0]


class Told(Progress):
    """Notes what it is told, and then does something."""

    def __init__(self, then=lambda done: None):
        self.done, self.totals, self.texts, self._then = [], set(), [], then

    def advance(self, label, done, total, text):
        self.done.append(done)
        self.totals.add(total)
        self.texts.append(text)
        self._then(done)


def test_progress_tells_the_objective():
    seen = Told()
    result = search(TUBES, 3, seen, rounds=2)
    assert seen.done == sorted(seen.done)
    assert seen.totals == {seen.done[-1]}
    assert seen.texts[-1] == f"mean standard deviation {result.objective:.3g}"
    told = [float(text.rpartition(" ")[2]) for text in seen.texts[2:]]
    assert told == sorted(told, reverse=True)


def test_time_budget_cuts_and_says_so():
    ticks = itertools.count(step=10.0)
    result = search(TUBES, 3, clock=lambda: float(next(ticks)), time_budget=15.0, rounds=50)
    assert result.stopped == "time budget"
    assert result.limit_check.holds
    assert any("--save-trajectory" in note for note in result.notes)


@pytest.mark.parametrize("workers", [1, 2])
def test_ctrl_c_keeps_the_best_so_far(workers):
    def interrupt(done):
        if done >= 2:
            raise KeyboardInterrupt

    result = search(TUBES, 3, Told(interrupt), rounds=50, workers=workers)
    assert result.stopped == "interrupted"
    assert any("interrupted" in note for note in result.notes)
    assert result.limit_check.holds


def test_ctrl_c_before_there_is_anything_is_an_interruption(monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("robot_sysid.motion.design.search._shrunk", interrupt)
    with pytest.raises(KeyboardInterrupt):
        search(TUBES, 3)


def test_ctrl_c_among_the_first_draws_keeps_the_best_of_them():
    def interrupt(done):
        raise KeyboardInterrupt

    result = search(TUBES, 3, Told(interrupt), draws=300)
    assert (result.stopped, result.n_drawn) == ("interrupted", 5)
    assert result.limit_check.holds
    assert result.objective == pytest.approx(result.start_objective)


class Ticking:
    """A clock that moves by as much as it is asked."""

    def __init__(self, step):
        self.step, self.asked = step, 0

    def __call__(self):
        self.asked += 1
        return self.step * self.asked


@pytest.mark.parametrize(("step", "drawn"), [(1.0, 1), (0.01, 20)])
def test_a_search_ends_in_the_middle_of_a_job(step, drawn):
    """Time is up after the first draw, or in the first round of improvement."""
    clock = Ticking(step)
    long = {"draws": 20, "rounds": 50, "iterations": 1000}
    result = search(TUBES, 3, clock=clock, time_budget=0.5, **long)
    assert (result.stopped, result.n_drawn) == ("time budget", drawn)
    assert result.limit_check.holds
    assert step * clock.asked < 0.5 + 10.0 * step


def test_a_search_that_is_late_checks_what_it_gives_back_and_nothing_else(monkeypatch):
    def refused(*_):
        raise AssertionError("checked twice")

    monkeypatch.setattr("robot_sysid.motion.design.optimise.keeps_limits", refused)
    result = search(TUBES, 3, clock=Ticking(1.0), time_budget=0.5)
    assert (result.stopped, result.limit_check.holds) == ("time budget", True)


def test_the_limits_that_hold_the_motion_back_are_told():
    result = search(TUBES, 3, rounds=4, iterations=30)
    dearest = max(result.prices, key=result.prices.get)
    assert all(price >= 0.0 for price in result.prices.values())
    (note,) = [note for note in result.notes if "keep the errors from being smaller" in note]
    assert note.split(": ")[1].startswith(dearest)
    late = search(TUBES, 3, clock=Ticking(1.0), time_budget=0.5)
    assert not any("keep the errors" in note for note in late.notes)


def weak(xml, torque):
    """The problem of an arm whose motors are all that weak."""
    some = problem(xml)
    return replace(some, limits=replace(some.limits, torque=np.full(some.n_joints, torque)))


def test_where_nothing_is_feasible_the_limit_is_named():
    # Without gravity holding the arm takes nothing; moving it takes at least its friction.
    stiff = TUBES.replace("<option />", '<option gravity="0 0 0"/>')
    stiff = stiff.replace('range="-2.5 2.5"', 'range="-2.5 2.5" frictionloss=".01"')
    with pytest.raises(InputError, match=r"6 of 6 .* torque limit of joint joint") as caught:
        search_of(weak(stiff, 1e-3))
    assert "\n" not in str(caught.value)


def test_the_floor_of_the_model_is_not_touched():
    result = search(TUBES_ON_FLOOR, 0, rounds=2, iterations=20)
    assert_obeys(TUBES_ON_FLOOR, result, problem(TUBES_ON_FLOOR))


@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_a_tighter_speed_limit_is_kept(speed):
    some = problem(arms.THREE)
    slow = replace(some, limits=replace(some.limits, velocity=np.full(3, speed)))
    result = search_of(slow)
    fastest = np.max(result.limit_check.joints[1])
    assert 0.3 * speed < fastest <= speed * (1.0 + ROUNDING)


@pytest.mark.slow
def test_the_tool_is_as_slow_as_asked_for_and_hardly_slower():
    result = search_of(problem(TUBES, max_tool_speed=0.3), iterations=20, rounds=2)
    assert result.limit_check.holds
    assert 0.2 < result.limit_check.tool_speed <= 0.3 * (1.0 + ROUNDING)


def test_a_load_within_the_reserve_breaks_no_torque_limit():
    some, loaded = (problem(TUBES, max_torque=25.0, payload_reserve=kg) for kg in (0.0, 1.5))
    result = search_of(loaded)
    motion = result.trajectory.evaluate(np.arange(600) / 100.0)
    torque = some.torque(motion) + 1.5 * some.torque_per_kilogram(motion)
    assert np.max(np.abs(torque)) <= 0.95 * 25.0 * (1.0 + ROUNDING)


def test_terminal_torques_optimise_what_they_can_show():
    result = search(arms.SEVEN, 0, torques="terminal")
    assert np.isfinite(result.objective)
    assert result.limit_check.holds


def test_the_duration_is_that_of_the_trajectory_options():
    assert search(arms.THREE, 0, duration=4.0).trajectory.duration == 4.0


PERIODIC = {"ends": "periodic"}
DESIGNS = [
    design(arms.THREE),
    design(TUBES),
    design(arms.SLIDE_IN_CHAIN),
    design(arms.UNLIMITED, **PERIODIC),
]


@given(st.sampled_from(DESIGNS), SEEDS)
def test_every_feasible_draw_keeps_all_limits_on_the_grid(some, seed):
    (draw,) = draw_trajectories(some, seed, [0])
    if np.isfinite(draw.score):
        value = constraints_of(some.problem, some.motion(draw.x)).value
        assert np.max(value) <= ROUNDING
        assert draw.obstacle == ""
    else:
        assert not np.any(draw.x)


def test_most_draws_of_an_arm_in_free_space_are_feasible():
    draws = draw_trajectories(design(TUBES), 0, range(30))
    assert sum(np.isfinite(draw.score) for draw in draws) > 20


def test_a_draw_depends_on_its_number_and_the_seed_alone():
    some = design(TUBES_AND_POST)
    together = draw_trajectories(some, 5, range(4))
    alone = draw_trajectories(some, 5, [2])[0]
    other_seed = draw_trajectories(some, 6, [2])[0]
    assert np.array_equal(together[2].x, alone.x)
    assert together[2].score == alone.score
    assert not np.array_equal(alone.x, other_seed.x)


def test_a_draw_that_fits_nowhere_names_what_is_in_the_way():
    some = design(TUBES)
    # Shoulders that hold less than the arm weighs, at rest and in any other posture.
    weak = np.full(4, 1e-3)
    object.__setattr__(some.problem.limits, "torque", weak)
    try:
        (draw,) = draw_trajectories(some, 0, [0])
    finally:
        object.__setattr__(some.problem.limits, "torque", np.full(4, np.inf))
    assert draw.score == np.inf
    assert "torque limit of joint joint" in draw.obstacle


@pytest.mark.parametrize("some", DESIGNS)
def test_the_score_is_the_criterion(some):
    draw = min(draw_trajectories(some, 1, range(5)), key=lambda d: d.score)
    assert draw.score == some.criterion_of(draw.x)


ROBOT = arms.robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X)))
DRAWS = 5


def arm_design(**limits):
    problem = build_problem(ROBOT, LimitOptions(**limits))
    options = ExcitationOptions(kind="optimal", draws=DRAWS, time_budget=1e6, workers=1)
    motion = TrajectoryOptions(duration=4.0, sample_rate=100.0)
    return Design(problem, options, motion, for_arm=True)


def test_for_a_whole_arm_the_best_draw_is_taken():
    design, seen = arm_design(), Told()
    result = design_excitation(design, np.random.default_rng(3), seen)
    assert keeps_limits(design.problem, result.trajectory)
    seed = int(np.random.default_rng(3).integers(2**62))
    draws = draw_trajectories(design, seed, range(DRAWS))
    told = [arm_criterion(design.problem, design.trajectory(d.x)) for d in draws]
    assert np.log(result.objective) == pytest.approx(min(told), rel=1e-12)
    assert arm_criterion(design.problem, result.trajectory) == pytest.approx(min(told), rel=1e-12)
    assert seen.texts[-1] == f"mean standard deviation {result.objective:.3g}"


def test_a_larger_motion_tells_more():
    design = arm_design()
    plan = design_excitation(design, np.random.default_rng(3)).trajectory
    smaller = arm_criterion(design.problem, replace(plan, coefficients=0.5 * plan.coefficients))
    assert smaller > arm_criterion(design.problem, plan)


def test_limits_that_nothing_of_a_whole_arm_keeps_are_said():
    with pytest.raises(InputError, match="no trajectory is feasible: 5 of 5 .* torque limit"):
        design_excitation(arm_design(max_torque=(0.01,)), np.random.default_rng(0))
