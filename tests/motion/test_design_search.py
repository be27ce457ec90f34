"""Searches for an excitation: limits hold, a seed repeats, interruptions keep the best."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng

from robot_sysid.errors import InputError
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.motion import design as design_module
from robot_sysid.motion import design_search as search
from robot_sysid.motion.design import Design, constraints_of
from robot_sysid.motion.design_search import design_excitation, draw_trajectory
from robot_sysid.motion.expected_errors import prior_knowledge
from robot_sysid.motion.problem import ROUNDING
from robot_sysid.records.messages import Progress
from robot_sysid.trajectory import TrajectoryOptions, motion_chunks
from tests.support import arms, witness
from tests.support.arms import SEEDS
from tests.support.excitation_arms import (
    DURATION,
    TOUCHING_AT_REST,
    TUBES_AND_POST,
    TUBES_ON_FLOOR,
    known_arm,
    make_design,
    make_problem,
    options,
    robot,
)

ARMS = (
    arms.SLIDE_IN_CHAIN,
    arms.UNLIMITED,
    TUBES_AND_POST,
    TOUCHING_AT_REST,
    TUBES_ON_FLOOR,
)


def run_search(design, seed, progress=None, clock=design_module.clock):
    """Return the result of a search with the seed, a progress listener and a clock in seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(design_module, "clock", clock)
        return design_excitation(design, default_rng(seed), progress)


def search_problem(problem, **changes):
    """Return the result of a search with limits that are set on the problem itself."""
    motion = TrajectoryOptions(duration=DURATION)
    design = Design(problem, options(**changes), motion, known_arm(problem))
    return design_excitation(design, default_rng(0))


def assert_obeys(xml, seed, **changes):
    """Check every limit at 500 Hz against the arm's own limits, and contacts by MuJoCo."""
    result = run_search(make_design(xml, **changes), seed)
    problem = make_problem(xml)
    arm = robot(xml)
    slack = 1.0 + ROUNDING
    for motion in motion_chunks(result.trajectory, 500.0):
        assert np.all(motion.q >= arm.limits.lower)
        assert np.all(motion.q <= arm.limits.upper)
        assert np.all(np.abs(motion.qd) <= arm.limits.velocity * slack)
        assert np.all(np.abs(motion.qdd) <= problem.limits.acceleration * slack)
        assert np.all(np.abs(problem.torque(motion)) <= problem.limits.torque * slack)
    assert witness.new_contacts(arm, result.trajectory) == set()
    ends = result.trajectory.evaluate(np.array([0.0, result.trajectory.duration]))
    assert np.max(np.abs([ends.qd, ends.qdd])) < 1e-9
    assert result.limit_check.holds


@pytest.mark.slow
@given(st.sampled_from(ARMS), SEEDS)
def test_limits_hold_for_any_seed(xml, seed):
    assert_obeys(xml, seed, rounds=2, iterations=10)


@pytest.mark.parametrize("xml", [arms.SLIDE_IN_CHAIN, TUBES_ON_FLOOR])
def test_limits_hold_for_a_slide_joint_and_over_a_floor(xml):
    assert_obeys(xml, 1)


@pytest.mark.slow
def test_the_seed_alone_decides_the_trajectory():
    design = make_design(arms.THREE, starts=2)
    first, again, other = (
        run_search(design, seed).trajectory.coefficients for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again) and not np.array_equal(first, other)


class RecordedProgress(Progress):
    """A progress listener that records its calls and then runs a callback."""

    def __init__(self, then=lambda done: None):
        self.done = []
        self.totals = set()
        self._then = then

    def advance(self, label, done, total, text):
        self.done.append(done)
        self.totals.add(total)
        self._then(done)


def test_rounds_improve_the_objective_and_report_progress():
    progress = RecordedProgress()
    design = make_design(arms.THREE, rounds=3, iterations=20)
    result = run_search(design, 3, progress)
    assert result.objective < 0.9 * result.start_objective
    assert progress.done == sorted(progress.done)
    assert progress.totals == {progress.done[-1]}


