"""The checks that need no bus; those of the motors themselves are in test_runs.py."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.damiao_rig import trajectory_of
from robot_sysid.commands.motors.setup import SetupOptions
from robot_sysid.damiao.joints import MOTORS
from robot_sysid.damiao.preflight import plan_checks, watchdog_checks
from robot_sysid.damiao.protocol import BusTiming, bus_load
from robot_sysid.damiao.settings import Plan, PlaySettings
from robot_sysid.records.messages import Level
from robot_sysid.records.option_fields import record_from


def rows_of(n, position=0.0, velocity=0.0, torque=0.0, seconds=1.0):
    """(time, q, qd, tau) of n joints that rise to these peaks (n,) one after the other."""
    risen = np.tril(np.ones((n + 1, n)), -1)
    time = np.cumsum([0.0, *(seconds * np.ones(n))])
    return time, position * risen, velocity * risen, torque * risen


def checks_of(rows, types, timing=None, **settings):
    """What is said to what the checks look at of a plan, without a trajectory file."""
    played = trajectory_of(rows, *types)
    plan = Plan(played, PlaySettings(**settings), timing or BusTiming())
    return [*plan_checks(plan)]


def severities(checks, words):
    """The severity of each check whose text contains these words."""
    return [check.level for check in checks if words in check.text]


@given(worst=st.floats(0.0, 0.2), speed=st.floats(0.05, 1.0))
def test_both_ends_have_to_be_at_rest_at_the_speed_they_are_played_at(worst, speed):
    rows = rows_of(2, velocity=np.array([0.0, worst]))
    checks = checks_of(rows, ["DM4340"] * 2, speed=speed)
    assert severities(checks, "at rest") == [Level.REFUSES] * (worst * speed > 0.05)


@given(rate=st.floats(10.0, 3000.0), n=st.integers(1, 8), fd=st.booleans())
def test_a_bus_that_is_too_full_is_refused(rate, n, fd):
    timing = BusTiming(fd=fd)
    checks = checks_of(rows_of(n), ["DM4340"] * n, timing, rate=rate)
    full = bus_load(n, rate, timing) > 0.7
    assert severities(checks, " load ") == [Level.REFUSES] * full
    assert severities(checks, "use --rate") == [Level.REFUSES] * full


@pytest.mark.parametrize("name", ["DM4340", "DM6248", "DMS3519"])
def test_what_a_motor_cannot_do_is_refused_and_what_is_beyond_its_rating_noted(name):
    spec = MOTORS[name]
    for torque, levels in (
        (spec.rated_torque, [Level.SAYS]),
        (spec.peak_torque, [Level.REFUSES, Level.SAYS]),
    ):
        checks = checks_of(rows_of(1, torque=1.001 * torque), [name])
        assert severities(checks, f"N·m is beyond what a {name} can do") == levels
    for share in (0.999, 1.001):
        top = share * (spec.no_load_rpm or 0.0) * 2 * np.pi / 60
        checks = checks_of(rows_of(1, velocity=top), [name])
        noted = severities(checks, f"rad/s is beyond what a {name} can do")
        assert noted == [Level.REFUSES] * (top > 0.0 and share > 1.0)


@pytest.mark.parametrize("rate", [2.0, 9.0, 12.5, 250.0])
@pytest.mark.parametrize("timeout", [0.0, 1e-3, 4.9, 20.0])
def test_the_watchdog_that_is_advised_can_be_given_and_lets_the_arm_play(rate, timeout):
    for check in watchdog_checks("motor 1", timeout, 1.0 / rate):
        (advised,) = re.findall(r"--watchdog ([\d.]*\d)", check.text)
        # Refuses what cannot be given.
        given = record_from(SetupOptions, {"watchdog": float(advised)})
        checks = watchdog_checks("motor 1", given.watchdog, 1.0 / rate)
        assert severities(checks, "") in ([], [Level.SAYS])
