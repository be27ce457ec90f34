"""What the errors of servos hold, and what a search leaves alone."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.records import Measurement
from robot_sysid.servo import search
from robot_sysid.simulation.servos import ServoRollouts, Servos, model_servos
from tests.support.arms import robot_of
from tests.support.servo_logs import SERVOS, TRUTH, XML, commanded, positions

NUMBERS = st.lists(st.floats(0.0, 30.0), min_size=9, max_size=9)


def scale(xml=XML, moves=(True, True)):
    robot = robot_of(xml)
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 2))
    return search.first_servos(robot, q, 0.02, np.array(moves))


SCALE = scale()


@given(NUMBERS, st.lists(st.booleans(), min_size=2, max_size=2))
def test_unknowns_and_servos_are_the_same_thing(numbers, moves):
    own = scale(moves=moves)
    servos = Servos.of(np.array(numbers))
    back = own.servos(own.unknowns(servos)).vector()
    wanted = np.where(own.free, servos.vector(), own.start.vector())
    np.testing.assert_allclose(back, wanted, rtol=1e-9, atol=1e-9)


@given(NUMBERS)
def test_the_derivative_is_that_of_the_numbers(numbers):
    servos = Servos.of(np.array(numbers) + 0.01)
    x = SCALE.unknowns(servos)
    step = 1e-6
    moved = SCALE.servos(x + step).vector() - SCALE.servos(x - step).vector()
    np.testing.assert_allclose(
        moved / (2.0 * step), SCALE.derivative(servos), rtol=1e-4, atol=1e-7
    )


def test_a_search_begins_at_the_models_numbers_or_at_usual_ones():
    start = SCALE.start
    assert start.stiffness.tolist() == [100.0, 80.0] and start.damping.tolist() == [
        3.0,
        2.0,
    ]
    bare = scale(XML.replace(SERVOS, ""))
    assert np.all(bare.start.stiffness > 0.0) and np.all(bare.start.vector() > 0.0)


def test_errors_hold_what_the_links_masses_and_the_time_step_add():
    exact = search.ServoFit(
        TRUTH, Servos.of(np.full(9, 1e-9)), np.ones(9, dtype=bool), np.ones(2)
    )
    errors = search.with_links_error(
        exact, np.array([0.5 * search.LEAST_SHARE, 1.0])
    ).errors
    assert errors.stiffness[0] == pytest.approx(TRUTH.stiffness[0])
    assert errors.stiffness[1] == pytest.approx(
        search.LINKS_WRONG * TRUTH.stiffness[1], rel=0.1
    )
    assert errors.armature[1] >= search.STEP * TRUTH.damping[1]
    assert errors.delay == pytest.approx(0.5 * search.STEP)
    still = replace(exact, errors=Servos.of(np.zeros(9)))
    assert not np.any(search.with_links_error(still, np.ones(2)).errors.vector())


def test_what_is_held_out_shares_no_sample_with_what_is_fitted():
    time = np.arange(500) / 50.0
    q = np.outer(np.sin(time), [1.0, 2.0])
    log = Measurement(time, q, None, 0.0 * q, command=q)
    (fitted,), (held,) = search.parted([log])
    np.testing.assert_array_equal(np.concatenate((fitted.time, held.time)), time)
    assert len(held) == 100 and fitted.time[-1] < held.time[0]


def test_joints_that_do_not_move_keep_the_models_numbers():
    bare = XML.replace(' frictionloss=".3"', "")
    own = scale(bare, (True, False)).start
    assert own.frictionloss[0] > 0.0 and own.frictionloss[1] == 0.0


SMALL = """<mujoco><worldbody><body>
<joint name="pan" axis="0 0 1" range="-2 2" damping=".6" armature=".028"/>
<inertial pos="0 0 .05" mass=".2" diaginertia="2e-4 2e-4 2e-4"/><body pos="0 0 .1">
<joint name="lift" axis="0 1 0" range="-2 2" damping=".6" armature=".028"/>
<inertial pos=".12 0 .02" mass=".3" diaginertia="2e-4 5e-4 5e-4"/></body></body></worldbody>
<actuator><general joint="pan" biastype="affine" gainprm="KP" biasprm="0 -KP -2.7"
  forcerange="-3.35 3.35"/>