def interrupt_after(rounds):
    """Return a listener that raises KeyboardInterrupt after the work of some rounds."""

    def interrupt(done):
        if done >= rounds:
            raise KeyboardInterrupt

    return RecordedProgress(interrupt)


@pytest.mark.parametrize("rounds", [2.0, 0.4])
def test_an_interruption_keeps_the_best_trajectory(rounds):
    """Interrupted in a round of improvement, or among the first draws."""
    result = run_search(make_design(arms.THREE, rounds=50), 3, interrupt_after(rounds))
    assert result.stopped == "interrupted"
    assert any("interrupted" in note for note in result.notes)
    assert result.limit_check.holds


def test_an_interruption_before_the_first_result_is_raised(monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(search, "_shrink_to_limits", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_search(make_design(arms.THREE), 3)


class Ticking:
    """A clock that advances by ``step`` seconds at each reading."""

    def __init__(self, step):
        self.step = step
        self.asked = 0

    def __call__(self):
        self.asked += 1
        return self.step * self.asked


@pytest.mark.parametrize("step", [1.0, 0.01])
def test_the_time_budget_ends_a_search_in_the_middle_of_a_job(step):
    """Time is up after the first draw, or in the first round of improvement."""
    clock = Ticking(step)
    design = make_design(
        arms.THREE, time_budget=0.5, draws=20, rounds=50, iterations=1000
    )
    result = run_search(design, 3, clock=clock)
    assert result.stopped == "time budget"
    assert any("--save-trajectory" in note for note in result.notes)
    assert result.limit_check.holds
    assert step * clock.asked < 0.5 + 10.0 * step


def test_the_limit_that_no_draw_keeps_is_named():
    # However slow, moving takes at least the friction.
    problem = make_problem(arms.DRY_FRICTION)
    weak = replace(problem.limits, torque=np.full(3, 1e-3))
    message = r"6 of 6 .* torque limit of joint joint"
    with pytest.raises(InputError, match=message) as caught:
        search_problem(replace(problem, limits=weak))
    assert "\n" not in str(caught.value)


DESIGNS = list(map(make_design, (arms.THREE, TUBES_AND_POST, arms.SLIDE_IN_CHAIN)))


@given(st.sampled_from(DESIGNS), SEEDS)
def test_every_feasible_draw_keeps_all_limits_on_the_grid(design, seed):
    """Each draw depends on the seed and its own number alone."""
    first, second, again = (draw_trajectory(design, seed, k) for k in (0, 1, 1))
    assert np.array_equal(again.x, second.x)
    assert not np.any(first.x) or not np.array_equal(first.x, second.x)
    if np.isfinite(first.score):
        value = constraints_of(design.problem, design.motion(first.x)).value
        assert np.max(value) <= ROUNDING
        assert (first.score, first.obstacle) == (design.criterion_of(first.x), "")
    else:
        assert not np.any(first.x) and first.obstacle


def test_the_target_decides_the_motion():
    """Improving a link's motion for a payload makes it worse for the link."""
    arm = make_problem(arms.serial_arm((arms.Z, arms.Y, arms.X)))
    motion = TrajectoryOptions(duration=4.0, sample_rate=100.0)
    search_options = options(draws=5, rounds=4, iterations=30)
    designs = []
    for target in ("link", "payload"):
        prior = prior_knowledge(arm, EstimationOptions(), target)
        designs.append(Design(arm, search_options, motion, prior))
    link, payload = designs
    x = design_excitation(link, default_rng(3)).trajectory.coefficients
    start = design_module.first_candidate(payload, x)
    other = design_module.improve(payload, start).feasible_x
    assert payload.criterion_of(other) < payload.criterion_of(x) - 0.01
    assert link.criterion_of(other) > link.criterion_of(x) + 0.005
