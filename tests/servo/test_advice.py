"""Advice on gains: what it says that a gain leaves is what an arm with that gain leaves."""

from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.servo_fits import servo_fit
from rigs.arms.small_arms import robot_of
from robot_sysid.records.servo_setting import UNKNOWN, ServoSetting
from robot_sysid.servo.advice import (
    ENOUGH,
    TIMES,
    advice_lines,
    advice_of,
    comes_to_rest,
)
from robot_sysid.servo.derived import derived_numbers, largest_weights
from robot_sysid.servo.fit import FIRM, ServoFit
from robot_sysid.servo.unknowns import column
from robot_sysid.simulation.playback import ServoParameters, ServoRollouts, ServoWindow

ARM = """<mujoco><compiler angle="radian"/><worldbody>
<body><joint name="lift" axis="0 1 0" range="-2 2"/>
<inertial pos=".2 0 0" mass=".4" diaginertia="2e-4 5e-4 5e-4"/>
<body pos=".25 0 0"><joint name="roll" axis="1 0 0" range="-2 2"/>
<inertial pos=".02 0 0" mass=".01" diaginertia="1e-5 1e-5 1e-5"/></body></body></worldbody>
<actuator><position joint="lift" kp="20"/><position joint="roll" kp="20"/></actuator></mujoco>"""
"""A joint that carries a link, and one that carries none."""
SLIDE = ARM.replace("joint name", 'joint type="slide" name')
PAST = {"damping": 2.0, "frictionloss": [0.3, 0.01]}
"""Damping with which no gain that is played overshoots, and friction that needs advice at the first
joint alone."""


@pytest.fixture(scope="module")
def robot():
    return robot_of(ARM)


def test_a_damped_joint_gets_the_least_gain_that_leaves_enough(robot):
    fit = servo_fit(robot, **PAST)
    (advice,) = advice_of(robot, fit, ServoSetting(register=16.0))
    left = advice.left[advice.chosen]
    assert advice.joint == "lift" and advice.chosen
    assert max(left.numbers.values()) <= ENOUGH or left.times == TIMES[-1]
    title, line, feed_forward = advice_lines([advice])
    assert title.startswith("Advice")
    assert f"; P = {16 * left.times:g} ({left.times:g} times) would leave " in line
    assert line.startswith("  lift: dead band 0.8") and ", sag 2.3" in line
    assert "takes off the sag" in feed_forward
    (advice,) = advice_of(robot, fit, UNKNOWN)
    assert f"; {left.times:g} times the gain would leave " in advice.line


def test_what_needs_no_advice_gets_none(robot):
    stiff = servo_fit(robot, gain=400.0, damping=30.0, armature=0.05)
    assert advice_of(robot, stiff, UNKNOWN) == []


def test_numbers_that_are_not_known_are_not_advised_on(robot):
    assert advice_of(robot, servo_fit(robot, error=1.0, **PAST), UNKNOWN) == []
    still = replace(servo_fit(robot, **PAST), is_known=np.array([False, True]))
    assert advice_of(robot, still, UNKNOWN) == []


def test_nothing_is_said_in_degrees_of_slides():
    arm = robot_of(SLIDE)
    assert advice_of(arm, servo_fit(arm, **PAST), UNKNOWN) == []


def test_a_joint_that_swings_gets_no_more_gain(robot):
    fit = servo_fit(robot, **{**PAST, "damping": 0.15})
    (advice,) = advice_of(robot, fit, UNKNOWN)
    assert not advice.chosen and advice.swings
    assert advice.line.endswith("degrees; more gain swings")


def test_where_only_some_of_the_possible_numbers_swing_nothing_is_advised(robot):
    """Damping at which the numbers of the fit come to rest, and some that are as likely do not."""
    fit = servo_fit(robot, **{**PAST, "damping": 0.6})
    unsure = fit.given_links.copy()
    unsure[:, column("damping"), column("damping")] = 0.35**2
    fit = replace(fit, given_links=unsure)
    at_rest, is_best_at_rest = comes_to_rest(robot, fit, [0])
    assert is_best_at_rest[1, 0] and at_rest[1, 0] < 0.95
    (advice,) = advice_of(robot, fit, UNKNOWN)
    assert not advice.chosen and not advice.swings
    assert advice.line.endswith("whether more gain swings is not known")


def test_gain_does_not_help_against_play(robot):
    play = servo_fit(
        robot, gain=200.0, damping=20.0, frictionloss=0.01, dead_zone=[0.02, 0.0]
    )
    (advice,) = advice_of(robot, play, UNKNOWN)
    assert not advice.chosen
    assert advice.line.endswith("more gain leaves nearly as much")


def test_what_a_servo_cannot_carry_has_no_sag(robot):
    """It falls, whatever its gain."""
    weak = servo_fit(robot, torque_limit=0.5, **PAST)
    (advice,) = advice_of(robot, weak, UNKNOWN)
    assert set(advice.errors) == {"dead_band"}


@pytest.mark.parametrize("times", TIMES)
def test_numbers_at_a_gain_are_those_of_an_arm_with_that_gain(robot, times):
    now = servo_fit(robot, stribeck=0.05, dead_zone=0.01, **PAST)
    raised = servo_fit(robot, stribeck=0.05, dead_zone=0.01, gain=20.0 * times, **PAST)
    expected = derived_numbers(robot, raised)
    for name, found in derived_numbers(robot, now, times).items():
        np.testing.assert_allclose(found.values, expected[name].values, 1e-9)


def held(robot, fit: ServoFit, times: float):
    """Position errors in which MuJoCo holds the first joint stretched out, reached from below and
    above.
    """
    gain, _, damping, friction, armature = fit.over_gain[:, :5].T
    numbers = np.stack((gain * times, damping * gain, friction * gain, armature * gain))
    limits = np.full(2, 5.0)
    servos = ServoParameters(numbers, 0.0, limits, np.zeros(2), np.full(2, FIRM))
    time = np.array([0.0, 0.1, 3.0])
    edges = np.arange(0.0, 3.0, 0.0005)
    ends = []
    for side in (-1.0, 1.0):
        start = np.array([0.6 * side, 0.0])
        window = ServoWindow(0.0, start, np.zeros(2), time, np.zeros((3, 2)))
        q = ServoRollouts(robot).positions(servos, [window], edges)[0]
        ends.append(-q[-1, 0])
    return ends


@pytest.mark.slow
def test_the_advised_gain_leaves_what_is_said(robot):
    """Of the arm in MuJoCo, which shares no code with what is played here."""
    fit = servo_fit(robot, **PAST)
    (advice,) = advice_of(robot, fit, UNKNOWN)
    for left in (advice.left[0], advice.left[advice.chosen]):
        errors = held(robot, fit, left.times)
        sag = np.mean(errors)
        dead_band = 0.5 * np.ptp(errors)
        assert abs(abs(sag) - left.numbers["sag"]) < 0.05 * left.numbers["sag"] + 1e-4
        assert dead_band <= 1.05 * left.numbers["dead_band"]
    assert largest_weights(robot, robot.thetas)[0][0] == pytest.approx(
        0.4 * 9.81 * 0.2, rel=0.05
    )
