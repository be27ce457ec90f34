"""Torque limits and dead zones of servos: seen where they are, and not where they are not."""

import numpy as np
import pytest

from rigs.arms.small_arms import robot_of
from rigs.logs.servo_logs import positions, sines_and_steps
from robot_sysid.records import Recording
from robot_sysid.servo.fit import fit_servos
from robot_sysid.simulation.playback import ServoParameters

ARM = """<mujoco><worldbody><body><joint name="lift" axis="0 1 0" damping=".1"/>
<inertial pos=".1 0 .02" mass=".3" diaginertia="2e-4 5e-4 5e-4"/></body></worldbody>
<actuator><position joint="lift" kp="20"{limit}/></actuator></mujoco>"""
NUMBERS = np.array([[16.0], [0.4], [0.05], [0.03]])


def fit(delay=0.035, dead_zone=0.0, limit=""):
    """The fit to a log of a servo, to a model that does not know its limit."""
    truth = ServoParameters(NUMBERS, delay, np.array([dead_zone]))
    time, command = sines_and_steps(10.0)
    command = 1.5 * command[:, :1]
    arm = robot_of(ARM.format(limit=limit))
    q = positions(arm, time, command, truth, steps=20)
    piece = Recording(time, q, None, command - q, command=command)
    return fit_servos(robot_of(ARM.format(limit="")), [piece])


@pytest.mark.parametrize("dead_zone", [0.0, np.radians(0.5)])
def test_a_dead_zone_is_found_where_there_is_one(dead_zone):
    found = fit(dead_zone=dead_zone)
    if not dead_zone:
        assert not found.dead_zones.any() and not found.dead_zone_errors.any()
    else:
        error = found.dead_zone_errors[0]
        assert 0.0 < error < 0.2 * dead_zone
        assert abs(found.dead_zones[0] - dead_zone) < 2.0 * error
    assert not found.limited_share.any() and found.is_known.all()
    assert np.all(np.abs(found.numbers - NUMBERS) < 2.0 * found.errors)
    assert abs(found.delay - 0.035) < 2.0 * found.delay_error


@pytest.mark.parametrize("seed", range(2))
def test_friction_that_sticks_at_each_turn_is_no_dead_zone(seed):
    """Of a joint that carries no link, it looks like one of 0.4 degrees where it sticks."""
    truth = ServoParameters(
        np.array([[16.0], [0.6], [0.3], [0.03]]), 0.035, np.zeros(1)
    )
    time, command = sines_and_steps(10.0, seed)
    command = 1.5 * command[:, :1]
    pan = robot_of(ARM.replace('axis="0 1 0"', 'axis="0 0 1"').format(limit=""))
    q = positions(pan, time, command, truth, steps=20)
    found = fit_servos(pan, [Recording(time, q, None, command - q, command=command)])
    assert not found.dead_zones.any()
    assert np.all(np.abs(found.numbers - truth.numbers) < 2.0 * found.errors)


def test_moments_at_a_torque_limit_are_left_out():
    """They would make the delay too long and the damping too small."""
    found = fit(limit=' forcerange="-2 2"')
    assert 0.02 < found.limited_share[0] < 0.5 and found.is_known.all()
    assert not found.dead_zones.any()
    assert found.numbers[:2] == pytest.approx(NUMBERS[:2], rel=0.1)
    assert abs(found.delay - 0.035) < 2.0 * found.delay_error < 3e-3


def test_a_delay_is_not_known_where_servos_are_often_at_their_limits():
    """What is left of such a log may fit a delay that is tens of milliseconds off."""
    found = fit(limit=' forcerange="-1.1 1.1"')
    assert 0.3 < found.limited_share[0] < 0.5 and found.is_known.all()
    assert found.delay_error == np.inf and np.isfinite(found.errors).all()


def test_a_servo_that_is_nearly_always_at_its_limit_keeps_the_models_numbers():
    found = fit(limit=' forcerange="-.6 .6"')
    assert not found.is_known.any() and found.delay_error == np.inf


def test_a_delay_of_a_third_of_a_second_is_found():
    found = fit(delay=0.33)
    assert abs(found.delay - 0.33) < 2.0 * found.delay_error
