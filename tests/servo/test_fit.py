"""What the standard errors of servo parameters include, and which numbers a search leaves alone."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.records import Measurement
from robot_sysid.records.messages import Progress
from robot_sysid.servo import fit as servo_fit
from robot_sysid.servo.loop_equations import LINK_ERROR
from robot_sysid.servo.windows import ServoProblem, make_problem, split_pieces
from robot_sysid.simulation.playback import (
    STEP,
    ServoParameters,
    ServoRollouts,
    servos_in_model,
)
from tests.support.arms import robot_of
from tests.support.servo_logs import SERVOS, TRUTH, XML, commanded, positions

from_vector = ServoParameters.from_vector
VECTORS = st.lists(st.floats(0.0, 30.0), min_size=9, max_size=9).map(np.array)


def log_of(xml, truth=TRUTH, steps=10, seconds=8.0):
    """A log of an arm whose links are as in a model, behind servos with the true parameters."""
    time, command = commanded(seconds)
    q = positions(robot_of(xml), time, command, truth, steps)
    return Measurement(time, q, None, command - q, command=command)


LOG = log_of(XML)


def parametrisation(xml=XML, moves=(True, True)):
    scale, _ = servo_fit.initial_parametrisation(robot_of(xml), [LOG], np.array(moves))
    return scale


ALL_FREE = replace(parametrisation(), free=np.ones(9, dtype=bool))
TYPICAL = ALL_FREE.typical


@given(VECTORS, st.lists(st.booleans(), min_size=2, max_size=2))
def test_unknowns_stand_for_the_free_numbers(vector, moves):
    scale = parametrisation(moves=moves)
    restored = scale.servos(scale.unknowns(from_vector(vector))).vector()
    expected = np.where(scale.free, vector, scale.start.vector())
    np.testing.assert_allclose(restored, expected, rtol=1e-9, atol=1e-9)


@given(VECTORS)
def test_the_derivative_is_that_of_the_numbers(vector):
    servos = from_vector(vector + 0.01)
    x = ALL_FREE.unknowns(servos)
    step = 1e-6
    change = ALL_FREE.servos(x + step).vector() - ALL_FREE.servos(x - step).vector()
    np.testing.assert_allclose(
        change / (2.0 * step), ALL_FREE.derivative(servos), rtol=1e-4, atol=1e-7
    )


BARE = XML.replace(SERVOS, "").replace(' armature=".05"', "")


@pytest.mark.parametrize("xml", [XML, BARE])
def test_a_search_begins_near_the_truth_whatever_the_model_says_of_servos(xml):
    start = parametrisation(xml).start
    for name in ("stiffness", "damping", "armature"):
        number = getattr(start, name)[1]
        assert number == pytest.approx(getattr(TRUTH, name)[1], rel=0.5), name
    assert start.delay == pytest.approx(TRUTH.delay, abs=0.01)


def test_errors_include_those_of_the_links_and_of_the_time_step():
    robot = robot_of(XML)
    moves = np.array([True, True])
    _, loop_fit = servo_fit.initial_parametrisation(robot, [LOG], moves)
    loop_fit = replace(loop_fit, scale_error=np.array([1.0, 0.0]))
    every = np.ones(9, dtype=bool)
    exact = servo_fit.ServoFit(TRUTH, from_vector(np.full(9, 1e-9)), every, np.ones(2))
    errors = servo_fit.add_link_errors(robot, exact, loop_fit, moves).errors
    assert errors.stiffness[0] >= TRUTH.stiffness[0]
    relative = errors.stiffness[1] / TRUTH.stiffness[1]
    assert LINK_ERROR < relative < 1.0
    assert errors.armature[1] >= STEP * TRUTH.damping[1]
    assert errors.delay == pytest.approx(0.5 * STEP)
    still = servo_fit.add_link_errors(robot, exact, loop_fit, ~moves).errors
    assert not np.any(still.vector()[:-1])


def test_held_out_samples_are_not_fitted():
    time = np.arange(500) / 50.0
    q = np.outer(np.sin(time), [1.0, 2.0])
    log = Measurement(time, q, None, 0.0 * q, command=q)
    (fitted,), (held_out,) = split_pieces([log])
    np.testing.assert_array_equal(np.concatenate((fitted.time, held_out.time)), time)
    assert len(held_out) == 100 and fitted.time[-1] < held_out.time[0]


def test_joints_that_do_not_move_keep_the_models_numbers():
    frictionless = XML.replace(' frictionloss=".3"', "")
    friction = parametrisation(frictionless, (True, False)).start.frictionloss
    assert friction[0] > 0.0 and friction[1] == 0.0


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


def fit_small_arm(kp, true_friction, friction):
    """The fit with some friction to the positions of a small arm with its true friction."""
    xml = SMALL.replace("KP", kp)
    servos = replace(servos_in_model(robot_of(xml)), delay=0.02)
    log = log_of(xml, replace(servos, frictionloss=true_friction), steps=20)
    moves = np.array([True, True])
    scale, _ = servo_fit.initial_parametrisation(robot_of(xml), [log], moves)
    problem = make_problem(ServoRollouts(robot_of(xml)), [log])
    return servo_fit.estimate_errors(
        servo_fit.ErrorDerivatives(problem),
        replace(scale, free=np.ones(9, dtype=bool)),
        replace(servos, frictionloss=friction),
    )


def test_commands_in_which_every_rollout_diverges_are_refused(monkeypatch):
    derivatives = servo_fit.ErrorDerivatives(
        make_problem(ServoRollouts(robot_of(XML)), [LOG])
    )
    play = ServoProblem.positions

    def diverge(self, candidates):
        """Yield positions that are NaN from an early step on."""
        for q in play(self, candidates):
            q[:, len(self.edges) // 4 :] = np.nan
            yield q

    monkeypatch.setattr(ServoProblem, "positions", diverge)
    moves = np.array([True, True])
    start, loop_fit = servo_fit.initial_parametrisation(robot_of(XML), [LOG], moves)
    with pytest.raises(InputError, match="cannot be played with these commands"):
        servo_fit.search_shown_numbers(derivatives, start, loop_fit, Progress())


def test_friction_behind_a_stiff_servo_is_not_identified_and_its_error_covers_the_truth():
    truth = np.array([0.13, 0.1])
    for friction in (0.0 * truth, truth):
        fit = fit_small_arm("998", truth, friction)
        assert np.all(np.abs(friction - truth) <= 2.0 * fit.errors.frictionloss)
        assert not np.any(fit.is_identified[4:6])
    fit = fit_small_arm("20", truth, truth)
    assert np.all(fit.is_identified) and np.all(fit.errors.frictionloss < 0.2 * truth)


def test_a_row_counts_no_more_than_rows_in_motion_typically_do():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(1000, 2)) * [1.0, 1e-3]
    moves = np.ones(1000, dtype=bool)
    typical = servo_fit.row_weights(rows, moves)
    assert np.mean(typical) > 0.8
    rows[:9] *= 1e3
    weights = servo_fit.row_weights(rows, moves)
    np.testing.assert_allclose(weights[9:], typical[9:], rtol=0.05)
    assert np.max(np.abs(rows * weights[:, None]) / [1.0, 1e-3]) < 2.0
    with_rest = np.concatenate((rows, 0.0 * rows))
    np.testing.assert_array_equal(
        servo_fit.row_weights(with_rest, np.append(moves, ~moves)),
        np.append(weights, np.ones(1000)),
    )


ROWS = 400
STEPS = 10


@dataclass(frozen=True)
class LinearProblem:
    """Errors of two joints that are linear in every number and in the length of a step."""

    edges: np.ndarray
    slopes: np.ndarray
    noise: np.ndarray
    step_error: float = 0.0
    played: list = field(default_factory=list)

    def is_moving(self):
        return np.ones((ROWS, 2), dtype=bool)

    def errors(self, candidates):
        self.played.extend(candidates)
        length = STEPS / (len(self.edges) - 1)
        step_error = self.step_error * (length - 1.0) * self.slopes[:, :, 0]
        offsets = [servos.vector() - TYPICAL.vector() for servos in candidates]
        return np.array(
            [self.noise + step_error + self.slopes @ offset for offset in offsets]
        )


def linear_problem(step_error=0.0, outlier=0.0):
    """A problem in which each number shows in its own joint alone, the delay in both."""
    rng = np.random.default_rng(0)
    shows = np.append(np.tile(np.eye(2), 4), np.ones((2, 1)), axis=1)
    slopes = 1e-3 * rng.normal(size=(ROWS, 2, 9)) * shows / TYPICAL.vector()
    slopes[ROWS // 2] *= 1.0 + outlier
    noise = 1e-4 * rng.normal(size=(ROWS, 2))
    edges = np.linspace(0.0, 1.0, STEPS + 1)
    return LinearProblem(edges, slopes, noise, step_error)


def linear_errors(**options):
    """The standard errors that such a problem leads to at the typical sizes."""
    derivatives = servo_fit.ErrorDerivatives(linear_problem(**options))
    scale = replace(ALL_FREE, start=TYPICAL)
    return servo_fit.estimate_errors(derivatives, scale, TYPICAL).errors


def test_derivatives_at_the_last_parameters_are_not_played_again():
    problem = linear_problem()
    derivatives = servo_fit.ErrorDerivatives(problem)
    half = replace(ALL_FREE, free=np.arange(9) % 2 == 0)
    slopes = derivatives.at(half, TYPICAL)
    np.testing.assert_array_equal(derivatives.at(ALL_FREE, TYPICAL)[..., ::2], slopes)
    assert len(problem.played) == 2 * 9
    other = from_vector(1.1 * TYPICAL.vector())
    expected = servo_fit.ErrorDerivatives(problem).at(half, other)
    np.testing.assert_array_equal(derivatives.at(half, other), expected)


def test_errors_include_the_change_by_shorter_steps():
    """Half as long they move joint 0 like a stiffness of 20, so without length like 40."""
    exact = linear_errors().stiffness
    coarse = linear_errors(step_error=40.0).stiffness
    assert np.hypot(exact[0], 40.0) == pytest.approx(coarse[0], rel=0.05)
    assert coarse[1] == pytest.approx(exact[1], rel=0.05)


def test_an_outlier_among_the_slopes_does_not_make_errors_smaller():
    plain = linear_errors().vector()
    np.testing.assert_allclose(linear_errors(outlier=1e3).vector(), plain, rtol=0.1)


def test_a_number_that_is_not_identified_is_as_in_the_model_where_that_has_one():
    robot = robot_of(XML)
    bare = robot_of(XML.replace(SERVOS, ""))
    keep = np.arange(9) % 2 == 0
    in_model = servos_in_model(robot).vector()
    mixed = servo_fit.keep_model_values(robot, TRUTH, keep).vector()
    expected = np.where(keep, in_model, TRUTH.vector())
    np.testing.assert_array_equal(mixed[:-1], expected[:-1])
    with_model_values = servo_fit.keep_model_values(bare, TRUTH)
    np.testing.assert_array_equal(with_model_values.stiffness, TRUTH.stiffness)
    np.testing.assert_array_equal(
        with_model_values.frictionloss, servos_in_model(bare).frictionloss
    )
    assert mixed[-1] == with_model_values.delay == TRUTH.delay
