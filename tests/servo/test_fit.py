"""What the errors of servos hold, and what a search leaves alone."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.records import Measurement
from robot_sysid.servo.search import (
    LEAST_SHARE,
    LINKS_WRONG,
    STEP,
    ServoFit,
    first_servos,
    parted,
    with_links_error,
)
from robot_sysid.simulation.servos import Servos
from tests.support.arms import robot_of
from tests.support.servo_logs import SERVOS, TRUTH, XML

NUMBERS = st.lists(st.floats(0.0, 30.0), min_size=9, max_size=9)


def scale(xml=XML, moves=(True, True)):
    robot = robot_of(xml)
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 2))
    return first_servos(robot, q, 0.02, np.array(moves))


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
    x, step = SCALE.unknowns(servos), 1e-6
    moved = SCALE.servos(x + step).vector() - SCALE.servos(x - step).vector()
    np.testing.assert_allclose(moved / (2.0 * step), SCALE.derivative(servos), rtol=1e-4, atol=1e-7)


def test_a_search_begins_at_the_models_numbers_or_at_usual_ones():
    start = SCALE.start
    assert start.stiffness.tolist() == [100.0, 80.0] and start.damping.tolist() == [3.0, 2.0]
    bare = scale(XML.replace(SERVOS, ""))
    assert np.all(bare.start.stiffness > 0.0) and np.all(bare.start.vector() > 0.0)


def test_errors_hold_what_the_links_masses_and_the_time_step_add():
    exact = ServoFit(TRUTH, Servos.of(np.full(9, 1e-9)), np.ones(9), np.ones(2))
    errors = with_links_error(exact, np.array([0.5 * LEAST_SHARE, 1.0])).errors
    assert errors.stiffness[0] == pytest.approx(TRUTH.stiffness[0])
    assert errors.stiffness[1] == pytest.approx(LINKS_WRONG * TRUTH.stiffness[1], rel=0.1)
    assert errors.armature[1] >= STEP * TRUTH.damping[1]
    still = replace(exact, errors=Servos.of(np.zeros(9)))
    assert not np.any(with_links_error(still, np.ones(2)).errors.vector())


def test_what_is_held_out_shares_no_sample_with_what_is_fitted():
    time = np.arange(500) / 50.0
    q = np.outer(np.sin(time), [1.0, 2.0])
    log = Measurement(time, q, None, 0.0 * q, command=q)
    (fitted,), (held,) = parted([log])
    np.testing.assert_array_equal(np.concatenate((fitted.time, held.time)), time)
    assert len(held) == 100 and fitted.time[-1] < held.time[0]


def test_joints_that_do_not_move_keep_the_models_numbers():
    bare = XML.replace(' frictionloss=".3"', "")
    own = scale(bare, (True, False)).start
    assert own.frictionloss[0] > 0.0 and own.frictionloss[1] == 0.0
