"""The checks that need no bus; those of the motors themselves are in test_runs.py."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.motors.damiao_rig import MotorBus, swing, trajectory_of
from robot_sysid.commands.motors.setup import SetupOptions
from robot_sysid.damiao.bus import inspect_bus
from robot_sysid.damiao.checks.preflight import (
    bus_checks,
    direction_checks,
    loss_checks,
    plan_checks,
    stiffness_checks,
    watchdog_checks,
)
from robot_sysid.damiao.joints import MOTORS, damiao_joints
from robot_sysid.damiao.protocol import BusTiming, Register, bus_load
from robot_sysid.damiao.settings import Plan, PlaySettings
from robot_sysid.errors import InputError
from robot_sysid.records import Limits
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


@given(slope=st.floats(0.0, 200.0), kp=st.floats(1.0, 300.0), load=st.floats(0.0, 9.0))
def test_a_stiffness_with_which_the_arm_topples_is_refused(slope, kp, load):
    rows = rows_of(2, torque=np.array([0.0, load]))
    played = trajectory_of(rows, "DM4340", "DM8009")
    sinking = replace(played, weight_slope=np.array([0.0, slope]))
    plan = Plan(sinking, PlaySettings(kp=(100.0, kp)), BusTiming())
    remarks = [*stiffness_checks(plan)]
    topples = [r for r in remarks if "topples" in r.text]
    assert bool(topples) == (kp < 0.8 * slope)
    assert all(r.level is Level.REFUSES and "motor 2" in r.text for r in topples)
    # What it may sag has to be held by its motor, which makes 40 N m.
    _, tracking = plan.settings.tracking
    assert tracking <= max(0.2, (0.75 * 40.0 - load) / max(slope, 1.0))
    assert tracking == 0.2 or kp > slope
    if topples:
        (text,) = [r.text for r in topples]
        enough = float(re.search(r"--kp of ([\d.]+)", text)[1])
        better = Plan(sinking, PlaySettings(kp=(100.0, enough)), BusTiming())
        assert not [r for r in stiffness_checks(better) if "topples" in r.text]


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
        assert severities(checks, "N·m is beyond what its motor can do") == levels
    for share in (0.999, 1.001):
        top = share * (spec.no_load_rpm or 0.0) * 2 * np.pi / 60
        checks = checks_of(rows_of(1, velocity=top), [name])
        noted = severities(checks, "rad/s is beyond what its motor can do")
        assert noted == [Level.REFUSES] * (top > 0.0 and share > 1.0)


@pytest.mark.parametrize("rate", [2.0, 9.0, 12.5, 250.0])
@pytest.mark.parametrize("timeout", [0.0, 1e-3, 4.9, 20.0])
def test_the_watchdog_that_is_advised_can_be_given_and_lets_the_arm_play(rate, timeout):
    (joint,) = damiao_joints(["DM4310"], 1)
    for check in watchdog_checks(joint, timeout, 1.0 / rate):
        (advised,) = re.findall(r"--watchdog ([\d.]*\d)", check.text)
        # Refuses what cannot be given.
        given = record_from(SetupOptions, {"watchdog": float(advised)})
        checks = watchdog_checks(joint, given.watchdog, 1.0 / rate)
        assert severities(checks, "") in ([], [Level.SAYS])


# --- one row per finding ------------------------------------------------------------------------


def texts(checks, level=Level.REFUSES):
    """What the checks of a level say."""
    return [check.text for check in checks if check.level is level]


def swing_plan(joints=None, **changes):
    """The plan of a short swing of two motors."""
    trajectory = trajectory_of(swing(2, duration=1.0, amplitude=-0.5))
    if joints is not None:
        trajectory = replace(trajectory, joints=joints)
    return replace(Plan(trajectory), **changes)


TWINS = damiao_joints(["DM4340"], 1) * 2
NARROW = Limits(np.array([-0.3, -0.6]), np.array([-0.1, 0.1]))
# At half the speed the joints' accelerations are 2.47 and 9.87 rad/s^2.
SHAKEN = {
    "settings": PlaySettings(speed=0.5),
    "user_limits": Limits(acceleration=np.array([2.5, 9.8])),
}
PLANS = (
    ({"joints": TWINS}, "CAN id 0x01 is used by more than one motor"),
    ({"user_limits": NARROW}, "motor 1: position -0.5 rad is beyond your limit, -0.3, at 0.50 s"),
    ({"model_limits": NARROW}, "rad is beyond the model's limit, -0.3, at 0.50 s; exp"),
    (SHAKEN, "motor 2: acceleration "),
)  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), PLANS)
def test_what_is_wrong_with_a_plan_is_said(changes, message):
    assert texts(plan_checks(swing_plan())) == []
    assert message in texts(plan_checks(swing_plan(**changes)))[0]


def test_a_plan_needs_two_rows():
    with pytest.raises(InputError, match="needs at least two rows to be played"):
        Plan(trajectory_of([signal[:1] for signal in swing(2)]))


ACCEPTED = PlaySettings(accept_register_limits=True)
REGISTERS = (
    ({"TMAX": 20.0}, ACCEPTED, Level.SAYS, "20 but a DM4340 has 12.5, 10, 28: the motor's own"),
    ({"VMAX": 0.3}, ACCEPTED, Level.REFUSES, "rad/s is beyond its registers' limit, 0.3, at"),
    *(({"TMAX": value}, ACCEPTED, Level.REFUSES, f"10, {value:g} but a DM4340 has 12.5, 10, 28; if")
      for value in (0.0, np.nan, np.inf)),
    ({"TIMEOUT": 2e4}, PlaySettings(), Level.SAYS, "watchdog of 1000 ms is long"),
    ({}, PlaySettings(), Level.REFUSES, "motor 1 does not tell its state; its firmware"),
)  # fmt: skip


@pytest.mark.parametrize(("registers", "settings", "level", "message"), REGISTERS)
def test_what_is_wrong_with_a_motor_is_said(registers, settings, level, message):
    bus = MotorBus()
    right = inspect_bus(bus.link)
    plan = replace(swing_plan(), settings=settings)
    assert texts(bus_checks(plan, right)) == []
    changed = {Register[name]: value for name, value in registers.items()}
    motor = right.motors[1]
    feedback = motor.feedback if registers else None
    registers = {**motor.registers, **changed}
    right.motors[1] = replace(motor, registers=registers, feedback=feedback)
    (text,) = texts(bus_checks(plan, right), level)
    assert message in text


@pytest.mark.parametrize(
    ("accepted", "is_model", "level", "message"),
    [
        (False, True, Level.REFUSES, "--joint-map; --accept-directions plays without"),
        (True, True, Level.SAYS, "mirrored or swapped, they would be played like that"),
        (
            False,
            False,
            Level.SAYS,
            "mirrored or swapped, they would be played like that",
        ),
    ],
)
def test_joints_that_nobody_verified_are_said(accepted, is_model, level, message):
    plan = replace(swing_plan(), settings=PlaySettings(accept_directions=accepted))
    holding = SimpleNamespace(unverified_joints=lambda q: [], is_model=is_model)
    assert list(direction_checks(plan, holding)) == []
    holding.unverified_joints = lambda q: plan.trajectory.joints[1:]
    (text,) = texts(direction_checks(plan, holding), level)
    assert text.startswith("nobody has verified which way motor 2 turn")
    assert text.endswith(message)


@pytest.mark.parametrize(
    ("lost", "level"), [(0.0, None), (0.03, Level.SAYS), (0.2, Level.REFUSES)]
)
def test_answers_that_do_not_come_are_said_and_many_forbid_to_play(lost, level):
    bus = MotorBus(damiao_joints(["DM4310"] * 2, 2))
    rng = np.random.default_rng(0)
    motors = []
    for motor in inspect_bus(bus.link).motors.values():
        seconds = np.where(rng.random(200) < lost, np.nan, 1e-3)
        motors.append(replace(motor, answer_times=tuple(seconds)))
    remarks = [*loss_checks(motors)]
    assert [remark.level for remark in remarks] == [level] * (level is not None)
    assert all("requests were not answered" in remark.text for remark in remarks)