<general joint="lift" biastype="affine" gainprm="KP" biasprm="0 -KP -2.7"
  forcerange="-3.35 3.35"/></actuator></mujoco>"""
"""Two joints like those of a small hobby arm, without friction."""


def of_small(kp, friction, stated):
    """Judge some friction of what an encoder reads of an arm with other friction."""
    robot = robot_of(SMALL.replace("KP", kp))
    (time, command) = commanded(8.0)
    own = replace(model_servos(robot), delay=0.02)
    q = positions(robot, time, command, replace(own, frictionloss=friction), steps=20)
    log = Measurement(time, q, None, command - q, command=command)
    sought = search.first_servos(robot, q[::10], 0.02, np.array([True, True]))
    problem = search.problem_of(ServoRollouts(robot), [log])
    return search.judged(
        search.Slopes(problem), sought, replace(own, frictionloss=stated)
    )


def test_friction_behind_a_stiff_servo_is_not_seen_and_its_error_holds_what_could_be():
    truth = np.array([0.13, 0.1])
    for stated in (0.0 * truth, truth):
        fit = of_small("998", truth, stated)
        assert np.all(np.abs(stated - truth) <= 2.0 * fit.errors.frictionloss)
        assert not np.any(fit.seen[4:6])
    fit = of_small("20", truth, truth)
    assert np.all(fit.seen) and np.all(fit.errors.frictionloss < 0.2 * truth)


def test_a_row_counts_no_more_than_usual_and_rest_is_not_usual():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(1000, 2)) * [1.0, 1e-3]
    moves = np.ones(1000, dtype=bool)
    usual = search.usual_share(rows, moves)
    assert np.mean(usual) > 0.8
    rows[:9] *= 1e3
    share = search.usual_share(rows, moves)
    np.testing.assert_allclose(share[9:], usual[9:], rtol=0.05)
    assert np.max(np.abs(rows * share[:, None]) / [1.0, 1e-3]) < 2.0
    rested = search.usual_share(
        np.concatenate((rows, 0.0 * rows)), np.append(moves, ~moves)
    )
    np.testing.assert_array_equal(rested, np.append(share, np.ones(1000)))


ROWS = 400
STEPS = 10


@dataclass(frozen=True)
class Linear:
    """Errors of two joints that go with every number, and with how long a step is."""

    edges: np.ndarray
    slopes: np.ndarray
    noise: np.ndarray
    drift: float = 0.0
    played: list = field(default_factory=list)

    def moves(self):
        return np.ones((ROWS, 2), dtype=bool)

    def errors(self, choices):
        self.played.extend(choices)
        step = self.drift * (STEPS / (len(self.edges) - 1) - 1.0) * self.slopes[:, :, 0]
        off = [choice.vector() - SCALE.size.vector() for choice in choices]
        return np.array([self.noise + step + self.slopes @ each for each in off])


def problem_of_slopes(drift=0.0, wild=0.0):
    """A problem in which each number shows in its own joint alone, the delay in both."""
    rng = np.random.default_rng(0)
    own = np.append(np.tile(np.eye(2), 4), np.ones((2, 1)), axis=1)
    slopes = 1e-3 * rng.normal(size=(ROWS, 2, 9)) * own / SCALE.size.vector()
    slopes[ROWS // 2] *= 1.0 + wild
    noise = 1e-4 * rng.normal(size=(ROWS, 2))
    return Linear(np.linspace(0.0, 1.0, STEPS + 1), slopes, noise, drift)


def linear(drift=0.0, wild=0.0):
    """What is found of such a problem at the usual sizes."""
    zero = replace(SCALE, start=SCALE.size)
    problem = problem_of_slopes(drift, wild)
    return search.judged(search.Slopes(problem), zero, Servos.of(SCALE.size.vector()))


def test_slopes_that_are_known_are_not_played_again():
    problem = problem_of_slopes()
    servos = Servos.of(SCALE.size.vector())
    slopes = search.Slopes(problem)
    sought = replace(SCALE, free=np.arange(9) % 2 == 0)
    some = slopes(sought, servos)
    np.testing.assert_array_equal(slopes(SCALE, servos)[..., ::2], some)
    assert len(problem.played) == 2 * 9
    moved = Servos.of(1.1 * SCALE.size.vector())
    np.testing.assert_array_equal(
        slopes(sought, moved), search.Slopes(problem)(sought, moved)
    )


def test_errors_hold_what_shorter_steps_would_change():
    """Half as long they move joint 0 like a stiffness of 20, so without length like 40."""
    still, moved = (linear(drift).errors.stiffness for drift in (0.0, 40.0))
    assert np.hypot(still[0], 40.0) == pytest.approx(moved[0], rel=0.05)
    assert moved[1] == pytest.approx(still[1], rel=0.05)


def test_a_row_that_runs_off_by_luck_does_not_make_numbers_surer():
    plain, lucky = (linear(wild=wild).errors.vector() for wild in (0.0, 1e3))
    np.testing.assert_allclose(lucky, plain, rtol=0.1)


def test_what_is_not_seen_is_as_in_the_model_where_it_has_any():
    robot = robot_of(XML)
    bare = robot_of(XML.replace(SERVOS, ""))
    which = np.arange(9) % 2 == 0
    own = model_servos(robot).vector()
    found = TRUTH.vector()
    mixed = search.as_in_model(robot, TRUTH, which).vector()
    np.testing.assert_array_equal(mixed[:-1], np.where(which, own, found)[:-1])
    whole = search.as_in_model(bare, TRUTH)
    np.testing.assert_array_equal(whole.stiffness, TRUTH.stiffness)
    np.testing.assert_array_equal(whole.frictionloss, model_servos(bare).frictionloss)
    assert mixed[-1] == whole.delay == TRUTH.delay
